use half::{bf16, f16};
use rare::Error;

use super::{LANES, Processor, Simd, Vectorized};

/// A method, from three vectors of bits to one.
#[derive(Debug, Clone, Copy)]
enum Method {
    Splat,
    LoadF16,
    LoadBf16,
    StoreBf16,
    Add,
    Sub,
    Mul,
    Div,
    Max,
    Min,
    MulAdd,
    DotPairs,
    Round,
    PowerOfTwo,
    Sum,
    Maximum,
}

struct Call(Method, [[f32; LANES]; 3]);

impl Vectorized for Call {
    type Output = [f32; LANES];

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> [f32; LANES] {
        let [a, b, c] = self.1.map(|lanes| simd.load(&lanes));
        let bits = self.1[0].map(|lane| lane.to_bits() as u16);
        let result = match self.0 {
            Method::Splat => simd.splat(self.1[0][0]),
            Method::LoadF16 => simd.load_f16(&bits.map(f16::from_bits)),
            Method::LoadBf16 => simd.load_bf16(&bits.map(bf16::from_bits)),
            Method::StoreBf16 => {
                let mut rounded = [bf16::ONE; LANES];
                simd.store_bf16(a, &mut rounded);
                return rounded.map(bf16::to_f32);
            }
            Method::Add => simd.add(a, b),
            Method::Sub => simd.sub(a, b),
            Method::Mul => simd.mul(a, b),
            Method::Div => simd.div(a, b),
            Method::Max => simd.max(a, b),
            Method::Min => simd.min(a, b),
            Method::MulAdd => simd.mul_add(a, b, c),
            Method::DotPairs => simd.dot_pairs(a, b, c),
            Method::Round => simd.round(a),
            Method::PowerOfTwo => simd.power_of_two(a),
            Method::Sum => return [simd.sum(a); LANES],
            Method::Maximum => return [simd.maximum(a); LANES],
        };
        let mut lanes = [0.0; LANES];
        simd.store(result, &mut lanes);
        lanes
    }
}

/// Calls the method on every processor.
fn results(method: Method, a: [f32; LANES], b: [f32; LANES], c: [f32; LANES]) -> Vec<[f32; LANES]> {
    let processors = Processor::available().into_iter();
    processors.map(|processor| processor.run(Call(method, [a, b, c]))).collect()
}

/// Every processor gives these very bits.
#[track_caller]
fn gives(method: Method, a: [f32; LANES], b: [f32; LANES], expected: [f32; LANES]) {
    for (processor, found) in results(method, a, b, [0.0; LANES]).into_iter().enumerate() {
        let [found_bits, expected_bits] = [found, expected].map(|lanes| lanes.map(f32::to_bits));
        assert_eq!(
            found_bits, expected_bits,
            "{method:?} of {a:?} and {b:?}: {found:?}, expected {expected:?} ({processor})"
        );
    }
}

const A: [f32; LANES] = [
    1.5, -2.25, 3.1, -4.7, 5.3e3, -6.9e-3, 7.77, -8.0, 9.1e10, -1.3e-10, 11.0, 0.1, -13.6, 14.2,
    1e-3, 16.9,
];
const B: [f32; LANES] = [
    -0.5, -2.5, 3.3, 4.1, 5.2e3, 6.1e-2, -7.1, 8.5, 9.0e10, -1.4e-10, -11.5, 0.3, -13.1, -14.9,
    15.5, 1e4,
];

fn pairwise(operation: impl Fn(f32, f32) -> f32) -> [f32; LANES] {
    std::array::from_fn(|lane| operation(A[lane], B[lane]))
}

/// From vector to vector of all numbers of 16 bits; an interpreter takes samples.
const STEP: usize = if cfg!(miri) { 64 * LANES } else { LANES };

/// Sixteen consecutive numbers.
fn counted(first: usize) -> [u32; LANES] {
    std::array::from_fn(|lane| (first + lane) as u32)
}

#[test]
fn arithmetic_is_exact_in_every_lane() {
    gives(Method::Splat, A, B, [A[0]; LANES]);
    gives(Method::Add, A, B, pairwise(|a, b| a + b));
    gives(Method::Sub, A, B, pairwise(|a, b| a - b));
    gives(Method::Mul, A, B, pairwise(|a, b| a * b));
    gives(Method::Div, A, B, pairwise(|a, b| a / b));
    gives(Method::Max, A, B, pairwise(f32::max));
    gives(Method::Min, A, B, pairwise(f32::min));
}

#[test]
fn lanes_are_folded_by_halves() {
    let mut sums = A;
    for half in [8, 4, 2, 1] {
        (0..half).for_each(|lane| sums[lane] += sums[lane + half]);
    }
    gives(Method::Sum, A, B, [sums[0]; LANES]);
    for place in 0..LANES {
        let mut lanes = A.map(|lane| -lane.abs());
        lanes[place] = -1e-20;
        gives(Method::Maximum, lanes, B, [-1e-20; LANES]);
    }
}

