//! The tensors of one network.

use std::collections::BTreeMap;
use std::path::PathBuf;

use rare::{Error, Result};

use super::{Tensor, safetensors};
use crate::Parameter;

/// The tensors of one network by name. Nothing is read before it is asked for.
///
/// Names follow the convention of the diffusers and transformers libraries, wherever the tensors come from; messages
/// give the name in the file as well where it differs.
#[derive(Debug, Clone, Default)]
pub struct Parameters {
    tensors: BTreeMap<String, Named>,
    metadata: BTreeMap<String, String>,
    files: Vec<PathBuf>,
}

/// A tensor and its name in the file.
#[derive(Debug, Clone)]
struct Named {
    name: String,
    tensor: Tensor,
}

impl Parameters {
    /// Opens one safetensors file, or several whose tensors are put together (sharded weights).
    ///
    /// # Errors
    /// `InvalidInput` if a file is malformed or truncated, or if two files have a tensor of the same name;
    /// `Io` if a file cannot be read.
    pub fn open_safetensors(files: &[PathBuf]) -> Result<Parameters> {
        let mut parameters = Parameters::default();
        for path in files {
            let opened = safetensors::open(path)?;
            parameters = parameters.join(Parameters {
                tensors: opened
                    .tensors
                    .into_iter()
                    .map(|(name, tensor)| (name.clone(), Named { name, tensor }))
                    .collect(),
                metadata: opened.metadata,
                files: vec![path.clone()],
            })?;
        }
        Ok(parameters)
    }

    /// Adds the tensors of `other`.
    ///
    /// # Errors
    /// `InvalidInput` if both have a tensor of the same name.
    pub fn join(mut self, other: Parameters) -> Result<Parameters> {
        for (name, named) in other.tensors {
            if let Some(before) = self.tensors.get(&name) {
                return Err(Error::in_file(
                    named.tensor.path(),
                    format!("tensor {name} is also in {}", before.tensor.path().display()),
                ));
            }
            self.tensors.insert(name, named);
        }
        self.metadata.extend(other.metadata);
        self.files.extend(other.files);
        Ok(self)
    }

    /// The sizes of the tensor `name`, the slowest first; `None` if there is none.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.tensors.get(name).map(|named| named.tensor.shape())
    }

    /// All names, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// The texts that the files carry beside the tensors.
    #[must_use]
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The files that hold the tensors.
    #[must_use]
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }

    /// Reads the tensor `name`, which must have the sizes `shape`.
    ///
    /// # Errors
    /// `InvalidInput` if there is no such tensor, if it has another shape, or if a value is not finite;
    /// `Unsupported` if its numbers are not F32, F16 or BF16; `Io` if the file cannot be read.
    pub fn read(&self, name: &str, shape: &[usize]) -> Result<Parameter> {
        let Some(named) = self.tensors.get(name) else {
            return Err(self.missing(name, shape));
        };
        let refuse = |what: String| {
            Error::in_file(named.tensor.path(), format!("tensor {}: {what}", named.shown(name)))
        };
        if named.tensor.shape() != shape {
            return Err(refuse(format!("shape {:?}, expected {shape:?}", named.tensor.shape())));
        }
        let (values, bad) = named.tensor.values().map_err(|error| match error {
            Error::Unsupported(what) => Error::Unsupported(format!(
                "{}: tensor {}: {what}",
                named.tensor.path().display(),
                named.shown(name)
            )),
            other => other,
        })?;
        if bad > 0 {
            return Err(refuse(format!(
                "{bad} of {} values are not finite: the weights are damaged",
                named.tensor.count()
            )));
        }
        Ok(Parameter { shape: shape.to_vec(), values })
    }

    fn missing(&self, name: &str, shape: &[usize]) -> Error {
        let what = format!("there is no tensor {name} (expected with shape {shape:?})");
        match self.files.first() {
            Some(file) => Error::in_file(file, what),
            None => Error::invalid(what),
        }
    }
}

impl Named {
    /// The name for a message: that of the network, and that in the file where it differs.
    fn shown(&self, name: &str) -> String {
        if self.name == name {
            name.to_owned()
        } else {
            format!("{name} ({} in the file)", self.name)
        }
    }
}
