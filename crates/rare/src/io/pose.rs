//! Poses: a rigid transform per file, as other registration tools write it.
//!
//! The numbers decide what a text means: 16 are a 4 x 4 matrix and 12 its first three rows (row by row), 7 are
//! `tx ty tz qx qy qz qw` and 8 the same after a time stamp (TUM). Brackets and commas between them do not matter.

use std::path::Path;

use nalgebra::{Matrix4, Quaternion, UnitQuaternion, Vector3};

use super::npy::{self, Array};
use super::pose_log::{Log, select};
use super::text::{Line, Word, lines};
use super::{name_file, split_selector, whole_file};
use crate::data::RigidTransform;
use crate::error::{Error, Result};

/// What to do about a file that holds no pose.
const REMEDY: &str = "write a rigid 4 x 4 matrix, 4 lines of 4 numbers with 0 0 0 1 as the last";

/// Reads a rigid transform, in the direction in which the file holds it.
///
/// Accepted: 4 x 4 or 3 x 4 matrices as text or NPY; one TUM line `[timestamp] tx ty tz qx qy qz qw`; a 3DMatch `.log`
/// with one block, or `file.log:i,j` for the block of the fragments `i` and `j`; JSON with the matrix
/// `target_from_source`.
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if it does not hold exactly one rigid transform.
pub fn read_pose(path: impl AsRef<Path>) -> Result<RigidTransform> {
    let (file, pair) = split_selector(path.as_ref(), "log");
    let bytes = whole_file::read_whole(&file)?;
    parse(&bytes, pair.as_deref()).map_err(|error| name_file(&file, error))
}

fn parse(bytes: &[u8], pair: Option<&str>) -> Result<RigidTransform> {
    if bytes.starts_with(npy::MAGIC) {
        return rigid(&matrix_of_array(&npy::read_array(bytes)?)?);
    }
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    if bytes.trim_ascii_start().starts_with(b"{") {
        return rigid(&matrix_of_json(bytes)?);
    }
    let rows = number_rows(bytes)?;
    match (Log::of(&rows), pair) {
        (Some(log), pair) => rigid(&select(&log, pair)?),
        (None, Some(pair)) => {
            Err(Error::invalid(format!("this is no 3DMatch log, so there is no block {pair}")))
        }
        (None, None) => pose_of_rows(&rows),
    }
}

/// The numbers of each line that has any.
fn number_rows(bytes: &[u8]) -> Result<Vec<Vec<f64>>> {
    let mut rows = Vec::new();
    for line in lines(bytes) {
        let text = line.bytes.split(|&byte| byte == b'#').next().unwrap_or_default();
        let row = words(text).map(|word| parse_word(line, word)).collect::<Result<Vec<f64>>>()?;
        if !row.is_empty() {
            rows.push(row);
        }
    }
    Ok(rows)
}

/// The words between blanks, commas, semicolons and brackets.
fn words(text: &[u8]) -> impl Iterator<Item = Word<'_>> {
    let separates = |&byte: &u8| byte.is_ascii_whitespace() || b",;[]()".contains(&byte);
    let mut column = 1;
    text.split(separates)
        .map(move |bytes| {
            let word = Word { column, bytes };
            column += bytes.len() + 1;
            word
        })
        .filter(|word| !word.bytes.is_empty())
}

fn parse_word(line: Line<'_>, word: Word<'_>) -> Result<f64> {
    line.parse(word).map_err(|error| Error::invalid(format!("{error}, or {REMEDY}")))
}

fn pose_of_rows(rows: &[Vec<f64>]) -> Result<RigidTransform> {
    if rows.len() > 1 && rows.iter().all(|row| matches!(row.len(), 7 | 8 | 12 | 16)) {
        return Err(Error::invalid(format!(
            "there are {} poses, one per line: keep the line of the pose that is meant",
            rows.len()
        )));
    }
    let numbers: Vec<f64> = rows.concat();
    match numbers.as_slice() {
        &[_, x, y, z, a, b, c, d] | &[x, y, z, a, b, c, d] => {
            pose_of_quaternion(Vector3::new(x, y, z), Quaternion::new(d, a, b, c))
        }
        numbers => rigid(&matrix(numbers)?),
    }
}

