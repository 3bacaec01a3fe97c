//! Normal noise that is the same on every machine.
//!
//! The polar method (Marsaglia and Bray: A convenient method for generating normal variables, 1964) over the
//! counter-based streams of [`Random`]. It needs a logarithm, and those of platforms differ in their last bits; ours is a
//! series of additions, multiplications and divisions, which IEEE 754 fixes to the bit.

use rare::random::Random;

/// Streams of noise begin here, so that no other use of the same seed draws the same numbers.
const FIRST_STREAM: u64 = 1 << 40;

/// The noise of one depth map.
#[derive(Debug, Clone, PartialEq)]
pub struct Noise {
    random: Random,
    second: Option<f64>,
}

impl Noise {
    /// The noise of the map that shows cloud `cloud` (0 reference, 1 source) in view `view`. Every map has its own, or,
    /// if `shared`, both clouds of a view have that of cloud 0.
    #[must_use]
    pub fn new(seed: u64, view: usize, cloud: usize, shared: bool) -> Noise {
        let cloud = if shared { 0 } else { cloud };
        let stream = FIRST_STREAM.wrapping_add(2 * view as u64 + cloud as u64);
        Noise { random: Random::new(seed, stream), second: None }
    }

    /// The next `count` values of mean 0 and variance 1.
    pub fn take(&mut self, count: usize) -> Vec<f32> {
        (0..count).map(|_| self.next() as f32).collect()
    }

    fn next(&mut self) -> f64 {
        if let Some(value) = self.second.take() {
            return value;
        }
        loop {
            let u = 2.0 * self.random.uniform() - 1.0;
            let v = 2.0 * self.random.uniform() - 1.0;
            let square = u * u + v * v;
            if square > 0.0 && square < 1.0 {
                let factor = (-2.0 * logarithm(square) / square).sqrt();
                self.second = Some(v * factor);
                return u * factor;
            }
        }
    }
}

/// The natural logarithm of a normal positive number, to about 1e-16 of the larger of itself and 1.
///
/// With `x = m * 2^e` and `m` near 1 it is `e * ln 2 + 2 artanh((m - 1) / (m + 1))`.
fn logarithm(x: f64) -> f64 {
    let bits = x.to_bits();
    let exponent = (bits >> 52) as i32 - 1023;
    let mantissa = f64::from_bits(bits & ((1 << 52) - 1) | 1.0_f64.to_bits());
    let (mantissa, exponent) = if mantissa > std::f64::consts::SQRT_2 {
        (0.5 * mantissa, exponent + 1)
    } else {
        (mantissa, exponent)
    };
    let z = (mantissa - 1.0) / (mantissa + 1.0);
    // |z| < 0.172, so what follows the term z^23 is below 1e-20.
    let series = (0..=11).rev().fold(0.0, |sum, k| sum * z * z + 1.0 / f64::from(2 * k + 1));
    f64::from(exponent) * std::f64::consts::LN_2 + 2.0 * z * series
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_logarithm_is_that_of_the_platform_but_for_rounding() {
        let mut random = Random::new(1, 0);
        for scale in [1.0, 1e-3, 1e-30, 1e30] {
            for _ in 0..1000 {
                let x = scale * (random.uniform() + 1e-9);
                let expected = libm::log(x);
                let bound = 3e-16 * expected.abs().max(1.0);
                assert!((logarithm(x) - expected).abs() <= bound, "{x}");
            }
        }
        assert_eq!(logarithm(1.0), 0.0);
    }

    #[test]
    fn the_first_values_are_these_on_every_machine() {
        let bits: Vec<u32> =
            Noise::new(0, 0, 0, false).take(6).iter().map(|x| x.to_bits()).collect();
        assert_eq!(
            bits,
            [
                3_187_624_845,
                3_205_269_146,
                3_217_813_583,
                3_212_747_295,
                3_213_506_390,
                3_206_609_298
            ]
        );
    }

    #[test]
    fn moments_and_tails_are_normal() {
        let count = 1 << 20;
        let values = Noise::new(3, 1, 0, false).take(count);
        let mean = |power: i32| {
            values.iter().map(|&x| f64::from(x).powi(power)).sum::<f64>() / count as f64
        };
        // Four standard deviations of each mean.
        for (power, expected, variance) in
            [(1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0), (6, 15.0, 10_170.0)]
        {
            let bound = 4.0 * f64::sqrt(variance / count as f64);
            assert!((mean(power) - expected).abs() < bound, "moment {power}: {}", mean(power));
        }
        for (limit, share) in
            [(1.0, 0.158_655), (2.0, 0.022_750), (3.0, 1.349_9e-3), (4.0, 3.167e-5)]
        {
            let bound = 4.0 * f64::sqrt(share / count as f64);
            for sign in [-1.0, 1.0] {
                let beyond = values.iter().filter(|&&x| sign * x > limit).count() as f64;
                assert!((beyond / count as f64 - share).abs() < bound, "{sign} {limit}: {beyond}");
            }
        }
        let lagged: f64 = values.windows(2).map(|pair| f64::from(pair[0] * pair[1])).sum();
        assert!((lagged / count as f64).abs() < 4.0 / 1024.0, "{lagged}");
    }

    #[test]
    fn maps_have_their_own_noise_unless_it_is_shared() {
        let first = |seed, view, cloud, shared| Noise::new(seed, view, cloud, shared).take(4);
        let all = [
            first(0, 0, 0, false),
            first(0, 0, 1, false),
            first(0, 1, 0, false),
            first(1, 0, 0, false),
        ];
        for (i, one) in all.iter().enumerate() {
            assert!(all[..i].iter().all(|other| other != one));
        }
        assert_eq!(first(0, 1, 1, true), first(0, 1, 0, true));
        assert_ne!(first(0, 1, 1, true), first(0, 0, 1, true));
    }
}
