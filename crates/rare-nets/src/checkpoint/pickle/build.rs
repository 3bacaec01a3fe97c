//! What the callables that stand for data give: tensors, arrays, dictionaries. Everything else becomes an instance.

use std::sync::Arc;

use rare::Result;

use super::super::ElementType;
use super::harm;
use super::machine::Machine;
use super::node::{Array, Id, Instance, Node, NumberType, Storage, Strided};

/// Axes that a tensor may have, numpy's own limit.
const MOST_AXES: usize = 64;

impl Machine<'_, '_> {
    /// What `callable` would give for the tuple `arguments`.
    pub(super) fn call(&mut self, callable: Id, arguments: Id) -> Result<Id> {
        let Node::Global(class) = self.node(callable) else {
            return Ok(self.instance("?".into(), arguments));
        };
        let class = Arc::clone(class);
        let given = match self.node(arguments) {
            // No callable that is known takes more than eight.
            Node::Tuple(items) => items.iter().copied().take(8).collect(),
            _ => Vec::new(),
        };
        match self.known(&class, &given)? {
            Some(id) => Ok(id),
            None if harm::runs_code(&class) => Err(self.input.fault(format!(
                "calls {class}, which runs code: it was not called, but this is no file of weights to trust"
            ))),
            None => Ok(self.instance(class, arguments)),
        }
    }

    /// The data that `class` stands for; `None` if it is unknown or called with something unknown.
    fn known(&mut self, class: &str, given: &[Id]) -> Result<Option<Id>> {
        match (class, given) {
            ("torch._utils._rebuild_tensor_v2" | "torch._utils._rebuild_tensor", given) => {
                self.tensor(given)
            }
            ("torch._utils._rebuild_parameter", &[data, ..])
            | ("torch._utils._rebuild_parameter_with_state", &[data, ..])
            | ("torch.Size", &[data]) => Ok(Some(data)),
            ("torch._tensor._rebuild_from_type_v2", &[function, _, arguments, _]) => {
                self.plain_tensor(function, arguments)
            }
            ("collections.OrderedDict", given) => self.ordered(given).map(Some),
            ("collections.defaultdict", _) => Ok(Some(self.add(Node::Dictionary(Vec::new())))),
            ("_codecs.encode", &[text, ..]) => self.encoded(text),
            ("numpy.dtype", &[name, ..]) => Ok(self.number_type(name)),
            ("numpy.core.multiarray.scalar" | "numpy._core.multiarray.scalar", &[kind, data]) => {
                let shape = self.add(Node::Tuple(Vec::new()));
                self.array(kind, shape, data, false)
            }
            (
                "numpy.core.numeric._frombuffer" | "numpy._core.numeric._frombuffer",
                &[data, kind, shape, order],
            ) => {
                let column_major = self.word(order) == Some("F");
                self.array(kind, shape, data, column_major)
            }
            _ => Ok(None),
        }
    }

    /// Adds an object of a class that means nothing here.
    pub(super) fn instance(&mut self, class: Arc<str>, arguments: Id) -> Id {
        let (items, entries) = (Vec::new(), Vec::new());
        self.add(Node::Instance(Box::new(Instance {
            class,
            arguments,
            state: None,
            items,
            entries,
        })))
    }

    /// Gives `state` to the object `target`. Attributes of dictionaries, lists and tensors are left out.
    pub(super) fn build(&mut self, target: Id, state: Id) -> Result<()> {
        if matches!(self.node(target), Node::NumberType(_)) {
            self.set_byte_order(target, state);
            return Ok(());
        }
        let Node::Instance(instance) = self.node(target) else { return Ok(()) };
        let is_array = instance.class.ends_with(".multiarray._reconstruct");
        if let (true, Node::Tuple(items)) = (is_array, self.node(state))
            && let &[_, shape, kind, order, data] = items.as_slice()
        {
            let column_major = matches!(self.node(order), Node::Bool(true));
            if let Some(array) = self.array_node(kind, shape, data, column_major)? {
                if let Some(node) = self.node_mut(target) {
                    *node = Node::Array(Box::new(array));
                }
                return Ok(());
            }
        }
        if let Some(Node::Instance(instance)) = self.node_mut(target) {
            instance.state = Some(state);
        }
        Ok(())
    }

