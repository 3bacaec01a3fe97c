//! What a page is made of, as its scripts read it.

use anyhow::Result;
use rare::nalgebra::Point3;
use rare::refine::{IllustratedCloud, IllustratedMap, IllustratedView, Illustration, PixelMatch};
use rare::scale::SceneKind;
use rare::verify::{REJECT_BELOW, Verdict};
use rare::viewpoints::Frame;
use rare::{PointCloud, RigidTransform, SetName};
use serde::Serialize;
use serde_json::Value;

use super::clouds::{Bounds, cloud_bytes, match_bytes};
use super::{command, page};
use crate::images::{self, Image};
use crate::record::{self, Matrix, rows};
use crate::run::Registration;
use crate::summary;

/// Of each set no more correspondences than that are drawn, evenly chosen.
const MOST_MATCHES: usize = 2000;
/// Bars of the histogram of residuals, ...
const BARS: usize = 40;
/// ... which ends at so many voxels.
const HISTOGRAM_VOXELS: f64 = 4.0;
/// Residuals are coloured up to so many voxels: where a correspondence is no inlier any more.
const COLOUR_VOXELS: f64 = 2.0;

/// A page and the binary data that it refers to.
pub(super) struct Report {
    pub(super) page: Page,
    pub(super) blobs: Vec<(String, Vec<u8>)>,
}

#[derive(Serialize)]
pub(super) struct Page {
    pub(super) title: String,
    version: &'static str,
    verdict: VerdictInWords,
    /// Name, value, what it means.
    numbers: Vec<[String; 3]>,
    warnings: Vec<String>,
    inputs: Inputs,
    transform: Transform,
    initial: Option<Transform>,
    command: String,
    record: Value,
    scene: Scene,
    sets: Vec<Set>,
    views: Vec<View>,
    residuals: Histogram,
    timings: Vec<(String, f64)>,
}

#[derive(Serialize)]
struct VerdictInWords {
    kind: Verdict,
    headline: String,
    explanation: String,
}

#[derive(Serialize)]
struct Inputs {
    source: String,
    reference: String,
}

#[derive(Serialize)]
struct Transform {
    rows: Matrix<4>,
    direction: &'static str,
}

#[derive(Serialize)]
struct Scene {
    kind: String,
    voxel: f64,
    up: [f64; 3],
    residual_end: f64,
    poses: Vec<Pose>,
    clouds: Clouds,
}

#[derive(Serialize)]
struct Pose {
    key: &'static str,
    name: &'static str,
    rows: Matrix<4>,
}

#[derive(Serialize)]
struct Clouds {
    source: Cloud,
    reference: Cloud,
}

#[derive(Serialize)]
struct Cloud {
    points: usize,
    shown: usize,
    low: [f64; 3],
    size: [f64; 3],
    blob: &'static str,
}

#[derive(Serialize)]
struct Set {
    name: SetName,
    label: &'static str,
    correspondences: usize,
    inliers: usize,
    /// Of the inliers, metres.
    median_residual: Option<f64>,
    shown: usize,
    blob: String,
}

#[derive(Serialize)]
struct View {
    name: String,
    frame: Frame,
    width: usize,
    height: usize,
    depth_range: Option<[f32; 2]>,
    reference: Map,
    source: Map,
    masks: Vec<Mask>,
    /// Column and row in the source's map, the same in the reference's, whether it is an inlier, the number of its set.
    matches: Vec<[usize; 6]>,
}

#[derive(Serialize)]
struct Map {
    sparse: String,
    dense: String,
    features: String,
}

#[derive(Serialize)]
struct Mask {
    key: &'static str,
    name: &'static str,
    image: String,
}

#[derive(Serialize)]
struct Histogram {
    end: f64,
    counts: Vec<Counts>,
}

#[derive(Serialize)]
struct Counts {
    key: &'static str,
    name: &'static str,
    counts: Vec<usize>,
    beyond: usize,
}

