//! FreeReg's `fill_in_fast`: one set of structuring elements for all depths.

use super::EMPTY;
use super::{Image, bilateral5, close_full, dilate_diamond, dilate_full, invert, median5, revert};

/// Widths of the bilateral filter: metres of depth, pixels.
const SIGMA_VALUE: f32 = 1.5;
const SIGMA_SPACE: f32 = 2.0;

/// Densifies depths in metres; what stays empty ends below 0.1. `observe` sees the image after each step.
pub(super) fn densify(
    image: &mut Image,
    max_depth: f32,
    observe: &mut dyn FnMut(&'static str, &Image),
) {
    image.map(|depth| invert(depth, max_depth));
    observe("invert", image);
    dilate_diamond(image);
    observe("dilate", image);
    close_full::<5>(image);
    observe("close", image);
    let mut around = image.clone();
    dilate_full::<7>(&mut around);
    image.zip_map(&around, |value, around| if value < EMPTY { around } else { value });
    observe("fill", image);
    median5(image);
    observe("median", image);
    bilateral5(image, SIGMA_VALUE, SIGMA_SPACE);
    observe("bilateral", image);
    image.map(|value| revert(value, max_depth));
    observe("revert", image);
}
