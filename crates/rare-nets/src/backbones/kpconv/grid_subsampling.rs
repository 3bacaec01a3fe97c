//! One point for each occupied voxel.

use std::collections::HashMap;

use rare::{Error, Result};

use super::Point;

/// Voxels along an axis that a grid can count.
pub(super) const CELLS_PER_AXIS: f64 = (1_u64 << 21) as f64;

/// The barycentre of the points in each occupied voxel of edge `voxel` (metres), in the order in which the voxels first
/// appear among `points`.
///
/// All arithmetic is in single precision, in the order of the points, as in the released code of the networks (Thomas
/// et al., ICCV 2019), so that the barycentres are equal to the last bit: the grid hangs at a multiple of the voxel, and
/// a sum is multiplied by the inverse of its count.
///
/// # Errors
/// `InvalidInput` if the voxel is not positive, a point is not finite or the cloud spans more than `2^21` voxels.
pub fn subsample(points: &[Point], voxel: f32) -> Result<Vec<Point>> {
    let (low, high) = bounds(points, voxel)?;
    let inverse = (1.0 / f64::from(voxel)) as f32;
    let origin = low.map(|coordinate| (coordinate * inverse).floor() * voxel);
    // The lowest point can end up below the origin by rounding, and then has a cell of its own, as in the released code.
    let cell = |coordinate: f32, axis: usize| {
        let steps = ((coordinate - origin[axis]) / voxel).floor();
        (steps as i64).cast_unsigned()
    };
    let sizes = [0, 1].map(|axis| cell(high[axis], axis).wrapping_add(1));
    // The map is only asked, never iterated: its order cannot show.
    let mut slots = HashMap::<u64, usize>::with_capacity(points.len() / 2);
    let mut sums: Vec<(Point, u32)> = Vec::new();
    for point in points {
        let [x, y, z] = [0, 1, 2].map(|axis| cell(point[axis], axis));
        let layer = y.wrapping_add(sizes[1].wrapping_mul(z));
        let key = x.wrapping_add(sizes[0].wrapping_mul(layer));
        let slot = *slots.entry(key).or_insert(sums.len());
        match sums.get_mut(slot) {
            Some((sum, count)) => {
                sum.iter_mut().zip(point).for_each(|(sum, coordinate)| *sum += coordinate);
                *count += 1;
            }
            // From zero, so that a negative zero becomes a positive one, as in the released code.
            None => sums.push((point.map(|coordinate| 0.0 + coordinate), 1)),
        }
    }
    let barycentre = |(sum, count): (Point, u32)| {
        let share = (1.0 / f64::from(count)) as f32;
        sum.map(|coordinate| coordinate * share)
    };
    Ok(sums.into_iter().map(barycentre).collect())
}

/// The lowest and highest coordinates, if a grid with this `edge` can be laid over the points.
///
/// # Errors
/// Those of [`subsample`].
pub(super) fn bounds(points: &[Point], edge: f32) -> Result<(Point, Point)> {
    if !(edge.is_finite() && edge > 0.0) {
        return Err(Error::invalid(format!("the voxel size is {edge} m, it must be positive")));
    }
    let Some(first) = points.first() else { return Ok(([0.0; 3], [0.0; 3])) };
    let (mut low, mut high) = (*first, *first);
    for point in points {
        for axis in 0..3 {
            let coordinate = point[axis];
            if !coordinate.is_finite() {
                return Err(Error::invalid(format!("the point {point:?} is not finite")));
            }
            low[axis] = low[axis].min(coordinate);
            high[axis] = high[axis].max(coordinate);
        }
    }
    let extent = (0..3).map(|axis| f64::from(high[axis]) - f64::from(low[axis]));
    let extent = extent.fold(0.0, f64::max);
    if extent / f64::from(edge) >= CELLS_PER_AXIS - 2.0 {
        return Err(Error::invalid(format!(
            "the cloud spans {extent} m, too much for voxels of {edge} m: remove stray points"
        )));
    }
    Ok((low, high))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_give_their_barycentre_in_order_of_appearance() {
        let points = [[0.5, 0.25, 0.0], [-0.25, 0.0, 0.0], [0.75, 0.5, 0.5], [-0.5, 0.25, 0.5]];
        let thinned = subsample(&points, 1.0).unwrap();
        assert_eq!(thinned, [[0.625, 0.375, 0.25], [-0.375, 0.125, 0.25]]);
        assert!(subsample(&[], 1.0).unwrap().is_empty());
    }

    #[test]
    fn what_no_grid_can_hold_is_refused() {
        for voxel in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert!(subsample(&[[0.0; 3]], voxel).is_err());
        }
        assert!(subsample(&[[0.0, f32::NAN, 0.0]], 1.0).is_err());
        let message = subsample(&[[0.0; 3], [0.0, 0.0, 1e8]], 0.1).unwrap_err().to_string();
        assert!(message.contains("stray points"), "{message}");
    }
}
