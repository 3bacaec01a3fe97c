//! The gated recurrent unit (Cho et al., 2014).

use super::math::exp2;
use super::simd::{LANES, Simd, Vectorized};
use super::vectors::{load, store};

/// Updates the states of some rows, `width` numbers each: `b = (1 - g) * n + g * b` with
/// `r = sigmoid(i_r + h_r)`, `g = sigmoid(i_g + h_g)`, `n = tanh(i_n + r * h_n)`, where a row of `input` is
/// `i_r, i_g, i_n` and a row of `hidden` is `h_r, h_g, h_n`.
pub(super) struct GatedUpdate<'a> {
    pub(super) width: usize,
    pub(super) input: &'a [f32],
    pub(super) hidden: &'a [f32],
    pub(super) states: &'a mut [f32],
}

impl Vectorized for GatedUpdate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let width = self.width;
        let inputs = self.input.chunks_exact(3 * width);
        let hiddens = self.hidden.chunks_exact(3 * width);
        for ((state, input), hidden) in self.states.chunks_exact_mut(width).zip(inputs).zip(hiddens)
        {
            for start in (0..width).step_by(LANES) {
                let gate = |part: usize| {
                    let part = part * width..(part + 1) * width;
                    (load(simd, &input[part.clone()], start), load(simd, &hidden[part], start))
                };
                let ((i_r, h_r), (i_g, h_g), (i_n, h_n)) = (gate(0), gate(1), gate(2));
                let reset = sigmoid(simd, simd.add(i_r, h_r));
                let keep = sigmoid(simd, simd.add(i_g, h_g));
                let new = tanh(simd, simd.mul_add(reset, h_n, i_n));
                let old = load(simd, state, start);
                // (1 - g) n + g b = n + g (b - n)
                store(simd, simd.mul_add(keep, simd.sub(old, new), new), state, start);
            }
        }
    }
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
fn sigmoid<S: Simd>(simd: S, x: S::Floats) -> S::Floats {
    let exponent = simd.mul(x, simd.splat(-std::f32::consts::LOG2_E));
    // Beyond 2^126 the quotient is 0 for all that matters.
    let exponent = simd.min(exponent, simd.splat(126.0));
    let one = simd.splat(1.0);
    simd.div(one, simd.add(one, exp2(simd, exponent)))
}

/// `tanh(x) = 2 sigmoid(2 x) - 1`, absolute error below 3e-7.
#[inline(always)]
fn tanh<S: Simd>(simd: S, x: S::Floats) -> S::Floats {
    let two = simd.splat(2.0);
    simd.sub(simd.mul(two, sigmoid(simd, simd.mul(two, x))), simd.splat(1.0))
}

#[cfg(test)]
mod tests {
    use super::super::simd::Processor;
    use super::*;

    #[test]
    fn states_follow_the_definition() {
        let mut random = rare::random::Random::new(6, 0);
        let mut numbers = |count: usize, scale: f64| -> Vec<f32> {
            (0..count).map(|_| (scale * random.normal()) as f32).collect()
        };
        let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
        for (width, scale) in [(16, 1.0), (21, 3.0), (256, 100.0)] {
            let (input, hidden) = (numbers(6 * width, scale), numbers(6 * width, scale));
            let states = numbers(2 * width, 1.0);
            for processor in Processor::available() {
                let mut found = states.clone();
                let (input, hidden) = (&input, &hidden);
                processor.run(GatedUpdate { width, input, hidden, states: &mut found });
                for (at, &found) in found.iter().enumerate() {
                    let (row, column) = (at / width, at % width);
                    let place = |part: usize| (3 * row + part) * width + column;
                    let both =
                        |part| (f64::from(input[place(part)]), f64::from(hidden[place(part)]));
                    let [(i_r, h_r), (i_g, h_g), (i_n, h_n)] = [both(0), both(1), both(2)];
                    let (reset, keep) = (sigmoid(i_r + h_r), sigmoid(i_g + h_g));
                    let new = (i_n + reset * h_n).tanh();
                    let expected = (1.0 - keep) * new + keep * f64::from(states[at]);
                    // Measured 2.7e-7 (scores of 100 are known to 1e-5).
                    let error = (f64::from(found) - expected).abs();
                    assert!(error < 1e-6 * scale, "{width}: {found} {expected}");
                }
            }
        }
    }
}
