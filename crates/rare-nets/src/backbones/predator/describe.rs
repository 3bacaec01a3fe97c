//! Keypoints, correspondences and a pose of two clouds.

use rare::nalgebra::Point3;
use rare::{PointFeatures, Result, matching};

use super::{Output, Predator};
use crate::backbones::consensus::{correspondences, for_target, pose};
use crate::backbones::hourglass::Prepared;
use crate::backbones::kpconv::NeighbourLimits;
use crate::backbones::{Description, Keypoints, Selection};

/// Bytes of a number.
const WORD: u64 = 4;

impl Predator {
    /// Describes two clouds: `selection.count` keypoints of each by the product of overlap and saliency, for each source
    /// keypoint the target keypoint with the nearest feature, and the pose that RANSAC finds in these pairs, whose scores
    /// are the cosines of their features. (The paper's tables take 250 to 5000 random keypoints, its demo 1000.)
    ///
    /// Points and results are in the local frames of the clouds, metres. Clouds that are denser than the voxels of the
    /// model are thinned first. `limits` are the most neighbours of a point in each stage.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is empty, not finite, too large for the voxels or too small for the coarse stage, or the
    /// limits do not fit.
    pub fn describe(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        limits: &NeighbourLimits,
        selection: &Selection,
    ) -> Result<Description> {
        let sizes = &self.config.pyramid;
        let prepared = Prepared::new(source, target, sizes)?;
        let output = self.run(&prepared.pyramid(sizes, limits)?)?;
        let [of_source, of_target] = prepared.points();
        let second = of_source.len();
        let from = keypoints(&output, of_source, 0, selection)?;
        let to = keypoints(&output, of_target, second, &for_target(selection))?;
        let matches = matching::nearest(&from.features, &to.features, None)?;
        let pairs =
            correspondences(&from.features, &to.features, &matches, |pair| pair.similarity(1));
        let target_from_source = pose(&self.config.ransac, [source, target], &pairs, selection);
        let mut warnings = prepared.warnings(sizes);
        warnings.extend(self.small_graphs(output.degrees));
        Ok(Description {
            source: from,
            target: to,
            correspondences: pairs,
            target_from_source,
            neighbour_limits: Some(limits.clone()),
            warnings,
        })
    }

    /// An estimate of the bytes that [`Predator::describe`] takes for these clouds. The clouds are thinned for it, which
    /// takes less than they do.
    ///
    /// # Errors
    /// Those of [`Predator::describe`].
    pub fn expected_bytes(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        limits: &NeighbourLimits,
    ) -> Result<u64> {
        let prepared = Prepared::new(source, target, &self.config.pyramid)?;
        // Edges of a graph, and their products before and after they are normalised.
        let [source, target] = prepared.coarsest().map(|count| count as u64);
        let edges = (source + target) * self.config.neighbours as u64;
        // How alike any two coarse points are: as the engine has it, as a matrix, and the other way round.
        let alike = source.saturating_mul(target).saturating_mul(3 * WORD);
        let edges = edges * 4 * self.config.coarse_channels as u64 * WORD;
        Ok(prepared
            .bytes(&self.config.encoder(), limits)
            .saturating_add(edges)
            .saturating_add(alike))
    }

    /// A remark if a cloud has fewer coarse points than the graph wants.
    fn small_graphs(&self, degrees: [usize; 2]) -> Option<String> {
        let [source, target] = degrees.map(|degree| degree + 1);
        let wanted = self.config.neighbours;
        (degrees.into_iter().any(|degree| degree < wanted)).then(|| {
            format!(
                "Predator looks at the {wanted} nearest coarse points of each, and these clouds have but {source} and \
                 {target} or more: it looks at all of them, which it was not trained for"
            )
        })
    }
}

/// The best points of a cloud, whose rows begin at `first`, with the product of both scores.
fn keypoints(
    output: &Output,
    points: Vec<Point3<f64>>,
    first: usize,
    selection: &Selection,
) -> Result<Keypoints> {
    let scores = output.overlap.iter().zip(&output.saliency).skip(first).take(points.len());
    let scores: Vec<f32> = scores.map(|(overlap, saliency)| overlap * saliency).collect();
    let chosen = selection.choose(&scores);
    let features = output.features.part(first, points.len());
    let dimension = features.columns();
    let features = PointFeatures::new(points, dimension, features.into_values())?.select(&chosen);
    Ok(Keypoints { features, scores: chosen.iter().map(|&index| scores[index]).collect() })
}
