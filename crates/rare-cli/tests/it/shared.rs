//! Small clouds in a temporary folder, and the program run on them.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use rare::nalgebra::{Matrix4, Point3, Rotation3, Vector3};
use rare::{RigidTransform, io as files};
use tempfile::TempDir;

/// A folder with a pair of clouds: `source.xyz`, `reference.xyz` and a wrong start in `initial.txt`.
pub(crate) struct Workplace {
    folder: TempDir,
}

/// What the program did.
#[derive(Debug)]
pub(crate) struct Outcome {
    pub(crate) code: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Workplace {
    pub(crate) fn empty() -> Workplace {
        Workplace { folder: TempDir::new().unwrap() }
    }

    pub(crate) fn with_pair() -> Workplace {
        let workplace = Workplace::empty();
        let to_sensor = Vector3::new(0.0, 0.0, 3.0);
        let [source, reference] = pair().map(|points| shifted(&points, to_sensor));
        workplace.cloud("source.xyz", &source);
        workplace.cloud("reference.xyz", &reference);
        workplace.pose("initial.txt", &about(&start(), to_sensor));
        workplace
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn cloud(&self, name: &str, points: &[Point3<f64>]) {
        files::write_cloud(self.path(name), points).unwrap();
    }

    pub(crate) fn pose(&self, name: &str, pose: &RigidTransform) {
        files::write_pose(self.path(name), pose).unwrap();
    }

    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).unwrap();
    }

    pub(crate) fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    pub(crate) fn text(&self, name: &str) -> String {
        String::from_utf8(self.read(name)).unwrap()
    }

    pub(crate) fn json(&self, name: &str) -> serde_json::Value {
        serde_json::from_slice(&self.read(name)).unwrap()
    }

