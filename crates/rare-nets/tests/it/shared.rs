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

/// The largest difference of two arrays over the largest value of the second, which is golden.
pub(crate) fn relative_difference(values: &[f32], golden: &[f64]) -> f64 {
    assert_eq!(values.len(), golden.len());
    let largest = golden.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    let difference = values.iter().zip(golden).fold(0.0, |largest: f64, (value, golden)| {
        // What is not a number is as far away as can be.
        let difference = (f64::from(*value) - golden).abs();
        if difference.is_nan() { f64::INFINITY } else { largest.max(difference) }
    });
    difference / largest
}

/// A golden `.safetensors` file, read without the code that is tested.
pub(crate) struct GoldenTensors {
    header: serde_json::Value,
    data: Vec<u8>,
    path: PathBuf,
}

impl GoldenTensors {
    /// Opens `golden/<relative>`; `None` where the shared data are missing.
    pub(crate) fn open(relative: &str) -> Option<GoldenTensors> {
        let path = path(&format!("golden/{relative}"))?;
        let bytes = std::fs::read(&path).expect("a golden file reads");
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header = serde_json::from_slice(&bytes[8..8 + length]).expect("a golden header parses");
        Some(GoldenTensors { header, data: bytes[8 + length..].to_vec(), path })
    }

    /// Whether there is a tensor `name`.
    pub(crate) fn contains(&self, name: &str) -> bool {
        self.header.get(name).is_some()
    }

    /// The tensor `name`, whatever its number type.
    pub(crate) fn array(&self, name: &str) -> Array {
        let entry = self
            .header
            .get(name)
            .unwrap_or_else(|| panic!("{}: no tensor {name}", self.path.display()));
        let sizes = |key: &str| -> Vec<usize> {
            let list = entry[key].as_array().unwrap();
            list.iter().map(|size| size.as_u64().unwrap() as usize).collect()
        };
        let place = sizes("data_offsets");
        let data = &self.data[place[0]..place[1]];
        let words = data.chunks_exact(4).map(|word| word.try_into().unwrap());
        let values = match entry["dtype"].as_str().unwrap() {
            "F32" => words.map(|word| f64::from(f32::from_le_bytes(word))).collect(),
            "I32" => words.map(|word| f64::from(i32::from_le_bytes(word))).collect(),
            "U8" => data.iter().map(|&value| f64::from(value)).collect(),
            other => panic!("{name}: number type {other}"),
        };
        Array { shape: sizes("shape"), values }
    }
}
