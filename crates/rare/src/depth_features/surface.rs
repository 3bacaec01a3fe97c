//! Depths and normals as the lattices sample them.

use nalgebra::Vector3;

use crate::data::DepthMap;
use crate::depth_features::CHANNELS;

/// Lattices sample every so many pixels at the finest.
pub(super) const THINNING: usize = 2;
/// The smallest and the largest half baseline of a normal, pixels.
const BASELINE_PIXELS: (usize, usize) = (2, 16);

/// What is seen at every second pixel of a depth map: the unit normal in the camera's frame (zero where a neighbour is
/// missing), then the depth. Lattices are coarser than that, and a quarter of the pixels stays in the cache.
pub(super) struct Surface<'a> {
    pub(super) map: &'a DepthMap,
    pub(super) width: usize,
    pub(super) height: usize,
    pixels: Vec<[f32; CHANNELS]>,
}

impl<'a> Surface<'a> {
    pub(super) fn new(map: &'a DepthMap, baseline: f64) -> Surface<'a> {
        let (width, height) = (map.width().div_ceil(THINNING), map.height().div_ceil(THINNING));
        let mut pixels = vec![[0.0; CHANNELS]; width * height];
        let focal_baseline = (baseline * map.intrinsics().fx) as f32;
        let rays = Rays::new(map);
        let (least, most) = BASELINE_PIXELS;
        for (row, pixels) in pixels.chunks_exact_mut(width.max(1)).enumerate() {
            for (column, pixel) in pixels.iter_mut().enumerate() {
                let (u, v) = (column * THINNING, row * THINNING);
                let depth = map.at(u, v);
                if depth > 0.0 {
                    let step = ((focal_baseline / depth) as usize).clamp(least, most);
                    let [x, y, z] = rays.normal(u, v, step).unwrap_or([0.0; 3]);
                    *pixel = [x, y, z, depth];
                }
            }
        }
        Surface { map, width, height, pixels }
    }

    pub(super) fn row(&self, row: usize) -> &[[f32; CHANNELS]] {
        &self.pixels[row * self.width..(row + 1) * self.width]
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
