//! The container of torch 1.6 and later: a zip archive with one folder, in which `data.pkl` is the object and
//! `data/<key>` are the storages, all of them uncompressed so that they can be read in place.

use std::collections::BTreeMap;
use std::io::BufReader;
use std::sync::Arc;

use rare::{Error, Result};
use zip::{CompressionMethod, ZipArchive};

use super::super::weight_file::WeightFile;
use super::finish::Storages;
use super::input::Input;
use super::machine;
use super::object::Object;

/// Opens an archive.
pub(super) fn open(file: &Arc<WeightFile>) -> Result<Object> {
    let entries = entries(file)?;
    let Some((folder, &(start, length))) =
        entries.iter().find_map(|(name, place)| Some((name.strip_suffix("/data.pkl")?, place)))
    else {
        let what = "a zip archive without data.pkl, so torch.save did not write it";
        return Err(Error::in_file(file.path(), what));
    };
    let big_endian = match entries.get(&format!("{folder}/byteorder")) {
        Some(&(start, length)) => {
            Input::new(file, start, start + length).take(length.min(3))? == b"big"
        }
        None => false,
    };
    let storages = format!("{folder}/data/");
    let places = entries
        .iter()
        .filter_map(|(name, &place)| Some((name.strip_prefix(&storages)?.to_owned(), place)))
        .collect();
    let graph = machine::run(&mut Input::new(file, start, start + length))?;
    graph.finish(&Storages { file: Arc::clone(file), places, big_endian })
}

/// First byte and number of bytes of every entry, by name.
fn entries(file: &WeightFile) -> Result<BTreeMap<String, (u64, u64)>> {
    let damaged = |cause: zip::result::ZipError| {
        Error::in_file(
            file.path(),
            format!("the zip archive is damaged or truncated ({cause}); fetch it again"),
        )
    };
    let mut archive = ZipArchive::new(BufReader::new(file.file())).map_err(damaged)?;
    let mut entries = BTreeMap::new();
    for index in 0..archive.len() {
        let entry = archive.by_index_raw(index).map_err(damaged)?;
        let name = entry.name().map_err(damaged)?.into_owned();
        if entry.encrypted() || entry.compression() != CompressionMethod::Stored {
            return Err(Error::Unsupported(format!(
                "{}: {name} is compressed, which torch.save does not do: save it again",
                file.path().display()
            )));
        }
        let (start, length) = (entry.data_start().unwrap_or(u64::MAX), entry.size());
        if start.checked_add(length).is_none_or(|end| end > file.length()) {
            return Err(Error::in_file(
                file.path(),
                format!("{name} ends after the end of the file"),
            ));
        }
        entries.insert(name, (start, length));
    }
    Ok(entries)
}
