//! AVX2 with fused multiply-add and half-precision conversion: two registers a vector.
#![allow(unsafe_code)]

use core::arch::x86_64::{
    __m256, __m256i, _mm_loadu_si128, _mm_storeu_si128, _mm256_add_epi32, _mm256_add_ps,
    _mm256_and_si256, _mm256_castps_si256, _mm256_castsi256_ps, _mm256_castsi256_si128,
    _mm256_cvtepu16_epi32, _mm256_cvtph_ps, _mm256_cvtps_epi32, _mm256_div_ps,
    _mm256_extracti128_si256, _mm256_fmadd_ps, _mm256_loadu_ps, _mm256_max_ps, _mm256_min_ps,
    _mm256_mul_ps, _mm256_packus_epi32, _mm256_permute4x64_epi64, _mm256_round_ps,
    _mm256_set1_epi32, _mm256_set1_ps, _mm256_slli_epi32, _mm256_srli_epi32, _mm256_storeu_ps,
    _mm256_sub_ps,
};

use half::{bf16, f16};

use super::super::tile::{Tile, choose_tile};
use super::{LANES, Simd, Vectorized};

/// Exists where the processor has AVX2, FMA and F16C.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Avx2(());

type Floats = [__m256; 2];

impl Avx2 {
    pub(super) fn detect() -> Option<Avx2> {
        let has = is_x86_feature_detected!("avx2")
            && is_x86_feature_detected!("fma")
            && is_x86_feature_detected!("f16c");
        has.then_some(Avx2(()))
    }

    #[inline]
    pub(super) fn run<K: Vectorized>(self, kernel: K) -> K::Output {
        // SAFETY: this token exists, so the processor has these instructions.
        unsafe { run_avx2(kernel, self) }
    }
}

#[target_feature(enable = "avx2,fma,f16c")]
fn run_avx2<K: Vectorized>(kernel: K, token: Avx2) -> K::Output {
    kernel.run(token)
}

/// Register by register.
#[inline(always)]
fn each(operation: impl Fn(usize) -> __m256) -> Floats {
    [operation(0), operation(1)]
}

/// The number whose bits are the upper half of every 32 bits, and the one whose bits are the lower half.
#[inline]
#[target_feature(enable = "avx2")]
fn pairs(bits: __m256) -> (__m256, __m256) {
    let bits = _mm256_castps_si256(bits);
    let upper = _mm256_and_si256(bits, _mm256_set1_epi32(0xffff_0000_u32 as i32));
    (_mm256_castsi256_ps(upper), _mm256_castsi256_ps(_mm256_slli_epi32::<16>(bits)))
}

/// Rounds to bf16 (ties to even), in the lower half of every 32 bits.
#[inline]
#[target_feature(enable = "avx2")]
fn rounded(floats: __m256) -> __m256i {
    let bits = _mm256_castps_si256(floats);
    let odd = _mm256_and_si256(_mm256_srli_epi32::<16>(bits), _mm256_set1_epi32(1));
    let to_even = _mm256_add_epi32(odd, _mm256_set1_epi32(0x7fff));
    _mm256_srli_epi32::<16>(_mm256_add_epi32(bits, to_even))
}

// SAFETY of every block below: `self` exists, so the processor has the instructions; loads and stores go through
// references to sixteen elements, of which each register takes eight.
impl Simd for Avx2 {
    type Floats = Floats;

    // Six rows of two registers, two for the columns, one for what is multiplied with them: 15 of 16 registers.
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
        let one = unsafe { _mm256_set1_ps(value) };
        [one, one]
    }

    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Floats {
        let pointer = values.as_ptr();
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_loadu_ps(pointer), _mm256_loadu_ps(pointer.add(8))] }
    }

    #[inline(always)]
    fn store(self, floats: Floats, values: &mut [f32; LANES]) {
        let pointer = values.as_mut_ptr();
        // SAFETY: see the implementation's comment.
        unsafe {
            _mm256_storeu_ps(pointer, floats[0]);
            _mm256_storeu_ps(pointer.add(8), floats[1]);
        }
    }

    #[inline(always)]
    fn load_f16(self, values: &[f16; LANES]) -> Floats {
        let pointer = values.as_ptr();
        // SAFETY: see the implementation's comment.
        unsafe {
            [
                _mm256_cvtph_ps(_mm_loadu_si128(pointer.cast())),
                _mm256_cvtph_ps(_mm_loadu_si128(pointer.add(8).cast())),
            ]
        }
    }

    #[inline(always)]
    fn load_bf16(self, values: &[bf16; LANES]) -> Floats {
        let pointer = values.as_ptr();
        // SAFETY: see the implementation's comment.
        each(|half| unsafe {
            let halves = _mm256_cvtepu16_epi32(_mm_loadu_si128(pointer.add(8 * half).cast()));
            _mm256_castsi256_ps(_mm256_slli_epi32::<16>(halves))
        })
    }

    #[inline(always)]
    fn store_bf16(self, floats: Floats, values: &mut [bf16; LANES]) {
        let pointer = values.as_mut_ptr();
        // SAFETY: see the implementation's comment.
        unsafe {
            // Packing interleaves the halves of both registers; the permutation puts them in order.
            let packed = _mm256_packus_epi32(rounded(floats[0]), rounded(floats[1]));
            let packed = _mm256_permute4x64_epi64::<0b11_01_10_00>(packed);
            _mm_storeu_si128(pointer.cast(), _mm256_castsi256_si128(packed));
            _mm_storeu_si128(pointer.add(8).cast(), _mm256_extracti128_si256::<1>(packed));
        }
    }

    #[inline(always)]
    fn add(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn sub(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_sub_ps(a[0], b[0]), _mm256_sub_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn mul(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn div(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_div_ps(a[0], b[0]), _mm256_div_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn max(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_max_ps(a[0], b[0]), _mm256_max_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn min(self, a: Floats, b: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_min_ps(a[0], b[0]), _mm256_min_ps(a[1], b[1])] }
    }

    #[inline(always)]
    fn mul_add(self, a: Floats, b: Floats, c: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        unsafe { [_mm256_fmadd_ps(a[0], b[0], c[0]), _mm256_fmadd_ps(a[1], b[1], c[1])] }
    }

    #[inline(always)]
    fn dot_pairs(self, a: Floats, b: Floats, sum: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|half| unsafe {
            let ((a_high, a_low), (b_high, b_low)) = (pairs(a[half]), pairs(b[half]));
            _mm256_fmadd_ps(a_high, b_high, _mm256_fmadd_ps(a_low, b_low, sum[half]))
        })
    }

    #[inline(always)]
    fn round(self, a: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|half| unsafe { _mm256_round_ps::<0x08>(a[half]) })
    }

    #[inline(always)]
    fn power_of_two(self, a: Floats) -> Floats {
        // SAFETY: see the implementation's comment.
        each(|half| unsafe {
            let exponent = _mm256_add_epi32(_mm256_cvtps_epi32(a[half]), _mm256_set1_epi32(127));
            _mm256_castsi256_ps(_mm256_slli_epi32::<23>(exponent))
        })
    }
}