#[test]
fn all_finite_half_precision_numbers_are_read_exactly() {
    for first in (0..1 << 16).step_by(STEP).filter(|first| first & 0x7c00 != 0x7c00) {
        let expected = counted(first).map(|bits| f16::from_bits(bits as u16).to_f32());
        gives(Method::LoadF16, counted(first).map(f32::from_bits), B, expected);
    }
}

#[test]
fn all_finite_upper_halves_are_read_exactly() {
    for first in (0..1 << 16).step_by(STEP).filter(|first| first & 0x7f80 != 0x7f80) {
        let expected = counted(first).map(|bits| f32::from_bits(bits << 16));
        gives(Method::LoadBf16, counted(first).map(f32::from_bits), B, expected);
    }
}

#[test]
fn upper_halves_are_rounded_to_nearest_and_ties_to_even() {
    // Without subnormal numbers, and all that is finite.
    let normal = |first: &usize| (0x80..0x7f80).contains(&(first & 0x7fff));
    for first in (0..1 << 16).step_by(STEP).filter(normal) {
        for lower in [0, 1, 0x7fff, 0x8000, 0x8001, 0xffff] {
            let floats = counted(first).map(|upper| f32::from_bits(upper << 16 | lower));
            let expected = floats.map(|float| bf16::from_f32(float).to_f32());
            gives(Method::StoreBf16, floats, B, expected);
        }
    }
}

#[test]
fn subnormal_numbers_are_rounded_or_zero() {
    // The instruction for it takes subnormal numbers for zero.
    let floats = counted(0).map(|lane| f32::from_bits((lane * 0x7_1234) | (lane & 1) << 31));
    for found in results(Method::StoreBf16, floats, B, B) {
        for (found, float) in found.into_iter().zip(floats) {
            assert!(found == 0.0 || found == bf16::from_f32(float).to_f32(), "{found} {float}");
        }
    }
}

#[test]
fn products_are_added_with_at_most_two_roundings() {
    let c: [f32; LANES] = std::array::from_fn(|lane| -A[lane] * B[lane] * 0.75);
    for found in results(Method::MulAdd, A, B, c) {
        for lane in 0..LANES {
            let product = f64::from(A[lane]) * f64::from(B[lane]);
            let error = (f64::from(found[lane]) - product - f64::from(c[lane])).abs();
            assert!(error <= product.abs() * 7.5e-8, "{error:e} in lane {lane}");
        }
    }
}

#[test]
fn pairs_are_multiplied_number_by_number() {
    // The first of a pair is the lower half of the bits.
    let pair = |[low, high]: [f32; 2]| {
        let [low, high] = [low, high].map(|half| u32::from(bf16::from_f32(half).to_bits()));
        f32::from_bits(high << 16 | low)
    };
    let a: [[f32; 2]; LANES] = std::array::from_fn(|lane| [1.0 + lane as f32, -3.5]);
    let b: [[f32; 2]; LANES] = std::array::from_fn(|lane| [0.375, lane as f32 - 7.5]);
    let expected =
        std::array::from_fn(|lane| 0.25 + a[lane][0] * b[lane][0] + a[lane][1] * b[lane][1]);
    for found in results(Method::DotPairs, a.map(pair), b.map(pair), [0.25; LANES]) {
        // All numbers are short: nothing is rounded.
        assert_eq!(found, expected);
    }
}

#[test]
fn ties_are_rounded_to_even_integers() {
    for first in [-4_194_303, -40, -8, 0, 40, 1000, 4_194_280] {
        let quarters: [f32; LANES] = std::array::from_fn(|lane| first as f32 + lane as f32 / 4.0);
        gives(Method::Round, quarters, B, quarters.map(|lane| lane.round_ties_even() + 0.0));
    }
}

#[test]
fn powers_of_two_are_exact() {
    for first in (-126..=112).step_by(14) {
        let exponents: [f32; LANES] = std::array::from_fn(|lane| first as f32 + lane as f32);
        let powers = exponents.map(|exponent| f64::from(exponent).exp2() as f32);
        gives(Method::PowerOfTwo, exponents, B, powers);
    }
}

#[test]
fn the_best_or_the_forced_instructions_are_taken() {
    let available = Processor::available();
    assert_eq!(available[0].name(), "portable");
    for nothing in [None, Some("".into())] {
        assert_eq!(Processor::choose(nothing).unwrap(), *available.last().unwrap());
    }
    for processor in available {
        assert_eq!(Processor::choose(Some(processor.name().into())).unwrap(), processor);
    }
    for unknown in ["AVX2", "avx", "cuda", " "] {
        let error = Processor::choose(Some(unknown.into())).unwrap_err();
        assert!(matches!(error, Error::Unsupported(_)));
        let message = error.to_string();
        assert!(message.contains(&format!("RARE_CPU={unknown}")), "{message}");
        assert!(message.contains("portable"), "{message}");
    }
}
