//! The bilateral filter of step 2, by its formula.

use std::ops::Range;

use std::f32::consts::LOG2_E;

use super::image::Image;

/// The taps within two pixels of the middle but for the middle itself, by the rows of the 5 x 5 window: column and
/// squared distance.
const TAPS: [&[(usize, f32)]; 5] = [
    &[(2, 4.0)],
    &[(1, 2.0), (2, 1.0), (3, 2.0)],
    &[(0, 4.0), (1, 1.0), (3, 1.0), (4, 4.0)],
    &[(1, 2.0), (2, 1.0), (3, 2.0)],
    &[(2, 4.0)],
];

/// Where the pixel `index - 2` of a side is taken from: pixels outside mirror those inside without repeating the edge,
/// `dcb|abcd|cba`.
fn reflect(index: usize, side: usize) -> usize {
    let last = side.saturating_sub(1);
    let inside = index.abs_diff(2);
    let mirrored = if inside > last { (2 * last).saturating_sub(inside) } else { inside };
    mirrored.min(last)
}

/// Averages each pixel with those within two pixels (`OpenCV`'s diameter 5), each weighted by
/// exp(-distance^2 / (2 `sigma_space`^2) - difference^2 / (2 `sigma_value`^2)); pixels outside mirror those inside.
///
/// `sigma_space` is in pixels, `sigma_value` in the unit of the values.
pub fn bilateral5(image: &mut Image, sigma_value: f32, sigma_space: f32) {
    let by_value = -LOG2_E / (2.0 * sigma_value * sigma_value);
    let by_distance = -LOG2_E / (2.0 * sigma_space * sigma_space);
    let mut padded = vec![0.0; image.width() + 4];
    let mut weights = vec![0.0; image.width()];
    let extents: Vec<Range<usize>> = (0..image.height()).map(|y| extent(image.row(y))).collect();
    image.rewrite_rows(|image, y, sums| {
        let centres = image.row(y);
        sums.copy_from_slice(centres);
        // Where all taps are 0 so is their mean; half-empty images are the rule.
        let rows = (0..5).map(|row| &extents[reflect(y + row, image.height())]);
        let columns =
            rows.fold(image.width()..0, |all, row| all.start.min(row.start)..all.end.max(row.end));
        let columns = columns.start.saturating_sub(2)..(columns.end + 2).min(image.width());
        if columns.is_empty() {
            return;
        }
        let (centres, sums) = (&centres[columns.clone()], &mut sums[columns.clone()]);
        let weights = &mut weights[columns.clone()];
        weights.fill(1.0);
        for (row, taps) in TAPS.iter().enumerate() {
            pad(image.row(reflect(y + row, image.height())), &mut padded);
            for &(column, squared_distance) in *taps {
                let offset = by_distance * squared_distance;
                let weight = |difference| exp2(by_value * difference * difference + offset);
                add_tap(&padded[columns.start + column..], centres, sums, weights, weight);
            }
        }
        for (sum, &mut weight) in sums.iter_mut().zip(weights) {
            *sum /= weight;
        }
    });
}

/// The columns from the first to the last value that is not 0; `width..0` if there is none.
fn extent(row: &[f32]) -> Range<usize> {
    let first = row.iter().position(|&value| value != 0.0);
    let last = row.iter().rposition(|&value| value != 0.0);
    first.unwrap_or(row.len())..last.map_or(0, |last| last + 1)
}

/// Copies a row with two more pixels on each side.
fn pad(row: &[f32], padded: &mut [f32]) {
    let width = row.len();
    padded[2..2 + width].copy_from_slice(row);
    for outside in [0, 1, width + 2, width + 3] {
        padded[outside] = row[reflect(outside, width)];
    }
}

/// Adds a tap of each pixel to the weighted sums.
fn add_tap(
    taps: &[f32],
    centres: &[f32],
    sums: &mut [f32],
    weights: &mut [f32],
    weight: impl Fn(f32) -> f32,
) {
    let totals = sums.iter_mut().zip(weights);
    for ((sum, total), (&tap, &centre)) in totals.zip(taps.iter().zip(centres)) {
        let weight = weight(tap - centre);
        *sum += weight * tap;
        *total += weight;
    }
}

/// 2 to the power of `x <= 0`, to 2e-7 of the value; what is below 2^-126 becomes 2^-126.
///
/// A polynomial for the fraction, the exponent's bits for the whole part: unlike the library's function it has no
/// branch and no call, so that a loop over it becomes vector instructions.
#[inline(always)]
fn exp2(x: f32) -> f32 {
    // 1.5 * 2^23: adding it leaves the nearest whole number in the low bits of the mantissa.
    const ROUND: f32 = 12_582_912.0;
    let x = if x > -126.0 { x } else { -126.0 };
    let rounded = x + ROUND;
    let fraction = (x - (rounded - ROUND)) * std::f32::consts::LN_2;
    // The series of the exponential; |fraction| <= ln(2) / 2, so the first term left out is below 2e-7.
    let power = 1.0
        + fraction
            * (1.0
                + fraction
                    * (1.0 / 2.0
                        + fraction
                            * (1.0 / 6.0
                                + fraction
                                    * (1.0 / 24.0
                                        + fraction * (1.0 / 120.0 + fraction * (1.0 / 720.0))))));
    let exponent = rounded.to_bits().wrapping_sub(ROUND.to_bits()) << 23;
    f32::from_bits(power.to_bits().wrapping_add(exponent))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_two_are_those_of_the_library() {
        for i in 0..126_000 {
            let x = -(i as f32) / 1000.0;
            assert!((exp2(x) / x.exp2() - 1.0).abs() < 4e-7, "{x}");
        }
        assert_eq!(exp2(f32::NEG_INFINITY), f32::MIN_POSITIVE);
        assert_eq!(exp2(-1e9), f32::MIN_POSITIVE);
    }
}