    /// The storage that a persistent identifier names.
    pub(super) fn persistent(&mut self, identifier: Id) -> Id {
        match self.storage(identifier) {
            Some(storage) => self.add(Node::Storage(storage)),
            None => self.instance("persistent".into(), identifier),
        }
    }

    /// Reads `('storage', type, key, device, number of elements)`; the old stream has a sixth item, which is `None` or
    /// `(key, offset, number of elements)` of the part of the storage that is meant.
    fn storage(&self, identifier: Id) -> Option<Storage> {
        let Node::Tuple(items) = self.node(identifier) else { return None };
        let (&[kind, class, key, _, _], rest) = items.split_first_chunk()?;
        let Node::Global(class) = self.node(class) else { return None };
        if self.word(kind)? != "storage" {
            return None;
        }
        let offset = match rest.first().map(|&view| self.node(view)) {
            None | Some(Node::None) => 0,
            Some(Node::Tuple(view)) => self.size(*view.get(1)?)?,
            Some(_) => return None,
        };
        Some(Storage { element: storage_element(class)?, key: self.word(key)?.into(), offset })
    }

    /// `_rebuild_tensor_v2(storage, offset, shape, strides, ...)`.
    fn tensor(&mut self, given: &[Id]) -> Result<Option<Id>> {
        let Some((&[storage, offset, shape, strides], _)) = given.split_first_chunk() else {
            return Ok(None);
        };
        let Node::Storage(storage) = self.node(storage) else { return Ok(None) };
        let storage = storage.clone();
        let (Some(offset), Some(shape), Some(strides)) =
            (self.size(offset), self.sizes(shape), self.sizes(strides))
        else {
            return Err(self.input.fault("a tensor without proper sizes"));
        };
        let tensor = Strided { storage, offset, shape, strides };
        Ok(Some(self.add(Node::Tensor(Box::new(tensor)))))
    }

    /// A tensor of a subclass is taken as a tensor.
    fn plain_tensor(&mut self, function: Id, arguments: Id) -> Result<Option<Id>> {
        match (self.node(function), self.node(arguments)) {
            (Node::Global(class), Node::Tuple(items))
                if &**class == "torch._utils._rebuild_tensor_v2" =>
            {
                let given: Vec<Id> = items.iter().copied().take(4).collect();
                self.tensor(&given)
            }
            _ => Ok(None),
        }
    }

    fn size(&self, id: Id) -> Option<usize> {
        match self.node(id) {
            Node::Integer(value) => usize::try_from(*value).ok(),
            _ => None,
        }
    }

    fn sizes(&self, id: Id) -> Option<Vec<usize>> {
        match self.node(id) {
            Node::Tuple(items) | Node::List(items) if items.len() <= MOST_AXES => {
                items.iter().map(|&item| self.size(item)).collect()
            }
            _ => None,
        }
    }

    /// `OrderedDict()`, or `OrderedDict([[key, value], ...])` as Python 2 writes it.
    fn ordered(&mut self, given: &[Id]) -> Result<Id> {
        let items = match given.first().map(|&list| self.node(list)) {
            Some(Node::List(items)) => items.len(),
            _ => 0,
        };
        self.spend(items)?;
        let mut entries = Vec::new();
        if let Some(Node::List(items)) = given.first().map(|&list| self.node(list)) {
            for &item in items {
                let (Node::List(pair) | Node::Tuple(pair)) = self.node(item) else {
                    return Err(self.input.fault("an ordered dictionary of something but pairs"));
                };
                let &[key, value] = pair.as_slice() else {
                    return Err(self.input.fault("an ordered dictionary of something but pairs"));
                };
                entries.push((key, value));
            }
        }
        Ok(self.add(Node::Dictionary(entries)))
    }

