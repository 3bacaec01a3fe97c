//! What people have from the official repositories: fragments and lists of pairs as pickles, read as data.
//!
//! Fragments of 3DMatch are arrays `N x 3` (`.pth`); lists of pairs are a dictionary of lists (Predator's
//! `configs/indoor/3DMatch.pkl`) or a list of dictionaries (GeoTransformer's `metadata/3DMatch.pkl`). What test runs of
//! CoFiNet and Predator saved of each pair becomes correspondences.

use std::path::Path;

use rare::eval::TruePair;
use rare::matching::{correspondences, nearest};
use rare::nalgebra::{Matrix4, Point3};
use rare::{Correspondence, Error, PointCloud, PointFeatures, Result};

use crate::checkpoint::{Object, open_pickle};

/// The extensions of pickles.
const EXTENSIONS: [&str; 3] = ["pth", "pkl", "pt"];

/// Whether a file is one for [`read_fragment`], by its name.
#[must_use]
pub fn is_fragment(path: &Path) -> bool {
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
    extension.is_some_and(|extension| EXTENSIONS.contains(&extension.as_str()))
}

/// Reads a cloud that was saved as an array or tensor `N x 3` (metres). Points that are not finite are dropped and counted.
///
/// # Errors
/// `Io`, `InvalidInput` or `Unsupported` if the file is no such pickle, or the cloud has no points.
pub fn read_fragment(path: &Path) -> Result<PointCloud> {
    let object = open_pickle(path)?;
    let tensor =
        object.tensor().filter(|tensor| matches!(tensor.shape(), [_, columns] if *columns >= 3));
    let Some(tensor) = tensor else {
        return Err(Error::in_file(path, "this pickle is no array of N x 3 coordinates"));
    };
    let columns = tensor.shape().get(1).copied().unwrap_or(3);
    let values = tensor.read_f64()?;
    let points = values.chunks_exact(columns).map(|row| Point3::new(row[0], row[1], row[2]));
    PointCloud::new(points.collect()).map_err(|error| Error::in_file(path, error))
}

/// Keypoints taken from each cloud of a dump of Predator, those with the highest scores.
const KEYPOINTS: usize = 1000;

/// Reads the correspondences of a pair from a dump of CoFiNet's or Predator's test run (`N.pth`), best first, each side
/// in its cloud's frame, metres.
///
/// CoFiNet saves its correspondences (`src_pcd`, `tgt_pcd`, indices `correspondences` and `confidence`). Predator saves
/// points with features and scores (`pcd`, `feats`, `overlaps`, `saliency`, `len_src`): there the 1000 points of
/// each cloud with the highest overlap times saliency are matched, each source point to its nearest feature.
///
/// # Errors
/// `Io`, `InvalidInput` or `Unsupported` if the file is neither, or its parts do not fit.
pub fn read_network_dump(path: &Path) -> Result<Vec<Correspondence>> {
    let object = open_pickle(path)?;
    let mut pairs = if object.get("correspondences").is_some() {
        of_cofinet(&object)
    } else {
        of_predator_dump(&object)
    }
    .map_err(|why| Error::in_file(path, why))?;
    pairs.sort_by(|a, b| b.score.total_cmp(&a.score));
    Ok(pairs)
}

fn of_cofinet(object: &Object) -> std::result::Result<Vec<Correspondence>, String> {
    let source = points_of(&rows(object, "src_pcd", 3)?);
    let target = points_of(&rows(object, "tgt_pcd", 3)?);
    let indices = rows(object, "correspondences", 2)?;
    let confidence = rows(object, "confidence", 1)?;
    if confidence.len() * 2 != indices.len() {
        return Err("as many correspondences as confidences are expected".to_owned());
    }
    let point = |points: &[Point3<f64>], index: f64| {
        let found = (index >= 0.0).then(|| points.get(index as usize).copied()).flatten();
        found.ok_or_else(|| format!("a correspondence names point {index} of {}", points.len()))
    };
    (indices.chunks_exact(2).zip(&confidence))
        .map(|(pair, score)| {
            let (source, target) = (point(&source, pair[0])?, point(&target, pair[1])?);
            Ok(Correspondence { source, target, score: *score })
        })
        .collect()
}

