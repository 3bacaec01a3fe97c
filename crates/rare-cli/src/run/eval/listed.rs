//! 3DMatch by the lists of pairs that Predator and GeoTransformer keep as pickles, where there is no `gt.log`.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use rare::eval::Protocol;
use rare::eval::dataset::{self, Dataset, DatasetPair};
use rare_nets::official::{self, ListedPair};

/// Where a list lies, below the root; `{}` is the benchmark's name.
const LISTS: [&str; 4] =
    ["metadata/{}.pkl", "data/3DMatch/metadata/{}.pkl", "configs/indoor/{}.pkl", "{}.pkl"];

/// The folders, below the root, that the files of a list are relative to.
const FOLDERS: [&str; 4] = ["data", "data/3DMatch/data", "data/indoor", ""];

/// Reads a benchmark by its name from `gt.log` files, or else from a list of pairs. Without `gt.log` there are no
/// information matrices, and so no RMSE: then [`Protocol::Dgr`] is the usual protocol.
///
/// # Errors
/// If there is neither, or one is malformed, or a cloud is missing.
pub(super) fn read_three_d_match(root: &Path, name: &str) -> Result<Dataset> {
    let lists = LISTS.map(|list| root.join(list.replace("{}", name)));
    let list = lists.into_iter().find(|list| list.is_file());
    match (dataset::read_three_d_match(root, name), list) {
        (Ok(dataset), _) => Ok(dataset),
        (Err(error), None) => Err(error.into()),
        (Err(_), Some(list)) => {
            let pairs = official::read_pairs(&list)?;
            let pairs = pairs.into_iter().map(|pair| located(root, &list, pair));
            Ok(Dataset {
                name: name.to_owned(),
                protocol: Protocol::Dgr,
                pairs: pairs.collect::<Result<_>>()?,
            })
        }
    }
}

fn located(root: &Path, list: &Path, pair: ListedPair) -> Result<DatasetPair> {
    let find = |name: &str| -> Result<PathBuf> {
        let candidates = FOLDERS.map(|folder| root.join(folder).join(name));
        match candidates.into_iter().find(|file| file.is_file()) {
            Some(file) => Ok(file),
            None => bail!(
                "{}: {name} is missing: sought below {} in {}",
                list.display(),
                root.display(),
                FOLDERS.join(", ")
            ),
        }
    };
    Ok(DatasetPair {
        source: find(&pair.source)?,
        reference: find(&pair.reference)?,
        truth: pair.truth,
    })
}