/// The homogeneous matrix of 16 numbers, or of 12 without its last row.
pub(super) fn matrix(numbers: &[f64]) -> Result<Matrix4<f64>> {
    match numbers.len() {
        16 => Ok(Matrix4::from_row_slice(numbers)),
        12 => Ok(Matrix4::from_row_slice(&[numbers, &[0.0, 0.0, 0.0, 1.0]].concat())),
        9 => Err(Error::invalid(format!("this is a 3 x 3 matrix without a translation: {REMEDY}"))),
        0 => Err(Error::invalid(format!("there is no number in the file: {REMEDY}"))),
        count => Err(Error::invalid(format!("{count} numbers are no pose: {REMEDY}"))),
    }
}

fn matrix_of_array(array: &Array<f64>) -> Result<Matrix4<f64>> {
    match array.shape.as_slice() {
        [4, 4] | [3, 4] | [1, 4, 4] | [1, 3, 4] | [3, 3] => matrix(&array.values),
        shape => {
            Err(Error::invalid(format!("an array of the shape {shape:?} is no pose: {REMEDY}")))
        }
    }
}

fn matrix_of_json(bytes: &[u8]) -> Result<Matrix4<f64>> {
    let document: serde_json::Value = serde_json::from_slice(bytes)
        .map_err(|error| Error::invalid(format!("the JSON is damaged: {error}")))?;
    let mut numbers = Vec::new();
    match document.get("target_from_source") {
        Some(value) => collect_numbers(value, &mut numbers)?,
        None => {
            return Err(Error::invalid(format!(
                "the JSON has no entry target_from_source: {REMEDY}"
            )));
        }
    }
    matrix(&numbers)
}

/// Appends the numbers of nested arrays. (The parser has limited how deep they nest.)
fn collect_numbers(value: &serde_json::Value, numbers: &mut Vec<f64>) -> Result<()> {
    match value {
        serde_json::Value::Array(values) => {
            values.iter().try_for_each(|value| collect_numbers(value, numbers))
        }
        serde_json::Value::Number(number) => {
            numbers.push(number.as_f64().unwrap_or(f64::NAN));
            Ok(())
        }
        other => Err(Error::invalid(format!("target_from_source holds {other}: {REMEDY}"))),
    }
}

fn pose_of_quaternion(
    translation: Vector3<f64>,
    quaternion: Quaternion<f64>,
) -> Result<RigidTransform> {
    const LENGTH_TOLERANCE: f64 = 1e-2;
    let length = quaternion.norm();
    if !length.is_finite() || (length - 1.0).abs() > LENGTH_TOLERANCE {
        return Err(Error::invalid(format!(
            "the quaternion (the last 4 of tx ty tz qx qy qz qw) has the length {length}, it must be 1: {REMEDY}"
        )));
    }
    let rotation = UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix();
    rigid(&RigidTransform::new(rotation, translation).to_matrix())
}

fn rigid(matrix: &Matrix4<f64>) -> Result<RigidTransform> {
    RigidTransform::from_matrix(matrix)
        .map_err(|error| Error::invalid(format!("{error}; {REMEDY}")))
}

/// The 4 x 4 matrix row by row: 4 lines of 4 numbers, each with as many digits as reading it back exactly needs.
#[must_use]
pub fn format_pose(pose: &RigidTransform) -> String {
    let matrix = pose.to_matrix();
    // Adding zero turns -0 into 0.
    let row = |row: usize| {
        let [a, b, c, d] = [0, 1, 2, 3].map(|column| matrix[(row, column)] + 0.0);
        format!("{a:?} {b:?} {c:?} {d:?}\n")
    };
    [0, 1, 2, 3].map(row).concat()
}

/// Writes [`format_pose`] to a file.
///
/// # Errors
/// Those of [`write_whole`](super::write_whole).
pub fn write_pose(path: impl AsRef<Path>, pose: &RigidTransform) -> Result<()> {
    whole_file::write_whole(path, |writer| writer.write_all(format_pose(pose).as_bytes()))
}
