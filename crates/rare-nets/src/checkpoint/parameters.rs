//! The tensors of one network.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rare::{Error, Result};

use super::{Object, Tensor, open_pickle, safetensors, shards};
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
    file: Arc<Path>,
}

impl Parameters {
    /// Opens one safetensors file, or several whose tensors are put together (sharded weights).
    ///
    /// # Errors
    /// `InvalidInput` if a file is malformed or truncated, or if two files have a tensor of the same name;
    /// `Io` if a file cannot be read.
    pub fn open_safetensors(files: &[PathBuf]) -> Result<Parameters> {
        files.iter().try_fold(Parameters::default(), |all, path| {
            let opened = safetensors::open(path)?;
            all.join(Parameters::from_tensors(path, opened.tensors, opened.metadata))
        })
    }

    /// Opens a file of `torch.save` and takes the dictionary of tensors in it: that under `state_dict`, else that under
    /// `model`, else the object itself. Names stay as they are; entries that are not tensors are left out. Numbers and
    /// texts under `config` become metadata: the settings of the training.
    ///
    /// # Errors
    /// Those of [`open_pickle`], and `InvalidInput` if there is no such dictionary.
    pub fn open_pickle(path: &Path) -> Result<Parameters> {
        let object = open_pickle(path)?;
        let candidates = [object.get("state_dict"), object.get("model"), Some(&object)];
        let tensors =
            candidates.into_iter().flatten().map(named_tensors).find(|found| !found.is_empty());
        match tensors {
            Some(tensors) => Ok(Parameters::from_tensors(path, tensors, settings(&object))),
            None => Err(Error::in_file(
                path,
                "holds no dictionary of tensors, neither itself nor under state_dict or model",
            )),
        }
    }

    /// Opens a weight file of any format, by the end of its name: `.index.json` names the files of sharded weights, which
    /// lie beside it; `.safetensors`; everything else is taken for a file of `torch.save`.
    ///
    /// # Errors
    /// Those of [`Parameters::open_safetensors`] and [`Parameters::open_pickle`], and `InvalidInput` if an index does not
    /// fit the files that it names.
    pub fn open(path: &Path) -> Result<Parameters> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.ends_with(".json") {
            shards::open(path)
        } else if name.ends_with(".safetensors") {
            Parameters::open_safetensors(&[path.to_owned()])
        } else {
            Parameters::open_pickle(path)
        }
    }

    /// Gives every tensor the name that `rename` makes of it, and leaves out those of which it makes none.
    ///
    /// # Errors
    /// `InvalidInput` if two tensors get the same name.
    pub fn renamed(self, rename: impl Fn(&str) -> Option<String>) -> Result<Parameters> {
        let mut tensors: BTreeMap<String, Named> = BTreeMap::new();
        for (name, named) in self.tensors {
            let Some(new) = rename(&name) else { continue };
            if let Some(other) = tensors.get(&new) {
                let both = format!("tensors {} and {} mean the same", other.name, named.name);
                return Err(Error::in_file(&named.file, both));
            }
            tensors.insert(new, named);
        }
        Ok(Parameters { tensors, ..self })
    }

    /// Whether there is a tensor `name`.
    #[must_use]
    pub fn contains(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    fn from_tensors(
        path: &Path,
        tensors: BTreeMap<String, Tensor>,
        metadata: BTreeMap<String, String>,
    ) -> Parameters {
        let file: Arc<Path> = path.into();
        let tensors = tensors
            .into_iter()
            .map(|(name, tensor)| (name.clone(), Named { name, tensor, file: Arc::clone(&file) }))
            .collect();
        Parameters { tensors, metadata, files: vec![path.to_owned()] }
    }

    /// Adds the tensors of `other`.
    ///
    /// # Errors
    /// `InvalidInput` if both have a tensor of the same name.
    pub fn join(mut self, other: Parameters) -> Result<Parameters> {
        for (name, named) in other.tensors {
            if let Some(before) = self.tensors.get(&name) {
                return Err(Error::in_file(
                    &named.file,
                    format!("tensor {name} is also in {}", before.file.display()),
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
            Error::in_file(&named.file, format!("tensor {}: {what}", named.shown(name)))
        };
        if named.tensor.shape() != shape {
            return Err(refuse(format!("shape {:?}, expected {shape:?}", named.tensor.shape())));
        }
        let (values, bad) = named.tensor.values().map_err(|error| match error {
            Error::Unsupported(what) => Error::Unsupported(format!(
                "{}: tensor {}: {what}",
                named.file.display(),
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

/// Numbers and texts under `config`.
fn settings(object: &Object) -> BTreeMap<String, String> {
    let Some(config) = object.get("config") else { return BTreeMap::new() };
    let text = |value: &Object| match value {
        Object::Bool(value) => Some(value.to_string()),
        Object::Integer(value) => Some(value.to_string()),
        Object::Float(value) => Some(value.to_string()),
        Object::Text(value) => Some(value.to_string()),
        _ => None,
    };
    let settings = config
        .entries()
        .iter()
        .filter_map(|(name, value)| Some((format!("config.{}", name.text()?), text(value)?)));
    settings.collect()
}

/// The tensors among the entries of a dictionary.
fn named_tensors(object: &Object) -> BTreeMap<String, Tensor> {
    let tensors = object.entries().iter().filter_map(|(name, value)| match value {
        Object::Tensor(tensor) => Some((name.text()?.to_owned(), Tensor::clone(tensor))),
        _ => None,
    });
    tensors.collect()
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