    /// `_codecs.encode(text, 'latin1')`: how protocol 2 writes bytes, one character each.
    fn encoded(&mut self, text: Id) -> Result<Option<Id>> {
        let Node::Text(text) = self.node(text) else { return Ok(None) };
        let text = Arc::clone(text);
        self.spend(text.len())?;
        let bytes: std::result::Result<Vec<u8>, _> =
            text.chars().map(|letter| u8::try_from(u32::from(letter))).collect();
        let bytes = bytes.map_err(|_| self.input.fault("bytes with a character above 255"))?;
        Ok(Some(self.add(Node::Bytes(bytes.into()))))
    }

    fn number_type(&mut self, name: Id) -> Option<Id> {
        let name = self.word(name)?;
        let element = array_element(name.trim_start_matches(['<', '>', '=', '|']));
        let kind = NumberType { element, big_endian: name.starts_with('>') };
        Some(self.add(Node::NumberType(kind)))
    }

    /// The state of a `numpy.dtype` is `(version, byte order, ...)`.
    fn set_byte_order(&mut self, target: Id, state: Id) {
        let Node::Tuple(items) = self.node(state) else { return };
        let big = items.get(1).and_then(|&order| self.word(order)) == Some(">");
        if let Some(Node::NumberType(kind)) = self.node_mut(target) {
            kind.big_endian |= big;
        }
    }

    fn array(&mut self, kind: Id, shape: Id, data: Id, column_major: bool) -> Result<Option<Id>> {
        let array = self.array_node(kind, shape, data, column_major)?;
        Ok(array.map(|array| self.add(Node::Array(Box::new(array)))))
    }

    /// An array of numbers; `None` for one of something else.
    fn array_node(
        &self,
        kind: Id,
        shape: Id,
        data: Id,
        column_major: bool,
    ) -> Result<Option<Array>> {
        let (Node::NumberType(kind), Node::Bytes(bytes)) = (self.node(kind), self.node(data))
        else {
            return Ok(None);
        };
        let (Some(element), Some(shape)) = (kind.element, self.sizes(shape)) else {
            return Ok(None);
        };
        let length =
            shape.iter().try_fold(element.bytes(), |product, &size| product.checked_mul(size));
        if length != Some(bytes.len()) {
            return Err(self.input.fault(format!(
                "an array of type {element} and shape {shape:?} has {} bytes",
                bytes.len()
            )));
        }
        let (bytes, big_endian) = (Arc::clone(bytes), kind.big_endian);
        Ok(Some(Array { element, big_endian, shape, column_major, bytes }))
    }
}

/// The element type of a class of torch's storages.
fn storage_element(class: &str) -> Option<ElementType> {
    Some(match class.strip_prefix("torch.")?.strip_prefix("cuda.").unwrap_or(class.get(6..)?) {
        "DoubleStorage" => ElementType::F64,
        "FloatStorage" => ElementType::F32,
        "HalfStorage" => ElementType::F16,
        "BFloat16Storage" => ElementType::Bf16,
        "LongStorage" => ElementType::I64,
        "IntStorage" => ElementType::I32,
        "ShortStorage" => ElementType::I16,
        "CharStorage" => ElementType::I8,
        "ByteStorage" => ElementType::U8,
        "BoolStorage" => ElementType::Bool,
        _ => return None,
    })
}

/// The element type that numpy calls `name`.
fn array_element(name: &str) -> Option<ElementType> {
    Some(match name {
        "f8" => ElementType::F64,
        "f4" => ElementType::F32,
        "f2" => ElementType::F16,
        "i8" => ElementType::I64,
        "i4" => ElementType::I32,
        "i2" => ElementType::I16,
        "i1" => ElementType::I8,
        "u8" => ElementType::U64,
        "u4" => ElementType::U32,
        "u2" => ElementType::U16,
        "u1" => ElementType::U8,
        "b1" => ElementType::Bool,
        _ => return None,
    })
}
