//! Vectors of sixteen numbers on every processor, and the choice of the processor's best instructions at run time.
//!
//! All kernels are written once against [`Simd`], whose vectors always have [`LANES`] elements: one register with
//! AVX-512, two with AVX2, four with NEON. So sums are split in the same way everywhere. A type that implements it is
//! a token: it only exists where the processor has the instructions, which is why its methods are safe to call.
//! [`Processor::run`] compiles a kernel for each token with the matching instructions switched on.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
#[cfg(target_arch = "aarch64")]
mod neon;
mod portable;

use std::ffi::OsString;

use half::{bf16, f16};
use rare::{Error, Result};

use portable::Portable;

use super::tile::Tile;

/// Elements of a vector.
pub(super) const LANES: usize = 16;

/// The environment variable that forces a set of instructions.
const OVERRIDE: &str = "RARE_CPU";

/// Operations on vectors of [`LANES`] elements.
pub(super) trait Simd: Copy + Send + Sync {
    /// Sixteen numbers in single precision.
    type Floats: Copy;

    /// The most groups of [`LANES`] columns that a register tile of the matrix product may have.
    const GROUPS: usize;

    /// The most rows of a register tile with this many groups of columns.
    fn tile_rows(groups: usize) -> usize;

    /// Computes a register tile: at most [`Simd::tile_rows`] rows, `groups` groups of columns.
    ///
    /// # Safety
    /// As [`Tile::registers`].
    unsafe fn multiply_tile<const PAIRS: bool>(
        self,
        tile: &Tile<'_>,
        groups: usize,
        b: *const f32,
        c: *mut f32,
    );

    fn splat(self, value: f32) -> Self::Floats;
    fn load(self, values: &[f32; LANES]) -> Self::Floats;
    fn store(self, floats: Self::Floats, values: &mut [f32; LANES]);
    /// Exact for finite values.
    fn load_f16(self, values: &[f16; LANES]) -> Self::Floats;
    fn load_bf16(self, values: &[bf16; LANES]) -> Self::Floats;
    /// Rounds to nearest, ties to even.
    fn store_bf16(self, floats: Self::Floats, values: &mut [bf16; LANES]);
    fn add(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    fn sub(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    fn mul(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    fn div(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    fn max(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    fn min(self, a: Self::Floats, b: Self::Floats) -> Self::Floats;
    /// `a * b + c`, rounded once where the processor can.
    fn mul_add(self, a: Self::Floats, b: Self::Floats, c: Self::Floats) -> Self::Floats;
    /// `sum + a.0 * b.0 + a.1 * b.1`, where every 32 bits of `a` and `b` are a pair of bf16.
    fn dot_pairs(self, a: Self::Floats, b: Self::Floats, sum: Self::Floats) -> Self::Floats;
    /// To the nearest integer, ties to even; for magnitudes below 2^22.
    fn round(self, a: Self::Floats) -> Self::Floats;
    /// `2^a` for integers from -126 to 127.
    fn power_of_two(self, a: Self::Floats) -> Self::Floats;
    /// The sum of the lanes, always in the same order: halves onto each other.
    #[inline(always)]
    fn sum(self, a: Self::Floats) -> f32 {
        fold(self, a, |a, b| a + b)
    }
    /// The largest lane.
    #[inline(always)]
    fn maximum(self, a: Self::Floats) -> f32 {
        fold(self, a, f32::max)
    }
}

/// Puts halves onto each other until one lane is left.
#[inline(always)]
fn fold<S: Simd>(simd: S, floats: S::Floats, operation: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0.0; LANES];
    simd.store(floats, &mut lanes);
    for half in [8, 4, 2, 1] {
        for lane in 0..half {
            lanes[lane] = operation(lanes[lane], lanes[lane + half]);
        }
    }
    lanes[0]
}

/// A piece of work that is compiled for every processor.
pub(super) trait Vectorized {
    /// What it gives.
    type Output;

    /// Does the work. Implementations are `#[inline(always)]`, so that they are compiled with the instructions of the
    /// caller.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// The instructions that kernels use.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Processor(Level);

/// The tokens. Only [`Processor`] hands them out, after asking the processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Level {
    Portable(Portable),
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Avx2),
    #[cfg(target_arch = "x86_64")]
    Avx512(avx512::Avx512<false>),
    #[cfg(target_arch = "x86_64")]
    Avx512Bf16(avx512::Avx512<true>),
    #[cfg(target_arch = "aarch64")]
    Neon(neon::Neon),
}

impl Processor {
    /// The best that this machine has, or what the environment variable `RARE_CPU` forces: `portable`, `avx2`,
    /// `avx512`, `avx512bf16`, `neon`.
    ///
    /// # Errors
    /// `Unsupported` if the variable names instructions that this machine does not have.
    pub fn detect() -> Result<Processor> {
        Processor::choose(std::env::var_os(OVERRIDE))
    }

    /// The best, or the one that is forced (by anything but an empty name).
    fn choose(forced: Option<OsString>) -> Result<Processor> {
        let available = Processor::available();
        let Some(forced) = forced.filter(|name| !name.is_empty()) else {
            return Ok(available.last().copied().unwrap_or(Processor(Level::Portable(Portable))));
        };
        let names = || available.iter().map(|one| one.name()).collect::<Vec<_>>().join(", ");
        let found = available.iter().find(|processor| forced == processor.name());
        found.copied().ok_or_else(|| {
            Error::Unsupported(format!(
                "{OVERRIDE}={} is not to be had on this machine: use one of {}",
                forced.display(),
                names()
            ))
        })
    }

    /// Everything that this machine can run, the slowest first.
    #[must_use]
    pub fn available() -> Vec<Processor> {
        let levels = [
            Some(Level::Portable(Portable)),
            #[cfg(target_arch = "x86_64")]
            avx2::Avx2::detect().map(Level::Avx2),
            #[cfg(target_arch = "x86_64")]
            avx512::Avx512::detect().map(Level::Avx512),
            #[cfg(target_arch = "x86_64")]
            avx512::Avx512::detect_bf16().map(Level::Avx512Bf16),
            #[cfg(target_arch = "aarch64")]
            neon::Neon::detect().map(Level::Neon),
        ];
        levels.into_iter().flatten().map(Processor).collect()
    }

    /// The name that `RARE_CPU` takes.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self.0 {
            Level::Portable(_) => "portable",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512Bf16(_) => "avx512bf16",
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) => "neon",
        }
    }

    /// Runs a kernel with the instructions of this processor.
    #[inline]
    pub(super) fn run<K: Vectorized>(self, kernel: K) -> K::Output {
        match self.0 {
            Level::Portable(token) => kernel.run(token),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(token) => token.run(kernel),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(token) => token.run(kernel),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512Bf16(token) => token.run_bf16(kernel),
            #[cfg(target_arch = "aarch64")]
            Level::Neon(token) => token.run(kernel),
        }
    }
}

#[cfg(test)]
mod tests;
