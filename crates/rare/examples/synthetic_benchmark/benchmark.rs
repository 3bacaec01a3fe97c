//! The folder: `cloud_bin_N.ply` (the reference of pair `k` is number `2 k`, its source `2 k + 1`), `pairs.json`, and
//! `init_NAME.json` for every set of starts.
//!
//! Everything is made in a hidden folder beside the one that is asked for, which gets its name when all is there.

use std::fs;
use std::path::Path;

use rare::data::{KdTree, voxel_downsample};
use rare::eval::results::rows_of;
use rare::io::{write_cloud, write_whole};
use rare::nalgebra::{Point3, Quaternion, UnitQuaternion, Vector3};
use rare::random::Random;
use rare::scale::{Profile, Scale};
use rare::synthetic::{ScanPair, object_pair, perturb, room_pair, street_pair};
use rare::verify::overlap;
use rare::{Error, PointCloud, Result, RigidTransform};
use serde_json::{Value, json};

/// What is scanned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scenes {
    /// With a depth camera; the overlap is in turn 0.1 to 0.2, 0.2 to 0.3, ... 0.8 to 0.9.
    Rooms,
    /// With a rotating laser scanner.
    Streets,
    /// With a depth camera, from two sides.
    Objects,
}

/// How a set of starts comes about from the truth.
struct StartSet {
    name: &'static str,
    error: StartError,
}

enum StartError {
    /// Degrees and metres between these bounds, the metres at the scale of a room.
    Between { degrees: [f64; 2], metres: [f64; 2] },
    /// Any rotation, with the middle of the source anywhere in the box around the reference.
    Anything,
}

const START_SETS: [StartSet; 3] = [
    StartSet {
        name: "pert_medium",
        error: StartError::Between { degrees: [5.0, 10.0], metres: [0.1, 0.2] },
    },
    StartSet {
        name: "pert_hard",
        error: StartError::Between { degrees: [15.0, 25.0], metres: [0.3, 0.5] },
    },
    StartSet { name: "wrong", error: StartError::Anything },
];

/// Rooms that are tried for two views of some overlap; not every room has them.
const MAX_ROOMS: usize = 64;
/// The stream of the first set of starts; the pairs use the streams from 0 up.
const FIRST_START_STREAM: u64 = 1 << 32;
/// Voxel size of the clouds of the information matrix at the scale of a room, metres.
const VOXEL: f64 = 0.05;

impl Scenes {
    /// # Errors
    /// `InvalidInput` for an unknown name.
    pub(crate) fn named(name: &str) -> Result<Scenes> {
        match name {
            "rooms" => Ok(Scenes::Rooms),
            "streets" => Ok(Scenes::Streets),
            "objects" => Ok(Scenes::Objects),
            _ => Err(Error::invalid(format!(
                "there are no scenes {name:?}: choose rooms, streets or objects"
            ))),
        }
    }

    /// Pair number `index` of the benchmark number `seed`.
    fn pair(self, index: usize, seed: u64) -> Result<ScanPair> {
        let mut random = Random::new(seed, index as u64);
        match self {
            Scenes::Streets => street_pair(random.bits()),
            Scenes::Objects => object_pair(random.bits()),
            Scenes::Rooms => {
                let tenth = 1.0 + (index % 8) as f64;
                let range = tenth / 10.0..=(tenth + 1.0) / 10.0;
                let mut pair = room_pair(random.bits(), range.clone());
                for _ in 1..MAX_ROOMS {
                    if pair.is_ok() {
                        break;
                    }
                    pair = room_pair(random.bits(), range.clone());
                }
                pair
            }
        }
    }

    /// How large the scene is beside a room.
    fn scale(self, pair: &ScanPair) -> Result<f64> {
        match self {
            Scenes::Rooms => Ok(1.0),
            Scenes::Streets => Ok(10.0),
            Scenes::Objects => {
                let scale = Scale::new(Profile::Auto, None, &pair.source, &pair.target)?;
                Ok(scale.voxel / VOXEL)
            }
        }
    }
}

