//! One slice that several threads write, each its own parts.
#![allow(unsafe_code)]

use std::marker::PhantomData;

/// A mutable slice of which disjoint parts are written at the same time.
pub(super) struct SharedOutput<'a, T> {
    start: *mut T,
    length: usize,
    borrow: PhantomData<&'a mut [T]>,
}

// SAFETY: it is a mutable borrow of plain values that may be sent; who makes parts of it vouches that they are disjoint.
unsafe impl<T: Send> Send for SharedOutput<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Send> Sync for SharedOutput<'_, T> {}

impl<'a, T> SharedOutput<'a, T> {
    pub(super) fn new(slice: &'a mut [T]) -> SharedOutput<'a, T> {
        SharedOutput { start: slice.as_mut_ptr(), length: slice.len(), borrow: PhantomData }
    }

    /// The part of `length` elements from `start`, cut off at the end of the slice.
    ///
    /// # Safety
    /// No two parts that exist at the same time overlap.
    #[inline]
    #[allow(clippy::mut_from_ref)]
    pub(super) unsafe fn part(&self, start: usize, length: usize) -> &mut [T] {
        let start = start.min(self.length);
        let length = length.min(self.length - start);
        // SAFETY: within the slice by the two lines above; the caller vouches for the rest.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(start), length) }
    }
}
