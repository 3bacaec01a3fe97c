//! NEON: four registers a vector.
#![allow(unsafe_code)]

use core::arch::aarch64::{
    float32x4_t, vaddq_f32, vaddq_s32, vaddq_u32, vandq_u32, vbslq_f32, vcgtq_f32, vcvtq_s32_f32,
    vdivq_f32, vdupq_n_f32, vdupq_n_s32, vdupq_n_u32, vfmaq_f32, vld1_u16, vld1q_f32, vmovl_u16,
    vmovn_u32, vmulq_f32, vorrq_u32, vreinterpretq_f32_s32, vreinterpretq_f32_u32,
    vreinterpretq_u32_f32, vrndnq_f32, vshlq_n_s32, vshlq_n_u32, vshrq_n_u32, vst1_u16, vst1q_f32,
    vsubq_f32,
};

use half::{bf16, f16};

use super::super::tile::{Tile, choose_tile};
use super::{LANES, Simd, Vectorized};

/// Exists where the processor has NEON.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Neon(());

type Floats = [float32x4_t; 4];

impl Neon {
    pub(super) fn detect() -> Option<Neon> {
        std::arch::is_aarch64_feature_detected!("neon").then_some(Neon(()))
    }

    #[inline]
    pub(super) fn run<K: Vectorized>(self, kernel: K) -> K::Output {
        // SAFETY: this token exists, so the processor has these instructions.
        unsafe { run_neon(kernel, self) }
    }
}

#[target_feature(enable = "neon")]
fn run_neon<K: Vectorized>(kernel: K, token: Neon) -> K::Output {
    kernel.run(token)
}

/// Register by register.
#[inline(always)]
fn each(operation: impl Fn(usize) -> float32x4_t) -> Floats {
    [operation(0), operation(1), operation(2), operation(3)]
}

/// The number whose bits are the upper half of every 32 bits, and the one whose bits are the lower half.
#[inline]
#[target_feature(enable = "neon")]
fn pairs(bits: float32x4_t) -> (float32x4_t, float32x4_t) {
    let bits = vreinterpretq_u32_f32(bits);
    let upper = vandq_u32(bits, vdupq_n_u32(0xffff_0000));
    (vreinterpretq_f32_u32(upper), vreinterpretq_f32_u32(vshlq_n_u32::<16>(bits)))
}

// SAFETY of every block below: `self` exists, so the processor has the instructions; loads and stores go through
// references to sixteen elements, of which each register takes four.
impl Simd for Neon {
    type Floats = Floats;

    // Six rows of four registers and four for the columns: 28 of 32 registers.
    const GROUPS: usize = 1;

    fn tile_rows(_groups: usize) -> usize {
        6
    }

    #[inline(always)]
    unsafe fn multiply_tile<const PAIRS: bool>(
        self,
        tile: &Tile<'_>,
        groups: usize,
        b: *const f32,
        c: *mut f32,
    ) {
        choose_tile!(self, tile, groups, b, c, 1: 1 2 3 4 5 6);
    }

    #[inline(always)]
    fn splat(self, value: f32) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|_| unsafe { vdupq_n_f32(value) })
    }

    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vld1q_f32(values.as_ptr().add(4 * quarter)) })
    }

    #[inline(always)]
    fn store(self, floats: Floats, values: &mut [f32; LANES]) {
        for (quarter, floats) in floats.into_iter().enumerate() {
            // SAFETY: see the implementation's comment.
            unsafe { vst1q_f32(values.as_mut_ptr().add(4 * quarter), floats) };
        }
    }

    #[inline(always)]
    fn load_f16(self, values: &[f16; LANES]) -> Floats {
        // Sign aside, the bits of a half are those of a single whose exponent is 112 too small.
        let rebias = f32::from_bits((127 + 112) << 23);
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            let bits = vmovl_u16(vld1_u16(values.as_ptr().add(4 * quarter).cast()));
            let magnitude = vshlq_n_u32::<13>(vandq_u32(bits, vdupq_n_u32(0x7fff)));
            let magnitude = vmulq_f32(vreinterpretq_f32_u32(magnitude), vdupq_n_f32(rebias));
            let sign = vshlq_n_u32::<16>(vandq_u32(bits, vdupq_n_u32(0x8000)));
            vreinterpretq_f32_u32(vorrq_u32(vreinterpretq_u32_f32(magnitude), sign))
        })
    }

    #[inline(always)]
    fn load_bf16(self, values: &[bf16; LANES]) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            let bits = vmovl_u16(vld1_u16(values.as_ptr().add(4 * quarter).cast()));
            vreinterpretq_f32_u32(vshlq_n_u32::<16>(bits))
        })
    }

    #[inline(always)]
    fn store_bf16(self, floats: Floats, values: &mut [bf16; LANES]) {
        for (quarter, floats) in floats.into_iter().enumerate() {
            // SAFETY: see the implementation's comment.
            unsafe {
                let bits = vreinterpretq_u32_f32(floats);
                let odd = vandq_u32(vshrq_n_u32::<16>(bits), vdupq_n_u32(1));
                let to_even = vaddq_u32(odd, vdupq_n_u32(0x7fff));
                let rounded = vshrq_n_u32::<16>(vaddq_u32(bits, to_even));
                vst1_u16(values.as_mut_ptr().add(4 * quarter).cast(), vmovn_u32(rounded));
            }
        }
    }

    #[inline(always)]
    fn add(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vaddq_f32(a[quarter], b[quarter]) })
    }

    #[inline(always)]
    fn sub(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vsubq_f32(a[quarter], b[quarter]) })
    }

    #[inline(always)]
    fn mul(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vmulq_f32(a[quarter], b[quarter]) })
    }

    #[inline(always)]
    fn div(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vdivq_f32(a[quarter], b[quarter]) })
    }

    #[inline(always)]
    fn max(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            vbslq_f32(vcgtq_f32(a[quarter], b[quarter]), a[quarter], b[quarter])
        })
    }

    #[inline(always)]
    fn min(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            vbslq_f32(vcgtq_f32(b[quarter], a[quarter]), a[quarter], b[quarter])
        })
    }

    #[inline(always)]
    fn mul_add(self, a: Floats, b: Floats, c: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vfmaq_f32(c[quarter], a[quarter], b[quarter]) })
    }

    #[inline(always)]
    fn dot_pairs(self, a: Floats, b: Floats, sum: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            let ((a_high, a_low), (b_high, b_low)) = (pairs(a[quarter]), pairs(b[quarter]));
            vfmaq_f32(vfmaq_f32(sum[quarter], a_low, b_low), a_high, b_high)
        })
    }

    #[inline(always)]
    fn round(self, a: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe { vrndnq_f32(a[quarter]) })
    }

    #[inline(always)]
    fn power_of_two(self, a: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|quarter| unsafe {
            let exponent = vaddq_s32(vcvtq_s32_f32(a[quarter]), vdupq_n_s32(127));
            vreinterpretq_f32_s32(vshlq_n_s32::<23>(exponent))
        })
    }
}
