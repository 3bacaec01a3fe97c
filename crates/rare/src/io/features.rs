//! Features and correspondences of other programs, as NPZ archives.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix4, Point3};

use super::npy::Array;
use super::npz::{self, Entry, NpzFile};
use super::whole_file::write_whole;
use crate::data::{Correspondence, PointFeatures, RigidTransform};
use crate::encode::{MapSummary, Recorded, Recording, map_names};
use crate::error::{Error, Result};

/// Reads points with a feature vector each: an NPZ archive of `points` (`N x 3`, metres, in the cloud's frame) and
/// `features` (`N x D`).
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if an array is missing, has another shape or a number that is not
/// finite.
pub fn read_point_features(path: impl AsRef<Path>) -> Result<PointFeatures> {
    read_named_features(path.as_ref(), "points", "features")
}

/// One of the clouds of a pair that features belong to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The cloud that is moved.
    Source,
    /// The cloud that stays.
    Reference,
}

/// Reads what [`read_point_features`] reads, or one side of what [`write_pair_features`] writes.
///
/// # Errors
/// Those of [`read_point_features`].
pub fn read_features_of_side(path: impl AsRef<Path>, side: Side) -> Result<PointFeatures> {
    let path = path.as_ref();
    let is_pair = NpzFile::open(path)?.names().iter().any(|name| name == "source_points");
    match (is_pair, side) {
        (false, _) => read_point_features(path),
        (true, Side::Source) => read_named_features(path, "source_points", "source_features"),
        (true, Side::Reference) => {
            read_named_features(path, "reference_points", "reference_features")
        }
    }
}

fn read_named_features(path: &Path, points_name: &str, name: &str) -> Result<PointFeatures> {
    let mut file = NpzFile::open(path)?;
    let points = points(path, &mut file, points_name)?;
    let features = file.array_f32(name)?;
    let &[rows, dimension @ 1..=usize::MAX] = features.shape.as_slice() else {
        return Err(shape_error(path, name, "N x D", &features.shape));
    };
    if rows != points.len() {
        return Err(count_error(path, points_name, points.len(), name, rows));
    }
    check_finite(path, name, &features.values, dimension)?;
    PointFeatures::new(points, dimension, features.values)
        .map_err(|error| super::name_file(path, error))
}

/// What a method says of a pair of clouds.
#[derive(Debug, Clone, Copy)]
pub struct PairFeatures<'a> {
    /// Keypoints of the source with features, in its frame, metres, and a score for each.
    pub source: (&'a PointFeatures, &'a [f32]),
    /// The same of the reference.
    pub reference: (&'a PointFeatures, &'a [f32]),
    /// Which points belong together.
    pub correspondences: &'a [Correspondence],
    /// The transform from source to reference, if the method found one.
    pub target_from_source: Option<&'a RigidTransform>,
}

/// Writes what a method says of a pair, an NPZ archive of `source_points`, `source_features`, `source_scores`, the same
/// of the `reference`, and what [`read_registration_dump`] reads; without a transform, that is missing.
///
/// # Errors
/// Those of [`write_whole`].
pub fn write_pair_features(path: impl AsRef<Path>, pair: &PairFeatures<'_>) -> Result<()> {
    let mut entries = Vec::new();
    for (side, (features, scores)) in [("source", pair.source), ("reference", pair.reference)] {
        let coordinates = features.points().iter().flat_map(|point| point.coords.as_slice());
        let shape = [features.len(), features.dimension()];
        entries.push(Entry::f64(format!("{side}_points"), &[features.len(), 3], coordinates));
        entries.push(Entry::f32(format!("{side}_features"), &shape, features.values()));
        entries.push(Entry::f32(format!("{side}_scores"), &[scores.len()], scores));
    }
    let pairs = pair.correspondences;
    let source = pairs.iter().flat_map(|pair| pair.source.coords.as_slice());
    let target = pairs.iter().flat_map(|pair| pair.target.coords.as_slice());
    let scores: Vec<f64> = pairs.iter().map(|pair| pair.score).collect();
    entries.push(Entry::f64("src_corr_points", &[pairs.len(), 3], source));
    entries.push(Entry::f64("ref_corr_points", &[pairs.len(), 3], target));
    entries.push(Entry::f64("corr_scores", &[pairs.len()], &scores));
    if let Some(pose) = pair.target_from_source {
        let rows = pose.to_matrix().transpose();
        entries.push(Entry::f64("estimated_transform", &[4, 4], rows.as_slice()));
    }
    write_whole(path, |writer| npz::write(writer, &entries))
}