impl Report {
    pub(super) fn new(registration: &Registration, illustration: &Illustration) -> Result<Report> {
        let refinement = &registration.refinement;
        let poses = poses(registration);
        let (scene, mut blobs) = scene(registration, illustration, &poses);
        let mut sets = Vec::new();
        for set in &refinement.matches.sets {
            let (set, bytes) = self::set(registration, set, sets.len());
            blobs.push((set.blob.clone(), bytes));
            sets.push(set);
        }
        let inputs = &registration.inputs;
        let timings = refinement.timings.iter();
        let page = Page {
            title: format!("{} onto {}", file_name(&inputs.source), file_name(&inputs.reference)),
            version: env!("CARGO_PKG_VERSION"),
            verdict: verdict(registration),
            numbers: numbers(registration),
            warnings: refinement.warnings.clone(),
            inputs: Inputs { source: inputs.source.clone(), reference: inputs.reference.clone() },
            transform: transform(&refinement.target_from_source),
            initial: registration.initial.as_ref().map(transform),
            command: command::line(registration),
            record: serde_json::from_str(&record::to_json(registration)?)?,
            scene,
            views: views(illustration, &poses, &sets)?,
            sets,
            residuals: histogram(registration, &illustration.source, &poses),
            timings: timings.map(|timing| (timing.step.clone(), timing.seconds)).collect(),
        };
        Ok(Report { page, blobs })
    }
}

/// The transforms that the illustration judged, in its order.
fn poses(registration: &Registration) -> Vec<Pose> {
    let (source, reference) = (&registration.source.cloud, &registration.reference.cloud);
    let pose = |key, name, pose: &RigidTransform| {
        let local = PointCloud::to_local(reference, source, pose);
        Pose { key, name, rows: rows(&local) }
    };
    let result = match registration.verdict() {
        Verdict::Refined if registration.initial.is_some() => "refined",
        Verdict::Refined => "registered",
        Verdict::KeptInitial => "result",
        Verdict::Rejected => "best guess",
    };
    let mut poses = vec![pose("given", "as given", &RigidTransform::identity())];
    poses.extend(registration.initial.iter().map(|initial| pose("initial", "initial", initial)));
    poses.push(pose("result", result, &registration.refinement.target_from_source));
    poses
}

fn transform(pose: &RigidTransform) -> Transform {
    Transform {
        rows: rows(pose),
        direction: "moves points of the source into the frame of the reference: q = R p + t, metres",
    }
}

fn verdict(registration: &Registration) -> VerdictInWords {
    let refinement = &registration.refinement;
    let likely = format!(
        "The estimated probability that it is right is {:.1} %, from what the sensors, the surfaces and the correspondences say.",
        100.0 * refinement.confidence
    );
    let (headline, explanation) = match registration.verdict() {
        Verdict::Refined if registration.initial.is_none() => {
            ("Registered: a transform was found and passed verification.", likely)
        }
        Verdict::Refined => {
            ("Refined: a better transform was found and passed verification.", likely)
        }
        Verdict::KeptInitial => (
            "Kept: the initial transform passed verification and nothing better was found.",
            likely,
        ),
        Verdict::Rejected => (
            "Rejected: no transform can be trusted. What is shown is the best guess.",
            format!(
                "{likely} Below {:.0} % nothing is accepted; do not use it without looking at it.",
                100.0 * REJECT_BELOW
            ),
        ),
    };
    VerdictInWords { kind: registration.verdict(), headline: headline.to_owned(), explanation }
}

