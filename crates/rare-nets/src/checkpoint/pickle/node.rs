//! The graph that the machine builds: nodes that refer to each other by number, because a pickle may fill a list
//! after it has put it into another one, or into itself.

use std::sync::Arc;

use super::super::ElementType;

/// The number of a node.
pub(super) type Id = u32;

/// All nodes of a pickle, and the one that it gives.
#[derive(Debug)]
pub(super) struct Graph {
    /// By number.
    pub(super) nodes: Vec<Node>,
    /// The result.
    pub(super) root: Id,
}

impl Graph {
    /// A node; a number that does not exist gives `None`, which cannot happen.
    pub(super) fn node(&self, id: Id) -> &Node {
        self.nodes.get(id as usize).unwrap_or(&Node::None)
    }
}

/// One object under construction.
#[derive(Debug)]
pub(super) enum Node {
    None,
    Bool(bool),
    Integer(i128),
    Float(f64),
    Text(Arc<str>),
    Bytes(Arc<[u8]>),
    List(Vec<Id>),
    Tuple(Vec<Id>),
    Dictionary(Vec<(Id, Id)>),
    Global(Arc<str>),
    Storage(Storage),
    Tensor(Box<Strided>),
    NumberType(NumberType),
    Array(Box<Array>),
    Instance(Box<Instance>),
}

/// Values beside the pickle that several tensors may share.
#[derive(Debug, Clone)]
pub(super) struct Storage {
    pub(super) element: ElementType,
    pub(super) key: Arc<str>,
    /// Elements before those that this name means.
    pub(super) offset: usize,
}

/// A tensor of torch.
#[derive(Debug)]
pub(super) struct Strided {
    pub(super) storage: Storage,
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    pub(super) strides: Vec<usize>,
}

/// A `numpy.dtype`.
#[derive(Debug, Clone, Copy)]
pub(super) struct NumberType {
    /// `None` for texts, objects, records.
    pub(super) element: Option<ElementType>,
    pub(super) big_endian: bool,
}

/// An array of numpy whose values are known.
#[derive(Debug)]
pub(super) struct Array {
    pub(super) element: ElementType,
    pub(super) big_endian: bool,
    pub(super) shape: Vec<usize>,
    /// Whether the first axis is the fastest.
    pub(super) column_major: bool,
    pub(super) bytes: Arc<[u8]>,
}

/// An object of a class that means nothing here.
#[derive(Debug)]
pub(super) struct Instance {
    pub(super) class: Arc<str>,
    pub(super) arguments: Id,
    pub(super) state: Option<Id>,
    pub(super) items: Vec<Id>,
    pub(super) entries: Vec<(Id, Id)>,
}
