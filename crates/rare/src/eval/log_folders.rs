//! The layout of the 3DMatch benchmark: a folder of scenes with `gt.log` and `gt.info` (and `gt_overlap.log`), and a
//! folder of scenes with a method's `est.log`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::Matrix4;

use super::scored::{ScoredPair, TruePair};
use super::trajectory::{self, Block, at};
use crate::error::{Error, Result};

/// What to do about pairs of the truth that a method's log lacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// An error.
    Refuse,
    /// They are not solved.
    CountAsFailures,
}

/// Reads the truth of all scenes of a folder, scenes by name, pairs in the order of `gt.log`.
///
/// # Errors
/// `Io` or `InvalidInput`, naming file and line, if a folder has no scene, a file cannot be read or is malformed.
pub fn read_truth(folder: impl AsRef<Path>) -> Result<Vec<TruePair>> {
    let folder = folder.as_ref();
    let mut pairs = Vec::new();
    for scene in scenes(folder, "gt.log")? {
        pairs.extend(read_scene(folder, &scene)?);
    }
    Ok(pairs)
}

/// Scores a folder of `est.log` files.
///
/// # Errors
/// `Io` or `InvalidInput`, naming file and line, if a scene has no log, a log is malformed, has a pair that the truth lacks,
/// or (with [`Missing::Refuse`]) lacks one.
pub fn score(
    truth: &[TruePair],
    estimates: impl AsRef<Path>,
    missing: Missing,
) -> Result<Vec<ScoredPair>> {
    let mut logs: BTreeMap<&str, SceneLog> = BTreeMap::new();
    for pair in truth {
        if !logs.contains_key(pair.scene.as_str()) {
            logs.insert(&pair.scene, SceneLog::read(estimates.as_ref(), &pair.scene)?);
        }
    }
    let scored = truth.iter().map(|pair| {
        let log = logs.get_mut(pair.scene.as_str());
        let estimate = log.and_then(|log| log.blocks.remove(&(pair.reference, pair.source)));
        ScoredPair::new(pair, estimate.map(|block| block.matrix).as_ref())
    });
    let scored: Vec<ScoredPair> = scored.collect();
    for log in logs.values() {
        log.check_empty()?;
    }
    match scored.iter().find(|pair| pair.errors.is_none()) {
        Some(pair) if missing == Missing::Refuse => Err(Error::in_file(
            estimate_path(estimates.as_ref(), &pair.scene),
            format!(
                "no estimate of the pair {} {}, which the truth has: add it, or let missing pairs count as failures",
                pair.reference, pair.source
            ),
        )),
        _ => Ok(scored),
    }
}

/// The estimates of one scene that have not been taken yet.
struct SceneLog {
    path: PathBuf,
    blocks: BTreeMap<(usize, usize), Block<4>>,
}

impl SceneLog {
    fn read(estimates: &Path, scene: &str) -> Result<SceneLog> {
        let path = estimate_path(estimates, scene);
        let blocks = trajectory::read_log(&path)?;
        let blocks = blocks.into_iter().map(|block| ((block.first, block.second), block)).collect();
        Ok(SceneLog { path, blocks })
    }

    fn check_empty(&self) -> Result<()> {
        match self.blocks.values().min_by_key(|block| block.line) {
            Some(block) => Err(at(
                &self.path,
                block.line,
                &format!("the truth has no pair {} {}", block.first, block.second),
            )),
            None => Ok(()),
        }
    }
}

fn estimate_path(estimates: &Path, scene: &str) -> PathBuf {
    estimates.join(scene).join("est.log")
}

/// The names of the folders that hold a file, sorted.
fn scenes(folder: &Path, file: &str) -> Result<Vec<String>> {
    let entries = fs::read_dir(folder).map_err(|cause| Error::io(folder, cause))?;
    let mut names = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|cause| Error::io(folder, cause))?;
        if entry.path().join(file).is_file() {
            names.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    names.sort();
    if names.is_empty() {
        return Err(Error::in_file(folder, format!("no scene here: no folder holds a {file}")));
    }
    Ok(names)
}

fn read_scene(folder: &Path, scene: &str) -> Result<Vec<TruePair>> {
    let folder = folder.join(scene);
    let path = folder.join("gt.log");
    let log = trajectory::read_log(&path)?;
    if let Some(block) = log.iter().find(|block| !is_nearly_rigid(&block.matrix)) {
        return Err(at(&path, block.line, "the true transform is not rigid"));
    }
    let information = trajectory::read_information(folder.join("gt.info"))?;
    let information = trajectory::information_of(&log, &path, &information)?;
    let overlaps = folder.join("gt_overlap.log");
    let overlaps =
        if overlaps.is_file() { trajectory::read_overlaps(overlaps)? } else { BTreeMap::new() };
    let pair = |(index, (block, information)): (usize, (&Block<4>, _))| TruePair {
        scene: scene.to_owned(),
        source: block.second,
        reference: block.first,
        target_from_source: block.matrix,
        information: Some(information),
        overlap: overlaps.get(&(block.first, block.second)).copied(),
        is_first_of_scene: index == 0,
    };
    Ok(log.iter().zip(information).enumerate().map(pair).collect())
}

/// Whether a truth is rigid up to the digits that are printed (the official ones deviate by up to `5e-4`).
fn is_nearly_rigid(matrix: &Matrix4<f64>) -> bool {
    let rotation = matrix.fixed_view::<3, 3>(0, 0);
    let deviation = (rotation.transpose() * rotation - nalgebra::Matrix3::identity()).amax();
    deviation < 1e-2 && rotation.determinant() > 0.0
}