fn of_predator_dump(object: &Object) -> std::result::Result<Vec<Correspondence>, String> {
    let points = points_of(&rows(object, "pcd", 3)?);
    let scores: Vec<f64> = (rows(object, "overlaps", 1)?.iter())
        .zip(rows(object, "saliency", 1)?)
        .map(|(overlap, saliency)| overlap * saliency)
        .collect();
    let (values, dimension) = table(object, "feats")?;
    let split =
        object.get("len_src").and_then(Object::integer).and_then(|n| usize::try_from(n).ok());
    let split =
        split.filter(|&split| split <= points.len()).ok_or("len_src is no number of points")?;
    if scores.len() != points.len() || values.len() != points.len() * dimension {
        return Err("points, features and scores are not equally many".to_owned());
    }
    let best = |range: std::ops::Range<usize>| {
        let mut indices: Vec<usize> = range.collect();
        indices.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
        indices.truncate(KEYPOINTS);
        let features = indices.iter().flat_map(|&index| &values[index * dimension..][..dimension]);
        let features = features.map(|&value| value as f32).collect();
        let points = indices.iter().map(|&index| points[index]).collect();
        PointFeatures::new(points, dimension, features).map_err(|error| error.to_string())
    };
    let (source, target) = (best(0..split)?, best(split..points.len())?);
    let matches = nearest(&source, &target, None).map_err(|error| error.to_string())?;
    Ok(correspondences(&source, &target, &matches, 1))
}

/// The numbers of an array, which has so many columns (1: any shape), all finite.
fn rows(object: &Object, key: &str, columns: usize) -> std::result::Result<Vec<f64>, String> {
    let (values, found) = table(object, key)?;
    if columns > 1 && found != columns {
        return Err(format!("{key} has {found} columns instead of {columns}"));
    }
    Ok(values)
}

/// The numbers of an array and its columns.
fn table(object: &Object, key: &str) -> std::result::Result<(Vec<f64>, usize), String> {
    let tensor = object.get(key).and_then(Object::tensor);
    let tensor =
        tensor.ok_or_else(|| format!("no array {key}: this is no dump of CoFiNet or Predator"))?;
    let columns = tensor.shape().get(1).copied().unwrap_or(1);
    let values = tensor.read_f64().or_else(|_| -> Result<Vec<f64>> {
        Ok(tensor.read_i64()?.into_iter().map(|value| value as f64).collect())
    });
    let values = values.map_err(|error| format!("{key}: {error}"))?;
    match values.iter().all(|value| value.is_finite()) {
        true => Ok((values, columns)),
        false => Err(format!("{key} has numbers that are not finite")),
    }
}

fn points_of(values: &[f64]) -> Vec<Point3<f64>> {
    values.chunks_exact(3).map(Point3::from_slice).collect()
}

/// A pair of an official list.
#[derive(Debug, Clone, PartialEq)]
pub struct ListedPair {
    /// The truth, its source and reference by number.
    pub truth: TruePair,
    /// The source's file as the list names it, relative to the folder of the data.
    pub source: String,
    /// The reference's file.
    pub reference: String,
}

