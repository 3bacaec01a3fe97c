//! Step 6: the features of the common points, diffusion and 3-D side by side (section 3.3).

use crate::data::{PointFeatures, normalise};

/// The fused features of the common points: either feature divided by its norm + 1e-5, then concatenated, at the place
/// of the 3-D keypoint. So both kinds weigh the same, whatever their scale and length.
///
/// `common` holds (index into `keypoints`, index into `lifted`) as
/// [`common_points`](crate::transfer::common_points) finds them; one row per pair, pairs out of range are passed over.
///
/// ```
/// use rare::{PointFeatures, fuse::fuse, nalgebra::Point3};
/// let at = |x: f64| Point3::new(x, 0.0, 2.0);
/// let keypoints = PointFeatures::new(vec![at(0.0), at(1.0)], 2, vec![3.0, 4.0, 0.0, 9.0])?;
/// let lifted = PointFeatures::new(vec![at(0.9)], 1, vec![-1.0])?;
/// let fused = fuse(&keypoints, &lifted, &[(1, 0)]);
/// assert_eq!((fused.points(), fused.dimension()), ([at(1.0)].as_slice(), 3));
/// assert!((fused.values()[1] - 1.0).abs() < 1e-4 && (fused.values()[2] + 1.0).abs() < 1e-4);
/// # Ok::<(), rare::Error>(())
/// ```
#[must_use]
pub fn fuse(
    keypoints: &PointFeatures,
    lifted: &PointFeatures,
    common: &[(usize, usize)],
) -> PointFeatures {
    let mut fused = PointFeatures::empty(keypoints.dimension() + lifted.dimension());
    for &(keypoint, pixel) in common.iter().filter(|&&(_, pixel)| pixel < lifted.len()) {
        if let Some(&point) = keypoints.points().get(keypoint) {
            // Equation (3).
            let geometric = normalise(keypoints.feature(keypoint));
            fused.push(point, geometric.chain(normalise(lifted.feature(pixel))));
        }
    }
    fused
}
