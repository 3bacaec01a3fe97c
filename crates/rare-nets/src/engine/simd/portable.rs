//! Plain Rust, for processors without anything better and as the reference of the others.

use half::{bf16, f16};

use super::{LANES, Simd};

/// Exists everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Portable;

type Floats = [f32; LANES];

/// Lane by lane.
#[inline(always)]
fn each(operation: impl Fn(usize) -> f32) -> Floats {
    let mut result = [0.0; LANES];
    for (lane, value) in result.iter_mut().enumerate() {
        *value = operation(lane);
    }
    result
}

/// The upper and the lower bf16 of 32 bits.
#[inline(always)]
fn pair(bits: f32) -> (f32, f32) {
    let bits = bits.to_bits();
    (f32::from_bits(bits & 0xffff_0000), f32::from_bits(bits << 16))
}

/// Halves onto each other, until one lane is left.
#[inline(always)]
fn fold(mut lanes: Floats, operation: impl Fn(f32, f32) -> f32) -> f32 {
    for half in [8, 4, 2, 1] {
        for lane in 0..half {
            lanes[lane] = operation(lanes[lane], lanes[lane + half]);
        }
    }
    lanes[0]
}

impl Simd for Portable {
    type Floats = Floats;

    // Two rows of four registers each, four for the columns: what 16 registers of 128 bits hold.
    const GROUPS: usize = 1;

    fn tile_rows(_groups: usize) -> usize {
        2
    }

    #[inline(always)]
    fn splat(self, value: f32) -> Floats {
        [value; LANES]
    }

    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Floats {
        *values
    }

    #[inline(always)]
    fn store(self, floats: Floats, values: &mut [f32; LANES]) {
        *values = floats;
    }

    #[inline(always)]
    fn load_f16(self, values: &[f16; LANES]) -> Floats {
        // Sign aside, the bits of a half are those of a single whose exponent is 112 too small.
        let rebias = f32::from_bits((127 + 112) << 23);
        each(|lane| {
            let bits = u32::from(values[lane].to_bits());
            let magnitude = f32::from_bits((bits & 0x7fff) << 13) * rebias;
            f32::from_bits(magnitude.to_bits() | (bits & 0x8000) << 16)
        })
    }

    #[inline(always)]
    fn load_bf16(self, values: &[bf16; LANES]) -> Floats {
        each(|lane| f32::from_bits(u32::from(values[lane].to_bits()) << 16))
    }

    #[inline(always)]
    fn store_bf16(self, floats: Floats, values: &mut [bf16; LANES]) {
        for (value, float) in values.iter_mut().zip(floats) {
            let bits = float.to_bits();
            let to_even = 0x7fff + ((bits >> 16) & 1);
            *value = bf16::from_bits((bits.wrapping_add(to_even) >> 16) as u16);
        }
    }

    #[inline(always)]
    fn add(self, a: Floats, b: Floats) -> Floats {
        each(|lane| a[lane] + b[lane])
    }

    #[inline(always)]
    fn sub(self, a: Floats, b: Floats) -> Floats {
        each(|lane| a[lane] - b[lane])
    }

    #[inline(always)]
    fn mul(self, a: Floats, b: Floats) -> Floats {
        each(|lane| a[lane] * b[lane])
    }

    #[inline(always)]
    fn div(self, a: Floats, b: Floats) -> Floats {
        each(|lane| a[lane] / b[lane])
    }

    #[inline(always)]
    fn max(self, a: Floats, b: Floats) -> Floats {
        each(|lane| if a[lane] > b[lane] { a[lane] } else { b[lane] })
    }

    #[inline(always)]
    fn min(self, a: Floats, b: Floats) -> Floats {
        each(|lane| if a[lane] < b[lane] { a[lane] } else { b[lane] })
    }

    #[inline(always)]
    fn mul_add(self, a: Floats, b: Floats, c: Floats) -> Floats {
        // Without an instruction for it, rounding once would be a function call.
        each(|lane| a[lane] * b[lane] + c[lane])
    }

    #[inline(always)]
    fn dot_pairs(self, a: Floats, b: Floats, sum: Floats) -> Floats {
        each(|lane| {
            let ((a_high, a_low), (b_high, b_low)) = (pair(a[lane]), pair(b[lane]));
            sum[lane] + a_low * b_low + a_high * b_high
        })
    }

    #[inline(always)]
    fn round(self, a: Floats) -> Floats {
        // The last bit of 1.5 * 2^23 is worth 1: adding it rounds.
        const SHIFT: f32 = 12_582_912.0;
        each(|lane| (a[lane] + SHIFT) - SHIFT)
    }

    #[inline(always)]
    fn power_of_two(self, a: Floats) -> Floats {
        // In the last bits of 1.5 * 2^23 + a stands a; shifted, it is the exponent.
        const SHIFT: f32 = 12_582_912.0;
        each(|lane| {
            let bits = (a[lane] + SHIFT).to_bits().wrapping_sub(SHIFT.to_bits());
            f32::from_bits(bits.wrapping_add(127) << 23)
        })
    }

    #[inline(always)]
    fn sum(self, a: Floats) -> f32 {
        fold(a, |a, b| a + b)
    }

    #[inline(always)]
    fn maximum(self, a: Floats) -> f32 {
        fold(a, f32::max)
    }
}
