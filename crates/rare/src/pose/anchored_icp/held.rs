//! The anchors under one pose.

use nalgebra::{Point3, Vector3};

use crate::data::{Correspondence, RigidTransform};
use crate::pose::RobustKernel;
use crate::pose::normal_equations::{NormalEquations, Symmetric3};

/// Anchors whose weights sum up to less than this are ignored: so few may agree by chance, and would have the same say
/// as many.
const LEAST_WEIGHT: f64 = 5.0;

/// The anchors that have a say at one pose.
pub(super) struct HeldAnchors {
    anchors: Vec<HeldAnchor>,
    /// The sum of their weights.
    weight: f64,
}

struct HeldAnchor {
    moved: Point3<f64>,
    residual: Vector3<f64>,
    weight: f64,
}

impl HeldAnchors {
    /// Weighs the anchors by a Tukey kernel of this width (metres); `None` if they weigh too little.
    pub(super) fn at(
        pose: &RigidTransform,
        anchors: &[Correspondence],
        width: f64,
    ) -> Option<HeldAnchors> {
        let held = |anchor: &Correspondence| {
            let moved = pose.apply(&anchor.source);
            let residual = moved - anchor.target;
            let weight = RobustKernel::Tukey.weight(residual.norm(), width);
            (weight > 0.0 && weight.is_finite()).then_some(HeldAnchor { moved, residual, weight })
        };
        let anchors: Vec<HeldAnchor> = anchors.iter().filter_map(held).collect();
        let weight: f64 = anchors.iter().map(|anchor| anchor.weight).sum();
        (weight >= LEAST_WEIGHT).then_some(HeldAnchors { anchors, weight })
    }

    pub(super) fn len(&self) -> usize {
        self.anchors.len()
    }

    /// Adds the anchors to the sums over the surface pairs, `share` times as heavy as all those together.
    pub(super) fn add_to(&self, sums: &mut NormalEquations, share: f64) {
        let factor = share * sums.weight / self.weight;
        for HeldAnchor { moved, residual, weight } in &self.anchors {
            sums.add_difference(moved, residual, &Symmetric3::IDENTITY, weight * factor);
        }
    }
}
