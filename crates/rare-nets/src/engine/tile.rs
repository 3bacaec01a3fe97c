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
                    sums[row][group] = simd.load(unsafe { read(c, row * self.c_stride, group) });
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
                    columns[group] = simd.load(unsafe { read(b, 0, group) });
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
                simd.store(sums[row][group], unsafe { write(c, row * self.c_stride, group) });
            }
        }
    }
}

/// A group of columns of a row, to be read: other threads may read it too.
///
/// # Safety
/// The group exists and nobody writes it.
#[inline(always)]
unsafe fn read<'a>(start: *const f32, row: usize, group: usize) -> &'a [f32; LANES] {
    // SAFETY: what the caller vouches for.
    unsafe { &*start.add(row + group * LANES).cast() }
}

/// A group of columns of a row, to be written.
///
/// # Safety
/// The group exists and nothing else refers to it.
#[inline(always)]
unsafe fn write<'a>(start: *mut f32, row: usize, group: usize) -> &'a mut [f32; LANES] {
    // SAFETY: what the caller vouches for.
    unsafe { &mut *start.add(row + group * LANES).cast() }
}

#[cfg(test)]
mod tests {
    //! Whole numbers, so that every order of the sums gives the same, in operands of exactly the size that is needed, so
    //! that a memory checker sees what is read or written beyond. Small enough for Miri.
    use half::bf16;

    use super::*;

    /// Rows begin where they like, and share what they read.
    const STARTS: [u32; 15] = [4, 0, 9, 2, 7, 1, 8, 3, 0, 6, 5, 9, 1, 2, 10];
    const SEGMENTS: [Segment; 3] = [
        Segment { offset: 3, steps: 2 },
        Segment { offset: 0, steps: 0 },
        Segment { offset: 1, steps: 5 },
    ];
    const STEPS: usize = 7;
    /// Beyond the columns, in `b` and `c`.
    const GAP: usize = 3;
    const UNTOUCHED: f32 = 0.5;

    /// Both sides of a product, and what it is written over.
    struct Operands {
        a: Vec<f32>,
        b: Vec<f32>,
        c: Vec<f32>,
        rows: usize,
        groups: usize,
    }

    fn number(index: usize) -> f32 {
        (index * 7 % 11) as f32 - 5.0
    }

    /// What stands at this place of an operand: a number, or a pair of bf16.
    fn unit(precision: Precision, index: usize) -> f32 {
        let half = |index| u32::from(bf16::from_f32(number(index)).to_bits());
        match precision {
            Precision::F32 => number(index),
            Precision::Bf16 => f32::from_bits(half(index) | half(index + 1) << 16),
        }
    }

    /// The product of two units.
    fn product(precision: Precision, a: usize, b: usize) -> f32 {
        match precision {
            Precision::F32 => number(a) * number(b),
            Precision::Bf16 => number(a) * number(b) + number(a + 1) * number(b + 1),
        }
    }

    impl Operands {
        fn new(precision: Precision, rows: usize, groups: usize) -> Operands {
            let width = groups * LANES;
            let reach = STARTS[..rows].iter().max().map_or(0, |&start| start as usize) + 6;
            let units = |count: usize| (0..count).map(|index| unit(precision, index)).collect();
            Operands {
                a: units(reach),
                b: units((STEPS - 1) * (width + GAP) + width),
                c: vec![UNTOUCHED; (rows - 1) * (width + GAP) + width],
                rows,
                groups,
            }
        }

        fn tile(&self, accumulate: bool) -> Tile<'_> {
            let stride = self.groups * LANES + GAP;
            Tile {
                a: &self.a,
                rows: &STARTS[..self.rows],
                segments: &SEGMENTS,
                b: &self.b,
                b_stride: stride,
                c_stride: stride,
                groups: self.groups,
                accumulate,
            }
        }

        /// What a number of `c` must be, after being stored once and added to once.
        fn expected(&self, precision: Precision, at: usize) -> f32 {
            let stride = self.groups * LANES + GAP;
            let (row, column) = (at / stride, at % stride);
            if column >= self.groups * LANES {
                return UNTOUCHED;
            }
            let units = SEGMENTS.iter().flat_map(|s| s.offset..s.offset + s.steps);
            let units = units.map(|offset| (STARTS[row] + offset) as usize).enumerate();
            2.0 * units.map(|(step, a)| product(precision, a, step * stride + column)).sum::<f32>()
        }
    }

    fn sizes() -> impl Iterator<Item = (usize, usize)> {
        let (rows, groups) = if cfg!(miri) { (3, 2) } else { (STARTS.len(), 5) };
        (1..=rows).flat_map(move |rows| (1..=groups).map(move |groups| (rows, groups)))
    }

    #[test]
    fn every_tile_of_every_processor_is_the_product_and_stays_within_its_operands() {
        for processor in Processor::available() {
            for precision in [Precision::F32, Precision::Bf16] {
                for (rows, groups) in sizes() {
                    let operands = Operands::new(precision, rows, groups);
                    let mut c = operands.c.clone();
                    operands.tile(false).multiply(processor, precision, &mut c);
                    operands.tile(true).multiply(processor, precision, &mut c);
                    let expected = (0..c.len()).map(|at| operands.expected(precision, at));
                    let name = processor.name();
                    assert!(c.iter().copied().eq(expected), "{name} {precision:?} {rows} {groups}");
                }
            }
        }
    }

    #[test]
    fn operands_fit_with_nothing_to_spare() {
        for (rows, groups) in sizes() {
            let operands = Operands::new(Precision::F32, rows, groups);
            let Operands { a, b, c, .. } = &operands;
            let fits =
                |a: &[f32], b: &[f32], c: &[f32]| Tile { a, b, ..operands.tile(true) }.fits(c);
            assert!(fits(a, b, c));
            assert!(!fits(&a[1..], b, c));
            assert!(!fits(a, &b[1..], c));
            assert!(!fits(a, b, &c[1..]));
        }
    }
}
