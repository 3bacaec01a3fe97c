//! The locality prior, tile by tile.

use nalgebra::Point3;

use super::Locality;
use super::search::{TILE_COLUMNS, TILE_ROWS};

/// Which pairs are near enough to match. In `f32`, relative to a point of the scene.
pub(super) struct Window {
    source: Vec<[f32; 3]>,
    /// x, y and z apart, so that a row of a tile is tested several points at a time.
    target: [Vec<f32>; 3],
    source_boxes: Vec<Bounds>,
    target_boxes: Vec<Bounds>,
    squared_distance: f32,
}

/// Lowest and highest coordinates of the points of one block.
type Bounds = ([f32; 3], [f32; 3]);

impl Window {
    pub(super) fn new(locality: &Locality<'_>) -> Window {
        let origin = locality.source_points.first().copied().unwrap_or_default();
        let local = |points: &[Point3<f64>]| -> Vec<[f32; 3]> {
            points.iter().map(|point| (point - origin).cast::<f32>().into()).collect()
        };
        let (source, target) = (local(locality.source_points), local(locality.target_points));
        Window {
            source_boxes: source.chunks(TILE_ROWS).map(bounds).collect(),
            target_boxes: target.chunks(TILE_COLUMNS).map(bounds).collect(),
            target: [0, 1, 2].map(|axis| target.iter().map(|point| point[axis]).collect()),
            source,
            squared_distance: (locality.max_distance * locality.max_distance) as f32,
        }
    }

    /// Whether no pair of the tile at source row `first` and target row `from` is near enough.
    pub(super) fn excludes(&self, first: usize, from: usize) -> bool {
        let source = self.source_boxes.get(first / TILE_ROWS);
        let target = self.target_boxes.get(from / TILE_COLUMNS);
        let (Some(source), Some(target)) = (source, target) else { return true };
        // Rounding is monotonic: no pair of the boxes can come out nearer than this.
        let gap = |axis: usize| {
            (target.0[axis] - source.1[axis]).max(source.0[axis] - target.1[axis]).max(0.0)
        };
        squared_norm(gap(0), gap(1), gap(2)) >= self.squared_distance
    }

    /// Sets the products of the pairs that are too far apart to minus infinity. `products` starts at source row `first`
    /// and target row `from`; its rows of `columns` numbers stand `width` apart.
    pub(super) fn mask(
        &self,
        first: usize,
        from: usize,
        columns: usize,
        width: usize,
        products: &mut [f32],
    ) {
        let [xs, ys, zs] = self.target.each_ref().map(|axis| &axis[from..from + columns]);
        for (&[x, y, z], row) in self.source[first..].iter().zip(products.chunks_exact_mut(width)) {
            for (product, ((tx, ty), tz)) in row.iter_mut().zip(xs.iter().zip(ys).zip(zs)) {
                let near = squared_norm(tx - x, ty - y, tz - z) < self.squared_distance;
                *product = if near { *product } else { f32::NEG_INFINITY };
            }
        }
    }
}

fn squared_norm(x: f32, y: f32, z: f32) -> f32 {
    x * x + y * y + z * z
}

fn bounds(points: &[[f32; 3]]) -> Bounds {
    let start = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    points.iter().fold(start, |(low, high), point| {
        let axes = [0, 1, 2];
        (axes.map(|axis| low[axis].min(point[axis])), axes.map(|axis| high[axis].max(point[axis])))
    })
}
