//! From the graph of nodes to an object: cycles and depths are cut, tensors find their bytes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rare::{Error, Result};

use super::super::tensor::{Description, Place, strides_of};
use super::super::weight_file::WeightFile;
use super::super::{ElementType, Tensor};
use super::node::{self, Graph, Id, Node};
use super::object::{Instance, Object};

/// Levels of nesting that are followed; checkpoints have about six.
const DEEPEST: usize = 200;

/// Where the storages of a file are.
#[derive(Debug)]
pub(super) struct Storages {
    pub(super) file: Arc<WeightFile>,
    /// First byte and number of bytes, by key.
    pub(super) places: BTreeMap<String, (u64, u64)>,
    pub(super) big_endian: bool,
}

impl Graph {
    /// The object that the pickle gives.
    pub(super) fn finish(&self, storages: &Storages) -> Result<Object> {
        let (done, open) = (BTreeMap::new(), BTreeSet::new());
        Finisher { graph: self, storages, done, open }.object(self.root, 0)
    }

    /// The element type of each storage, by key.
    pub(super) fn storage_elements(&self) -> BTreeMap<&str, ElementType> {
        let storages = self.nodes.iter().filter_map(|node| match node {
            Node::Storage(storage) => Some((&*storage.key, storage.element)),
            _ => None,
        });
        storages.collect()
    }
}

struct Finisher<'a> {
    graph: &'a Graph,
    storages: &'a Storages,
    /// What is made of a node is made once, however often it occurs.
    done: BTreeMap<Id, Object>,
    /// The nodes around the one that is being made.
    open: BTreeSet<Id>,
}

impl Finisher<'_> {
    fn object(&mut self, id: Id, depth: usize) -> Result<Object> {
        if let Some(object) = self.leaf(id) {
            return Ok(object);
        }
        if let Some(object) = self.done.get(&id) {
            return Ok(object.clone());
        }
        if depth > DEEPEST || !self.open.insert(id) {
            return Ok(Object::Cut);
        }
        let object = self.compound(id, depth + 1)?;
        self.open.remove(&id);
        self.done.insert(id, object.clone());
        Ok(object)
    }

    /// An object without parts.
    fn leaf(&self, id: Id) -> Option<Object> {
        Some(match self.graph.node(id) {
            Node::None => Object::None,
            Node::Bool(value) => Object::Bool(*value),
            Node::Integer(value) => Object::Integer(*value),
            Node::Float(value) => Object::Float(*value),
            Node::Text(text) => Object::Text(Arc::clone(text)),
            Node::Bytes(bytes) => Object::Bytes(Arc::clone(bytes)),
            Node::Global(name) => Object::Global(Arc::clone(name)),
            // Neither occurs alone in a checkpoint.
            Node::NumberType(_) => Object::Global("numpy.dtype".into()),
            Node::Storage(_) => Object::Global("torch.Storage".into()),
            _ => return None,
        })
    }

    fn compound(&mut self, id: Id, depth: usize) -> Result<Object> {
        Ok(match self.graph.node(id) {
            Node::List(items) => Object::List(self.objects(items, depth)?),
            Node::Tuple(items) => Object::Tuple(self.objects(items, depth)?),
            Node::Dictionary(entries) => Object::Dictionary(self.pairs(entries, depth)?),
            Node::Tensor(strided) => Object::Tensor(Arc::new(self.tensor(strided)?)),
            Node::Array(array) => Object::Array(Arc::new(self.array(array)?)),
            Node::Instance(instance) => Object::Instance(Arc::new(Instance {
                class: Arc::clone(&instance.class),
                arguments: self.object(instance.arguments, depth)?,
                state: instance
                    .state
                    .map_or(Ok(Object::None), |state| self.object(state, depth))?,
                items: self.objects(&instance.items, depth)?,
                entries: self.pairs(&instance.entries, depth)?,
            })),
            _ => Object::None,
        })
    }

    fn objects(&mut self, ids: &[Id], depth: usize) -> Result<Arc<[Object]>> {
        ids.iter().map(|&id| self.object(id, depth)).collect()
    }

    fn pairs(&mut self, ids: &[(Id, Id)], depth: usize) -> Result<Arc<[(Object, Object)]>> {
        ids.iter()
            .map(|&(key, value)| Ok((self.object(key, depth)?, self.object(value, depth)?)))
            .collect()
    }

    fn tensor(&self, strided: &node::Strided) -> Result<Tensor> {
        let node::Strided { storage, offset, shape, strides } = strided;
        let fault = |what: String| Error::in_file(self.storages.file.path(), what);
        let Some(&(start, length)) = self.storages.places.get(&*storage.key) else {
            return Err(fault(format!("storage {} of a tensor is missing", storage.key)));
        };
        let description = Description {
            element: storage.element,
            shape: shape.clone(),
            strides: strides.clone(),
            offset: offset.saturating_add(storage.offset),
            big_endian: self.storages.big_endian,
        };
        let place = Place::File(Arc::clone(&self.storages.file));
        Tensor::in_storage(description, place, start, length).map_err(fault)
    }

    fn array(&self, array: &node::Array) -> Result<Tensor> {
        let node::Array { element, big_endian, shape, column_major, bytes } = array;
        let strides = if *column_major {
            let reversed: Vec<usize> = shape.iter().rev().copied().collect();
            strides_of(&reversed).into_iter().rev().collect()
        } else {
            strides_of(shape)
        };
        let (element, big_endian, shape) = (*element, *big_endian, shape.clone());
        let description = Description { element, shape, strides, offset: 0, big_endian };
        Tensor::in_storage(description, Place::Memory(Arc::clone(bytes)), 0, bytes.len() as u64)
            .map_err(|what| Error::in_file(self.storages.file.path(), what))
    }
}
