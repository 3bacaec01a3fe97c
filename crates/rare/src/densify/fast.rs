//! FreeReg's `fill_in_fast`: one set of structuring elements for all depths.

use super::EMPTY;
use super::{Image, bilateral5, close_full, dilate_diamond, dilate_full, invert, median5, revert};

/// Widths of the bilateral filter: metres of depth, pixels.
const SIGMA_VALUE: f32 = 1.5;
const SIGMA_SPACE: f32 = 2.0;

/// Densifies depths in metres; what stays empty ends below 0.1. `observe` sees the image after each step.
pub(super) fn densify(
    depth: Image,
    max_depth: f32,
    observe: &mut dyn FnMut(&'static str, &Image),
) -> Image {
    let mut step = |name, image: Image| {
        observe(name, &image);
        image
    };
    let inverted = step("invert", depth.map(|depth| invert(depth, max_depth)));
    let dilated = step("dilate", dilate_diamond(&inverted));
    let closed = step("close", close_full::<5>(&dilated));
    let around = dilate_full::<7>(&closed);
    let filled =
        closed.zip_map(&around, |value, around| if value < EMPTY { around } else { value });
    let filled = step("fill", filled);
    let median = step("median", median5(&filled));
    let smooth = step("bilateral", bilateral5(&median, SIGMA_VALUE, SIGMA_SPACE));
    step("revert", smooth.map(|value| revert(value, max_depth)))
}
