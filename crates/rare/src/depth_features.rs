//! Built-in depth features: dense descriptors of a depth map that need no weights and no download.
//!
//! Around every grid pixel a lattice of fixed *metric* size is laid (its spacing in pixels follows the depth), at two
//! sizes. At each lattice point stand the depth relative to the centre, clipped to the lattice's size, and the surface
//! normal in the camera's frame; where nothing was seen both are zero, so holes neither attract nor repel. Both maps
//! of a view come from the same virtual camera with a small parallax, which makes upright descriptors fair.

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::data::{DepthMap, FeatureMap, LayeredFeatures};
use crate::encode::DepthEncoder;
use crate::error::Result;

/// The settings of the built-in encoder. Lengths are metres.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DepthFeatures {
    /// Pixels between neighbouring cells of the feature map.
    pub stride: usize,
    /// Half side lengths of the lattices, metres.
    pub radii: Vec<f64>,
    /// Points along a side of a lattice.
    pub lattice: usize,
    /// Weight of the relative depth against the unit normal.
    pub depth_weight: f32,
    /// Half the baseline over which normals are taken, metres.
    pub normal_baseline: f64,
}

impl DepthFeatures {
    /// Lattices of 3 and 7 voxels, a cell every 10 pixels: with 5 cm voxels 0.15 m and 0.35 m.
    #[must_use]
    pub fn for_voxel(voxel: f64) -> DepthFeatures {
        DepthFeatures {
            stride: 10,
            radii: vec![3.0 * voxel, 7.0 * voxel],
            lattice: 7,
            depth_weight: 0.7,
            normal_baseline: 0.3 * voxel,
        }
    }

    /// Numbers per cell.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.radii.len() * self.lattice * self.lattice * 4
    }
}

impl DepthEncoder for DepthFeatures {
    fn encode(&self, maps: &[DepthMap]) -> Result<Vec<LayeredFeatures>> {
        maps.par_iter().map(|map| Ok(vec![self.describe(map)?])).collect()
    }
}

impl DepthFeatures {
    /// One map: `dimension x (height / stride) x (width / stride)`; a cell without depth is all zero.
    fn describe(&self, map: &DepthMap) -> Result<FeatureMap> {
        let (rows, columns) = ((map.height() / self.stride).max(1), (map.width() / self.stride).max(1));
        let normals = NormalMap::new(map, self.normal_baseline);
        let cells = rows * columns;
        let mut values = vec![0.0_f32; self.dimension() * cells];
        let mut descriptor = vec![0.0_f32; self.dimension()];
        for cell in 0..cells {
            let u = (cell % columns) * self.stride + self.stride / 2;
            let v = (cell / columns) * self.stride + self.stride / 2;
            if map.at(u, v) > 0.0 {
                self.describe_pixel(map, &normals, u, v, &mut descriptor);
                for (channel, &value) in descriptor.iter().enumerate() {
                    values[channel * cells + cell] = value;
                }
            }
        }
        FeatureMap::new(self.dimension(), rows, columns, values)
    }

    fn describe_pixel(&self, map: &DepthMap, normals: &NormalMap, u: usize, v: usize, descriptor: &mut [f32]) {
        let depth = map.at(u, v);
        let focal = map.intrinsics().fx as f32;
        let half = (self.lattice.max(2) - 1) as f32 / 2.0;
        let mut out = descriptor.chunks_exact_mut(4);
        for &radius in &self.radii {
            let radius = radius as f32;
            let step = radius * focal / depth / half;
            for row in 0..self.lattice {
                for column in 0..self.lattice {
                    let x = u as f32 + (column as f32 - half) * step;
                    let y = v as f32 + (row as f32 - half) * step;
                    if let Some(out) = out.next() {
                        out.copy_from_slice(&self.sample(map, normals, (x, y), depth, radius));
                    }
                }
            }
        }
        let norm = descriptor.iter().map(|value| value * value).sum::<f32>().sqrt() + 1e-6;
        descriptor.iter_mut().for_each(|value| *value /= norm);
    }

    /// Relative depth and normal at real-valued pixel coordinates, clamped to the image.
    fn sample(&self, map: &DepthMap, normals: &NormalMap, (x, y): (f32, f32), centre: f32, radius: f32) -> [f32; 4] {
        let u = (x.round().max(0.0) as usize).min(map.width() - 1);
        let v = (y.round().max(0.0) as usize).min(map.height() - 1);
        let depth = map.at(u, v);
        if depth <= 0.0 {
            return [0.0; 4];
        }
        let relative = ((depth - centre) / radius).clamp(-1.0, 1.0);
        let normal = normals.normals[v * map.width() + u];
        [relative * self.depth_weight, normal[0], normal[1], normal[2]]
    }
}

/// Unit normals of a depth map in the camera's frame; zero where a neighbour is missing.
struct NormalMap {
    normals: Vec<[f32; 3]>,
}

impl NormalMap {
    fn new(map: &DepthMap, baseline: f64) -> NormalMap {
        let (width, height) = (map.width(), map.height());
        let normals = (0..width * height)
            .map(|index| normal_at(map, index % width, index / width, baseline).unwrap_or([0.0; 3]))
            .collect();
        NormalMap { normals }
    }
}

/// The normal from the four neighbours at a fixed metric distance (at least 2 pixels).
fn normal_at(map: &DepthMap, u: usize, v: usize, baseline: f64) -> Option<[f32; 3]> {
    let intrinsics = map.intrinsics();
    let seen = |u: usize, v: usize| Some(map.at(u, v)).filter(|&depth| depth > 0.0);
    let centre = seen(u, v)?;
    let step = ((baseline * intrinsics.fx / f64::from(centre)) as usize).clamp(2, 16);
    let point = |u: usize, v: usize| {
        let depth = seen(u, v)?;
        let x = (u as f32 - intrinsics.cx as f32) / intrinsics.fx as f32;
        let y = (v as f32 - intrinsics.cy as f32) / intrinsics.fy as f32;
        Some(Vector3::new(x, y, 1.0) * depth)
    };
    let across = point(u + step, v)? - point(u.checked_sub(step)?, v)?;
    let down = point(u, v + step)? - point(u, v.checked_sub(step)?)?;
    let normal = across.cross(&down);
    let length = normal.norm();
    (length > 0.0).then(|| (normal / length).into())
}
