//! Separable resampling of pictures: each new pixel is a weighted sum of old ones, along rows and then along columns.

use std::f64::consts::PI;

use super::GrayImage;

/// The old pixels along one side that a new pixel is made of, and their weights, which sum to 1.
pub(super) type Taps = Vec<(usize, f32)>;

/// Lanczos' filter of 8 taps, for a side of `old` pixels (at least 1) that gets `new` ones.
pub(super) fn lanczos4(old: usize, new: usize) -> Vec<Taps> {
    let last = old as isize - 1;
    let taps = |index: usize| {
        let place = (index as f64 + 0.5) * old as f64 / new as f64 - 0.5;
        let first = place.floor() as isize - 3;
        let taps = (first..first + 8)
            .map(|tap| (tap.clamp(0, last) as usize, lanczos(place - tap as f64)))
            .collect();
        normalised(taps)
    };
    (0..new).map(taps).collect()
}

/// The mean of the covered area, for a side of `old` pixels (at least 1) that gets `new` ones.
pub(super) fn area(old: usize, new: usize) -> Vec<Taps> {
    let scale = old as f64 / new as f64;
    let taps = |index: usize| {
        let (from, to) = (index as f64 * scale, (index + 1) as f64 * scale);
        let first = (from as usize).min(old - 1);
        let covered = |tap: usize| (to.min((tap + 1) as f64) - from.max(tap as f64)).max(0.0);
        let taps = (first..old).take_while(|&tap| tap == first || (tap as f64) < to);
        normalised(taps.map(|tap| (tap, covered(tap))).collect())
    };
    (0..new).map(taps).collect()
}

/// Makes a picture of as many rows and columns as there are taps.
pub(super) fn resample(image: &GrayImage, rows: &[Taps], columns: &[Taps]) -> GrayImage {
    let along_rows: Vec<Vec<f32>> =
        image.values.chunks_exact(image.width).map(|row| resample_row(row, columns)).collect();
    let mut values = Vec::with_capacity(rows.len() * columns.len());
    let mut sums = vec![0.0_f32; columns.len()];
    for taps in rows {
        sums.fill(0.0);
        for &(tap, weight) in taps {
            for (sum, value) in sums.iter_mut().zip(&along_rows[tap]) {
                *sum += weight * value;
            }
        }
        values.extend(sums.iter().map(|sum| sum.round_ties_even() as u8));
    }
    GrayImage { width: columns.len(), height: rows.len(), values }
}

fn resample_row(row: &[u8], columns: &[Taps]) -> Vec<f32> {
    let pixel = |taps: &Taps| taps.iter().map(|&(tap, weight)| weight * f32::from(row[tap])).sum();
    columns.iter().map(pixel).collect()
}

/// sinc(x) sinc(x / 4) within four pixels.
fn lanczos(x: f64) -> f64 {
    let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
    if x.abs() < 4.0 { sinc(x) * sinc(x / 4.0) } else { 0.0 }
}

fn normalised(taps: Vec<(usize, f64)>) -> Taps {
    let total: f64 = taps.iter().map(|tap| tap.1).sum();
    taps.into_iter().map(|(tap, weight)| (tap, (weight / total) as f32)).collect()
}
