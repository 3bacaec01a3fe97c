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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::{Arena, Buffer};

    fn size(bytes: usize) -> usize {
        Arc::new(Arena::default()).lend(bytes).slice::<u8>().len()
    }

    #[test]
    fn buffers_are_whole_cache_lines() {
        for (bytes, expected) in [(0, 0), (1, 64), (64, 64), (65, 128), (1000, 1024)] {
            assert_eq!(size(bytes), expected);
        }
        let buffer = Buffer::zeroed(1000);
        assert_eq!(buffer.slice::<f32>().as_ptr().align_offset(64), 0);
        assert!(buffer.slice::<u8>().iter().all(|&byte| byte == 0));
    }

    #[test]
    fn a_buffer_comes_back_with_what_was_in_it() {
        let arena = Arc::new(Arena::default());
        let mut lent = arena.lend(1024);
        lent.slice_mut::<f32>()[255] = 7.0;
        // While it is lent, it is nobody else's.
        assert_eq!(arena.lend(1024).slice::<f32>()[255], 0.0);
        drop(lent);
        let again = [arena.lend(1000), arena.lend(1000)];
        let numbers = again.iter().map(|lent| lent.slice::<f32>()[255]).sum::<f32>();
        assert_eq!(numbers, 7.0);
        assert_eq!(arena.free.lock().unwrap().len(), 0);
        drop(again);
        assert_eq!(arena.free.lock().unwrap().len(), 2);
    }

    #[test]
    fn the_smallest_that_is_large_enough_is_lent() {
        let arena = Arc::new(Arena::default());
        drop([2048, 640, 1024, 512].map(|bytes| arena.lend(bytes)));
        let lent = |bytes| arena.lend(bytes).slice::<u8>().len();
        assert_eq!(lent(600), 640);
        assert_eq!(lent(641), 1024);
        assert_eq!(lent(1024), 1024);
        assert_eq!(lent(1025), 2048);
        // Not one of more than twice the size, and not one that is too small: new ones.
        assert_eq!(lent(192), 192);
        assert_eq!(lent(4096), 4096);
    }
}
