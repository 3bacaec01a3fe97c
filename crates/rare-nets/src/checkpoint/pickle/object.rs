//! What a pickle holds, as data.

use std::sync::Arc;

use super::super::Tensor;

/// A Python object. Parts that occur several times are shared, so a clone is cheap.
#[derive(Debug, Clone)]
pub enum Object {
    /// `None`.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer of at most 128 bits with sign; larger ones are instances of `int`.
    Integer(i128),
    /// A floating-point number.
    Float(f64),
    /// A text.
    Text(Arc<str>),
    /// Bytes, or a text of Python 2.
    Bytes(Arc<[u8]>),
    /// A list or a set.
    List(Arc<[Object]>),
    /// A tuple.
    Tuple(Arc<[Object]>),
    /// A dictionary in the order of its insertion; of entries with the same key the last one counts.
    Dictionary(Arc<[(Object, Object)]>),
    /// A tensor of torch, still in its file.
    Tensor(Arc<Tensor>),
    /// An array of numpy.
    Array(Arc<Tensor>),
    /// A class or function by its full name, never called.
    Global(Arc<str>),
    /// An object of a class that means nothing here.
    Instance(Arc<Instance>),
    /// Not followed: a reference to an object that contains this place, or nesting deeper than 200 levels.
    Cut,
}

/// An object of a class that means nothing here, with everything that the pickle says about it.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Full name of the class, or of the function that makes it.
    pub class: Arc<str>,
    /// What the class is called with.
    pub arguments: Object,
    /// What `__setstate__` gets, often a dictionary of attributes; `None` without.
    pub state: Object,
    /// What is appended to it, for a class that is a list.
    pub items: Arc<[Object]>,
    /// What is set in it, for a class that is a dictionary.
    pub entries: Arc<[(Object, Object)]>,
}

impl Object {
    /// The entries of a dictionary, or of an instance of a class that is a dictionary; empty for everything else.
    #[must_use]
    pub fn entries(&self) -> &[(Object, Object)] {
        match self {
            Object::Dictionary(entries) => entries,
            Object::Instance(instance) => &instance.entries,
            _ => &[],
        }
    }

    /// The elements of a list or tuple, or of an instance of a class that is a list; empty for everything else.
    #[must_use]
    pub fn items(&self) -> &[Object] {
        match self {
            Object::List(items) | Object::Tuple(items) => items,
            Object::Instance(instance) => &instance.items,
            _ => &[],
        }
    }

    /// The value under the text `key`: of a dictionary, of an instance that is a dictionary, or among the attributes of
    /// an instance.
    #[must_use]
    pub fn get(&self, key: &str) -> Option<&Object> {
        let find = |object: &'_ Object| -> Option<usize> {
            object.entries().iter().rposition(|(name, _)| name.text() == Some(key))
        };
        if let Some(at) = find(self) {
            return self.entries().get(at).map(|(_, value)| value);
        }
        let Object::Instance(instance) = self else { return None };
        let at = find(&instance.state)?;
        instance.state.entries().get(at).map(|(_, value)| value)
    }

    /// A text, also one of Python 2 if it is UTF-8.
    #[must_use]
    pub fn text(&self) -> Option<&str> {
        match self {
            Object::Text(text) => Some(text),
            Object::Bytes(bytes) => std::str::from_utf8(bytes).ok(),
            _ => None,
        }
    }

    /// An integer.
    #[must_use]
    pub fn integer(&self) -> Option<i128> {
        match self {
            Object::Integer(value) => Some(*value),
            _ => None,
        }
    }

    /// A number.
    #[must_use]
    pub fn number(&self) -> Option<f64> {
        match self {
            Object::Float(value) => Some(*value),
            Object::Integer(value) => Some(*value as f64),
            _ => None,
        }
    }

    /// A tensor of torch or an array of numpy.
    #[must_use]
    pub fn tensor(&self) -> Option<&Tensor> {
        match self {
            Object::Tensor(tensor) | Object::Array(tensor) => Some(tensor),
            _ => None,
        }
    }
}