/// Writes what [`read_point_features`] reads: `points` as 64-bit, `features` as 32-bit floats.
///
/// # Errors
/// Those of [`write_whole`].
pub fn write_point_features(path: impl AsRef<Path>, features: &PointFeatures) -> Result<()> {
    let coordinates = features.points().iter().flat_map(|point| point.coords.as_slice());
    let entries = [
        Entry::f64("points", &[features.len(), 3], coordinates),
        Entry::f32("features", &[features.len(), features.dimension()], features.values()),
    ];
    write_whole(path, |writer| npz::write(writer, &entries))
}

/// Reads the features of depth maps that another program computed: an NPZ archive of the arrays that
/// [`Recorded::from_arrays`] takes (`initial`, `refview_ref_layer0`, ...).
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if an array is missing, unknown, or has another shape.
pub fn read_depth_features(path: impl AsRef<Path>) -> Result<Recorded> {
    let path = path.as_ref();
    let mut file = NpzFile::open(path)?;
    let initial = file.array_f64("initial")?;
    if initial.shape != [4, 4] {
        return Err(shape_error(path, "initial", "4 x 4", &initial.shape));
    }
    let mut arrays = BTreeMap::new();
    for name in file.names().into_iter().filter(|name| name != "initial") {
        let array = file.array_f32(&name)?;
        arrays.insert(name, (array.shape, array.values));
    }
    Recorded::from_arrays(&Matrix4::from_row_slice(&initial.values), arrays)
        .map_err(|error| super::name_file(path, error))
}

/// Writes what [`read_depth_features`] reads, exactly: the layers as 32-bit floats, the transform as 64-bit floats.
///
/// # Errors
/// `Io` if there are 4 GiB or more, otherwise those of [`write_whole`].
pub fn write_depth_features(path: impl AsRef<Path>, recorded: &Recorded) -> Result<()> {
    let initial = recorded.initial().to_matrix().transpose();
    let mut entries = vec![Entry::f64("initial", &[4, 4], initial.as_slice())];
    entries.extend(recorded.recording().into_iter().flat_map(recording_entries));
    let names = map_names(recorded.features().len() / 2);
    for (name, layers) in names.iter().zip(recorded.features()) {
        for (number, layer) in layers.iter().enumerate() {
            let shape = [layer.channels(), layer.height(), layer.width()];
            entries.push(Entry::f32(format!("{name}_layer{number}"), &shape, layer.values()));
        }
    }
    write_whole(path, |writer| npz::write(writer, &entries))
}

fn recording_entries(recording: &Recording) -> [Entry; 4] {
    let row = |map: &MapSummary| {
        [map.width as f64, map.height as f64, map.seen as f64, f64::from(map.mean_depth)]
    };
    let rows: Vec<f64> = recording.maps.iter().flat_map(row).collect();
    let components = recording.components.unwrap_or(0) as f64;
    let aligned_corners = f64::from(u8::from(recording.aligned_corners));
    [
        Entry::f64("depth_maps", &[recording.maps.len(), 4], &rows),
        Entry::f64("components", &[1], &[components]),
        Entry::f64("aligned_corners", &[1], &[aligned_corners]),
        Entry::bytes("settings", recording.settings.as_bytes()),
    ]
}

/// What an official run left of a pair: correspondences and the transform that it estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct RegistrationDump {
    /// Each side in its cloud's frame, metres, with scores.
    pub correspondences: Vec<Correspondence>,
    /// Moves the source into the frame of the reference, as the file holds it; `None` if the run found none.
    pub target_from_source: Option<Matrix4<f64>>,
}

/// Reads the dump of a pair by GeoTransformer's `test.py`: an NPZ archive with `ref_corr_points`, `src_corr_points`,
/// `corr_scores` and, if a transform was found, `estimated_transform` (source to reference).
///
/// # Errors
/// As [`read_correspondences`].
pub fn read_registration_dump(path: impl AsRef<Path>) -> Result<RegistrationDump> {
    let path = path.as_ref();
    let mut file = NpzFile::open(path)?;
    let source = points(path, &mut file, "src_corr_points")?;
    let target = points(path, &mut file, "ref_corr_points")?;
    if source.len() != target.len() {
        let (sources, targets) = (source.len(), target.len());
        return Err(count_error(path, "src_corr_points", sources, "ref_corr_points", targets));
    }
    let scores = scores(path, &file.array_f64("corr_scores")?, source.len())?;
    let has_transform = file.names().iter().any(|name| name == "estimated_transform");
    let target_from_source =
        has_transform.then(|| estimated_transform(path, &mut file)).transpose()?;
    let pairs = source.into_iter().zip(target).zip(scores);
    Ok(RegistrationDump {
        correspondences: pairs
            .map(|((source, target), score)| Correspondence { source, target, score })
            .collect(),
        target_from_source,
    })
}

