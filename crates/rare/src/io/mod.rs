//! Files: clouds, poses, features and correspondences in the formats that people have them in.
//!
//! A file is read whole, its format is told from its first bytes and only then from its name, and every count in a
//! header is compared with the file's length before anything is allocated for it. Nothing in a file can make a reader
//! panic, loop or allocate more than a fixed multiple of the file's length. Files are written whole or not at all.
//!
//! | format | read | written | notes |
//! |---|---|---|---|
//! | `.ply` | text, binary of both byte orders | binary | any types, properties and elements around `x y z` |
//! | `.pcd` | text, binary, compressed | binary | organised clouds with NaN |
//! | `.xyz .txt .csv .asc .pts` | yes | `.xyz` | any delimiter, comments, column names |
//! | `.npy .npz` | yes | `.npy` | `N x 3` or wider; `file.npz:name` names the array |
//! | `.bin` | yes | | KITTI, `x y z reflectance` as 32-bit floats |
//! | `.las .laz` | yes | | |
//! | `.e57` | yes | | all scans, in the frame of the file |

mod contain_panics;
mod e57;
mod features;
mod kitti_bin;
mod las;
mod laz;
mod lzf;
mod npy;
mod npz;
mod pcd;
mod ply;
mod pose;
mod pose_log;
mod scalar;
mod text;
mod whole_file;
mod xyz;

use std::fs::File;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use nalgebra::Point3;

pub use self::features::{
    PairFeatures, RegistrationDump, Side, read_correspondences, read_depth_features,
    read_features_of_side, read_point_features, read_registration_dump, write_depth_features,
    write_pair_features, write_point_features,
};
pub use self::npy::Array;
pub use self::npz::NpzFile;
pub use self::pose::{format_pose, read_pose, write_pose};
pub use self::whole_file::write_whole;
use crate::data::PointCloud;
use crate::error::{Error, Result};

/// The extensions that [`read_cloud`] knows.
const READABLE: &str = ".ply .pcd .xyz .txt .csv .asc .pts .npy .npz .bin .las .laz .e57";

/// The extensions that [`write_cloud`] knows.
const WRITABLE: &str = ".ply .pcd .xyz .npy";

/// The formats of clouds, by how they are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Ply,
    Pcd,
    Text,
    Npy,
    Npz,
    KittiBin,
    Las,
    E57,
}

/// The content of a text file.
///
/// # Errors
/// `Io` if the file cannot be read, `InvalidInput` if it is empty or not UTF-8.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    let bytes = whole_file::read_whole(path)?;
    String::from_utf8(bytes).map_err(|_| Error::in_file(path, "this is not a text file"))
}

/// Reads a cloud, in the units and the frame of the file. Points that are not finite are dropped and counted.
///
/// The content decides the format; the extension does only where the content has no mark of its own (text, KITTI).
/// In an archive, `file.npz:name` names the array; without a name it is `points`, otherwise the only `N x 3` array.
///
/// # Errors
/// `Io` if the file cannot be read, `Unsupported` if its format is not one that is read, `InvalidInput` if it is
/// damaged or holds no finite point. The message names the file and what to do.
pub fn read_cloud(path: impl AsRef<Path>) -> Result<PointCloud> {
    let (file, name) = split_selector(path.as_ref(), "npz");
    let bytes = whole_file::read_whole(&file)?;
    let points = match Format::of(&file, &bytes)? {
        Format::Ply => ply::read(&bytes),
        Format::Pcd => pcd::read(&bytes),
        Format::Text => xyz::read(&bytes),
        Format::Npy => npy::read_cloud(&bytes),
        Format::Npz => read_npz(&file, bytes, name),
        Format::KittiBin => kitti_bin::read(&bytes),
        Format::Las => las::read(bytes),
        Format::E57 => e57::read(&bytes),
    };
    points.and_then(PointCloud::new).map_err(|error| name_file(&file, error))
}

fn read_npz(path: &Path, bytes: Vec<u8>, name: Option<String>) -> Result<Vec<Point3<f64>>> {
    let mut archive = NpzFile::from_bytes(path, bytes)?;
    let name = name.map_or_else(|| archive.cloud_name(), Ok)?;
    archive.points(&name)
}

/// The name of the format in which [`read_cloud`] would read a file, for example `PLY`.
///
/// # Errors
/// `Io` if the file cannot be opened, otherwise as [`read_cloud`] where no format fits.
pub fn cloud_format(path: impl AsRef<Path>) -> Result<&'static str> {
    /// More than any format's mark needs.
    const LOOKED_AT: u64 = 4096;
    let (file, _) = split_selector(path.as_ref(), "npz");
    let mut start = Vec::new();
    File::open(&file)
        .and_then(|opened| opened.take(LOOKED_AT).read_to_end(&mut start))
        .map_err(|error| Error::io(&file, error))?;
    Format::of(&file, &start).map(Format::name)
}

