//! Built-in depth features: dense descriptors of a depth map that need no weights and no download.
//!
//! Around every grid pixel a lattice of fixed *metric* size is laid (its spacing in pixels follows the depth), at three
//! sizes. At each lattice point stand the depth relative to the centre, clipped to the lattice's size, and the surface
//! normal in the camera's frame; where nothing was seen both are zero, so holes neither attract nor repel, and so are
//! the normals of surfaces far before or behind the centre, which parallax moves. The low frequencies of a cosine
//! transform over the lattice are kept: they carry the similarity of the patches in a quarter of the numbers. Both maps
//! of a view come from the same virtual camera with a small parallax, which makes upright descriptors fair.

mod surface;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, FeatureMap, LayeredFeatures};
use crate::depth_features::surface::{Surface, THINNING};
use crate::encode::DepthEncoder;
use crate::error::{Error, Result};

/// What stands at one lattice point: weighted relative depth and the normal.
const CHANNELS: usize = 4;
/// Surfaces further before or behind the centre than this many lattice radii show no normal.
const NORMAL_REACH: f32 = 1.5;

/// The settings of the built-in encoder. Lengths are metres.
///
/// ```
/// use rare::{DepthMap, Intrinsics, depth_features::DepthFeatures, encode::DepthEncoder};
/// let intrinsics = Intrinsics { width: 80, height: 60, fx: 80.0, fy: 80.0, cx: 40.0, cy: 30.0 };
/// let wall = DepthMap::new(intrinsics, vec![2.0; 80 * 60])?;
/// let encoder = DepthFeatures::for_voxel(0.05);
/// let layers = encoder.encode(&[wall])?.remove(0);
/// assert_eq!((layers[0].channels(), layers[0].height(), layers[0].width()), (252, 6, 8));
/// # Ok::<(), rare::Error>(())
/// ```
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
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> Result<Vec<LayeredFeatures>> {
        self.validate()?;
        let cosines = Cosines::new(self.lattice, self.frequencies);
        maps.par_iter().map(|(_, map)| Ok(vec![self.describe(map, &cosines)?])).collect()
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
        // In pixels of the thinned surface.
        let thinned = |position: f32| position / THINNING as f32;
        let (left, top) = (thinned(u as f32 - half * step), thinned(v as f32 - half * step));
        let (step, per_radius) = (thinned(step), 1.0 / radius);
        for (row, points) in patch.chunks_exact_mut(self.lattice).enumerate() {
            let pixels = surface.row(nearest_pixel(top + row as f32 * step, surface.height));
            for (column, point) in points.iter_mut().enumerate() {
                let x = nearest_pixel(left + column as f32 * step, surface.width);
                *point = self.sample(pixels[x], centre, per_radius);
            }
        }
    }

    fn sample(
        &self,
        [x, y, z, depth]: [f32; CHANNELS],
        centre: f32,
        per_radius: f32,
    ) -> [f32; CHANNELS] {
        let relative = (depth - centre) * per_radius;
        let seen = if depth > 0.0 { self.depth_weight } else { 0.0 };
        let near = if relative.abs() > NORMAL_REACH { 0.0 } else { 1.0 };
        [relative.clamp(-1.0, 1.0) * seen, x * near, y * near, z * near]
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
    /// Those whose indices add up to less are kept; may be more than the basis has.
    frequencies: usize,
    /// At most `lattice` frequencies, each `lattice` long.
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
        let of_lattice = |frequency| (0..lattice).map(move |position| value(frequency, position));
        let basis = (0..frequencies.min(lattice)).flat_map(of_lattice).collect();
        Cosines { lattice, frequencies, basis }
    }

    /// Transforms a lattice of points; coefficients whose indices add up to less than the number of frequencies, each
    /// with all channels. `sums` is working memory, one row of the lattice.
    fn transform(&self, patch: &[[f32; CHANNELS]], sums: &mut [[f32; CHANNELS]], out: &mut [f32]) {
        let mut out = out.chunks_exact_mut(CHANNELS);
        for (down, basis_down) in self.basis.chunks_exact(self.lattice).enumerate() {
            sums.fill([0.0; CHANNELS]);
            for (weight, row) in basis_down.iter().zip(patch.chunks_exact(self.lattice)) {
                for (sum, point) in sums.iter_mut().zip(row) {
                    add_scaled(sum, *weight, point);
                }
            }
            for basis_across in self.basis.chunks_exact(self.lattice).take(self.frequencies - down)
            {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Intrinsics;

    const SIDE: usize = 210;

    /// A hilly surface around 2 m of depth, seen by a camera that has moved forward by `forward` metres.
    fn hills(forward: f64) -> DepthMap {
        let centre = (SIDE / 2) as f64;
        let intrinsics =
            Intrinsics { width: SIDE, height: SIDE, fx: 240.0, fy: 240.0, cx: centre, cy: centre };
        let surface =
            |x: f64, y: f64| 2.0 + 0.06 * (9.0 * x).sin() * (7.0 * y + 0.4).cos() + 0.1 * x;
        let depth = |pixel: usize| {
            let at = |side: usize| (side as f64 - centre) / 240.0;
            let (x, y) = (at(pixel % SIDE), at(pixel / SIDE));
            (0..30).fold(2.0 - forward, |depth, _| surface(x * depth, y * depth) - forward) as f32
        };
        DepthMap::new(intrinsics, (0..SIDE * SIDE).map(depth).collect()).unwrap()
    }

    /// The descriptors of all cells, row by row.
    fn descriptors(map: &DepthMap) -> Vec<Vec<f32>> {
        let encoder = DepthFeatures::for_voxel(0.05);
        let features = encoder.encode(std::slice::from_ref(map)).unwrap().remove(0).remove(0);
        let cells = features.height() * features.width();
        assert_eq!((features.channels(), cells), (encoder.dimension(), 21 * 21));
        let channel = |cell: usize| features.values().iter().skip(cell).step_by(cells).copied();
        (0..cells).map(|cell| channel(cell).collect()).collect()
    }

    /// The cell in the middle of the image: the point on the optical axis.
    const MIDDLE: usize = 21 * 10 + 10;

    fn similarity(a: &[f32], b: &[f32]) -> f32 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    #[test]
    fn the_dimension_counts_the_low_frequencies_of_all_lattices_and_channels() {
        // 6 + 5 + 4 + 3 + 2 + 1 = 21 of 81.
        assert_eq!(DepthFeatures::for_voxel(0.05).dimension(), 3 * 21 * 4);
        let with = |lattice, frequencies| {
            let settings = DepthFeatures::for_voxel(0.05);
            DepthFeatures { lattice, frequencies, radii: vec![0.1], ..settings }
        };
        // Not more frequencies than points: 3 + 3 + 3, or 3 + 2 + 1.
        assert_eq!((with(3, 9).coefficients(), with(3, 3).coefficients()), (9, 6));
        assert_eq!(with(3, 9).dimension(), 9 * 4);
        let map = hills(0.0);
        for settings in [with(3, 9), with(3, 4), with(5, 1)] {
            let features = settings.encode(std::slice::from_ref(&map)).unwrap().remove(0).remove(0);
            let last = features.channel(settings.dimension() - CHANNELS).unwrap();
            assert!(last.iter().any(|&value| value != 0.0), "{settings:?}: no last coefficient");
        }
    }

    #[test]
    fn descriptors_have_unit_length_and_cells_without_depth_none() {
        let mut map = hills(0.0);
        let holes = [105 * SIDE + 105, 5 * SIDE + 205];
        for pixel in holes {
            map.depth_mut()[pixel] = 0.0;
        }
        for (cell, descriptor) in descriptors(&map).iter().enumerate() {
            let norm = similarity(descriptor, descriptor).sqrt();
            let expected = if [MIDDLE, 20].contains(&cell) { 0.0 } else { 1.0 };
            assert!((norm - expected).abs() < 1e-4, "{cell}: {norm}");
        }
        let empty = descriptors(&DepthMap::empty(*map.intrinsics()));
        assert!(empty.iter().flatten().all(|&value| value == 0.0));
    }

    #[test]
    fn a_place_looks_the_same_from_nearer_by() {
        let (far, near) = (descriptors(&hills(0.0)), descriptors(&hills(0.9)));
        let same = similarity(&far[MIDDLE], &near[MIDDLE]);
        let other = similarity(&far[MIDDLE], &near[MIDDLE + 4]);
        assert!(same > 0.95 && other < same - 0.05, "{same} {other}");
        let nearest = |cells: &[Vec<f32>]| {
            let to = |cell: &usize| similarity(&far[MIDDLE], &cells[*cell]);
            (0..cells.len()).max_by(|a, b| to(a).total_cmp(&to(b)))
        };
        assert_eq!(nearest(&near), Some(MIDDLE));
    }

    #[test]
    fn holes_neither_attract_nor_repel() {
        let (whole, mut holed) = (hills(0.0), hills(0.0));
        // Right of the middle nothing is seen: two fifths of the largest lattice.
        for row in holed.depth_mut().chunks_exact_mut(SIDE) {
            row[112..].fill(0.0);
        }
        let (whole, holed) = (descriptors(&whole), descriptors(&holed));
        let same = similarity(&whole[MIDDLE], &holed[MIDDLE]);
        assert!(same > 0.7, "{same}");
        // Two places with the same hole at their side are no more alike than before.
        let alike = |cells: &[Vec<f32>]| similarity(&cells[MIDDLE], &cells[MIDDLE - 21 * 5]);
        assert!(alike(&holed) < alike(&whole) + 0.05, "{} {}", alike(&whole), alike(&holed));
    }

    #[test]
    fn settings_that_make_no_sense_are_refused() {
        let good = || DepthFeatures::for_voxel(0.05);
        for bad in [
            DepthFeatures { stride: 0, ..good() },
            DepthFeatures { lattice: 1, ..good() },
            DepthFeatures { frequencies: 0, ..good() },
            DepthFeatures { radii: Vec::new(), ..good() },
        ] {
            let message = bad.encode(&[]).unwrap_err().to_string();
            assert!(message.contains("make no sense"), "{message}");
        }
        assert!(good().encode(&[]).unwrap().is_empty());
    }
}
