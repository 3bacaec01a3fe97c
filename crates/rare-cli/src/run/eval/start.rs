//! Where the methods start from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use rare::eval::dataset::{self, Dataset, StartPose};
use rare::eval::trajectory;
use rare::nalgebra::{Matrix4, Point3};
use rare::pose::{PoseEstimator, Ransac};
use rare::{Correspondence, InitialMethod, PointCloud};
use rare_nets::backbones::Description;
use rare_nets::official;
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
    /// What official runs left of each pair, correspondences and perhaps a transform.
    Dumped(Vec<PathBuf>),
    /// Made for each pair by the network that describes it.
    Described,
}

/// Where the methods start on one pair.
pub(super) struct Start {
    /// Moves the source into the frame of the reference; why there is none, if what made the correspondences found none.
    pub(super) pose: Result<Matrix4<f64>, String>,
    /// Correspondences that came with it, best first.
    pub(super) correspondences: Option<Vec<Correspondence>>,
    /// What a network said of the pair, which has its features then.
    pub(super) description: Option<Description>,
}

impl Starts {
    /// Reads the transforms that `init` names: a method, a JSON file (in the dataset's folder or anywhere), or a folder
    /// of scenes with `est.log`, or one of dumps.
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
        if let Some(dumps) = dumps(&path, dataset) {
            return Ok(Starts::Dumped(dumps));
        }
        let poses = if path.is_dir() {
            read_logs(&path, dataset)?
        } else if path.extension().is_some_and(|extension| extension == "log") {
            // A log does not say of which scene it is.
            read_log(&path, "")?
        } else {
            dataset::read_folder_starts(&path)?
        };
        in_order(&poses, dataset, &path).map(Starts::Given)
    }

    /// Whether transforms are all that there is.
    pub(super) fn lack_correspondences(&self) -> bool {
        !matches!(self, Starts::Dumped(_) | Starts::Described)
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
            Starts::Described => json!("described"),
            Starts::Dumped(files) => {
                let files = files.iter().map(|file| file.display().to_string());
                json!({ "dumped": files.collect::<Vec<_>>() })
            }
        }
    }
}

impl Start {
    /// A transform alone.
    pub(super) fn at(pose: Matrix4<f64>) -> Start {
        Start { pose: Ok(pose), correspondences: None, description: None }
    }

    /// The transform.
    ///
    /// # Errors
    /// `NoPose` if there is none.
    pub(super) fn pose(&self) -> rare::Result<Matrix4<f64>> {
        self.pose.clone().map_err(rare::Error::no_pose)
    }

    /// Reads a dump and keeps so many of its correspondences, those with the highest scores. Where it has no transform
    /// (always of CoFiNet and Predator), RANSAC makes one of them, as those networks' own scripts do.
    pub(super) fn read(file: &Path, most: usize, ransac: &Ransac) -> rare::Result<Start> {
        let (mut correspondences, pose) = if official::is_fragment(file) {
            (official::read_network_dump(file)?, None)
        } else {
            let dump = rare::io::read_registration_dump(file)?;
            (dump.correspondences, dump.target_from_source)
        };
        correspondences.sort_by(|a, b| b.score.total_cmp(&a.score));
        correspondences.truncate(most);
        let pose = match pose {
            Some(pose) => Ok(pose),
            None => {
                let point = PointCloud::new(vec![Point3::origin()])?;
                let found = ransac.estimate(&point, &point, &correspondences);
                found.map(|found| found.target_from_source.to_matrix()).map_err(|e| e.to_string())
            }
        };
        Ok(Start { pose, correspondences: Some(correspondences), description: None })
    }
}

/// The dumps of all pairs, if they are there: `SCENE/REF_SRC.npz` or `SEQUENCE_SRC_REF.npz` (GeoTransformer), or `N.pth` by
/// the place in the list (CoFiNet, Predator).
fn dumps(folder: &Path, dataset: &Dataset) -> Option<Vec<PathBuf>> {
    let file = |(index, pair): (usize, &dataset::DatasetPair)| {
        let (scene, source, reference) =
            (&pair.truth.scene, pair.truth.source, pair.truth.reference);
        let indoors = folder.join(scene).join(format!("{reference}_{source}.npz"));
        let sequence = scene.trim_start_matches('0');
        let outdoors = folder.join(format!("{sequence}_{source}_{reference}.npz"));
        let by_place = folder.join(format!("{index}.pth"));
        [indoors, outdoors, by_place].into_iter().find(|file| file.is_file())
    };
    dataset.pairs.iter().enumerate().map(file).collect()
}

/// The logs of all scenes.
fn read_logs(folder: &Path, dataset: &Dataset) -> Result<Vec<StartPose>> {
    let mut poses = Vec::new();
    let mut scenes: Vec<&str> =
        dataset.pairs.iter().map(|pair| pair.truth.scene.as_str()).collect();
    scenes.dedup();
    for scene in scenes {
        poses.extend(read_log(&folder.join(scene).join("est.log"), scene)?);
    }
    Ok(poses)
}

fn read_log(path: &Path, scene: &str) -> Result<Vec<StartPose>> {
    let start = |block: trajectory::Block<4>| StartPose {
        scene: scene.to_owned(),
        source: block.second,
        reference: block.first,
        target_from_source: block.matrix,
    };
    Ok(trajectory::read_log(path)?.into_iter().map(start).collect())
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
