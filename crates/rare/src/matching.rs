//! Step 7: correspondences by feature similarity.
//!
//! Two keypoints match if each one's feature is the other's nearest (Euclidean distance, section 3.3: "feature
//! similarity matching"). Both directions come from one pass over the product of the two feature matrices, computed
//! tile by tile, so that two sets of 20 000 keypoints need a few megabytes. Ties go to the lowest index and the
//! result does not depend on the number of threads.

mod ranked;
mod search;
mod window;

use nalgebra::Point3;

use crate::data::{Correspondence, PointFeatures};
use crate::error::{Error, Result};
use ranked::ranked;
use search::{Nearest, search};

/// A pair of keypoints whose features belong together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Index into the source keypoints.
    pub source_index: usize,
    /// Index into the target keypoints.
    pub target_index: usize,
    /// Squared Euclidean distance of the two features.
    pub squared_distance: f64,
}

impl Match {
    /// The confidence of the match: the cosine similarity of its features, `max(0, 1 - d^2 / 2)` for unit vectors.
    ///
    /// A feature that concatenates `kinds` unit vectors has `kinds` times the squared distance of one on average,
    /// which is divided out first: 1 for plain features, 2 for fused ones. (0 counts as 1.)
    #[must_use]
    pub fn similarity(&self, kinds: usize) -> f64 {
        (1.0 - self.squared_distance / (2.0 * kinds.max(1) as f64)).max(0.0)
    }
}

/// A prior on where matches lie: pairs whose points are `max_distance` or more apart are not considered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Locality<'a> {
    /// One point per source keypoint, metres, in the frame of `target_points`.
    pub source_points: &'a [Point3<f64>],
    /// One point per target keypoint, metres.
    pub target_points: &'a [Point3<f64>],
    /// Pairs further apart than this, metres, do not match. Evaluated in `f32`.
    pub max_distance: f64,
}

/// For every source keypoint the target keypoint with the nearest feature, in the order of the source keypoints.
///
/// Features may have any length (fast point feature histograms are matched as they are); products are in `f32`, so
/// of two candidates whose squared distances differ by less than about 1e-6 of the squared norms either may win.
/// A source keypoint is left out if its feature is not finite or `locality` leaves it no candidate.
///
/// # Errors
/// `InvalidInput` if the two sets differ in dimension, the dimension is 0, or `locality` does not fit.
///
/// ```
/// use rare::{PointFeatures, matching, nalgebra::Point3};
/// let at = |values: &[f32]| {
///     let points = values.iter().map(|&x| Point3::new(f64::from(x), 0.0, 1.0)).collect();
///     PointFeatures::new(points, 1, values.to_vec())
/// };
/// let source = at(&[0.0, 0.1, 0.2, 0.9, 1.0])?;
/// let target = at(&[1.1, 0.25, 2.0, 0.0, 0.0])?;
/// let found: Vec<_> =
///     matching::nearest(&source, &target, None)?.iter().map(|pair| pair.target_index).collect();
/// assert_eq!(found, [3, 3, 1, 0, 0]);
/// # Ok::<(), rare::Error>(())
/// ```
pub fn nearest(
    source: &PointFeatures,
    target: &PointFeatures,
    locality: Option<&Locality<'_>>,
) -> Result<Vec<Match>> {
    check(source, target, locality)?;
    let Nearest { of_source, .. } = search(source, target, locality, false);
    let pairs = of_source.into_iter().enumerate();
    Ok(pairs.filter_map(|(i, j)| Some(matched(source, target, i, j?))).collect())
}

/// For every source keypoint the `count` target keypoints with the nearest features (all, if there are fewer), nearest
/// first; none where its feature is not finite. See [`nearest`] for the precision.
///
/// # Errors
/// `InvalidInput` if the two sets differ in dimension or the dimension is 0.
///
/// ```
/// use rare::{PointFeatures, matching, nalgebra::Point3};
/// let at = |values: &[f32]| {
///     let points = values.iter().map(|&x| Point3::new(f64::from(x), 0.0, 1.0)).collect();
///     PointFeatures::new(points, 1, values.to_vec())
/// };
/// let found = matching::nearest_ranked(&at(&[0.3, 0.9])?, &at(&[1.0, 0.25, 2.0, 0.0])?, 3)?;
/// let indices = |row: &[matching::Match]| row.iter().map(|found| found.target_index).collect();
/// let indices: Vec<Vec<_>> = found.iter().map(|row| indices(row)).collect();
/// assert_eq!(indices, [[1, 3, 0], [0, 1, 3]]);
/// # Ok::<(), rare::Error>(())
/// ```
pub fn nearest_ranked(
    source: &PointFeatures,
    target: &PointFeatures,
    count: usize,
) -> Result<Vec<Vec<Match>>> {
    check(source, target, None)?;
    let rows = ranked(source, target, count).into_iter().enumerate();
    let matches = |(i, row): (usize, Vec<u32>)| {
        row.into_iter().map(|j| matched(source, target, i, j as usize)).collect()
    };
    Ok(rows.map(matches).collect())
}