/// Makes sure that [`write_cloud`] knows the format of the extension, before there is anything to write.
///
/// # Errors
/// `Unsupported` for an extension that is not written.
pub fn check_writable_format(path: impl AsRef<Path>) -> Result<()> {
    writer_of(path.as_ref()).map(|_| ())
}

/// Writes points in the format of the extension: `.ply` and `.pcd` (binary, in single precision where that keeps
/// 0.1 mm within 10 km of the origin, otherwise double), `.xyz` (text that reads back exactly) or `.npy` (64-bit
/// `N x 3`).
///
/// # Errors
/// `Unsupported` for another extension, `InvalidInput` if there is no point, otherwise those of [`write_whole`].
pub fn write_cloud(path: impl AsRef<Path>, points: &[Point3<f64>]) -> Result<()> {
    let path = path.as_ref();
    let write = writer_of(path)?;
    if points.is_empty() {
        return Err(Error::in_file(path, "there is no point to write"));
    }
    write_whole(path, |writer| write(writer, points))
}

/// Writes points to somewhere.
type CloudWriter = fn(&mut dyn Write, &[Point3<f64>]) -> io::Result<()>;

fn writer_of(path: &Path) -> Result<CloudWriter> {
    match extension(path).as_str() {
        "ply" => Ok(ply::write),
        "pcd" => Ok(pcd::write),
        "xyz" => Ok(xyz::write),
        "npy" => Ok(npy::write),
        _ => Err(Error::Unsupported(format!(
            "{}: a cloud is not written in this format: choose one of {WRITABLE}",
            path.display()
        ))),
    }
}

/// Writes several clouds into one binary PLY file, each in its colour (red, green, blue), to look at how they fit.
///
/// # Errors
/// `InvalidInput` if there is no point, otherwise those of [`write_whole`].
pub fn write_coloured_ply(
    path: impl AsRef<Path>,
    clouds: &[(&[Point3<f64>], [u8; 3])],
) -> Result<()> {
    let path = path.as_ref();
    if clouds.iter().all(|(points, _)| points.is_empty()) {
        return Err(Error::in_file(path, "there is no point to write"));
    }
    write_whole(path, |writer| ply::write_coloured(writer, clouds))
}

impl Format {
    fn of(path: &Path, bytes: &[u8]) -> Result<Format> {
        if let Some(format) = Format::by_content(bytes) {
            return Ok(format);
        }
        match extension(path).as_str() {
            "xyz" | "txt" | "csv" | "asc" | "pts" => Ok(Format::Text),
            "bin" => Ok(Format::KittiBin),
            claimed @ ("ply" | "pcd" | "npy" | "npz" | "las" | "laz" | "e57") => {
                Err(Error::in_file(
                    path,
                    format!(
                        "it is named .{claimed}, but its content is not: it begins with {}; give it the name of its format \
                     or write it again",
                        text::quoted(&bytes[..bytes.len().min(12)])
                    ),
                ))
            }
            other => Err(Error::Unsupported(format!(
                "{}: .{other} is not a format that is read: convert it to one of {READABLE}",
                path.display()
            ))),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Format::Ply => "PLY",
            Format::Pcd => "PCD",
            Format::Text => "text",
            Format::Npy => "NPY",
            Format::Npz => "NPZ",
            Format::KittiBin => "KITTI binary",
            Format::Las => "LAS or LAZ",
            Format::E57 => "E57",
        }
    }

    fn by_content(bytes: &[u8]) -> Option<Format> {
        match bytes {
            _ if ply::is_ply(bytes) => Some(Format::Ply),
            _ if bytes.starts_with(npy::MAGIC) => Some(Format::Npy),
            _ if bytes.starts_with(npz::MAGIC) => Some(Format::Npz),
            _ if bytes.starts_with(las::MAGIC) => Some(Format::Las),
            _ if bytes.starts_with(e57::MAGIC) => Some(Format::E57),
            _ if pcd::is_pcd(bytes) => Some(Format::Pcd),
            _ => None,
        }
    }
}

/// The extension in lower case, empty if there is none.
fn extension(path: &Path) -> String {
    path.extension()
        .map(|extension| extension.to_string_lossy().to_ascii_lowercase())
        .unwrap_or_default()
}

/// Splits `file.ext:selector` unless a file of that very name exists.
fn split_selector(path: &Path, expected: &str) -> (PathBuf, Option<String>) {
    let split = path.to_str().filter(|_| !path.exists()).and_then(|path| path.rsplit_once(':'));
    match split {
        Some((file, selector)) if extension(Path::new(file)) == expected => {
            (PathBuf::from(file), Some(selector.to_owned()))
        }
        _ => (path.to_path_buf(), None),
    }
}

/// The same error with the file's name before it.
fn name_file(path: &Path, error: Error) -> Error {
    match error {
        Error::InvalidInput(what) => Error::in_file(path, what),
        Error::Unsupported(what) => Error::Unsupported(format!("{}: {what}", path.display())),
        other => other,
    }
}
