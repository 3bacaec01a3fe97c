//! FreeReg's `fill_in_multiscale`: near points are spread wider than far ones, because the gaps between the rings of
//! a LiDAR are wider there, and every column is filled below its highest point.

use super::{
    EMPTY, Image, bilateral5, close_full, dilate_cross, dilate_full, invert, median5, revert,
};

/// Widths of the bilateral filter: metres of depth, pixels.
const SIGMA_VALUE: f32 = 0.5;
const SIGMA_SPACE: f32 = 2.0;

/// How many times gaps take the largest value within two pixels.
const FILL_ROUNDS: usize = 6;

/// Densifies depths in metres; what stays empty ends below 0.1. `observe` sees the image after each step.
pub(super) fn densify(
    image: &mut Image,
    max_depth: f32,
    observe: &mut dyn FnMut(&'static str, &Image),
) {
    let depth = image.clone();
    // What a filter makes of the image, where only some pixels take it.
    let mut filtered = image.clone();
    image.map(|depth| invert(depth, max_depth));
    observe("invert", image);
    dilate_by_range(image, &depth, &mut filtered, max_depth);
    observe("dilate", image);
    close_full::<5>(image);
    observe("close", image);
    filtered.copy_from(image);
    median5(&mut filtered);
    image.zip_map(&filtered, |value, median| if value > EMPTY { median } else { value });
    observe("median", image);
    let mut mask = depth;
    fill_columns(image, &mut mask, &mut filtered, observe);
    smooth(image, &mut mask, &mut filtered, observe);
    image.map(|value| revert(value, max_depth));
    observe("revert", image);
}

/// Dilates the far, middle and near range each with its own cross, near over middle over far.
fn dilate_by_range(image: &mut Image, depth: &Image, range: &mut Image, max_depth: f32) {
    let (near_end, middle_end) = (max_depth * 3.0 / 20.0, max_depth * 3.0 / 10.0);
    let mut spread = |from: f32, to: f32, dilate: fn(&mut Image)| {
        range.copy_from(depth);
        range.map(|depth| if depth > from && depth <= to { invert(depth, max_depth) } else { 0.0 });
        dilate(range);
        image.zip_map(range, |value, dilated| if dilated > EMPTY { dilated } else { value });
    };
    spread(middle_end, f32::INFINITY, dilate_cross::<3>);
    spread(near_end, middle_end, dilate_cross::<5>);
    spread(EMPTY, near_end, dilate_cross::<7>);
}

/// Fills the gaps below the highest pixel of each column, first far, then near; leaves in `mask` where that is.
fn fill_columns(
    image: &mut Image,
    mask: &mut Image,
    filtered: &mut Image,
    observe: &mut dyn FnMut(&'static str, &Image),
) {
    below_top(image, mask);
    fill::<9>(image, mask, filtered);
    observe("fill columns", image);
    below_top(image, mask);
    observe("top mask", mask);
    for _ in 0..FILL_ROUNDS {
        fill::<5>(image, mask, filtered);
    }
    observe("fill gaps", image);
}

/// Smooths the pixels inside `mask` that are filled by now.
fn smooth(
    image: &mut Image,
    mask: &mut Image,
    filtered: &mut Image,
    observe: &mut dyn FnMut(&'static str, &Image),
) {
    mask.zip_map(image, |inside, value| if value > EMPTY { inside } else { 0.0 });
    filtered.copy_from(image);
    median5(filtered);
    replace(image, mask, filtered);
    observe("second median", image);
    filtered.copy_from(image);
    bilateral5(filtered, SIGMA_VALUE, SIGMA_SPACE);
    replace(image, mask, filtered);
    observe("bilateral", image);
}

/// Writes 1 from the first filled pixel of each column downwards and 0 above it; 1 everywhere in a column that is
/// wholly empty.
fn below_top(image: &Image, mask: &mut Image) {
    let mut below = vec![1.0_f32; image.width()];
    for y in 0..image.height() {
        for (empty, &value) in below.iter_mut().zip(image.row(y)) {
            *empty = if value > EMPTY { 0.0 } else { *empty };
        }
    }
    mask.rewrite_rows(|_, y, row| {
        for ((inside, below), &value) in row.iter_mut().zip(&mut below).zip(image.row(y)) {
            *below = if value > EMPTY { 1.0 } else { *below };
            *inside = *below;
        }
    });
}

/// Empty pixels inside `mask` take the largest value of the `SIDE x SIDE` square around them.
fn fill<const SIDE: usize>(image: &mut Image, mask: &Image, around: &mut Image) {
    around.copy_from(image);
    dilate_full::<SIDE>(around);
    around.zip_map(mask, |value, inside| value * inside);
    image.zip_map(
        around,
        |value, around| if value < EMPTY && around > 0.0 { around } else { value },
    );
}

/// Takes the pixels of `other` where `mask` is 1.
fn replace(image: &mut Image, mask: &Image, other: &Image) {
    let others = mask.values().iter().zip(other.values());
    for (value, (&inside, &other)) in image.values_mut().iter_mut().zip(others) {
        *value = if inside > 0.0 { other } else { *value };
    }
}
