//! The files of one part: which of several weight files is taken, and the reading of JSON.

use std::fs;
use std::path::{Path, PathBuf};

use rare::{Error, Result};
use serde_json::{Map, Value};

/// The longest JSON that is read here; real ones have a few kB.
const LONGEST_JSON: u64 = 1 << 20;

/// The names that weights may have, the preferred first; the first is the plain one.
pub(super) type Names = [&'static str; 8];

/// The weights of the U-Net and the `ControlNet`.
pub(super) const DIFFUSION_MODEL: Names = [
    "diffusion_pytorch_model.safetensors",
    "diffusion_pytorch_model.safetensors.index.json",
    "diffusion_pytorch_model.bin",
    "diffusion_pytorch_model.bin.index.json",
    "diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.safetensors.index.fp16.json",
    "diffusion_pytorch_model.fp16.safetensors.index.json",
    "diffusion_pytorch_model.fp16.bin",
];

/// The weights of the text encoder.
pub(super) const TEXT_MODEL: Names = [
    "model.safetensors",
    "model.safetensors.index.json",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
    "model.fp16.safetensors",
    "model.safetensors.index.fp16.json",
    "model.fp16.safetensors.index.json",
    "pytorch_model.fp16.bin",
];

/// The weight file in `folder`.
pub(super) fn weights(folder: &Path, names: &Names) -> Result<PathBuf> {
    let found = names.iter().map(|name| folder.join(name)).find(|path| path.is_file());
    found.ok_or_else(|| {
        let what = format!("there are no weights: looked for {}", names.join(", "));
        Error::in_file(folder, what)
    })
}

/// A JSON object in a file.
#[derive(Debug)]
pub(super) struct Json {
    pub(super) path: PathBuf,
    pub(super) values: Map<String, Value>,
}

impl Json {
    /// Reads a file.
    pub(super) fn read(path: PathBuf) -> Result<Json> {
        let io = |cause| Error::io(&path, cause);
        let length = fs::metadata(&path).map_err(io)?.len();
        if length > LONGEST_JSON {
            return Err(Error::in_file(&path, format!("{length} bytes of JSON")));
        }
        let bytes = fs::read(&path).map_err(io)?;
        let values = serde_json::from_slice(&bytes)
            .map_err(|cause| Error::in_file(&path, format!("does not parse: {cause}")))?;
        Ok(Json { path, values })
    }

    /// The value of `key`; `null` counts as absent.
    pub(super) fn get(&self, key: &str) -> Option<&Value> {
        self.values.get(key).filter(|value| !value.is_null())
    }

    /// The size `key`, at least 1 and at most a million; `default` if it is absent.
    pub(super) fn size(&self, key: &str, default: usize) -> Result<usize> {
        let Some(value) = self.get(key) else { return Ok(default) };
        let size = value.as_u64().and_then(|size| usize::try_from(size).ok());
        match size {
            Some(size @ 1..=1_000_000) => Ok(size),
            _ => Err(self.wrong(key, value, "a size from 1 to 1000000")),
        }
    }

    /// Four sizes; `default` if they are absent.
    pub(super) fn sizes(&self, key: &str, default: [usize; 4]) -> Result<[usize; 4]> {
        let Some(value) = self.get(key) else { return Ok(default) };
        let sizes: Option<Vec<usize>> = value.as_array().and_then(|sizes| {
            let size = |value: &Value| usize::try_from(value.as_u64()?).ok();
            sizes
                .iter()
                .map(size)
                .map(|size| size.filter(|size| (1..=1_000_000).contains(size)))
                .collect()
        });
        let four = sizes.and_then(|sizes| <[usize; 4]>::try_from(sizes).ok());
        four.ok_or_else(|| self.wrong(key, value, "four sizes"))
    }

    /// The number `key`; `default` if it is absent.
    pub(super) fn number(&self, key: &str, default: f64) -> Result<f64> {
        let Some(value) = self.get(key) else { return Ok(default) };
        value.as_f64().ok_or_else(|| self.wrong(key, value, "a number"))
    }

    /// The value of a key is not what it must be.
    pub(super) fn wrong(&self, key: &str, found: &Value, expected: &str) -> Error {
        Error::in_file(&self.path, format!("{key} is {found}, expected {expected}"))
    }
}
