//! Keypoints, correspondences and a pose of two clouds.

use std::collections::BTreeSet;

use rare::nalgebra::Point3;
use rare::{Correspondence, PointFeatures, Result};

use super::{CoFiNet, FinePair, Output};
use crate::backbones::consensus::pose;
use crate::backbones::hourglass::Prepared;
use crate::backbones::kpconv::NeighbourLimits;
use crate::backbones::{Description, Keypoints, Selection};

/// Bytes of a number.
const WORD: u64 = 4;

impl CoFiNet {
    /// Describes two clouds: `selection.count` of the pairs of points that the network finds, by its confidence, the
    /// points of these pairs with the decoder's features, and the pose that RANSAC finds in them. (The paper's tables
    /// take 250 to 5000 random pairs.)
    ///
    /// Points and results are in the local frames of the clouds, metres. Clouds that are denser than the voxels of the
    /// model are thinned first. `limits` are the most neighbours of a point in each stage.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is empty, not finite or too large for the voxels, or the limits do not fit.
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
        let confidences: Vec<f32> = output.fine_pairs.iter().map(|pair| pair.confidence).collect();
        let chosen = selection.choose(&confidences);
        let chosen: Vec<FinePair> = chosen.iter().map(|&index| output.fine_pairs[index]).collect();
        let pair = |pair: &FinePair| Correspondence {
            source: of_source[pair.source],
            target: of_target[pair.target],
            score: f64::from(pair.confidence),
        };
        let correspondences: Vec<Correspondence> = chosen.iter().map(pair).collect();
        let target_from_source =
            pose(&self.config.ransac, [source, target], &correspondences, selection);
        let mut warnings = prepared.warnings(sizes);
        warnings.extend(self.surplus(&output));
        let from = chosen.iter().map(|pair| (pair.source, pair.confidence));
        let to = chosen.iter().map(|pair| (pair.target, pair.confidence));
        Ok(Description {
            source: keypoints(&output, of_source, 0, from)?,
            target: keypoints(&output, of_target, second, to)?,
            correspondences,
            target_from_source,
            neighbour_limits: Some(limits.clone()),
            warnings,
        })
    }

    /// An estimate of the bytes that [`CoFiNet::describe`] takes for these clouds. The clouds are thinned for it, which
    /// takes less than they do.
    ///
    /// # Errors
    /// Those of [`CoFiNet::describe`].
    pub fn expected_bytes(
        &self,
        source: &[Point3<f64>],
        target: &[Point3<f64>],
        limits: &NeighbourLimits,
    ) -> Result<u64> {
        let prepared = Prepared::new(source, target, &self.config.pyramid)?;
        let [source, target] = prepared.coarsest().map(|count| count as u64 + 1);
        // The transport plan of coarse points, its scores and confidences; those of patches.
        let plan = source.saturating_mul(target).saturating_mul(4);
        let side = self.config.patch as u64 + 1;
        let patches = plan.min(self.config.most_pairs as u64) * side * side;
        Ok(prepared.bytes(&self.config.encoder(), limits) + (plan + patches) * WORD)
    }

    /// A remark if there were more coarse pairs than are looked at.
    fn surplus(&self, output: &Output) -> Option<String> {
        let (found, most) = (output.coarse_pairs_found, self.config.most_pairs);
        (found > most).then(|| {
            format!(
                "CoFiNet takes {found} pairs of coarse points for possible and looks at the {most} likeliest: \
                 the clouds are unlike those that it was trained on"
            )
        })
    }
}

/// Different points of a cloud, whose features begin at row `first`, each with the first score that comes with it.
fn keypoints(
    output: &Output,
    points: Vec<Point3<f64>>,
    first: usize,
    members: impl Iterator<Item = (usize, f32)>,
) -> Result<Keypoints> {
    let mut seen = BTreeSet::new();
    let (indices, scores): (Vec<usize>, Vec<f32>) =
        members.filter(|(index, _)| seen.insert(*index)).unzip();
    let features = output.fine_features.part(first, points.len());
    let dimension = features.columns();
    let features = PointFeatures::new(points, dimension, features.into_values())?.select(&indices);
    Ok(Keypoints { features, scores })
}
