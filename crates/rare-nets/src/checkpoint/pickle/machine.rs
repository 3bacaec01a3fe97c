//! The stack machine of Python's pickles, protocols 2 to 5, without calling anything.

use std::collections::BTreeMap;

use rare::Result;

use super::input::Input;
use super::node::{Graph, Id, Node};

/// The operation that begins every pickle of protocol 2 or later.
pub(super) const PROTOCOL: u8 = 0x80;

/// Operations of one pickle. Every operation makes at most one node, stack entry, mark and memo entry, so this bounds
/// the memory that a small file can ask for; a checkpoint of ten thousand tensors has 400 000.
const MOST_OPERATIONS: usize = 1 << 24;

/// Bytes of a name. It is limited because one text may serve as many names.
const LONGEST_WORD: usize = 300;

/// The state of the machine.
pub(super) struct Machine<'a, 'b> {
    pub(super) input: &'a mut Input<'b>,
    nodes: Vec<Node>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: BTreeMap<u32, Id>,
    /// Bytes and entries that may still be copied from one node to another; a pickle that copies more than it holds
    /// repeats itself only to exhaust memory.
    copies: usize,
}

/// Runs a pickle to its end.
pub(super) fn run(input: &mut Input<'_>) -> Result<Graph> {
    let copies = usize::try_from(input.left()).unwrap_or(usize::MAX).saturating_add(1 << 16);
    let (nodes, stack, marks, memo) = Default::default();
    let mut machine = Machine { input, nodes, stack, marks, memo, copies };
    for _ in 0..MOST_OPERATIONS {
        let code = machine.input.byte()?;
        if code == b'.' {
            let root = machine.pop()?;
            return Ok(Graph { nodes: machine.nodes, root });
        }
        machine.step(code)?;
    }
    Err(machine.input.unsupported(format!("a pickle of more than {MOST_OPERATIONS} operations")))
}

impl Machine<'_, '_> {
    fn step(&mut self, code: u8) -> Result<()> {
        match code {
            PROTOCOL => self.input.byte().map(|_| ()),
            0x95 => self.input.array::<8>().map(|_| ()),
            b'N' | b'J' | b'K' | b'M' | b'G' | 0x88..=0x8b => self.number(code),
            b'X' | b'T' | b'U' | b'B' | b'C' | 0x8c..=0x8e | 0x96 => self.text(code),
            b'(' | b'0' | b'1' | b'2' => self.stack_operation(code),
            b']' | b')' | b'}' | b'l' | b't' | b'd' | 0x85..=0x87 | 0x8f | 0x91 => {
                self.container(code)
            }
            b'a' | b'e' | b's' | b'u' | 0x90 => self.insertion(code),
            b'q' | b'r' | b'h' | b'j' | 0x94 => self.memory(code),
            b'c' | b'R' | b'b' | b'Q' | 0x81 | 0x92 | 0x93 => self.object(code),
            b'I' | b'L' | b'F' | b'S' | b'V' | b'P' | b'p' | b'g' | b'i' => Err(self
                .input
                .unsupported("a text pickle (protocol 0): save it again with protocol 2 or later")),
            _ => Err(self.input.unsupported(format!("the pickle operation {code:#04x}"))),
        }
    }

    fn number(&mut self, code: u8) -> Result<()> {
        let node = match code {
            b'N' => Node::None,
            0x88 => Node::Bool(true),
            0x89 => Node::Bool(false),
            b'J' => Node::Integer(i32::from_le_bytes(self.input.array()?).into()),
            b'K' => Node::Integer(self.input.byte()?.into()),
            b'M' => Node::Integer(u16::from_le_bytes(self.input.array()?).into()),
            b'G' => Node::Float(f64::from_be_bytes(self.input.array()?)),
            _ => return self.long_integer(code),
        };
        self.push(node);
        Ok(())
    }

