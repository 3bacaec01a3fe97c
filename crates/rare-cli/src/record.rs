//! What programs read: the JSON record of a registration.

use anyhow::Result;
use rare::data::SetName;
use rare::nalgebra::Matrix4;
use rare::refine::{Hypothesis, Timing};
use rare::scale::{Profile, Scale, SceneKind};
use rare::verify::{Evidence, Model, Verdict};
use rare::viewpoints::CameraChoice;
use rare::{Recipe, RigidTransform};
use serde::{Serialize, Serializer};

use crate::backbone::BackboneRecord;
use crate::given_weights::FilterIdentity;
use crate::network::NetworkRecord;
use crate::options::{Encoder, Preset, Settings};
use crate::run::{Inputs, Registration};

pub(crate) type Matrix<const N: usize> = [[f64; N]; N];

/// Everything that is known of a transform. The keys are part of the program's interface.
#[derive(Serialize)]
struct Record<'a> {
    target_from_source: Matrix<4>,
    #[serde(skip_serializing_if = "Option::is_none")]
    initial: Option<Matrix<4>>,
    verdict: Verdict,
    confidence: f64,
    signals: Signals<'a>,
    evidence: &'a Evidence,
    overlap: f64,
    inliers: usize,
    correspondences: usize,
    sets: Vec<Set>,
    hypotheses: Vec<HypothesisRecord>,
    information: Matrix<6>,
    timings_s: Timings<'a>,
    config: Config<'a>,
    version: &'static str,
    warnings: &'a [String],
}

#[derive(Serialize)]
struct Set {
    name: SetName,
    correspondences: usize,
    inliers: usize,
}

/// Everything that was decided before or during the registration.
#[derive(Serialize)]
struct Config<'a> {
    #[serde(flatten)]
    inputs: &'a Inputs,
    preset: Preset,
    profile: Profile,
    camera: CameraChoice,
    voxel: f64,
    seed: u64,
    encoder: Encoder,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_features: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    diffusion: Option<&'a NetworkRecord>,
    #[serde(skip_serializing_if = "Option::is_none")]
    backbone: Option<&'a BackboneRecord>,
    #[serde(skip_serializing_if = "Option::is_none")]
    filter: Option<&'a FilterIdentity>,
    threads: usize,
    recipe: &'a Recipe,
    scale: Scale,
}

/// What made features.
#[derive(Serialize)]
struct Features {
    encoder: Encoder,
    preset: Preset,
    profile: Profile,
    camera: CameraChoice,
    voxel: Option<f64>,
    seed: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    diffusion: Option<NetworkRecord>,
    version: &'static str,
}

/// A transform that was compared with others; the probability is that of the model that fits what was known.
#[derive(Serialize)]
struct HypothesisRecord {
    target_from_source: Matrix<4>,
    from_initial: bool,
    /// Whether depth maps were matched from where it lies, or it was only screened.
    matched: bool,
    probability: f64,
}

impl From<&Hypothesis> for HypothesisRecord {
    fn from(hypothesis: &Hypothesis) -> HypothesisRecord {
        HypothesisRecord {
            target_from_source: rows(&hypothesis.target_from_source),
            from_initial: hypothesis.from_initial,
            matched: hypothesis.evidence.support.is_some(),
            probability: Model::ranking(&hypothesis.evidence).probability(&hypothesis.evidence),
        }
    }
}

/// The inputs of the confidence, by name.
struct Signals<'a>(&'a Evidence);

impl Serialize for Signals<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.signals())
    }
}

/// Seconds by step, in the order of the steps.
struct Timings<'a> {
    read: f64,
    steps: &'a [Timing],
    total: f64,
}

impl Serialize for Timings<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let steps = self.steps.iter().map(|timing| (timing.step.as_str(), timing.seconds));
        let ends = |name, seconds| std::iter::once((name, seconds));
        serializer
            .collect_map(ends("read", self.read).chain(steps).chain(ends("total", self.total)))
    }
}

/// The record as text.
pub(crate) fn to_json(registration: &Registration) -> Result<String> {
    let refinement = &registration.refinement;
    let sets = refinement.sets.iter().map(|set| Set {
        name: set.name,
        correspondences: set.correspondences,
        inliers: set.inliers,
    });
    let information = &refinement.information;
    let record = Record {
        target_from_source: rows(&refinement.target_from_source),
        initial: registration.initial.as_ref().map(rows),
        verdict: registration.verdict(),
        confidence: refinement.confidence,
        signals: Signals(&refinement.evidence),
        evidence: &refinement.evidence,
        overlap: refinement.overlap,
        inliers: refinement.inliers,
        correspondences: refinement.correspondences,
        sets: sets.collect(),
        hypotheses: refinement.hypotheses.iter().map(HypothesisRecord::from).collect(),
        information: matrix(|row, column| information[(row, column)]),
        timings_s: Timings {
            read: registration.read_seconds,
            steps: &refinement.timings,
            total: registration.total_seconds,
        },
        config: config(registration),
        version: env!("CARGO_PKG_VERSION"),
        warnings: &refinement.warnings,
    };
    Ok(serde_json::to_string_pretty(&record)? + "\n")
}

/// The settings that made features, which are kept with them.
pub(crate) fn features_to_json(
    settings: &Settings,
    network: Option<NetworkRecord>,
) -> Result<String> {
    let features = Features {
        encoder: settings.encoder,
        preset: settings.preset,
        profile: settings.refiner.profile,
        camera: settings.refiner.camera,
        voxel: settings.refiner.voxel,
        seed: settings.refiner.seed,
        diffusion: network,
        version: env!("CARGO_PKG_VERSION"),
    };
    Ok(serde_json::to_string_pretty(&features)? + "\n")
}

fn config(registration: &Registration) -> Config<'_> {
    let (settings, scale) = (&registration.settings, registration.refinement.scale);
    Config {
        inputs: &registration.inputs,
        preset: settings.preset,
        profile: settings.refiner.profile,
        camera: chosen_camera(settings.refiner.camera, scale.kind, &settings.refiner.recipe),
        voxel: scale.voxel,
        seed: settings.refiner.seed,
        encoder: settings.encoder,
        depth_features: settings.depth_features.as_ref().map(|file| file.display().to_string()),
        diffusion: registration.network.as_ref(),
        backbone: registration.backbone.as_ref(),
        filter: registration.filter.as_ref(),
        threads: rayon::current_num_threads(),
        recipe: &settings.refiner.recipe,
        scale,
    }
}

/// The cameras that `auto` stands for.
fn chosen_camera(choice: CameraChoice, kind: SceneKind, recipe: &Recipe) -> CameraChoice {
    match (choice, kind) {
        (CameraChoice::Auto, SceneKind::Indoor) => CameraChoice::Sensor,
        // In metres, as the paper has it, a street is seen through KITTI's one colour camera.
        (CameraChoice::Auto, SceneKind::Lidar) if recipe.metric => CameraChoice::Kitti,
        (CameraChoice::Auto, SceneKind::Lidar) => CameraChoice::Ring,
        (CameraChoice::Auto, SceneKind::Object) => CameraChoice::Overlap,
        (choice, _) => choice,
    }
}

pub(crate) fn rows(pose: &RigidTransform) -> Matrix<4> {
    let pose: Matrix4<f64> = pose.to_matrix();
    // Adding zero turns -0 into 0.
    matrix(|row, column| pose[(row, column)] + 0.0)
}

fn matrix<const N: usize>(element: impl Fn(usize, usize) -> f64) -> Matrix<N> {
    std::array::from_fn(|row| std::array::from_fn(|column| element(row, column)))
}
