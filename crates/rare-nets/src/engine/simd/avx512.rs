//! AVX-512, with or without products of bf16 pairs.
#![allow(unsafe_code)]

use core::arch::x86_64::{
    __m256bh, __m256i, __m512, __m512bh, _mm256_loadu_si256, _mm256_storeu_si256, _mm512_add_epi32,
    _mm512_add_ps, _mm512_and_si512, _mm512_castps_si512, _mm512_castsi512_ps,
    _mm512_cvtepi32_epi16, _mm512_cvtepu16_epi32, _mm512_cvtneps_pbh, _mm512_cvtph_ps,
    _mm512_div_ps, _mm512_dpbf16_ps, _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_max_ps,
    _mm512_min_ps, _mm512_mul_ps, _mm512_reduce_add_ps, _mm512_reduce_max_ps, _mm512_roundscale_ps,
    _mm512_scalef_ps, _mm512_set1_epi32, _mm512_set1_ps, _mm512_slli_epi32, _mm512_srli_epi32,
    _mm512_storeu_ps, _mm512_sub_ps,
};
use core::mem::transmute;

use half::{bf16, f16};

use super::super::tile::{Tile, choose_tile};
use super::{LANES, Simd, Vectorized};

/// Exists where the processor has AVX-512 F, BW, DQ and VL; with `BF16`, that as well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Avx512<const BF16: bool>(());

impl Avx512<false> {
    pub(super) fn detect() -> Option<Avx512<false>> {
        let has = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        has.then_some(Avx512(()))
    }

    pub(super) fn detect_bf16() -> Option<Avx512<true>> {
        let has = Avx512::detect().is_some() && is_x86_feature_detected!("avx512bf16");
        has.then_some(Avx512(()))
    }

    #[inline]
    pub(super) fn run<K: Vectorized>(self, kernel: K) -> K::Output {
        // SAFETY: this token exists, so the processor has these instructions.
        unsafe { run_avx512(kernel, self) }
    }
}

impl Avx512<true> {
    #[inline]
    pub(super) fn run_bf16<K: Vectorized>(self, kernel: K) -> K::Output {
        // SAFETY: this token exists, so the processor has these instructions.
        unsafe { run_avx512_bf16(kernel, self) }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn run_avx512<K: Vectorized>(kernel: K, token: Avx512<false>) -> K::Output {
    kernel.run(token)
}

#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16")]
fn run_avx512_bf16<K: Vectorized>(kernel: K, token: Avx512<true>) -> K::Output {
    kernel.run(token)
}

/// The number whose bits are the upper half of every 32 bits, and the one whose bits are the lower half.
#[inline]
#[target_feature(enable = "avx512f")]
fn pairs(bits: __m512) -> (__m512, __m512) {
    let bits = _mm512_castps_si512(bits);
    let upper = _mm512_and_si512(bits, _mm512_set1_epi32(0xffff_0000_u32 as i32));
    (_mm512_castsi512_ps(upper), _mm512_castsi512_ps(_mm512_slli_epi32::<16>(bits)))
}

// SAFETY of every block below: `self` exists, so the processor has the instructions; loads and stores go through
// references to sixteen elements.
impl<const BF16: bool> Simd for Avx512<BF16> {
    type Floats = __m512;

    const GROUPS: usize = 3;

    fn tile_rows(groups: usize) -> usize {
        // 32 registers, less one per group of columns and one for what is multiplied with them.
        match groups {
            1 => 6,
            2 => 14,
            _ => 9,
        }
    }

    #[inline(always)]
    unsafe fn multiply_tile<const PAIRS: bool>(
        self,
        tile: &Tile<'_>,
        groups: usize,
        b: *const f32,
        c: *mut f32,
    ) {
        choose_tile!(self, tile, groups, b, c, 1: 1 2 3 4 5 6, 2: 1 2 3 4 5 6 7 8 9 10 11 12 13 14, 3: 1 2 3 4 5 6 7 8 9);
    }

    #[inline(always)]
    fn splat(self, value: f32) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_set1_ps(value) }
    }

    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_loadu_ps(values.as_ptr()) }
    }

    #[inline(always)]
    fn store(self, floats: __m512, values: &mut [f32; LANES]) {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_storeu_ps(values.as_mut_ptr(), floats) }
    }

    #[inline(always)]
    fn load_f16(self, values: &[f16; LANES]) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(values.as_ptr().cast())) }
    }

    #[inline(always)]
    fn load_bf16(self, values: &[bf16; LANES]) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe {
            let halves = _mm256_loadu_si256(values.as_ptr().cast());
            _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(halves)))
        }
    }

    #[inline(always)]
    fn store_bf16(self, floats: __m512, values: &mut [bf16; LANES]) {
        // SAFETY: see the implementation's comment.
        unsafe {
            let halves = if BF16 {
                transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(floats))
            } else {
                let bits = _mm512_castps_si512(floats);
                let odd = _mm512_and_si512(_mm512_srli_epi32::<16>(bits), _mm512_set1_epi32(1));
                let to_even = _mm512_add_epi32(odd, _mm512_set1_epi32(0x7fff));
                _mm512_cvtepi32_epi16(_mm512_srli_epi32::<16>(_mm512_add_epi32(bits, to_even)))
            };
            _mm256_storeu_si256(values.as_mut_ptr().cast(), halves);
        }
    }

    #[inline(always)]
    fn add(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_add_ps(a, b) }
    }

    #[inline(always)]
    fn sub(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_sub_ps(a, b) }
    }

    #[inline(always)]
    fn mul(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_mul_ps(a, b) }
    }

    #[inline(always)]
    fn div(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_div_ps(a, b) }
    }

    #[inline(always)]
    fn max(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_max_ps(a, b) }
    }

    #[inline(always)]
    fn min(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_min_ps(a, b) }
    }

    #[inline(always)]
    fn mul_add(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }

    #[inline(always)]
    fn dot_pairs(self, a: __m512, b: __m512, sum: __m512) -> __m512 {
        // SAFETY: see the implementation's comment; with `BF16` the token vouches for BF16 too.
        unsafe {
            if BF16 {
                let (a, b) = (transmute::<__m512, __m512bh>(a), transmute::<__m512, __m512bh>(b));
                return _mm512_dpbf16_ps(sum, a, b);
            }
            let ((a_high, a_low), (b_high, b_low)) = (pairs(a), pairs(b));
            _mm512_fmadd_ps(a_high, b_high, _mm512_fmadd_ps(a_low, b_low, sum))
        }
    }

    #[inline(always)]
    fn round(self, a: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_roundscale_ps::<0>(a) }
    }

    #[inline(always)]
    fn power_of_two(self, a: __m512) -> __m512 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_scalef_ps(_mm512_set1_ps(1.0), a) }
    }

    #[inline(always)]
    fn sum(self, a: __m512) -> f32 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_reduce_add_ps(a) }
    }

    #[inline(always)]
    fn maximum(self, a: __m512) -> f32 {
        // SAFETY: see the implementation's comment.
        unsafe { _mm512_reduce_max_ps(a) }
    }
}
