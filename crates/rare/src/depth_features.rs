//! Built-in depth features: dense descriptors of a depth map that need no weights and no download.
//!
//! Around every grid pixel a lattice of fixed *metric* size is laid (its spacing in pixels follows the depth), at three
//! sizes. At each lattice point stand the depth relative to the centre, clipped to the lattice's size, and the surface
//! normal in the camera's frame; where nothing was seen both are zero, so holes neither attract nor repel, and so are
//! the normals of surfaces far before or behind the centre, which parallax moves. The low frequencies of a cosine
//! transform over the lattice are kept: they carry the similarity of the patches in a quarter of the numbers. Both maps
//! of a view come from the same virtual camera with a small parallax, which makes upright descriptors fair.

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, FeatureMap, LayeredFeatures};
use crate::encode::DepthEncoder;
use crate::error::{Error, Result};

/// What stands at one lattice point: weighted relative depth and the normal.
const CHANNELS: usize = 4;
/// Surfaces further before or behind the centre than this many lattice radii show no normal.
const NORMAL_REACH: f32 = 1.5;
/// The smallest and the largest half baseline of a normal, pixels.
const BASELINE_PIXELS: (usize, usize) = (2, 16);

/// The settings of the built-in encoder. Lengths are metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DepthFeatures {
    /// Pixels between neighbouring cells of the feature map.
    pub stride: usize,
    /// Half side lengths of the lattices, metres.
    pub radii: Vec<f64>,
    /// Points along a side of a lattice.
    pub lattice: usize,
    /// Frequencies kept: those whose indices along the two sides add up to less.
    pub frequencies: usize,
    /// Weight of the relative depth against the unit normal.
    pub depth_weight: f32,
    /// Half the baseline over which normals are taken, metres.
    pub normal_baseline: f64,
}

impl DepthFeatures {
    /// Lattices of 2, 4 and 8 voxels, a cell every 10 pixels: with 5 cm voxels 0.1 m, 0.2 m and 0.4 m.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> DepthFeatures {
        DepthFeatures {
            stride: 10,
            radii: vec![2.0 * voxel, 4.0 * voxel, 8.0 * voxel],
            lattice: 9,
            frequencies: 6,
            depth_weight: 0.7,
            normal_baseline: 0.4 * voxel,
        }
    }

    /// Numbers per cell.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.radii.len() * self.coefficients() * CHANNELS
    }

    /// Coefficients per lattice and channel.
    fn coefficients(&self) -> usize {
        let kept = |row: usize| self.frequencies.saturating_sub(row).min(self.lattice);
        (0..self.frequencies.min(self.lattice)).map(kept).sum()
    }

    fn validate(&self) -> Result<()> {
        if self.stride == 0 || self.lattice < 2 || self.frequencies == 0 || self.radii.is_empty() {
            return Err(Error::invalid(format!(
                "the settings of the built-in depth features make no sense: {self:?}"
            )));
        }
        Ok(())
    }
}

impl DepthEncoder for DepthFeatures {
    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        self.validate()?;
        let cosines = Cosines::new(self.lattice, self.frequencies);
        maps.par_iter().map(|map| Ok(vec![self.describe(map, &cosines)?])).collect()
    }
}

impl DepthFeatures {
    /// One map: `dimension x (height / stride) x (width / stride)`; a cell without depth is all zero.
    fn describe(&self, map: &DepthMap, cosines: &Cosines) -> Result<FeatureMap> {
        let rows = (map.height() / self.stride).max(1);
        let columns = (map.width() / self.stride).max(1);
        let (cells, dimension) = (rows * columns, self.dimension());
        let surface = Surface::new(map, self.normal_baseline);
        let mut values = vec![0.0_f32; dimension * cells];
        let mut band = vec![0.0_f32; dimension * columns];
        for row in 0..rows {
            self.describe_row(&surface, row * self.stride + self.stride / 2, cosines, &mut band);
            // Cells of a row lie side by side in each channel: one band at a time keeps the writes together.
            for (channel, image) in values.chunks_exact_mut(cells).enumerate() {
                let cells_of_row = &mut image[row * columns..(row + 1) * columns];
                for (value, descriptor) in cells_of_row.iter_mut().zip(band.chunks_exact(dimension))
                {
                    *value = descriptor[channel];
                }
            }
        }
        FeatureMap::new(dimension, rows, columns, values)
    }

