//! Features and correspondences of other programs, as NPZ archives.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix4, Point3};

use super::npy::Array;
use super::npz::{self, Entry, NpzFile};
use super::whole_file::write_whole;
use crate::data::{Correspondence, PointFeatures};
use crate::encode::{MapSummary, Recorded, Recording, map_names};
use crate::error::{Error, Result};

/// Reads points with a feature vector each: an NPZ archive of `points` (`N x 3`, metres, in the cloud's frame) and
/// `features` (`N x D`).
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if an array is missing, has another shape or a number that is not
/// finite.
pub fn read_point_features(path: impl AsRef<Path>) -> Result<PointFeatures> {
    let path = path.as_ref();
    let mut file = NpzFile::open(path)?;
    let points = points(path, &mut file, "points")?;
    let features = file.array_f32("features")?;
    let &[rows, dimension @ 1..=usize::MAX] = features.shape.as_slice() else {
        return Err(shape_error(path, "features", "N x D", &features.shape));
    };
    if rows != points.len() {
        return Err(count_error(path, "points", points.len(), "features", rows));
    }
    check_finite(path, "features", &features.values, dimension)?;
    PointFeatures::new(points, dimension, features.values)
        .map_err(|error| super::name_file(path, error))
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
    /// Moves the source into the frame of the reference, as the file holds it.
    pub target_from_source: Matrix4<f64>,
}

/// Reads the dump of a pair by GeoTransformer's `test.py`: an NPZ archive with `ref_corr_points`, `src_corr_points`,
/// `corr_scores` and `estimated_transform` (source to reference).
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
    let transform = file.array_f64("estimated_transform")?;
    if transform.shape != [4, 4] {
        return Err(shape_error(path, "estimated_transform", "4 x 4", &transform.shape));
    }
    check_finite(path, "estimated_transform", &transform.values, 4)?;
    let pairs = source.into_iter().zip(target).zip(scores);
    Ok(RegistrationDump {
        correspondences: pairs
            .map(|((source, target), score)| Correspondence { source, target, score })
            .collect(),
        target_from_source: Matrix4::from_row_slice(&transform.values),
    })
}

/// Reads correspondences: an NPZ archive of `source` and `reference` (`N x 3`, metres, each in its cloud's frame) and,
/// if there is one, `score` (`N`, at least 0; 1 where it is missing).
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if an array is missing, has another shape, a number that is not
/// finite or a negative score.
pub fn read_correspondences(path: impl AsRef<Path>) -> Result<Vec<Correspondence>> {
    let path = path.as_ref();
    let mut file = NpzFile::open(path)?;
    let source = points(path, &mut file, "source")?;
    let target = points(path, &mut file, "reference")?;
    if source.len() != target.len() {
        return Err(count_error(path, "source", source.len(), "reference", target.len()));
    }
    let scores = if file.names().iter().any(|name| name == "score") {
        scores(path, &file.array_f64("score")?, source.len())?
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