fn estimated_transform(path: &Path, file: &mut NpzFile) -> Result<Matrix4<f64>> {
    let transform = file.array_f64("estimated_transform")?;
    if transform.shape != [4, 4] {
        return Err(shape_error(path, "estimated_transform", "4 x 4", &transform.shape));
    }
    check_finite(path, "estimated_transform", &transform.values, 4)?;
    Ok(Matrix4::from_row_slice(&transform.values))
}

/// Reads correspondences: an NPZ archive of `source` and `reference` (`N x 3`, metres, each in its cloud's frame) and,
/// if there is one, `score` (`N`, at least 0; 1 where it is missing). The names of GeoTransformer's `test.py` do as well
/// (`src_corr_points`, `ref_corr_points`, `corr_scores`).
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if an array is missing, has another shape, a number that is not
/// finite or a negative score.
pub fn read_correspondences(path: impl AsRef<Path>) -> Result<Vec<Correspondence>> {
    let path = path.as_ref();
    let mut file = NpzFile::open(path)?;
    let names = file.names();
    let is_dump = names.iter().any(|name| name == "src_corr_points");
    let [source_name, target_name, score_name] = if is_dump {
        ["src_corr_points", "ref_corr_points", "corr_scores"]
    } else {
        ["source", "reference", "score"]
    };
    let source = points(path, &mut file, source_name)?;
    let target = points(path, &mut file, target_name)?;
    if source.len() != target.len() {
        return Err(count_error(path, source_name, source.len(), target_name, target.len()));
    }
    let scores = if names.iter().any(|name| name == score_name) {
        scores(path, &file.array_f64(score_name)?, source.len())?
    } else {
        vec![1.0; source.len()]
    };
    let pairs = source.into_iter().zip(target).zip(scores);
    Ok(pairs.map(|((source, target), score)| Correspondence { source, target, score }).collect())
}

fn points(path: &Path, file: &mut NpzFile, name: &str) -> Result<Vec<Point3<f64>>> {
    let array = file.array_f64(name)?;
    if !matches!(array.shape.as_slice(), [_, 3]) {
        return Err(shape_error(path, name, "N x 3", &array.shape));
    }
    check_finite(path, name, &array.values, 3)?;
    Ok(array.values.chunks_exact(3).map(Point3::from_slice).collect())
}

fn scores(path: &Path, array: &Array<f64>, count: usize) -> Result<Vec<f64>> {
    if array.values.len() != count {
        return Err(count_error(path, "source", count, "score", array.values.len()));
    }
    match array.values.iter().position(|score| !(score.is_finite() && *score >= 0.0)) {
        Some(row) => Err(Error::in_file(
            path,
            format!("score {row} is {}: scores must be finite and at least 0", array.values[row]),
        )),
        None => Ok(array.values.clone()),
    }
}

/// Dropping a row would shift what belongs together, so a number that is not finite is an error.
fn check_finite<T: Copy + Into<f64>>(
    path: &Path,
    name: &str,
    values: &[T],
    width: usize,
) -> Result<()> {
    match values.iter().position(|&value| !value.into().is_finite()) {
        Some(at) => Err(Error::in_file(
            path,
            format!(
                "row {} of {name} has a number that is not finite: remove it from every array",
                at / width
            ),
        )),
        None => Ok(()),
    }
}

fn shape_error(path: &Path, name: &str, expected: &str, shape: &[usize]) -> Error {
    Error::in_file(path, format!("{name} has the shape {shape:?}, {expected} is needed"))
}

fn count_error(
    path: &Path,
    first: &str,
    first_count: usize,
    second: &str,
    second_count: usize,
) -> Error {
    Error::in_file(
        path,
        format!("{first} has {first_count} rows and {second} {second_count}: they must be as many"),
    )
}