    /// The unit descriptors of one row of cells, `columns x dimension`.
    fn describe_row(&self, surface: &Surface<'_>, v: usize, cosines: &Cosines, band: &mut [f32]) {
        let dimension = self.dimension();
        let of_radius = dimension / self.radii.len();
        let mut patch = vec![[0.0_f32; CHANNELS]; self.lattice * self.lattice];
        let mut sums = vec![[0.0_f32; CHANNELS]; self.lattice];
        for (cell, descriptor) in band.chunks_exact_mut(dimension).enumerate() {
            let u = cell * self.stride + self.stride / 2;
            descriptor.fill(0.0);
            if surface.map.at(u, v) <= 0.0 {
                continue;
            }
            for (&radius, out) in self.radii.iter().zip(descriptor.chunks_exact_mut(of_radius)) {
                self.sample_patch(surface, (u, v), radius as f32, &mut patch);
                cosines.transform(&patch, &mut sums, out);
            }
            let norm = descriptor.iter().map(|value| value * value).sum::<f32>().sqrt() + 1e-6;
            descriptor.iter_mut().for_each(|value| *value /= norm);
        }
    }

    /// The lattice of half side `radius` around a pixel, row by row; clamped to the image.
    fn sample_patch(
        &self,
        surface: &Surface<'_>,
        (u, v): (usize, usize),
        radius: f32,
        patch: &mut [[f32; CHANNELS]],
    ) {
        let map = surface.map;
        let centre = map.at(u, v);
        let half = (self.lattice - 1) as f32 / 2.0;
        let step = radius * map.intrinsics().fx as f32 / centre / half;
        let (left, top) = (u as f32 - half * step, v as f32 - half * step);
        for (row, points) in patch.chunks_exact_mut(self.lattice).enumerate() {
            let y = nearest_pixel(top + row as f32 * step, map.height());
            let pixels = &surface.pixels[y * map.width()..(y + 1) * map.width()];
            for (column, point) in points.iter_mut().enumerate() {
                let x = nearest_pixel(left + column as f32 * step, map.width());
                *point = self.sample(pixels[x], centre, radius);
            }
        }
    }

    fn sample(
        &self,
        [x, y, z, depth]: [f32; CHANNELS],
        centre: f32,
        radius: f32,
    ) -> [f32; CHANNELS] {
        if depth <= 0.0 {
            return [0.0; CHANNELS];
        }
        let relative = (depth - centre) / radius;
        let facing = if relative.abs() > NORMAL_REACH { 0.0 } else { 1.0 };
        [relative.clamp(-1.0, 1.0) * self.depth_weight, x * facing, y * facing, z * facing]
    }
}

/// The nearest pixel of a side of `size`; positions outside are clamped. (Casting saturates and truncates, which is
/// rounding here, and far cheaper.)
fn nearest_pixel(position: f32, size: usize) -> usize {
    ((position + 0.5) as usize).min(size - 1)
}

/// The low frequencies of the orthonormal cosine transform (DCT-II) along one side of a lattice.
struct Cosines {
    lattice: usize,
    /// `frequencies x lattice`.
    basis: Vec<f32>,
}

impl Cosines {
    fn new(lattice: usize, frequencies: usize) -> Cosines {
        let n = lattice as f64;
        let value = |frequency: usize, position: usize| {
            let scale = if frequency == 0 { (1.0 / n).sqrt() } else { (2.0 / n).sqrt() };
            let angle = std::f64::consts::PI * (position as f64 + 0.5) * frequency as f64 / n;
            (scale * angle.cos()) as f32
        };
        let frequencies = frequencies.min(lattice);
        let basis = (0..frequencies).flat_map(|k| (0..lattice).map(move |i| value(k, i))).collect();
        Cosines { lattice, basis }
    }

