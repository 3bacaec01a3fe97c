//! Functions of sixteen numbers at once.

use super::simd::Simd;

/// `2^x` for `x` up to 127 (smaller than -126 counts as that), relative error below 2.5e-7: the power of the nearest
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

#[cfg(test)]
mod tests {
    use super::super::simd::{LANES, Processor, Simd, Vectorized};
    use super::{exp2, gelu, sigmoid_linear};

    #[derive(Clone, Copy)]
    enum Function {
        Exp2,
        SigmoidLinear(f32),
        Gelu,
    }

    /// Puts the function in the place of its arguments.
    struct Evaluation<'a>(Function, &'a mut [f32]);

    impl Vectorized for Evaluation<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            for lanes in self.1.as_chunks_mut::<LANES>().0 {
                let x = simd.load(lanes);
                let value = match self.0 {
                    Function::Exp2 => exp2(simd, x),
                    Function::SigmoidLinear(slope) => sigmoid_linear(simd, x, slope),
                    Function::Gelu => gelu(simd, x),
                };
                simd.store(value, lanes);
            }
        }
    }

    /// Evenly spread, and far out.
    fn arguments(first: f32, last: f32, extremes: &[f32]) -> Vec<f32> {
        let count = if cfg!(miri) { 400 } else { 40_000 };
        let step = (f64::from(last) - f64::from(first)) / f64::from(count - 1);
        let even = (0..count).map(|index| (f64::from(first) + f64::from(index) * step) as f32);
        let signed = extremes.iter().flat_map(|&value| [value, -value]);
        let mut all: Vec<f32> = even.chain(signed).collect();
        all.resize(all.len().next_multiple_of(LANES), 0.0);
        all
    }

    /// The largest error on any processor, relative to what `size` gives for argument and expected value.
    fn error(
        function: Function,
        arguments: &[f32],
        expected: impl Fn(f64) -> f64,
        size: impl Fn(f64, f64) -> f64,
    ) -> f64 {
        let mut largest: f64 = 0.0;
        for processor in Processor::available() {
            let mut found = arguments.to_vec();
            processor.run(Evaluation(function, &mut found));
            for (&x, &found) in arguments.iter().zip(&found) {
                assert!(found.is_finite(), "{found} at {x}");
                let (x, found) = (f64::from(x), f64::from(found));
                let expected = expected(x);
                largest = largest.max((found - expected).abs() / size(x, expected));
            }
        }
        largest
    }

    #[test]
    fn powers_of_two_have_single_precision() {
        let arguments = arguments(-126.0, 127.0, &[0.5, 1e-30, 126.5]);
        let clamped = |x: f64| x.max(-126.0).exp2();
        let error = error(Function::Exp2, &arguments, clamped, |_, expected| expected);
        // Measured 2.33e-7.
        assert!(error < 2.5e-7, "{error:e}");
    }

    #[test]
    fn powers_far_below_are_the_smallest_normal_number() {
        let far = [-126.0, -127.0, -150.0, -1e3, -1e30, f32::MIN];
        let far: Vec<f32> = far.into_iter().cycle().take(LANES).collect();
        let error = error(Function::Exp2, &far, |_| f64::from(f32::MIN_POSITIVE), |_, size| size);
        assert!(error == 0.0, "{error:e}");
    }

    #[test]
    fn sigmoid_linear_units_have_single_precision() {
        let extremes = [1e-38, 1e-20, 60.0, 87.0, 88.0, 89.0, 100.0, 1e4, 1e30];
        let arguments = arguments(-30.0, 30.0, &extremes);
        for slope in [1.0, 1.702] {
            let expected = |x: f64| x / (1.0 + (-f64::from(slope) * x).exp());
            let size = |x: f64, _| x.abs().max(1.0);
            let error = error(Function::SigmoidLinear(slope), &arguments, expected, size);
            // Measured 1.2e-7.
            assert!(error < 1.5e-7, "{error:e}");
        }
    }

    #[test]
    fn sigmoid_linear_units_keep_small_results() {
        let arguments = arguments(-80.0, 80.0, &[1e-38, 1e-20]);
        let expected = |x: f64| x / (1.0 + (-x).exp());
        let size = |_, expected: f64| expected.abs().max(1e-38);
        let error = error(Function::SigmoidLinear(1.0), &arguments, expected, size);
        // Measured 3.8e-6: the exponent is known to 2^-24 of its 115.
        assert!(error < 5e-6, "{error:e}");
    }

    #[test]
    fn gaussian_error_linear_units_have_their_stated_error() {
        let arguments = arguments(-10.0, 10.0, &[1e-38, 1e-20, 12.0, 13.5, 20.0, 1e4, 1e30, 1e38]);
        let expected = |x: f64| 0.5 * x * (1.0 + libm::erf(x / std::f64::consts::SQRT_2));
        let size = |x: f64, _| x.abs().max(1.0);
        let error = error(Function::Gelu, &arguments, expected, size);
        // Measured 1.5e-7.
        assert!(error < 2e-7, "{error:e}");
    }
}