fn numbers(registration: &Registration) -> Vec<[String; 3]> {
    let refinement = &registration.refinement;
    let row =
        |name: &str, value: String, meaning: &str| [name.to_owned(), value, meaning.to_owned()];
    let (degrees, voxels) = match refinement.scale.kind {
        SceneKind::Lidar => (5, 2.0),
        SceneKind::Indoor | SceneKind::Object => (15, 6.0),
    };
    let meaning = format!(
        "probability that the transform is within {degrees} degrees and {} of the truth",
        summary::short_length(voxels * refinement.scale.voxel)
    );
    let mut numbers = vec![
        row("confidence", format!("{:.3}", refinement.confidence), &meaning),
        row(
            "overlap",
            format!("{:.1} %", 100.0 * refinement.overlap),
            "share of the source that lies on the reference",
        ),
        row(
            "inliers",
            format!("{} of {}", refinement.inliers, refinement.correspondences),
            "correspondences of all sets that agree with the transform",
        ),
    ];
    if let Some(initial) = &registration.initial {
        let (degrees, metres) = summary::moved(registration, initial);
        let moved = format!("{degrees:.2}\u{b0}, {metres:.3} m");
        numbers.push(row(
            "moved",
            moved,
            "turn, and way of the source's middle, from the initial transform",
        ));
    }
    numbers.push(row(
        "voxel",
        summary::short_length(refinement.scale.voxel),
        "the length from which all others follow",
    ));
    numbers.push(row(
        "time",
        format!("{:.2} s", registration.total_seconds),
        "reading included, this page not",
    ));
    numbers
}

fn scene(
    registration: &Registration,
    illustration: &Illustration,
    poses: &[Pose],
) -> (Scene, Vec<(String, Vec<u8>)>) {
    let scale = &registration.refinement.scale;
    let residual_end = COLOUR_VOXELS * scale.voxel;
    let cloud = |name, cloud: &PointCloud, known: &IllustratedCloud| {
        let points = cloud.points();
        let shown = known.indices.iter().filter_map(|&index| points.get(index).copied());
        let shown: Vec<Point3<f64>> = shown.collect();
        let bounds = Bounds::of(&shown);
        let bytes = cloud_bytes(&shown, &bounds, known, residual_end);
        let cloud = Cloud {
            points: points.len(),
            shown: shown.len(),
            low: bounds.low.coords.into(),
            size: bounds.size.into(),
            blob: name,
        };
        (cloud, (name.to_owned(), bytes))
    };
    let (source, source_bytes) =
        cloud("cloud-source", &registration.source.cloud, &illustration.source);
    let (reference, reference_bytes) =
        cloud("cloud-reference", &registration.reference.cloud, &illustration.reference);
    let scene = Scene {
        kind: summary::kind_in_words(scale.kind),
        voxel: scale.voxel,
        up: up(scale.kind),
        residual_end,
        poses: poses.iter().map(|pose| Pose { ..*pose }).collect(),
        clouds: Clouds { source, reference },
    };
    (scene, vec![source_bytes, reference_bytes])
}

/// Where up is in the reference's frame: a depth camera's y points down, everything else has z up.
fn up(kind: SceneKind) -> [f64; 3] {
    match kind {
        SceneKind::Indoor => [0.0, -1.0, 0.0],
        SceneKind::Lidar | SceneKind::Object => [0.0, 0.0, 1.0],
    }
}

fn set(
    registration: &Registration,
    set: &rare::CorrespondenceSet,
    number: usize,
) -> (Set, Vec<u8>) {
    let pose = local_pose(registration);
    let radius = registration.refinement.scale.acceptance_radius;
    let (source, reference) = (&registration.source.cloud, &registration.reference.cloud);
    let judged = set.pairs.iter().map(|pair| {
        let ends = [pair.source - source.shift(), pair.target - reference.shift()];
        let [moved, target] = [pose.apply(&ends[0]), ends[1]];
        (ends, (moved - target).norm())
    });
    let judged: Vec<_> = judged.collect();
    let mut agreeing: Vec<f64> =
        judged.iter().map(|(_, distance)| *distance).filter(|&d| d < radius).collect();
    agreeing.sort_by(f64::total_cmp);
    let step = judged.len().div_ceil(MOST_MATCHES).max(1);
    let drawn = judged.iter().step_by(step).map(|(ends, distance)| (*ends, *distance < radius));
    let drawn: Vec<_> = drawn.collect();
    let described = Set {
        name: set.name,
        label: label(set.name),
        correspondences: set.pairs.len(),
        inliers: agreeing.len(),
        median_residual: agreeing.get(agreeing.len() / 2).copied(),
        shown: drawn.len(),
        blob: format!("matches-{number}"),
    };
    (described, match_bytes(&drawn))
}

