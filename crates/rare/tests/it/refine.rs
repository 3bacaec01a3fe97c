//! From two clouds and a start to a verified pose, over all steps.

mod given_features;
mod illustration;
mod scenes;
mod switches;

use std::sync::OnceLock;

use nalgebra::{Point3, Vector3};
use rare::synthetic::{ScanPair, demo_pair, perturb};
use rare::{PointCloud, Recipe, Refinement, Refiner, RefinerConfig, RigidTransform, Scan};

/// A synthetic pair as the refiner takes it.
struct Pair {
    source: Scan,
    target: Scan,
    truth: RigidTransform,
    initial: RigidTransform,
}

impl Pair {
    /// Every `step`-th point of the scans.
    fn thinned(pair: &ScanPair, step: usize) -> Pair {
        let thin = |cloud: &PointCloud| {
            PointCloud::new(cloud.points().iter().step_by(step).copied().collect()).unwrap()
        };
        Pair {
            source: thin(&pair.source).into(),
            target: thin(&pair.target).into(),
            truth: pair.target_from_source,
            initial: pair.initial,
        }
    }

    /// Half of a room seen by both, 10 degrees and 0.2 m off.
    fn room(seed: u64) -> Pair {
        let mut pair = Pair::thinned(&demo_pair(seed).unwrap(), 3);
        let points = pair.source.cloud.points();
        let sum = points.iter().fold(Vector3::zeros(), |sum, point| sum + point.coords);
        let middle = pair.truth.apply(&Point3::from(sum / points.len() as f64));
        pair.initial = perturb(&pair.truth, 10.0, 0.2, &middle, seed);
        pair
    }

    fn refined(&self, config: RefinerConfig) -> Refinement {
        Refiner::new(config).refine(&self.source, &self.target, &self.initial).unwrap()
    }

    /// Degrees, and how far the middle of the source is from where it belongs, metres.
    fn error(&self, pose: &RigidTransform) -> (f64, f64) {
        let points = self.source.cloud.points();
        let sum = points.iter().fold(Vector3::zeros(), |sum, point| sum + point.coords);
        let middle = Point3::from(sum / points.len() as f64);
        let apart = (pose.apply(&middle) - self.truth.apply(&middle)).norm();
        (pose.error_to(&self.truth).rotation_degrees, apart)
    }
}

/// The room that most tests share.
fn room() -> &'static Pair {
    static ROOM: OnceLock<Pair> = OnceLock::new();
    ROOM.get_or_init(|| Pair::room(1))
}

fn default() -> RefinerConfig {
    RefinerConfig::default()
}

fn paper() -> RefinerConfig {
    RefinerConfig { recipe: Recipe::paper(), ..RefinerConfig::default() }
}

/// The result without its times, which differ from run to run.
fn without_times(refinement: Refinement) -> Refinement {
    Refinement { timings: Vec::new(), ..refinement }
}
