//! Seeds: reliable correspondences that lie well apart.

use nalgebra::Point3;

use crate::data::KdTree;
use crate::pose::Mode;

/// The indices of at most `count` of the highest scores (any sign) that are local maxima: no point within `radius`
/// (metres, of the frame of `points`) scores higher. Highest first, ties by the lowest index. There is a score for each
/// point; only equal scores are seeds within the radius of each other.
///
/// [`Mode::Faithful`] keeps what the released code of SC2-PCR, PointDSC and VBReg does: others than local maxima count as
/// score 0 instead of being left out. So they fill the list up to `count`, and come before maxima of negative score.
#[must_use]
pub fn spread_seeds(
    points: &[Point3<f64>],
    scores: &[f64],
    radius: f64,
    count: usize,
    mode: Mode,
) -> Vec<usize> {
    let is_maximum = local_maxima(points, scores, radius);
    let mut indices: Vec<usize> = (0..points.len().min(scores.len())).collect();
    if mode == Mode::Fixed {
        indices.retain(|&i| is_maximum[i]);
    }
    let key = |i: usize| if is_maximum[i] { scores[i] } else { 0.0 };
    indices.sort_by(|&a, &b| key(b).total_cmp(&key(a)));
    indices.truncate(count);
    indices
}

fn local_maxima(points: &[Point3<f64>], scores: &[f64], radius: f64) -> Vec<bool> {
    let tree = KdTree::new(points);
    let mut near = Vec::new();
    (points.iter().zip(scores))
        .map(|(point, score)| {
            tree.k_nearest_unordered(point, usize::MAX, radius, &mut near);
            near.iter().filter_map(|other| scores.get(other.index)).all(|other| score >= other)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn local_maxima_come_first_and_others_count_as_nothing() {
        let points: Vec<_> =
            [0.0, 0.05, 1.0, 1.05, 2.0, 3.0].map(|x| Point3::new(x, 0.0, 0.0)).into();
        let scores = [3.0, 2.0, 5.0, 5.0, -1.0, 1.0];
        let seeds = |count, mode| spread_seeds(&points, &scores, 0.1, count, mode);
        assert_eq!(seeds(9, Mode::Fixed), [2, 3, 0, 5, 4]);
        assert_eq!(seeds(9, Mode::Faithful), [2, 3, 0, 5, 1, 4]);
        assert_eq!(seeds(3, Mode::Fixed), [2, 3, 0]);
        assert!(spread_seeds(&[], &[], 0.1, 3, Mode::Fixed).is_empty());
    }
}
