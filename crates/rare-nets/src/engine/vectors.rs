//! Slices of any length, sixteen numbers at a time.

use half::{bf16, f16};

use super::simd::{LANES, Simd};
use super::tensor::Values;

/// What kernels write.
pub(super) trait Element: Copy + Default + bytemuck::Pod + Send + Sync {
    fn store<S: Simd>(simd: S, floats: S::Floats, values: &mut [Self; LANES]);
}

impl Element for f32 {
    #[inline(always)]
    fn store<S: Simd>(simd: S, floats: S::Floats, values: &mut [f32; LANES]) {
        simd.store(floats, values);
    }
}

impl Element for bf16 {
    #[inline(always)]
    fn store<S: Simd>(simd: S, floats: S::Floats, values: &mut [bf16; LANES]) {
        simd.store_bf16(floats, values);
    }
}

/// What numbers of weights are stored as.
pub(super) trait Stored: Copy + bytemuck::Pod {
    fn load<S: Simd>(simd: S, values: &[Self; LANES]) -> S::Floats;
}

impl Stored for f32 {
    #[inline(always)]
    fn load<S: Simd>(simd: S, values: &[f32; LANES]) -> S::Floats {
        simd.load(values)
    }
}

impl Stored for f16 {
    #[inline(always)]
    fn load<S: Simd>(simd: S, values: &[f16; LANES]) -> S::Floats {
        simd.load_f16(values)
    }
}

impl Stored for bf16 {
    #[inline(always)]
    fn load<S: Simd>(simd: S, values: &[bf16; LANES]) -> S::Floats {
        simd.load_bf16(values)
    }
}

/// The vector that begins at `start`; what lies beyond the end is zero.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, values: &[f32], start: usize) -> S::Floats {
    let values = values.get(start..).unwrap_or_default();
    match values.first_chunk::<LANES>() {
        Some(whole) => simd.load(whole),
        None => {
            let mut padded = [0.0; LANES];
            padded[..values.len()].copy_from_slice(values);
            simd.load(&padded)
        }
    }
}

/// The same of elements in either precision.
#[inline(always)]
pub(super) fn load_values<S: Simd>(simd: S, values: Values<'_>, start: usize) -> S::Floats {
    match values {
        Values::F32(values) => load(simd, values, start),
        Values::Bf16(values) => {
            let values = values.get(start..).unwrap_or_default();
            match values.first_chunk::<LANES>() {
                Some(whole) => simd.load_bf16(whole),
                None => {
                    let mut padded = [bf16::ZERO; LANES];
                    padded[..values.len()].copy_from_slice(values);
                    simd.load_bf16(&padded)
                }
            }
        }
    }
}

/// Stores a vector from `start` on; what lies beyond the end is dropped.
#[inline(always)]
pub(super) fn store<S: Simd, T: Element>(
    simd: S,
    floats: S::Floats,
    values: &mut [T],
    start: usize,
) {
    let values = values.get_mut(start..).unwrap_or_default();
    if let Some(whole) = values.first_chunk_mut::<LANES>() {
        T::store(simd, floats, whole);
    } else {
        let mut padded = [T::default(); LANES];
        T::store(simd, floats, &mut padded);
        let count = values.len();
        values.copy_from_slice(&padded[..count]);
    }
}
