//! The matrix product's innermost loop: a tile of rows times a few groups of columns, held in registers.
#![allow(unsafe_code)]

use super::simd::{LANES, Simd};

/// A product of rows of `a` with a panel of `b`, added to or stored in `c`. Elements of `a` and `b` are units of 32 bits:
/// a number, or a pair of bf16.
///
/// Row `r` of the product sums, over all segments, the units from `a[rows[r] + segment.offset]` on, times consecutive
/// rows of `b`.
#[derive(Clone, Copy)]
pub(super) struct Tile<'a> {
    /// The left operand.
    pub(super) a: &'a [f32],
    /// Where each row begins in `a`.
    pub(super) rows: &'a [u32],
    /// The parts of the sum, in the order of the rows of `b`.
    pub(super) segments: &'a [Segment],
    /// The right operand, row by row of the sum.
    pub(super) b: &'a [f32],
    /// Units between rows of `b`.
    pub(super) b_stride: usize,
    /// Numbers between rows of `c`.
    pub(super) c_stride: usize,
    /// Groups of [`LANES`] columns.
    pub(super) groups: usize,
    /// Whether `c` is added to.
    pub(super) accumulate: bool,
}

/// A run of consecutive units of every row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Segment {
    /// Where it begins, from the row's begin.
    pub(super) offset: u32,
    /// How many units.
    pub(super) steps: u32,
}

impl Tile<'_> {
    /// Whether everything that will be read and written exists.
    fn fits(&self, c: &[f32]) -> bool {
        let reach = self.segments.iter().map(|s| s.offset as usize + s.steps as usize).max();
        let last = self.rows.iter().max().map_or(0, |&row| row as usize);
        let steps: usize = self.segments.iter().map(|segment| segment.steps as usize).sum();
        let width = self.groups * LANES;
        let needed = |rows: usize, stride: usize| rows.saturating_sub(1) * stride + width;
        reach.is_some_and(|reach| last + reach <= self.a.len())
            && (steps == 0 || needed(steps, self.b_stride) <= self.b.len())
            && needed(self.rows.len(), self.c_stride) <= c.len()
    }

    /// Computes the product of any number of rows and groups. With `PAIRS`, units are pairs of bf16.
    ///
    /// Operands that do not fit are a defect of the caller: then nothing is computed (and debug builds stop).
    #[inline(always)]
    pub(super) fn multiply<S: Simd, const PAIRS: bool>(&self, simd: S, c: &mut [f32]) {
        debug_assert!(self.fits(c));
        if !self.fits(c) {
            return;
        }
        let mut group = 0;
        while group < self.groups {
            let groups = (self.groups - group).min(S::GROUPS);
            self.columns::<S, PAIRS>(simd, c, group, groups);
            group += groups;
        }
    }

    /// Some groups of columns, in tiles of about equally many rows.
    #[inline(always)]
    fn columns<S: Simd, const PAIRS: bool>(
        &self,
        simd: S,
        c: &mut [f32],
        group: usize,
        groups: usize,
    ) {
        let tiles = self.rows.len().div_ceil(S::tile_rows(groups));
        for tile in 0..tiles {
            let (first, end) =
                (self.rows.len() * tile / tiles, self.rows.len() * (tile + 1) / tiles);
            let part = Tile { rows: &self.rows[first..end], ..*self };
            let b = self.b[group * LANES..].as_ptr();
            let c = c[first * self.c_stride + group * LANES..].as_mut_ptr();
            // SAFETY: `fits` holds for the whole, and this is a part of it.
            unsafe { part.rows_of::<S, PAIRS>(simd, groups, b, c) };
        }
    }

    /// Chooses the tile that is compiled for this many rows and groups.
    ///
    /// # Safety
    /// As [`Tile::registers`].
    #[inline(always)]
    unsafe fn rows_of<S: Simd, const PAIRS: bool>(
        &self,
        simd: S,
        groups: usize,
        b: *const f32,
        c: *mut f32,
    ) {
        macro_rules! choose {
            ($($rows:literal)*) => {
                match (self.rows.len(), groups) {
                    $(
                        ($rows, 1) => unsafe { self.registers::<S, PAIRS, $rows, 1>(simd, b, c) },
                        ($rows, 2) if S::GROUPS >= 2 => unsafe { self.registers::<S, PAIRS, $rows, 2>(simd, b, c) },
                        ($rows, 3) if S::GROUPS >= 3 && $rows <= 9 => unsafe { self.registers::<S, PAIRS, $rows, 3>(simd, b, c) },
                    )*
                    _ => debug_assert!(false, "no tile of {} rows", self.rows.len()),
                }
            };
        }
        // SAFETY (of every call): what the caller vouches for.
        choose!(1 2 3 4 5 6 7 8 9 10 11 12 13 14)
    }

    /// The loop itself: `ROWS * GROUPS` sums in registers.
    ///
    /// # Safety
    /// There are `ROWS` rows; `b` has `GROUPS * LANES` columns of all steps, `c` of all rows, and `a` all segments of
    /// all rows.
    #[inline(always)]
    unsafe fn registers<S: Simd, const PAIRS: bool, const ROWS: usize, const GROUPS: usize>(
        &self,
        simd: S,
        b: *const f32,
        c: *mut f32,
    ) {
        let group = |pointer: *const f32, group: usize| {
            // SAFETY: the caller vouches for the columns.
            simd.load(unsafe { &*pointer.add(group * LANES).cast::<[f32; LANES]>() })
        };
        let mut sums = [[simd.splat(0.0); GROUPS]; ROWS];
        if self.accumulate {
            for (row, sums) in sums.iter_mut().enumerate() {
                for (index, sum) in sums.iter_mut().enumerate() {
                    // SAFETY: the caller vouches for the rows of `c`.
                    *sum = group(unsafe { c.add(row * self.c_stride) }, index);
                }
            }
        }
        let mut b = b;
        for segment in self.segments {
            let mut a = [std::ptr::null(); ROWS];
            for (row, a) in a.iter_mut().enumerate() {
                // SAFETY: the caller vouches for the segments of all rows.
                *a = unsafe {
                    let start = *self.rows.get_unchecked(row) as usize + segment.offset as usize;
                    self.a.as_ptr().add(start)
                };
            }
            for step in 0..segment.steps as usize {
                let mut columns = [simd.splat(0.0); GROUPS];
                for (index, column) in columns.iter_mut().enumerate() {
                    *column = group(b, index);
                }
                for (row, sums) in sums.iter_mut().enumerate() {
                    // SAFETY: `step` is within the segment.
                    let factor = simd.splat(unsafe { *a[row].add(step) });
                    for (sum, column) in sums.iter_mut().zip(columns) {
                        *sum = if PAIRS {
                            simd.dot_pairs(factor, column, *sum)
                        } else {
                            simd.mul_add(factor, column, *sum)
                        };
                    }
                }
                // Past the last row nothing is read.
                b = b.wrapping_add(self.b_stride);
            }
        }
        for (row, sums) in sums.into_iter().enumerate() {
            for (index, sum) in sums.into_iter().enumerate() {
                // SAFETY: the caller vouches for the rows of `c`.
                let place = unsafe {
                    &mut *c.add(row * self.c_stride + index * LANES).cast::<[f32; LANES]>()
                };
                simd.store(sum, place);
            }
        }
    }
}
