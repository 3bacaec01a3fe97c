//! Weights in several files: an index names the file of each tensor.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use rare::{Error, Result};
use serde::Deserialize;

use super::Parameters;

/// The longest index that is read; that of a network of a thousand tensors has 100 kB.
const LONGEST_INDEX: u64 = 100_000_000;

#[derive(Deserialize)]
struct Index {
    weight_map: BTreeMap<String, String>,
}

/// Opens all files of an index. They must lie beside it and hold exactly the tensors that it names.
pub(super) fn open(path: &Path) -> Result<Parameters> {
    let index = read_index(path)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let names: BTreeSet<&String> = index.weight_map.values().collect();
    let mut all = Parameters::default();
    for name in names {
        if !is_plain_name(name) {
            let what = format!("names the file {name:?}, which is not beside the index");
            return Err(Error::in_file(path, what));
        }
        all = all.join(Parameters::open(&folder.join(name))?)?;
    }
    if let Some(name) = index.weight_map.keys().find(|name| !all.contains(name)) {
        return Err(Error::in_file(path, format!("tensor {name} is in none of the files")));
    }
    Ok(all)
}

fn read_index(path: &Path) -> Result<Index> {
    let io = |cause| Error::io(path, cause);
    let length = std::fs::metadata(path).map_err(io)?.len();
    if length > LONGEST_INDEX {
        return Err(Error::in_file(path, format!("an index of {length} bytes")));
    }
    let bytes = std::fs::read(path).map_err(io)?;
    serde_json::from_slice(&bytes)
        .map_err(|cause| Error::in_file(path, format!("the index does not parse: {cause}")))
}

/// Whether it is the name of a file, not a path, and not an index again.
fn is_plain_name(name: &str) -> bool {
    let mut parts = Path::new(name).components();
    let plain = matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None));
    plain && !name.contains(['/', '\\']) && !name.ends_with(".json")
}
