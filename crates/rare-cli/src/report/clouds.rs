//! Points and correspondences as the viewer reads them: little-endian numbers, one array after the other.

use rare::nalgebra::{Point3, Vector3};
use rare::refine::IllustratedCloud;
use rare::verify::Visibility;

/// Residuals beyond the end of the scale.
const BEYOND: u8 = 255;
/// The end of the scale.
const END: f32 = 254.0;

/// Where the positions of a cloud lie: a 16-bit number is a share of `size` above `low`, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Bounds {
    pub(super) low: Point3<f64>,
    pub(super) size: Vector3<f64>,
}

impl Bounds {
    /// Of points, of which there is at least one; a cube of no size at the origin otherwise.
    pub(super) fn of(points: &[Point3<f64>]) -> Bounds {
        let Some(&first) = points.first() else {
            return Bounds { low: Point3::origin(), size: Vector3::zeros() };
        };
        let (low, high) = points
            .iter()
            .fold((first, first), |(low, high), point| (low.inf(point), high.sup(point)));
        Bounds { low, size: high - low }
    }

    fn quantised(&self, point: &Point3<f64>) -> [u16; 3] {
        std::array::from_fn(|axis| {
            let share = (point[axis] - self.low[axis]) / self.size[axis];
            // Where all points have the same coordinate, the share is not a number and becomes 0.
            (share * f64::from(u16::MAX)).round() as u16
        })
    }
}

/// Positions, then for each pose the residuals (0 to 254 up to `residual_end` metres, 255 beyond), then for each pose what
/// the other sensor says.
pub(super) fn cloud_bytes(
    points: &[Point3<f64>],
    bounds: &Bounds,
    known: &IllustratedCloud,
    residual_end: f64,
) -> Vec<u8> {
    let positions = points.iter().flat_map(|point| bounds.quantised(point));
    let mut bytes: Vec<u8> = positions.flat_map(u16::to_le_bytes).collect();
    for residuals in &known.residuals {
        bytes.extend(residuals.iter().map(|&residual| residual_byte(residual, residual_end)));
    }
    for visibility in &known.visibility {
        bytes.extend(visibility.iter().map(|&visibility| visibility_byte(visibility)));
    }
    bytes
}

/// Both points of each correspondence in single precision, then whether each is an inlier.
pub(super) fn match_bytes(matches: &[([Point3<f64>; 2], bool)]) -> Vec<u8> {
    let numbers =
        matches.iter().flat_map(|(ends, _)| ends.iter().flat_map(|end| end.coords.iter()));
    let mut bytes: Vec<u8> = numbers.flat_map(|&number| (number as f32).to_le_bytes()).collect();
    bytes.extend(matches.iter().map(|&(_, inlier)| u8::from(inlier)));
    bytes
}

fn residual_byte(residual: f32, end: f64) -> u8 {
    let share = residual / end as f32;
    if share <= 1.0 { (share * END).round() as u8 } else { BEYOND }
}

fn visibility_byte(visibility: Visibility) -> u8 {
    match visibility {
        Visibility::Unseen => 0,
        Visibility::Agree => 1,
        Visibility::Occluded => 2,
        Visibility::Violation | Visibility::GrossViolation => 3,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cloud_is_written_number_by_number() {
        let points = [Point3::new(1.0, 5.0, -2.0), Point3::new(3.0, 5.0, -1.0)];
        let known = IllustratedCloud {
            indices: vec![0, 1],
            residuals: vec![vec![0.0, 0.1], vec![0.05, f32::INFINITY]],
            visibility: vec![
                vec![Visibility::Unseen, Visibility::Agree],
                vec![Visibility::Occluded, Visibility::GrossViolation],
            ],
        };
        let bounds = Bounds::of(&points);
        assert_eq!((bounds.low, bounds.size), (points[0], Vector3::new(2.0, 0.0, 1.0)));
        let bytes = cloud_bytes(&points, &bounds, &known, 0.1);
        assert_eq!(bytes[..12], [0, 0, 0, 0, 0, 0, 255, 255, 0, 0, 255, 255]);
        assert_eq!(bytes[12..], [0, 254, 127, 255, 0, 1, 2, 3]);
    }

    #[test]
    fn matches_are_written_end_by_end() {
        let ends = [Point3::new(1.0, 2.0, 3.0), Point3::new(-1.0, 0.5, 0.0)];
        let bytes = match_bytes(&[(ends, true), (ends, false)]);
        assert_eq!(bytes.len(), 2 * 25);
        assert_eq!(bytes[12..16], (-1.0_f32).to_le_bytes());
        assert_eq!(bytes[48..], [1, 0]);
    }
}
