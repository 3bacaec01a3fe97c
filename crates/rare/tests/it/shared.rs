//! Where the golden inputs and outputs and the real data lie, and how to read the golden arrays.
//!
//! They stand beside a development checkout, never in it: a test that does not find them says so and passes,
//! unless `RARE_REQUIRE_SHARED=1` makes the absence a failure.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// The file or folder `relative` of the shared data, or `None` (with a printed line) where there is none.
pub(crate) fn path(relative: &str) -> Option<PathBuf> {
    let root = std::env::var_os("RARE_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"));
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    assert!(
        std::env::var("RARE_REQUIRE_SHARED").as_deref() != Ok("1"),
        "RARE_REQUIRE_SHARED=1, but there is no {}",
        path.display()
    );
    println!("skipped: no {}", path.display());
    None
}

/// One array of a golden file: shape and values, widened to `f64`, in C order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Vec<f64>,
}

impl Array {
    pub(crate) fn f32(&self) -> Vec<f32> {
        self.values.iter().map(|&value| value as f32).collect()
    }

    pub(crate) fn usize(&self) -> Vec<usize> {
        self.values.iter().map(|&value| value as usize).collect()
    }

    /// The rows of an `N x 3` array as points.
    pub(crate) fn points(&self) -> Vec<nalgebra::Point3<f64>> {
        assert_eq!(self.shape.last(), Some(&3));
        self.values
            .chunks_exact(3)
            .map(|row| nalgebra::Point3::new(row[0], row[1], row[2]))
            .collect()
    }

    /// A `4 x 4` array.
    pub(crate) fn matrix4(&self) -> nalgebra::Matrix4<f64> {
        assert_eq!(self.shape, [4, 4]);
        nalgebra::Matrix4::from_row_slice(&self.values)
    }
}

/// A golden `.npz` archive.
pub(crate) struct Golden {
    archive: npyz::npz::NpzArchive<BufReader<File>>,
    path: PathBuf,
}

impl Golden {
    /// Opens `golden/<relative>`; `None` where the shared data are missing.
    pub(crate) fn open(relative: &str) -> Option<Golden> {
        Golden::open_path(path(&format!("golden/{relative}"))?)
    }

    /// Opens any `.npz` file.
    pub(crate) fn open_path(path: PathBuf) -> Option<Golden> {
        let archive = npyz::npz::NpzArchive::open(&path).expect("a golden file opens");
        Some(Golden { archive, path })
    }

    /// The array `name`, whatever its number type.
    pub(crate) fn array(&mut self, name: &str) -> Array {
        let npy = self
            .archive
            .by_name(name)
            .expect("a golden file reads")
            .unwrap_or_else(|| panic!("{}: no array {name}", self.path.display()));
        let shape = npy.shape().iter().map(|&size| size as usize).collect();
        let order = npy.order();
        let npyz::DType::Plain(kind) = npy.dtype() else { panic!("{name}: structured array") };
        let values = match kind.to_string().as_str() {
            "<f4" => npy.into_vec::<f32>().unwrap().into_iter().map(f64::from).collect(),
            "<f8" => npy.into_vec::<f64>().unwrap(),
            "<i4" => npy.into_vec::<i32>().unwrap().into_iter().map(f64::from).collect(),
            "<i8" => npy.into_vec::<i64>().unwrap().into_iter().map(|value| value as f64).collect(),
            "|u1" => npy.into_vec::<u8>().unwrap().into_iter().map(f64::from).collect(),
            "|b1" => npy.into_vec::<bool>().unwrap().into_iter().map(f64::from).collect(),
            other => panic!("{name}: number type {other}"),
        };
        match order {
            npyz::Order::C => Array { shape, values },
            npyz::Order::Fortran => Array { values: transposed(&shape, &values), shape },
        }
    }

    /// The names of all arrays, sorted.
    pub(crate) fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = self.archive.array_names().map(str::to_owned).collect();
        names.sort();
        names
    }
}

/// The values of a two-dimensional array in Fortran order, in C order.
fn transposed(shape: &[usize], values: &[f64]) -> Vec<f64> {
    let [rows, columns] = *shape else { panic!("an array in Fortran order with shape {shape:?}") };
    (0..rows * columns).map(|at| values[at % columns * rows + at / columns]).collect()
}

#[test]
fn a_golden_file_reads() {
    let Some(mut golden) = Golden::open("rare/s8_metrics.npz") else { return };
    assert!(!golden.names().is_empty());
    for name in golden.names() {
        let array = golden.array(&name);
        assert_eq!(array.shape.iter().product::<usize>(), array.values.len());
    }
    let Some(mut golden) = Golden::open("rare/s1_projection_3dmatch.npz") else { return };
    assert_eq!(golden.array("ref_points").points().len(), 18977);
    assert_eq!(golden.array("gt").matrix4()[(3, 3)], 1.0);
    assert_eq!(
        golden.array("refview_ref_idx").usize().len(),
        golden.array("refview_ref_depth").f32().len()
    );
}