fn local_pose(registration: &Registration) -> RigidTransform {
    let (source, reference) = (&registration.source.cloud, &registration.reference.cloud);
    PointCloud::to_local(reference, source, &registration.refinement.target_from_source)
}

fn label(name: SetName) -> &'static str {
    match name {
        SetName::CommonReference => "common points, reference view",
        SetName::CommonSource => "common points, source view",
        SetName::DiffusionReference => "depth-map features, reference view",
        SetName::DiffusionSource => "depth-map features, source view",
        SetName::Features3d => "3D features",
    }
}

fn views(illustration: &Illustration, poses: &[Pose], sets: &[Set]) -> Result<Vec<View>> {
    let frames = [Frame::Reference, Frame::Source];
    let several = |frame| illustration.views.iter().filter(|view| view.frame == frame).count() > 1;
    let [several_reference, several_source] = frames.map(several);
    let (mut reference, mut source) = (0, 0);
    let name = |view: &IllustratedView| {
        let (name, number, several) = match view.frame {
            Frame::Reference => ("reference view", &mut reference, several_reference),
            Frame::Source => ("source view", &mut source, several_source),
        };
        *number += 1;
        if several { format!("{name} {number}") } else { name.to_owned() }
    };
    let names: Vec<String> = illustration.views.iter().map(name).collect();
    let views = illustration.views.iter().zip(names);
    views.map(|(view, name)| self::view(view, name, poses, sets)).collect()
}

fn view(view: &IllustratedView, name: String, poses: &[Pose], sets: &[Set]) -> Result<View> {
    let range = images::depth_range([&view.reference, &view.source]);
    let features = [&view.reference.features, &view.source.features];
    let [reference, source] = images::feature_images(features);
    let map = |map: &IllustratedMap, features: &Image| -> Result<Map> {
        Ok(Map {
            sparse: address(&images::depth_image(&map.sparse, range))?,
            dense: address(&images::depth_image(&map.dense, range))?,
            features: address(features)?,
        })
    };
    let masks = poses.iter().zip(&view.masks).filter(|(pose, _)| pose.key != "given");
    let masks = masks.map(|(pose, mask)| {
        let image = address(&images::mask_image(mask))?;
        Ok(Mask { key: pose.key, name: pose.name, image })
    });
    let matches = view.matches.iter().filter_map(|found| match_numbers(found, sets));
    Ok(View {
        name,
        frame: view.frame,
        width: view.reference.dense.width(),
        height: view.reference.dense.height(),
        depth_range: range,
        reference: map(&view.reference, &reference)?,
        source: map(&view.source, &source)?,
        masks: masks.collect::<Result<_>>()?,
        matches: matches.collect(),
    })
}

fn match_numbers(found: &PixelMatch, sets: &[Set]) -> Option<[usize; 6]> {
    let set = sets.iter().position(|set| set.name == found.set)?;
    let (source, reference) = (found.source, found.reference);
    Some([source.0, source.1, reference.0, reference.1, usize::from(found.inlier), set])
}

fn address(image: &Image) -> Result<String> {
    Ok(page::image_address(&image.to_png()?))
}

fn histogram(registration: &Registration, source: &IllustratedCloud, poses: &[Pose]) -> Histogram {
    let end = HISTOGRAM_VOXELS * registration.refinement.scale.voxel;
    let judged = poses.iter().zip(&source.residuals).filter(|(pose, _)| pose.key != "given");
    let counts = judged.map(|(pose, residuals)| {
        let mut counts = vec![0; BARS];
        let mut beyond = 0;
        for residual in residuals {
            let bar = f64::from(*residual) / end * BARS as f64;
            match counts.get_mut(bar as usize) {
                Some(count) => *count += 1,
                None => beyond += 1,
            }
        }
        Counts { key: pose.key, name: pose.name, counts, beyond }
    });
    Histogram { end, counts: counts.collect() }
}

/// The last part of a path.
fn file_name(path: &str) -> &str {
    path.rsplit(['/', '\\']).find(|part| !part.is_empty()).unwrap_or(path)
}
