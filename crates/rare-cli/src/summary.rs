//! What people read: a few lines on stderr.

use std::fmt::Write as _;
use std::io::{self, Write as _};

use rare::scale::SceneKind;
use rare::verify::Verdict;
use rare::{PointCloud, Refinement, RigidTransform};

use crate::run::Registration;

/// Prints a line on stderr. Nobody can be told if that fails.
pub(crate) fn say(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}

/// What came out, in plain words.
pub(crate) fn describe(registration: &Registration) -> String {
    let refinement = &registration.refinement;
    let mut text = format!("{}\n", verdict_in_words(registration));
    let mut line = |name: &str, value: String| row(&mut text, name, &value);
    line("confidence", format!("{:.3} (0 to 1)", refinement.confidence));
    line("overlap", format!("{:.1} % of the source", 100.0 * refinement.overlap));
    line(
        "inliers",
        format!("{} of {} correspondences", refinement.inliers, refinement.correspondences),
    );
    if let Some(initial) = &registration.initial {
        let (degrees, metres) = moved(registration, initial);
        line("moved", format!("{degrees:.3} degrees and {metres:.4} m from the initial transform"));
    }
    line(
        "time",
        format!("{:.2} s (reading {:.2} s)", registration.total_seconds, registration.read_seconds),
    );
    text.trim_end().to_owned()
}

fn verdict_in_words(registration: &Registration) -> &'static str {
    match registration.verdict() {
        Verdict::Refined if registration.initial.is_none() => {
            "registered: a transform was found and passed verification"
        }
        Verdict::Refined => "refined: a better transform was found and passed verification",
        Verdict::KeptInitial => {
            "kept the initial transform: it passed verification and nothing better was found"
        }
        Verdict::Rejected => {
            "rejected: no transform can be trusted, this is the best guess (exit code 1)"
        }
    }
}

/// How far the initial transform was changed: the turn, degrees, and the way of the source's middle, metres.
pub(crate) fn moved(registration: &Registration, initial: &RigidTransform) -> (f64, f64) {
    let (source, reference) = (&registration.source.cloud, &registration.reference.cloud);
    let found = &registration.refinement.target_from_source;
    let (low, high) = source.bounds();
    let middle = rare::nalgebra::center(&low, &high);
    let place = |pose| PointCloud::to_local(reference, source, pose).apply(&middle);
    (found.error_to(initial).rotation_degrees, (place(found) - place(initial)).norm())
}

/// The evidence by set and the time by step.
pub(crate) fn describe_details(refinement: &Refinement) -> String {
    let mut text = String::from("sets of correspondences (inliers of all)\n");
    for set in &refinement.sets {
        let value = format!("{} of {}", set.inliers, set.correspondences);
        row(&mut text, set.name.as_str(), &value);
    }
    text.push_str("time by step\n");
    for timing in &refinement.timings {
        row(&mut text, &timing.step, &format!("{:.3} s", timing.seconds));
    }
    text.push_str("decided from the clouds\n");
    row(&mut text, "scene", &kind_in_words(refinement.scale.kind));
    row(&mut text, "voxel", &short_length(refinement.scale.voxel));
    text.trim_end().to_owned()
}

/// The kind of scene as options name it.
pub(crate) fn kind_in_words(kind: SceneKind) -> String {
    format!("{kind:?}").to_lowercase()
}

/// A length whose few digits hold for figurines and streets alike.
pub(crate) fn short_length(metres: f64) -> String {
    // Single precision prints 0.026 where double precision knows of 0.026000000000000002.
    format!("{} m", metres as f32)
}

/// A name and its value, in columns.
pub(crate) fn row(text: &mut String, name: &str, value: &str) {
    // Writing to a string does not fail.
    let _ = writeln!(text, "  {name:<14} {value}");
}
