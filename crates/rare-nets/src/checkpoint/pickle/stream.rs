//! Pickles one after the other: the container of torch before 1.6, and pickles alone.
//!
//! The old container is a magic number, a version, facts about the machine, the object and the keys of the storages,
//! each a pickle of its own, then for each key the number of its elements (`i64`) and the elements.

use std::collections::BTreeMap;
use std::sync::Arc;

use rare::Result;

use super::super::weight_file::WeightFile;
use super::finish::Storages;
use super::input::Input;
use super::machine;
use super::node::{Graph, Node};
use super::object::Object;

/// What torch before 1.6 writes first.
const MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;

/// Its only version.
const VERSION: i128 = 1001;

/// Opens a stream, or a pickle alone.
pub(super) fn open(file: &Arc<WeightFile>) -> Result<Object> {
    let mut input = Input::new(file, 0, file.length());
    let first = machine::run(&mut input)?;
    let mut storages =
        Storages { file: Arc::clone(file), places: BTreeMap::new(), big_endian: false };
    if !is_integer(&first, MAGIC) {
        return first.finish(&storages);
    }
    if !is_integer(&machine::run(&mut input)?, VERSION) {
        return Err(input.unsupported(format!("a version of the format that is not {VERSION}")));
    }
    machine::run(&mut input)?;
    let graph = machine::run(&mut input)?;
    let keys = machine::run(&mut input)?.finish(&storages)?;
    storages.places = places(&graph, &keys, &mut input)?;
    graph.finish(&storages)
}

fn is_integer(graph: &Graph, expected: i128) -> bool {
    matches!(graph.node(graph.root), Node::Integer(value) if *value == expected)
}

/// Walks over the storages: first byte and number of bytes, by key.
fn places(
    graph: &Graph,
    keys: &Object,
    input: &mut Input<'_>,
) -> Result<BTreeMap<String, (u64, u64)>> {
    let elements = graph.storage_elements();
    let mut places = BTreeMap::new();
    for key in keys.items() {
        let Some(key) = key.text() else { return Err(input.fault("a storage without a name")) };
        let Some(element) = elements.get(key) else {
            return Err(input.unsupported(format!("storage {key} has an unknown type of numbers")));
        };
        let count = u64::from_le_bytes(input.array()?);
        let Some(length) = count.checked_mul(element.bytes() as u64) else {
            return Err(input.fault(format!("storage {key} has {count} elements")));
        };
        let start = input.position();
        input.skip(length)?;
        places.insert(key.to_owned(), (start, length));
    }
    Ok(places)
}