    /// Transforms a lattice of points; coefficients whose indices add up to less than the number of frequencies, each
    /// with all channels. `sums` is working memory, one row of the lattice.
    fn transform(&self, patch: &[[f32; CHANNELS]], sums: &mut [[f32; CHANNELS]], out: &mut [f32]) {
        let frequencies = self.basis.len() / self.lattice;
        let mut out = out.chunks_exact_mut(CHANNELS);
        for (down, basis_down) in self.basis.chunks_exact(self.lattice).enumerate() {
            sums.fill([0.0; CHANNELS]);
            for (weight, row) in basis_down.iter().zip(patch.chunks_exact(self.lattice)) {
                for (sum, point) in sums.iter_mut().zip(row) {
                    add_scaled(sum, *weight, point);
                }
            }
            for basis_across in self.basis.chunks_exact(self.lattice).take(frequencies - down) {
                let mut coefficient = [0.0; CHANNELS];
                for (weight, sum) in basis_across.iter().zip(&*sums) {
                    add_scaled(&mut coefficient, *weight, sum);
                }
                if let Some(out) = out.next() {
                    out.copy_from_slice(&coefficient);
                }
            }
        }
    }
}

fn add_scaled(sum: &mut [f32; CHANNELS], weight: f32, point: &[f32; CHANNELS]) {
    for (sum, value) in sum.iter_mut().zip(point) {
        *sum += weight * value;
    }
}

/// What is seen at each pixel of a depth map: the unit normal in the camera's frame (zero where a neighbour is
/// missing), then the depth.
struct Surface<'a> {
    map: &'a DepthMap,
    pixels: Vec<[f32; CHANNELS]>,
}

impl<'a> Surface<'a> {
    fn new(map: &'a DepthMap, baseline: f64) -> Surface<'a> {
        let mut pixels = vec![[0.0; CHANNELS]; map.depth().len()];
        let focal_baseline = (baseline * map.intrinsics().fx) as f32;
        let rays = Rays::new(map);
        let (least, most) = BASELINE_PIXELS;
        for (v, row) in pixels.chunks_exact_mut(map.width()).enumerate() {
            for (u, pixel) in row.iter_mut().enumerate() {
                let depth = map.depth()[v * map.width() + u];
                if depth > 0.0 {
                    let step = ((focal_baseline / depth) as usize).clamp(least, most);
                    let [x, y, z] = rays.normal(u, v, step).unwrap_or([0.0; 3]);
                    *pixel = [x, y, z, depth];
                }
            }
        }
        Surface { map, pixels }
    }
}

/// The viewing rays of a map's columns and rows, at depth 1.
struct Rays<'a> {
    map: &'a DepthMap,
    x: Vec<f32>,
    y: Vec<f32>,
}

impl<'a> Rays<'a> {
    fn new(map: &'a DepthMap) -> Rays<'a> {
        let camera = map.intrinsics();
        let axis = |size, centre: f64, focal: f64| {
            (0..size).map(|i| ((i as f64 - centre) / focal) as f32).collect()
        };
        Rays {
            map,
            x: axis(map.width(), camera.cx, camera.fx),
            y: axis(map.height(), camera.cy, camera.fy),
        }
    }

    /// The normal from the four neighbours `step` pixels away; `None` at the border and beside holes.
    fn normal(&self, u: usize, v: usize, step: usize) -> Option<[f32; 3]> {
        let (left, top) = (u.checked_sub(step)?, v.checked_sub(step)?);
        let across = self.point(u + step, v)? - self.point(left, v)?;
        let down = self.point(u, v + step)? - self.point(u, top)?;
        let normal = across.cross(&down);
        let length = normal.norm();
        (length > 0.0).then(|| (normal / length).into())
    }

    fn point(&self, u: usize, v: usize) -> Option<Vector3<f32>> {
        let (x, y) = (self.x.get(u)?, self.y.get(v)?);
        let depth = *self.map.depth().get(v * self.map.width() + u)?;
        (depth > 0.0).then(|| Vector3::new(x * depth, y * depth, depth))
    }
}
