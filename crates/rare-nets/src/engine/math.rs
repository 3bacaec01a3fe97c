//! Functions of sixteen numbers at once.

use super::simd::Simd;

/// `2^x` for `x` up to 127 (smaller than -126 counts as that), relative error below 2e-7: the power of the nearest
/// integer, times a polynomial of the rest (least squares with minimax weights, 7.5e-8).
#[inline(always)]
pub(super) fn exp2<S: Simd>(simd: S, x: S::Floats) -> S::Floats {
    const COEFFICIENTS: [f32; 5] = [0.009_675_541, 0.055_507_133, 0.240_221_2, 0.693_146_97, 1.0];
    let x = simd.max(x, simd.splat(-126.0));
    let whole = simd.round(x);
    let rest = simd.sub(x, whole);
    let mut power = simd.splat(0.001_327_647_1);
    for coefficient in COEFFICIENTS {
        power = simd.mul_add(power, rest, simd.splat(coefficient));
    }
    simd.mul(power, simd.power_of_two(whole))
}

/// `x * sigmoid(slope * x)`.
#[inline(always)]
pub(super) fn sigmoid_linear<S: Simd>(simd: S, x: S::Floats, slope: f32) -> S::Floats {
    let exponent = simd.mul(x, simd.splat(-slope * std::f32::consts::LOG2_E));

    // Beyond 2^126 the quotient is 0 for all that matters.
    let exponent = simd.min(exponent, simd.splat(126.0));
    simd.div(x, simd.add(simd.splat(1.0), exp2(simd, exponent)))
}

/// `erf(x)` for `x >= 0`, absolute error below 3e-7 (Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26).
#[inline(always)]
fn error_function<S: Simd>(simd: S, x: S::Floats) -> S::Floats {
    const COEFFICIENTS: [f32; 4] = [-1.453_152_1, 1.421_413_8, -0.284_496_72, 0.254_829_6];
    let one = simd.splat(1.0);
    let t = simd.div(one, simd.mul_add(x, simd.splat(0.327_591_1), one));
    let mut sum = simd.splat(1.061_405_4);
    for coefficient in COEFFICIENTS {
        sum = simd.mul_add(sum, t, simd.splat(coefficient));
    }
    let square = simd.mul(x, x);
    let decay = exp2(simd, simd.mul(square, simd.splat(-std::f32::consts::LOG2_E)));
    simd.sub(one, simd.mul(simd.mul(sum, t), decay))
}

/// `x * (1 + erf(x / sqrt 2)) / 2`.
#[inline(always)]
pub(super) fn gelu<S: Simd>(simd: S, x: S::Floats) -> S::Floats {
    let magnitude = simd.max(x, simd.sub(simd.splat(0.0), x));
    let argument = simd.mul(magnitude, simd.splat(std::f32::consts::FRAC_1_SQRT_2));
    // The error function is odd: x erf(x) = |x| erf(|x|).
    let odd = simd.mul(magnitude, error_function(simd, argument));
    simd.mul(simd.splat(0.5), simd.add(x, odd))
}