/// The pairs of keypoints that are each other's nearest in feature space, in the order of the source keypoints.
/// At most one pair per keypoint; see [`nearest`] for precision and for what is left out.
///
/// # Errors
/// `InvalidInput` if the two sets differ in dimension, the dimension is 0, or `locality` does not fit.
///
/// ```
/// use rare::{PointFeatures, matching, nalgebra::Point3};
/// let at = |values: &[f32]| {
///     let points = values.iter().map(|&x| Point3::new(f64::from(x), 0.0, 1.0)).collect();
///     PointFeatures::new(points, 1, values.to_vec())
/// };
/// let source = at(&[0.0, 0.1, 0.2, 0.9, 1.0])?;
/// let target = at(&[1.1, 0.25, 2.0, 0.0, 0.0])?;
/// let found: Vec<_> = matching::mutual_nearest(&source, &target, None)?
///     .iter()
///     .map(|pair| (pair.source_index, pair.target_index))
///     .collect();
/// assert_eq!(found, [(0, 3), (2, 1), (4, 0)]);
/// # Ok::<(), rare::Error>(())
/// ```
pub fn mutual_nearest(
    source: &PointFeatures,
    target: &PointFeatures,
    locality: Option<&Locality<'_>>,
) -> Result<Vec<Match>> {
    check(source, target, locality)?;
    let Nearest { of_source, of_target } = search(source, target, locality, true);
    let pairs = of_source.into_iter().enumerate();
    Ok(pairs
        .filter_map(|(i, j)| Some((i, j?)))
        .filter(|&(i, j)| of_target.get(j) == Some(&Some(i)))
        .map(|(i, j)| matched(source, target, i, j))
        .collect())
}

/// The matched keypoints as correspondences scored by [`Match::similarity`]; `kinds` is the number of unit vectors
/// that each feature concatenates. Matches whose indices are out of range are passed over.
///
/// ```
/// use rare::{PointFeatures, matching::{self, Match}, nalgebra::Point3};
/// let keypoints = PointFeatures::new(vec![Point3::new(1.0, 2.0, 3.0)], 2, vec![0.6, 0.8])?;
/// let found = Match { source_index: 0, target_index: 0, squared_distance: 0.5 };
/// let pairs = matching::correspondences(&keypoints, &keypoints, &[found], 1);
/// assert_eq!((pairs[0].source, pairs[0].score), (Point3::new(1.0, 2.0, 3.0), 0.75));
/// # Ok::<(), rare::Error>(())
/// ```
#[must_use]
pub fn correspondences(
    source: &PointFeatures,
    target: &PointFeatures,
    matches: &[Match],
    kinds: usize,
) -> Vec<Correspondence> {
    let correspondence = |pair: &Match| {
        Some(Correspondence {
            source: *source.points().get(pair.source_index)?,
            target: *target.points().get(pair.target_index)?,
            score: pair.similarity(kinds),
        })
    };
    matches.iter().filter_map(correspondence).collect()
}

/// The match of source `i` and target `j`, its distance in `f64` from the differences: near 0 the products' distance
/// is mostly rounding.
fn matched(source: &PointFeatures, target: &PointFeatures, i: usize, j: usize) -> Match {
    let differences = source.feature(i).iter().zip(target.feature(j));
    let squared_distance = differences.map(|(a, b)| f64::from(a - b).powi(2)).sum();
    Match { source_index: i, target_index: j, squared_distance }
}

fn check(
    source: &PointFeatures,
    target: &PointFeatures,
    locality: Option<&Locality<'_>>,
) -> Result<()> {
    if let Some(locality) = locality {
        check_locality(source, target, locality)?;
    }
    if source.is_empty() || target.is_empty() {
        return Ok(());
    }
    if source.dimension() != target.dimension() || source.dimension() == 0 {
        return Err(Error::invalid(format!(
            "the source features have {} dimensions, the target features {}: they must be the same number, at least 1",
            source.dimension(),
            target.dimension()
        )));
    }
    if source.len().max(target.len()) >= u32::MAX as usize {
        return Err(Error::invalid(format!(
            "cannot match {} with {} keypoints: at most {} are supported",
            source.len(),
            target.len(),
            u32::MAX - 1
        )));
    }
    Ok(())
}

fn check_locality(
    source: &PointFeatures,
    target: &PointFeatures,
    locality: &Locality<'_>,
) -> Result<()> {
    let (given_source, given_target) = (locality.source_points.len(), locality.target_points.len());
    if (given_source, given_target) != (source.len(), target.len()) {
        return Err(Error::invalid(format!(
            "the locality prior has {given_source} and {given_target} points for {} and {} keypoints",
            source.len(),
            target.len()
        )));
    }
    if locality.max_distance.is_nan() || locality.max_distance <= 0.0 {
        return Err(Error::invalid(format!(
            "the matching window is {} m: it must be greater than 0",
            locality.max_distance
        )));
    }
    Ok(())
}