    /// An integer of any length: little-endian, two's complement.
    fn long_integer(&mut self, code: u8) -> Result<()> {
        let count = match code {
            0x8a => self.input.byte()?.into(),
            _ => u32::from_le_bytes(self.input.array()?).into(),
        };
        let bytes = self.input.take(count)?;
        if bytes.len() > 16 {
            let arguments = self.add(Node::Bytes(bytes.into()));
            let integer = self.instance("int".into(), arguments);
            self.stack.push(integer);
            return Ok(());
        }
        let filler = if bytes.last().is_some_and(|last| *last >= 0x80) { 0xff } else { 0 };
        let mut wide = [filler; 16];
        for (target, byte) in wide.iter_mut().zip(bytes) {
            *target = byte;
        }
        self.push(Node::Integer(i128::from_le_bytes(wide)));
        Ok(())
    }

    fn text(&mut self, code: u8) -> Result<()> {
        let count = match code {
            b'U' | b'C' | 0x8c => self.input.byte()?.into(),
            b'X' | b'T' | b'B' => u32::from_le_bytes(self.input.array()?).into(),
            _ => u64::from_le_bytes(self.input.array()?),
        };
        let bytes = self.input.take(count)?;
        let node = match code {
            b'X' | 0x8c | 0x8d => {
                let text = String::from_utf8(bytes);
                Node::Text(text.map_err(|_| self.input.fault("a text that is not UTF-8"))?.into())
            }
            _ => Node::Bytes(bytes.into()),
        };
        self.push(node);
        Ok(())
    }

    fn stack_operation(&mut self, code: u8) -> Result<()> {
        match code {
            b'(' => self.marks.push(self.stack.len()),
            b'1' => drop(self.pop_to_mark()?),
            b'2' => {
                let top = self.pop()?;
                self.stack.extend([top, top]);
            }
            _ if self.marks.last() == Some(&self.stack.len()) => drop(self.marks.pop()),
            _ => drop(self.pop()?),
        }
        Ok(())
    }

    fn container(&mut self, code: u8) -> Result<()> {
        let node = match code {
            b']' | 0x8f => Node::List(Vec::new()),
            b')' => Node::Tuple(Vec::new()),
            b'}' => Node::Dictionary(Vec::new()),
            b'l' | 0x91 => Node::List(self.pop_to_mark()?),
            b't' => Node::Tuple(self.pop_to_mark()?),
            b'd' => {
                let items = self.pop_to_mark()?;
                Node::Dictionary(self.pairs(&items)?)
            }
            _ => {
                let count = usize::from(code - 0x84);
                let mut items = Vec::new();
                for _ in 0..count {
                    items.push(self.pop()?);
                }
                items.reverse();
                Node::Tuple(items)
            }
        };
        self.push(node);
        Ok(())
    }

    fn insertion(&mut self, code: u8) -> Result<()> {
        let items = match code {
            b'a' => vec![self.pop()?],
            b's' => {
                let value = self.pop()?;
                vec![self.pop()?, value]
            }
            _ => self.pop_to_mark()?,
        };
        let pairs = if matches!(code, b's' | b'u') { Some(self.pairs(&items)?) } else { None };
        let target = self.top()?;
        match (self.node_mut(target), pairs) {
            (Some(Node::List(list)), None) => list.extend(items),
            (Some(Node::Dictionary(entries)), Some(pairs)) => entries.extend(pairs),
            (Some(Node::Instance(instance)), None) => instance.items.extend(items),
            (Some(Node::Instance(instance)), Some(pairs)) => instance.entries.extend(pairs),
            _ => return Err(self.input.fault("something is put into what holds nothing")),
        }
        Ok(())
    }

    fn memory(&mut self, code: u8) -> Result<()> {
        let index = match code {
            b'q' | b'h' => self.input.byte()?.into(),
            b'r' | b'j' => u32::from_le_bytes(self.input.array()?),
            _ => u32::try_from(self.memo.len()).unwrap_or(u32::MAX),
        };
        if matches!(code, b'h' | b'j') {
            let Some(&id) = self.memo.get(&index) else {
                return Err(self.input.fault(format!("object {index} is used before it is made")));
            };
            self.stack.push(id);
            return Ok(());
        }
        let top = self.top()?;
        self.memo.insert(index, top);
        Ok(())
    }