/// Writes a benchmark of `count` pairs into `folder`, all of it or nothing.
///
/// # Errors
/// `InvalidInput` if `count` is 0 or the folder is there already; `Io` if it cannot be written.
pub(crate) fn write(scenes: Scenes, count: usize, seed: u64, folder: &Path) -> Result<()> {
    if count == 0 {
        return Err(Error::invalid("0 pairs are no benchmark: ask for at least one"));
    }
    if folder.exists() {
        return Err(Error::in_file(folder, "this is there already: name another folder"));
    }
    let parent = folder.parent().filter(|parent| !parent.as_os_str().is_empty());
    let failed = |cause| Error::io(folder, cause);
    let hidden = tempfile::Builder::new()
        .prefix(".benchmark-")
        .tempdir_in(parent.unwrap_or(Path::new(".")))
        .map_err(failed)?;
    // Within the hidden folder, which only its owner may read.
    let unfinished = hidden.path().join("benchmark");
    fs::create_dir(&unfinished).map_err(failed)?;
    fill(scenes, count, seed, &unfinished)?;
    fs::rename(&unfinished, folder).map_err(failed)
}

fn fill(scenes: Scenes, count: usize, seed: u64, folder: &Path) -> Result<()> {
    let mut pairs = Vec::new();
    let mut starts = START_SETS.map(|_| Vec::new());
    for index in 0..count {
        let pair = scenes.pair(index, seed)?;
        let scale = scenes.scale(&pair)?;
        let (source, reference) = (2 * index + 1, 2 * index);
        for (number, cloud) in [(source, &pair.source), (reference, &pair.target)] {
            write_cloud(folder.join(format!("cloud_bin_{number}.ply")), cloud.points())?;
        }
        pairs.push(listed(&pair, source, reference, scale)?);
        for (stream, (set, starts)) in START_SETS.iter().zip(&mut starts).enumerate() {
            let stream = FIRST_START_STREAM + stream as u64;
            let mut random = Random::new(Random::new(seed, stream).bits(), index as u64);
            let start = rows_of(&set.error.start(&pair, scale, &mut random).to_matrix());
            starts.push(json!({ "src": source, "ref": reference, "init": start }));
        }
    }
    for (set, starts) in START_SETS.iter().zip(starts) {
        let set_of_starts = json!({ "name": set.name, "pairs": starts });
        write_json(&folder.join(format!("init_{}.json", set.name)), &set_of_starts)?;
    }
    write_json(&folder.join("pairs.json"), &Value::from(pairs))
}

/// A pair as the list has it.
fn listed(pair: &ScanPair, source: usize, reference: usize, scale: f64) -> Result<Value> {
    let voxel = VOXEL * scale;
    let thin = |cloud: &PointCloud| voxel_downsample(cloud.points(), voxel);
    let (source_points, tree) = (thin(&pair.source)?, KdTree::new(&thin(&pair.target)?));
    let common = overlap(&tree, &source_points, &pair.target_from_source, voxel, 1.0);
    let information: [[f64; 6]; 6] =
        std::array::from_fn(|row| std::array::from_fn(|column| common.information[(row, column)]));
    Ok(json!({
        "src": source,
        "ref": reference,
        "overlap": pair.overlap,
        "gt": rows_of(&pair.target_from_source.to_matrix()),
        "info": information,
    }))
}

impl StartError {
    /// A start of the pair, whose scene is `scale` times as large as a room.
    fn start(&self, pair: &ScanPair, scale: f64, random: &mut Random) -> RigidTransform {
        let centre = centre(&pair.source);
        let truth = &pair.target_from_source;
        match self {
            StartError::Between { degrees, metres } => {
                let (degrees, metres) = (between(random, *degrees), between(random, *metres));
                perturb(truth, degrees, metres * scale, &truth.apply(&centre), random.bits())
            }
            StartError::Anything => {
                let [w, x, y, z] = std::array::from_fn(|_| random.normal());
                let turn = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
                let turn = turn.to_rotation_matrix();
                let place = anywhere_around(&pair.target, random);
                RigidTransform::new(turn, place - turn * centre.coords)
            }
        }
    }
}

fn between(random: &mut Random, [low, high]: [f64; 2]) -> f64 {
    low + random.uniform() * (high - low)
}

fn centre(cloud: &PointCloud) -> Point3<f64> {
    let sum = cloud.points().iter().fold(Vector3::zeros(), |sum, point| sum + point.coords);
    Point3::from(sum / cloud.len() as f64)
}

/// A place in the box around a cloud.
fn anywhere_around(cloud: &PointCloud, random: &mut Random) -> Vector3<f64> {
    let first = cloud.points().first().map_or_else(Vector3::zeros, |point| point.coords);
    let (low, high) = cloud.points().iter().fold((first, first), |(low, high), point| {
        (low.inf(&point.coords), high.sup(&point.coords))
    });
    low + Vector3::from_fn(|_, _| random.uniform()).component_mul(&(high - low))
}

fn write_json(path: &Path, value: &Value) -> Result<()> {
    write_whole(path, |writer| writeln!(writer, "{value}"))
}
