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
    depth: &Image,
    max_depth: f32,
    observe: &mut dyn FnMut(&'static str, &Image),
) -> Image {
    let mut step = |name, image: Image| {
        observe(name, &image);
        image
    };
    let inverted = step("invert", depth.clone().map(|depth| invert(depth, max_depth)));
    let dilated = step("dilate", dilate_by_range(depth, &inverted, max_depth));
    let closed = step("close", close_full::<5>(&dilated));
    let median = median5(&closed);
    let median =
        closed.zip_map(&median, |value, median| if value > EMPTY { median } else { value });
    let median = step("median", median);
    let extended = step("fill columns", fill::<9>(median.clone(), &below_top(&median)));
    let mask = step("top mask", below_top(&extended));
    let filled = (0..FILL_ROUNDS).fold(extended, |image, _| fill::<5>(image, &mask));
    let filled = step("fill gaps", filled);
    let valid =
        filled.clone().zip_map(&mask, |value, inside| if value > EMPTY { inside } else { 0.0 });
    let smooth = replace(filled.clone(), &valid, &median5(&filled));
    let smooth = step("second median", smooth);
    let bilateral = bilateral5(&smooth, SIGMA_VALUE, SIGMA_SPACE);
    let smooth = step("bilateral", replace(smooth, &valid, &bilateral));
    step("revert", smooth.map(|value| revert(value, max_depth)))
}

/// Dilates the far, middle and near range each with its own cross, near over middle over far.
fn dilate_by_range(depth: &Image, inverted: &Image, max_depth: f32) -> Image {
    let (near_end, middle_end) = (max_depth * 3.0 / 20.0, max_depth * 3.0 / 10.0);
    let range = |from: f32, to: f32| {
        inverted.clone().zip_map(
            depth,
            |value, depth| {
                if depth > from && depth <= to { value } else { 0.0 }
            },
        )
    };
    let over = |below: Image, above: Image| {
        below.zip_map(&above, |below, above| if above > EMPTY { above } else { below })
    };
    let far = over(inverted.clone(), dilate_cross::<3>(&range(middle_end, f32::INFINITY)));
    let middle = over(far, dilate_cross::<5>(&range(near_end, middle_end)));
    over(middle, dilate_cross::<7>(&range(EMPTY, near_end)))
}

/// 1 from the first filled pixel of each column downwards, 0 above it; 1 everywhere in a column that is wholly empty.
fn below_top(image: &Image) -> Image {
    let mut empty_column = vec![1.0_f32; image.width()];
    for y in 0..image.height() {
        for (empty, &value) in empty_column.iter_mut().zip(image.row(y)) {
            *empty = if value > EMPTY { 0.0 } else { *empty };
        }
    }
    let mut below = empty_column;
    image.build_rows(|y, mask| {
        for ((mask, below), &value) in mask.iter_mut().zip(&mut below).zip(image.row(y)) {
            *below = if value > EMPTY { 1.0 } else { *below };
            *mask = *below;
        }
    })
}

/// Empty pixels inside `mask` take the largest value of the `SIDE x SIDE` square around them.
fn fill<const SIDE: usize>(image: Image, mask: &Image) -> Image {
    let around = dilate_full::<SIDE>(&image);
    let gaps =
        image.clone().zip_map(mask, |value, inside| if value < EMPTY { inside } else { 0.0 });
    replace(image, &gaps, &around)
}

/// Takes the pixels of `other` where `mask` is 1.
fn replace(mut image: Image, mask: &Image, other: &Image) -> Image {
    let others = mask.values().iter().zip(other.values());
    for (value, (&inside, &other)) in image.values_mut().iter_mut().zip(others) {
        *value = if inside > 0.0 { other } else { *value };
    }
    image
}
