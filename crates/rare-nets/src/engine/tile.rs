//! The matrix product's innermost loop: a tile of rows times a few groups of columns, held in registers.
#![allow(unsafe_code)]

use super::cpu::Precision;
use super::simd::{LANES, Processor, Simd, Vectorized};

/// Calls the register tile that is compiled for this many rows and groups of columns.
macro_rules! choose_tile {
    ($simd:expr, $tile:expr, $groups:expr, $b:expr, $c:expr, $($count:literal: $($rows:literal)*),*) => {
        match ($groups, $tile.rows.len()) {
            $($(($count, $rows) => unsafe {
                // SAFETY: what the caller vouches for.
                $tile.registers::<Self, PAIRS, $rows, $count>($simd, $b, $c);
            },)*)*
            (groups, rows) => debug_assert!(false, "no tile of {rows} rows and {groups} groups"),
        }
    };
}
pub(super) use choose_tile;

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

/// A product that fits; with `PAIRS`, units are pairs of bf16.
struct Multiplication<'a, const PAIRS: bool> {
    tile: &'a Tile<'a>,
    c: &'a mut [f32],
}

impl<const PAIRS: bool> Vectorized for Multiplication<'_, PAIRS> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let mut group = 0;
        while group < self.tile.groups {
            let groups = (self.tile.groups - group).min(S::GROUPS);
            self.tile.columns::<S, PAIRS>(simd, self.c, group, groups);
            group += groups;
        }
    }
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

    /// Computes the product of any number of rows and groups, in the precision of the units.
    ///
    /// Operands that do not fit are a defect of the caller: then nothing is computed (and debug builds stop).
    pub(super) fn multiply(&self, processor: Processor, precision: Precision, c: &mut [f32]) {
        debug_assert!(self.fits(c));
        if !self.fits(c) {
            return;
        }
        // A kernel of its own, so that its many register tiles are compiled once for each processor.
        match precision {
            Precision::F32 => processor.run(Multiplication::<false> { tile: self, c }),
            Precision::Bf16 => processor.run(Multiplication::<true> { tile: self, c }),
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
            unsafe { simd.multiply_tile::<PAIRS>(&part, groups, b, c) };
        }
    }

    /// The loop itself: `ROWS * GROUPS` sums in registers.
    ///
    /// # Safety
    /// There are `ROWS` rows; `b` has `GROUPS * LANES` columns of all steps, `c` of all rows, and `a` all segments of
    /// all rows.
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "iterators would move the sums")]
    pub(super) unsafe fn registers<
        S: Simd,
        const PAIRS: bool,
        const ROWS: usize,
        const GROUPS: usize,
    >(
        &self,
        simd: S,
        b: *const f32,
        c: *mut f32,
    ) {
        // Indices instead of iterators: the sums must never be moved, or they leave their registers.
        let mut sums = [[simd.splat(0.0); GROUPS]; ROWS];
        if self.accumulate {
            for row in 0..ROWS {
                for group in 0..GROUPS {
                    // SAFETY: the caller vouches for the rows of `c`.
                    sums[row][group] = simd.load(unsafe { place(c, row * self.c_stride, group) });
                }
            }
        }
        let mut b = b;
        for segment in self.segments {
            let mut a = [std::ptr::null(); ROWS];
            for row in 0..ROWS {
                // SAFETY: the caller vouches for the segments of all rows.
                a[row] = unsafe {
                    let start = *self.rows.get_unchecked(row) as usize + segment.offset as usize;
                    self.a.as_ptr().add(start)
                };
            }
            for step in 0..segment.steps as usize {
                let mut columns = [simd.splat(0.0); GROUPS];
                for group in 0..GROUPS {
                    // SAFETY: the caller vouches for the columns of this step.
                    columns[group] = simd.load(unsafe { place(b.cast_mut(), 0, group) });
                }
                for row in 0..ROWS {
                    // SAFETY: `step` is within the segment.
                    let factor = simd.splat(unsafe { *a[row].add(step) });
                    for group in 0..GROUPS {
                        let sum = sums[row][group];
                        sums[row][group] = if PAIRS {
                            simd.dot_pairs(factor, columns[group], sum)
                        } else {
                            simd.mul_add(factor, columns[group], sum)
                        };
                    }
                }
                // Past the last row nothing is read.
                b = b.wrapping_add(self.b_stride);
            }
        }
        for row in 0..ROWS {
            for group in 0..GROUPS {
                // SAFETY: the caller vouches for the rows of `c`.
                simd.store(sums[row][group], unsafe { place(c, row * self.c_stride, group) });
            }
        }
    }
}

/// A group of columns of a row.
///
/// # Safety
/// The group exists and nothing else refers to it.
#[inline(always)]
unsafe fn place<'a>(start: *mut f32, row: usize, group: usize) -> &'a mut [f32; LANES] {
    // SAFETY: what the caller vouches for.
    unsafe { &mut *start.add(row + group * LANES).cast() }
}
