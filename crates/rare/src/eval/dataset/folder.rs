//! A plain folder: `cloud_bin_N.ply`, a list of pairs as JSON, and sets of initial transforms as JSON.
//!
//! A pair is `{"src": j, "ref": i, "gt": 4x4, "info": 6x6, "overlap": f}` (the last two may be missing), an initial
//! transform `{"src": j, "ref": i, "init": 4x4}` in the list `pairs` of an object; matrices move the source into the
//! frame of the reference. Other keys are allowed.

use std::collections::BTreeSet;
use std::path::Path;

use nalgebra::{Matrix4, Matrix6};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::{Dataset, DatasetPair, StartPose};
use crate::error::{Error, Result};
use crate::eval::{Protocol, TruePair};
use crate::io::read_text;

/// A pair as the list has it.
#[derive(Deserialize)]
struct ListedPair {
    src: usize,
    #[serde(rename = "ref")]
    reference: usize,
    overlap: Option<f64>,
    info: Option<[[f64; 6]; 6]>,
    #[serde(flatten)]
    others: serde_json::Map<String, Value>,
}

/// Reads the list of pairs `list` of a folder; `truth` is the key of the true transform, usually `gt`.
///
/// # Errors
/// `Io` or `InvalidInput`, naming the file and the pair, if the list is malformed, has a pair twice, lacks a truth, or
/// names a cloud that is not there.
pub fn read_folder(folder: impl AsRef<Path>, list: &str, truth: &str) -> Result<Dataset> {
    let folder = folder.as_ref();
    let path = folder.join(list);
    let listed: Vec<ListedPair> = parse(&path, &read_text(&path)?)?;
    let scene = folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned();
    let mut seen = BTreeSet::new();
    let mut pairs = Vec::with_capacity(listed.len());
    for (index, pair) in listed.into_iter().enumerate() {
        let name = format!("pair {} -> {}", pair.src, pair.reference);
        if !seen.insert((pair.src, pair.reference)) {
            return Err(Error::in_file(&path, format!("{name} is listed twice")));
        }
        let rows =
            pair.others.get(truth).cloned().and_then(|rows| serde_json::from_value(rows).ok());
        let Some(target_from_source) = rows.as_ref().map(matrix) else {
            return Err(Error::in_file(&path, format!("{name} has no 4 x 4 matrix `{truth}`")));
        };
        pairs.push(DatasetPair {
            source: cloud(folder, pair.src)?,
            reference: cloud(folder, pair.reference)?,
            truth: TruePair {
                scene: scene.clone(),
                source: pair.src,
                reference: pair.reference,
                target_from_source,
                information: pair
                    .info
                    .map(|rows| Matrix6::from_fn(|row, column| rows[row][column])),
                overlap: pair.overlap,
                is_first_of_scene: index == 0,
            },
        });
    }
    if pairs.is_empty() {
        return Err(Error::in_file(&path, "the list has no pairs"));
    }
    Ok(Dataset { name: scene, protocol: Protocol::Plain, pairs })
}

/// Reads a set of initial transforms.
///
/// # Errors
/// `Io` or `InvalidInput`, naming the file, if it is malformed or has a pair twice.
pub fn read_folder_starts(path: impl AsRef<Path>) -> Result<Vec<StartPose>> {
    #[derive(Deserialize)]
    struct Starts {
        pairs: Vec<Start>,
    }
    #[derive(Deserialize)]
    struct Start {
        src: usize,
        #[serde(rename = "ref")]
        reference: usize,
        init: [[f64; 4]; 4],
    }
    let path = path.as_ref();
    let starts: Starts = parse(path, &read_text(path)?)?;
    let mut seen = BTreeSet::new();
    let twice = starts.pairs.iter().find(|pair| !seen.insert((pair.src, pair.reference)));
    if let Some(pair) = twice {
        let what = format!("pair {} -> {} is listed twice", pair.src, pair.reference);
        return Err(Error::in_file(path, what));
    }
    let start = |pair: &Start| StartPose {
        scene: String::new(),
        source: pair.src,
        reference: pair.reference,
        target_from_source: matrix(&pair.init),
    };
    Ok(starts.pairs.iter().map(start).collect())
}

fn parse<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    // serde_json's message ends with line and column.
    serde_json::from_str(text).map_err(|cause| Error::in_file(path, cause))
}

fn matrix(rows: &[[f64; 4]; 4]) -> Matrix4<f64> {
    Matrix4::from_fn(|row, column| rows[row][column])
}

fn cloud(folder: &Path, number: usize) -> Result<std::path::PathBuf> {
    let path = folder.join(format!("cloud_bin_{number}.ply"));
    if path.is_file() {
        Ok(path)
    } else {
        Err(Error::in_file(&path, "no such file, but the list of pairs has it"))
    }
}