    fn object(&mut self, code: u8) -> Result<()> {
        match code {
            b'c' => {
                let name = format!("{}.{}", self.input.line()?, self.input.line()?);
                self.push(Node::Global(name.into()));
            }
            0x93 => self.stacked_global()?,
            b'Q' => {
                let persistent = self.pop()?;
                let id = self.persistent(persistent);
                self.stack.push(id);
            }
            b'b' => {
                let state = self.pop()?;
                let target = self.top()?;
                self.build(target, state)?;
            }
            _ => {
                // NEWOBJ_EX has keyword arguments as well; no class that is known here takes any.
                if code == 0x92 {
                    self.pop()?;
                }
                let arguments = self.pop()?;
                let callable = self.pop()?;
                let id = self.call(callable, arguments)?;
                self.stack.push(id);
            }
        }
        Ok(())
    }

    fn stacked_global(&mut self) -> Result<()> {
        let (name, module) = (self.pop()?, self.pop()?);
        let (Some(module), Some(name)) = (self.word(module), self.word(name)) else {
            return Err(self.input.fault("a name that is not a short text"));
        };
        let name = format!("{module}.{name}");
        self.push(Node::Global(name.into()));
        Ok(())
    }

    fn push(&mut self, node: Node) {
        let id = self.add(node);
        self.stack.push(id);
    }

    /// Takes the top of the stack, never what lies below the last mark.
    fn pop(&mut self) -> Result<Id> {
        let top = self.top()?;
        self.stack.pop();
        Ok(top)
    }

    fn top(&self) -> Result<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&top) if self.stack.len() > floor => Ok(top),
            _ => Err(self.input.fault("the stack of the pickle is empty")),
        }
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Id>> {
        match self.marks.pop() {
            Some(mark) if mark <= self.stack.len() => Ok(self.stack.split_off(mark)),
            _ => Err(self.input.fault("the stack of the pickle has no mark")),
        }
    }

    fn pairs(&self, items: &[Id]) -> Result<Vec<(Id, Id)>> {
        let (pairs, rest) = items.as_chunks::<2>();
        if !rest.is_empty() {
            return Err(self.input.fault("a key without a value"));
        }
        Ok(pairs.iter().map(|&[key, value]| (key, value)).collect())
    }

    /// Adds a node to the graph.
    pub(super) fn add(&mut self, node: Node) -> Id {
        // There are fewer nodes than twice the operations, so the number fits.
        let id = u32::try_from(self.nodes.len()).unwrap_or(u32::MAX);
        self.nodes.push(node);
        id
    }

    /// A node of the graph.
    pub(super) fn node(&self, id: Id) -> &Node {
        self.nodes.get(id as usize).unwrap_or(&Node::None)
    }

    /// A node of the graph, to change it.
    pub(super) fn node_mut(&mut self, id: Id) -> Option<&mut Node> {
        self.nodes.get_mut(id as usize)
    }

    /// A short text, also one of Python 2.
    pub(super) fn word(&self, id: Id) -> Option<&str> {
        let word = match self.node(id) {
            Node::Text(text) => text,
            Node::Bytes(bytes) => std::str::from_utf8(bytes).ok()?,
            _ => return None,
        };
        (word.len() <= LONGEST_WORD).then_some(word)
    }

    /// Accounts for `amount` bytes or entries that are about to be copied.
    pub(super) fn spend(&mut self, amount: usize) -> Result<()> {
        let left = self.copies.checked_sub(amount);
        self.copies =
            left.ok_or_else(|| self.input.fault("the pickle repeats its content endlessly"))?;
        Ok(())
    }
}
