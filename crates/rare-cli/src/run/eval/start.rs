//! Where the methods start from.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, bail};
use rare::InitialMethod;
use rare::eval::dataset::{self, Dataset, StartPose};
use rare::eval::trajectory;
use rare::nalgebra::Matrix4;
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error as ValueError, StrDeserializer};
use serde_json::{Value, json};

/// The initial transforms of a benchmark.
pub(super) enum Starts {
    /// One per pair, by the index of the pair.
    Given(Vec<Matrix4<f64>>),
    /// Made for each pair.
    Estimated(InitialMethod),
}

impl Starts {
    /// Reads the transforms that `init` names: a method, a JSON file (in the dataset's folder or anywhere), or a folder
    /// of scenes with `est.log`.
    ///
    /// # Errors
    /// If there is no such thing, it is malformed, or a pair has no initial transform.
    pub(super) fn read(init: &str, root: &Path, dataset: &Dataset) -> Result<Starts> {
        let name: StrDeserializer<'_, ValueError> = init.into_deserializer();
        if let Ok(method) = InitialMethod::deserialize(name) {
            return Ok(Starts::Estimated(method));
        }
        let path =
            if Path::new(init).exists() { Path::new(init).to_owned() } else { root.join(init) };
        if !path.exists() {
            bail!("--init {init}: neither a file, nor a file in {}, nor a method", root.display());
        }
        let poses = if path.is_dir() {
            read_logs(&path, dataset)?
        } else {
            dataset::read_folder_starts(&path)?
        };
        in_order(&poses, dataset, &path).map(Starts::Given)
    }

    /// What results depend on.
    pub(super) fn description(&self) -> Value {
        match self {
            Starts::Given(poses) => {
                let poses: Vec<Vec<f64>> =
                    poses.iter().map(|pose| pose.transpose().iter().copied().collect()).collect();
                json!({ "given": poses })
            }
            Starts::Estimated(method) => json!({ "estimated": method }),
        }
    }
}

/// The logs of all scenes.
fn read_logs(folder: &Path, dataset: &Dataset) -> Result<Vec<StartPose>> {
    let mut poses = Vec::new();
    let mut scenes: Vec<&str> =
        dataset.pairs.iter().map(|pair| pair.truth.scene.as_str()).collect();
    scenes.dedup();
    for scene in scenes {
        let blocks = trajectory::read_log(folder.join(scene).join("est.log"))?;
        poses.extend(blocks.into_iter().map(|block| StartPose {
            scene: scene.to_owned(),
            source: block.second,
            reference: block.first,
            target_from_source: block.matrix,
        }));
    }
    Ok(poses)
}

fn in_order(poses: &[StartPose], dataset: &Dataset, path: &Path) -> Result<Vec<Matrix4<f64>>> {
    let by_pair: BTreeMap<_, _> = poses
        .iter()
        .map(|pose| ((pose.scene.as_str(), pose.source, pose.reference), pose.target_from_source))
        .collect();
    let find = |pair: &dataset::DatasetPair| {
        let (truth, scenes) = (&pair.truth, [pair.truth.scene.as_str(), ""]);
        let found =
            scenes.iter().find_map(|scene| by_pair.get(&(*scene, truth.source, truth.reference)));
        match found {
            Some(pose) => Ok(*pose),
            None => bail!(
                "{}: no initial transform of {} {} -> {}",
                path.display(),
                truth.scene,
                truth.source,
                truth.reference
            ),
        }
    };
    dataset.pairs.iter().map(find).collect()
}