    pub(crate) fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder.path()).unwrap();
        let mut names: Vec<String> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// Runs the program in the folder.
    pub(crate) fn run(&self, arguments: &[&str]) -> Outcome {
        let output = Command::new(env!("CARGO_BIN_EXE_rare"))
            .args(arguments)
            .current_dir(self.folder.path())
            .output()
            .unwrap();
        Outcome {
            code: output.status.code().unwrap(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }

    /// Refines the pair.
    pub(crate) fn refine(&self, more: &[&str]) -> Outcome {
        let pair = ["refine", "source.xyz", "reference.xyz", "--init", "initial.txt"];
        self.run(&[&pair, more].concat())
    }

    /// Writes an NPZ archive of 64-bit arrays, not compressed.
    pub(crate) fn npz(&self, name: &str, arrays: &[(&str, &[usize], Vec<f64>)]) {
        self.write(name, npz(arrays));
    }
}

impl Outcome {
    /// No pose, for a reason that contains the words, in one line.
    pub(crate) fn assert_refused_pose(&self, words: &[&str]) {
        assert_eq!(self.code, 1, "{self:?}");
        for word in words {
            assert!(self.stderr.contains(word), "{word} is missing in {self:?}");
        }
    }

    /// The transform on stdout.
    pub(crate) fn pose(&self) -> RigidTransform {
        let rows: Vec<Vec<f64>> = self
            .stdout
            .lines()
            .map(|line| line.split(' ').map(|number| number.parse().unwrap()).collect())
            .collect();
        assert!(rows.len() == 4 && rows.iter().all(|row| row.len() == 4), "{self:?}");
        RigidTransform::from_matrix(&Matrix4::from_row_slice(&rows.concat())).unwrap()
    }

    /// Asserts that the input was refused in one line that has all of the `words`.
    #[track_caller]
    pub(crate) fn assert_refused(&self, words: &[&str]) {
        assert_eq!((self.code, self.stdout.as_str()), (2, ""), "{self:?}");
        assert!(self.stderr.starts_with("error: "), "{self:?}");
        assert_eq!(self.stderr.trim_end().lines().count(), 1, "{self:?}");
        for word in words {
            assert!(self.stderr.contains(word), "{word} is missing in {self:?}");
        }
    }
}

/// The true motion of [`pair`].
pub(crate) fn truth() -> RigidTransform {
    RigidTransform::new(
        Rotation3::new(Vector3::new(0.05, -0.1, 0.04)),
        Vector3::new(0.1, -0.05, 0.08),
    )
}

/// A start that is 4 degrees and 10 cm off the truth.
pub(crate) fn start() -> RigidTransform {
    let error =
        RigidTransform::new(Rotation3::new(Vector3::new(0.0, 0.07, 0.0)), Vector3::x() * 0.1);
    error * truth()
}

/// The same motion of clouds that lie `shift` further away.
pub(crate) fn about(pose: &RigidTransform, shift: Vector3<f64>) -> RigidTransform {
    RigidTransform::from_translation(shift) * *pose * RigidTransform::from_translation(-shift)
}

pub(crate) fn shifted(points: &[Point3<f64>], shift: Vector3<f64>) -> Vec<Point3<f64>> {
    points.iter().map(|point| point + shift).collect()
}

/// Two samplings of a corner with boxes around the origin, source and reference, [`truth`] apart.
pub(crate) fn pair() -> [Vec<Point3<f64>>; 2] {
    let source = truth().inverse().apply_all(&corner(1));
    [source, corner(2)]
}

/// Standard deviation of a coordinate, metres. Without noise the neighbours of a point lie in one plane exactly, and
/// the last digit of a coordinate decides what their features are.
const NOISE: f64 = 0.004;

/// 8000 points on a wall, a floor, a side wall and three boxes, in a cube of 2.4 m around the origin.
fn corner(seed: u64) -> Vec<Point3<f64>> {
    let mut random = rare::random::Random::new(seed, 0);
    let sheets = [
        ([-1.2, -0.9, 1.2], [2.4, 0.0, 0.0], [0.0, 1.8, 0.0], 0.3),
        ([-1.2, 0.9, -1.0], [2.4, 0.0, 0.0], [0.0, 0.0, 2.2], 0.3),
        ([-1.2, -0.9, -1.0], [0.0, 1.8, 0.0], [0.0, 0.0, 2.2], 0.15),
        ([0.2, 0.3, 0.3], [0.6, 0.0, 0.1], [0.0, 0.6, 0.0], 0.08),
        ([0.2, 0.3, 0.3], [0.6, 0.0, 0.1], [-0.1, 0.0, 0.6], 0.07),
        ([-0.9, 0.1, -0.2], [0.4, 0.0, -0.2], [0.0, 0.8, 0.0], 0.06),
        ([-0.3, -0.6, 0.9], [0.5, 0.2, 0.0], [-0.2, 0.5, 0.0], 0.04),
    ];
    let mut points = Vec::new();
    for (start, along, across, share) in sheets {
        for _ in 0..(8000.0 * share) as usize {
            let (u, v) = (random.uniform(), random.uniform());
            let mut place =
                |i: usize| start[i] + u * along[i] + v * across[i] + NOISE * random.normal();
            points.push(Point3::new(place(0), place(1), place(2)));
        }
    }
    points
}

/// Every name of an object's entries.
pub(crate) fn keys(value: &serde_json::Value) -> Vec<String> {
    value.as_object().unwrap().keys().cloned().collect()
}

/// The archive as `numpy.savez` writes it, as far as a reader sees.
fn npz(arrays: &[(&str, &[usize], Vec<f64>)]) -> Vec<u8> {
    let (mut body, mut directory) = (Vec::new(), Vec::new());
    for (name, shape, values) in arrays {
        let (name, data) = (format!("{name}.npy"), npy(shape, values));
        let mut fixed = vec![20, 0, 0, 0, 0, 0, 0, 0, 0, 0];
        for number in [crc32(&data), data.len() as u32, data.len() as u32, name.len() as u32] {
            fixed.extend(number.to_le_bytes());
        }
        let offset = body.len() as u32;
        body.extend([&b"PK\x03\x04"[..], &fixed, name.as_bytes(), &data].concat());
        let rest = [&[0; 10][..], &offset.to_le_bytes(), name.as_bytes()].concat();
        directory.extend([&b"PK\x01\x02\x14\x00"[..], &fixed, &rest].concat());
    }
    let count = (arrays.len() as u16).to_le_bytes();
    let ends = [(directory.len() as u32).to_le_bytes(), (body.len() as u32).to_le_bytes()];
    let end = [&b"PK\x05\x06\0\0\0\0"[..], &count, &count, &ends.concat(), &[0, 0]].concat();
    [body, directory, end].concat()
}

fn npy(shape: &[usize], values: &[f64]) -> Vec<u8> {
    let mut list = String::new();
    for length in shape {
        write!(list, "{length}, ").unwrap();
    }
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({list}), }}");
    let header = format!("{header:<117}\n");
    let length = (header.len() as u16).to_le_bytes();
    let data: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    [&b"\x93NUMPY\x01\x00"[..], &length, header.as_bytes(), &data].concat()
}

fn crc32(data: &[u8]) -> u32 {
    let step = |crc: u32| if crc & 1 == 1 { 0xEDB8_8320 ^ (crc >> 1) } else { crc >> 1 };
    !data.iter().fold(!0, |crc, &byte| (0..8).fold(crc ^ u32::from(byte), |crc, _| step(crc)))
}

/// Every name in `after` that is not in `before`.
pub(crate) fn added(before: &[String], after: &[String]) -> Vec<String> {
    after.iter().filter(|name| !before.contains(name)).cloned().collect()
}

/// A path as an argument.
pub(crate) fn argument(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The file or folder `relative` of the shared data, or `None` (with a printed line) where there is none.
pub(crate) fn shared_path(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RARE_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
    let path = root.join(relative);
    let required = std::env::var("RARE_REQUIRE_SHARED").as_deref() == Ok("1");
    assert!(path.exists() || !required, "there is no {}", path.display());
    if !path.exists() {
        println!("skipped: no {}", path.display());
    }
    path.canonicalize().ok()
}
