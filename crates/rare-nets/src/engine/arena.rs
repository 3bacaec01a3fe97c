//! Memory that is used again: a network asks for the same sizes in every pass, and fresh pages are slow.

use std::sync::{Arc, Mutex, PoisonError};

use bytemuck::{Pod, Zeroable};

/// A cache line, so that buffers begin at one.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Line([f32; 16]);

// SAFETY: sixteen numbers fill the 64 bytes of the alignment, so there is no padding, and all bits are a valid value.
#[allow(unsafe_code)]
unsafe impl Zeroable for Line {}
// SAFETY: as above; the type is plain and `'static`.
#[allow(unsafe_code)]
unsafe impl Pod for Line {}

/// A block of memory that begins at a cache line.
#[derive(Debug, Default)]
pub(super) struct Buffer(Vec<Line>);

impl Buffer {
    /// Zeros; fresh pages cost nothing until they are written.
    pub(super) fn zeroed(bytes: usize) -> Buffer {
        Buffer(bytemuck::allocation::zeroed_vec(bytes.div_ceil(size_of::<Line>())))
    }

    /// All of it as elements of type `T`.
    pub(super) fn slice<T: Pod>(&self) -> &[T] {
        bytemuck::must_cast_slice(&self.0)
    }

    /// All of it as elements of type `T`.
    pub(super) fn slice_mut<T: Pod>(&mut self) -> &mut [T] {
        bytemuck::must_cast_slice_mut(&mut self.0)
    }
}

/// Buffers that nobody uses at the moment.
#[derive(Debug, Default)]
pub(super) struct Arena {
    free: Mutex<Vec<Buffer>>,
}

/// A buffer that goes back to its arena when it is dropped.
#[derive(Debug)]
pub(super) struct Lent {
    buffer: Buffer,
    arena: Arc<Arena>,
}

impl Arena {
    /// A buffer of at least this size with anything in it: the smallest free one that is large enough but not more
    /// than twice too large, or a new one.
    pub(super) fn lend(self: &Arc<Self>, bytes: usize) -> Lent {
        let lines = bytes.div_ceil(size_of::<Line>());
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |buffer: &Buffer| (lines..=2 * lines).contains(&buffer.0.len());
        let best = (0..free.len()).filter(|&i| fits(&free[i])).min_by_key(|&i| free[i].0.len());
        let found = best.map(|index| free.swap_remove(index));
        drop(free);
        let buffer = found.unwrap_or_else(|| Buffer::zeroed(bytes));
        Lent { buffer, arena: Arc::clone(self) }
    }
}

impl Lent {
    /// All of it as elements of type `T`.
    pub(super) fn slice<T: Pod>(&self) -> &[T] {
        self.buffer.slice()
    }

    /// All of it as elements of type `T`.
    pub(super) fn slice_mut<T: Pod>(&mut self) -> &mut [T] {
        self.buffer.slice_mut()
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        let buffer = std::mem::take(&mut self.buffer);
        self.arena.free.lock().unwrap_or_else(PoisonError::into_inner).push(buffer);
    }
}