/// Reads a list of pairs of Predator or GeoTransformer.
///
/// # Errors
/// `Io`, `InvalidInput` or `Unsupported`, naming the file and the pair, if it is malformed.
pub fn read_pairs(path: &Path) -> Result<Vec<ListedPair>> {
    let object = open_pickle(path)?;
    let count = if object.items().is_empty() {
        object.get("src").map_or(0, |names| names.items().len())
    } else {
        object.items().len()
    };
    if count == 0 {
        return Err(Error::in_file(
            path,
            "this pickle is no list of pairs of Predator or GeoTransformer",
        ));
    }
    let mut scene = String::new();
    (0..count)
        .map(|index| {
            let pair = match object.items().get(index) {
                Some(entry) => of_geotransformer(entry),
                None => of_predator(&object, index),
            };
            let mut pair = pair.ok_or_else(|| {
                Error::in_file(
                    path,
                    format!("pair {index} lacks names, rotation, translation or overlap"),
                )
            })?;
            pair.truth.is_first_of_scene = scene != pair.truth.scene;
            scene.clone_from(&pair.truth.scene);
            Ok(pair)
        })
        .collect()
}

/// `{overlap, pcd0 (reference), pcd1 (source), rotation, translation, scene_name, frag_id0, frag_id1}`; the pose moves
/// the source into the frame of the reference.
fn of_geotransformer(entry: &Object) -> Option<ListedPair> {
    let name = |key| entry.get(key).and_then(Object::text).map(str::to_owned);
    let (source, reference) = (name("pcd1")?, name("pcd0")?);
    let number = |key| entry.get(key)?.integer().and_then(|number| usize::try_from(number).ok());
    let pose = pose(entry.get("rotation")?, entry.get("translation")?)?;
    let truth = truth(
        name("scene_name")?,
        number("frag_id1")?,
        number("frag_id0")?,
        pose,
        entry.get("overlap")?,
    );
    Some(ListedPair { truth, source, reference })
}

/// `{src: [...], tgt: [...], rot: [...], trans: [...], overlap: [...]}`.
fn of_predator(lists: &Object, index: usize) -> Option<ListedPair> {
    let entry = |key| element(lists.get(key)?, index);
    let name = |key| entry(key).as_ref().and_then(Object::text).map(str::to_owned);
    let (source, reference) = (name("src")?, name("tgt")?);
    let pose = pose(&entry("rot")?, &entry("trans")?)?;
    let scene = Path::new(&source).parent()?.file_name()?.to_string_lossy().into_owned();
    let truth = truth(scene, number_of(&source)?, number_of(&reference)?, pose, &entry("overlap")?);
    Some(ListedPair { truth, source, reference })
}

fn element(list: &Object, index: usize) -> Option<Object> {
    match list.tensor() {
        // A column of numbers.
        Some(tensor) => tensor.read_f64().ok()?.get(index).copied().map(Object::Float),
        None => list.items().get(index).cloned(),
    }
}

/// The number of `.../cloud_bin_7.pth`.
fn number_of(name: &str) -> Option<usize> {
    let stem = Path::new(name).file_stem()?.to_str()?;
    stem.rsplit('_').next()?.parse().ok()
}

fn truth(
    scene: String,
    source: usize,
    reference: usize,
    target_from_source: Matrix4<f64>,
    overlap: &Object,
) -> TruePair {
    let overlap = overlap.number().or_else(|| overlap.tensor()?.read_f64().ok()?.first().copied());
    TruePair {
        scene,
        source,
        reference,
        target_from_source,
        information: None,
        overlap,
        is_first_of_scene: false,
    }
}

/// A rotation of 3 x 3 and a translation of 3 or 3 x 1 as one matrix.
fn pose(rotation: &Object, translation: &Object) -> Option<Matrix4<f64>> {
    let rotation: [f64; 9] = rotation.tensor()?.read_f64().ok()?.try_into().ok()?;
    let translation: [f64; 3] = translation.tensor()?.read_f64().ok()?.try_into().ok()?;
    let is_finite = rotation.iter().chain(&translation).all(|value| value.is_finite());
    let element = |row: usize, column: usize| match (row, column) {
        (3, 3) => 1.0,
        (3, _) => 0.0,
        (row, 3) => translation[row],
        (row, column) => rotation[3 * row + column],
    };
    is_finite.then(|| Matrix4::from_fn(element))
}
