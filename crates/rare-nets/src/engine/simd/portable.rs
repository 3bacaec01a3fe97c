//! What every processor of an architecture has (SSE2, plain Rust), for those without anything better and as the
//! reference of the others.
#![allow(unsafe_code)]

use bytemuck::cast;
use half::{bf16, f16};
use wide::{f32x4, u32x4};

use super::super::tile::{Tile, choose_tile};
use super::{LANES, Simd};

/// Exists everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Portable;

type Floats = [f32x4; 4];

/// 1.5 * 2^23: the last bit of it is worth 1.
const SHIFT: f32 = 12_582_912.0;

/// Register by register.
#[inline(always)]
fn each(operation: impl Fn(usize) -> f32x4) -> Floats {
    [operation(0), operation(1), operation(2), operation(3)]
}

/// The bits of 16-bit elements in the lower halves of 32 bits, register by register.
#[inline(always)]
fn wider(bits: impl Fn(usize) -> u16) -> [u32x4; 4] {
    let four = |first: usize| {
        u32x4::new([first, first + 1, first + 2, first + 3].map(|lane| u32::from(bits(lane))))
    };
    [four(0), four(4), four(8), four(12)]
}

/// The numbers whose bits are the upper halves of every 32 bits, and those whose bits are the lower halves.
#[inline(always)]
fn pairs(bits: f32x4) -> (f32x4, f32x4) {
    let bits: u32x4 = cast(bits);
    (cast(bits & u32x4::splat(0xffff_0000)), cast(bits << 16))
}

impl Simd for Portable {
    type Floats = Floats;

    // Two rows of four registers each, four for the columns: what 16 registers of 128 bits hold.
    const GROUPS: usize = 1;

    fn tile_rows(_groups: usize) -> usize {
        2
    }

    #[inline(always)]
    unsafe fn multiply_tile<const PAIRS: bool>(
        self,
        tile: &Tile<'_>,
        groups: usize,
        b: *const f32,
        c: *mut f32,
    ) {
        choose_tile!(self, tile, groups, b, c, 1: 1 2);
    }

    #[inline(always)]
    fn splat(self, value: f32) -> Floats {
        [f32x4::splat(value); 4]
    }

    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Floats {
        let quarters = values.as_chunks::<4>().0;
        each(|quarter| f32x4::new(quarters[quarter]))
    }

    #[inline(always)]
    fn store(self, floats: Floats, values: &mut [f32; LANES]) {
        for (quarter, values) in floats.into_iter().zip(values.as_chunks_mut::<4>().0) {
            *values = quarter.to_array();
        }
    }

    #[inline(always)]
    fn load_f16(self, values: &[f16; LANES]) -> Floats {
        let bits = wider(|lane| values[lane].to_bits());
        // Sign aside, the bits of a half are those of a single whose exponent is 112 too small.
        let rebias = f32x4::splat(f32::from_bits((127 + 112) << 23));
        each(|quarter| {
            let magnitude: f32x4 = cast((bits[quarter] & u32x4::splat(0x7fff)) << 13);
            let sign = (bits[quarter] & u32x4::splat(0x8000)) << 16;
            cast(cast::<f32x4, u32x4>(magnitude * rebias) | sign)
        })
    }

    #[inline(always)]
    fn load_bf16(self, values: &[bf16; LANES]) -> Floats {
        let bits = wider(|lane| values[lane].to_bits());
        each(|quarter| cast(bits[quarter] << 16))
    }

    #[inline(always)]
    fn store_bf16(self, floats: Floats, values: &mut [bf16; LANES]) {
        for (quarter, values) in floats.into_iter().zip(values.as_chunks_mut::<4>().0) {
            let bits: u32x4 = cast(quarter);
            let to_even = ((bits >> 16) & u32x4::splat(1)) + u32x4::splat(0x7fff);
            let rounded: u32x4 = (bits + to_even) >> 16;
            *values = rounded.to_array().map(|bits| bf16::from_bits(bits as u16));
        }
    }

    #[inline(always)]
    fn add(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter] + b[quarter])
    }

    #[inline(always)]
    fn sub(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter] - b[quarter])
    }

    #[inline(always)]
    fn mul(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter] * b[quarter])
    }

    #[inline(always)]
    fn div(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter] / b[quarter])
    }

    #[inline(always)]
    fn max(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter].fast_max(b[quarter]))
    }

    #[inline(always)]
    fn min(self, a: Floats, b: Floats) -> Floats {
        each(|quarter| a[quarter].fast_min(b[quarter]))
    }

    #[inline(always)]
    fn mul_add(self, a: Floats, b: Floats, c: Floats) -> Floats {
        // Without an instruction for it, rounding once would be a function call.
        each(|quarter| a[quarter] * b[quarter] + c[quarter])
    }

    #[inline(always)]
    fn dot_pairs(self, a: Floats, b: Floats, sum: Floats) -> Floats {
        each(|quarter| {
            let ((a_high, a_low), (b_high, b_low)) = (pairs(a[quarter]), pairs(b[quarter]));
            sum[quarter] + a_low * b_low + a_high * b_high
        })
    }

    #[inline(always)]
    fn round(self, a: Floats) -> Floats {
        each(|quarter| (a[quarter] + f32x4::splat(SHIFT)) - f32x4::splat(SHIFT))
    }

    #[inline(always)]
    fn power_of_two(self, a: Floats) -> Floats {
        // In the last bits of SHIFT + a stands a; with the bias added and shifted, it is the exponent.
        let bias = u32x4::splat(127_u32.wrapping_sub(SHIFT.to_bits()));
        each(|quarter| {
            let bits: u32x4 = cast(a[quarter] + f32x4::splat(SHIFT));
            cast((bits + bias) << 23)
        })
    }
}
