//! 3DMatch and 3DLoMatch in the layouts that people have: Predator's and GeoTransformer's (`.pth` fragments), Princeton's
//! and PointDSC's (`.ply` fragments).
//!
//! The list of pairs and their truth are the `gt.log` and `gt.info` of each scene; the fragments are sought in the
//! folders of the known layouts. What a fragment's file holds is for the reader of clouds to find out.

use std::path::{Path, PathBuf};

use super::{Dataset, DatasetPair};
use crate::error::{Error, Result};
use crate::eval::{Protocol, log_folders};

/// Where the truth of a benchmark lies, below the root; `{}` is its name (`3DMatch`, `3DLoMatch`).
const TRUTHS: [&str; 6] = [
    "metadata/benchmarks/{}",
    "data/3DMatch/metadata/benchmarks/{}",
    "benchmarks/{}",
    "configs/benchmarks/{}",
    "gt_result",
    "",
];

/// Where a fragment lies, below the root; `{s}` is the scene, `{n}` the number.
const FRAGMENTS: [&str; 12] = [
    "data/test/{s}/cloud_bin_{n}.pth",
    "data/3DMatch/data/test/{s}/cloud_bin_{n}.pth",
    "data/indoor/test/{s}/cloud_bin_{n}.pth",
    "indoor/test/{s}/cloud_bin_{n}.pth",
    "test/{s}/cloud_bin_{n}.pth",
    "{s}/cloud_bin_{n}.pth",
    "fragments/{s}/cloud_bin_{n}.ply",
    "{s}/fragments/cloud_bin_{n}.ply",
    "{s}/cloud_bin_{n}.ply",
    "test/{s}/fragments/cloud_bin_{n}.ply",
    "test/{s}/cloud_bin_{n}.ply",
    "data/test/{s}/cloud_bin_{n}.ply",
];

/// Reads a benchmark by its name, `3DMatch` or `3DLoMatch`.
///
/// # Errors
/// `InvalidInput` if the root has none of the known layouts, naming what was sought; otherwise as
/// [`log_folders::read_truth`].
pub fn read_three_d_match(root: impl AsRef<Path>, name: &str) -> Result<Dataset> {
    let root = root.as_ref();
    let truth = log_folders::read_truth(truth_folder(root, name)?)?;
    let mut layout = None;
    let mut pairs = Vec::with_capacity(truth.len());
    for truth in truth {
        let mut find = |number| fragment(root, &truth.scene, number, &mut layout);
        let (source, reference) = (find(truth.source)?, find(truth.reference)?);
        pairs.push(DatasetPair { truth, source, reference });
    }
    Ok(Dataset { name: name.to_owned(), protocol: Protocol::Predator, pairs })
}

/// The folder of scenes with `gt.log`.
fn truth_folder(root: &Path, name: &str) -> Result<PathBuf> {
    let holds_scenes = |folder: &PathBuf| {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        entries.into_iter().any(|entry| entry.path().join("gt.log").is_file())
    };
    let candidates = TRUTHS.map(|folder| root.join(folder.replace("{}", name)));
    candidates.into_iter().find(holds_scenes).ok_or_else(|| {
        Error::in_file(
            root,
            format!(
                "no {name} here: sought the folders of scenes with gt.log and gt.info in {}",
                TRUTHS.map(|folder| folder.replace("{}", name)).join(", ")
            ),
        )
    })
}

/// The file of a fragment, in the layout of the ones before.
fn fragment(
    root: &Path,
    scene: &str,
    number: usize,
    layout: &mut Option<&'static str>,
) -> Result<PathBuf> {
    // Princeton's truth stands in `<scene>-evaluation` beside the scene.
    let scene = scene.strip_suffix("-evaluation").unwrap_or(scene);
    let path =
        |layout: &str| root.join(layout.replace("{s}", scene).replace("{n}", &number.to_string()));
    let found = layout.iter().copied().chain(FRAGMENTS).find(|layout| path(layout).is_file());
    *layout = found;
    found.map(path).ok_or_else(|| {
        Error::in_file(
            root,
            format!(
                "fragment {number} of the scene {scene} is missing: sought {}",
                FRAGMENTS.map(|layout| layout.replace("{s}", scene)).join(", ")
            ),
        )
    })
}
