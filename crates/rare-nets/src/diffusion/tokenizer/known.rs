//! The tokens of the default prompts.

use crate::diffusion::settings::{INDOOR_PROMPT, NEGATIVE_PROMPT, STREET_PROMPT};

/// CLIP's token at the start of a prompt.
pub(super) const START: u32 = 49406;

/// CLIP's token at the end of a prompt.
pub(super) const END: u32 = 49407;

const INDOOR: [u32; 13] = [320, 1125, 539, 320, 1530, 267, 7993, 267, 12412, 6207, 267, 949, 3027];

const STREET: [u32; 22] = [
    320, 5299, 3934, 1125, 539, 2012, 1093, 267, 4682, 267, 3346, 267, 1047, 267, 1212, 267, 1759,
    267, 2390, 267, 949, 3027,
];

const NEGATIVE: [u32; 13] =
    [1049, 934, 267, 2103, 15376, 267, 2103, 3500, 267, 31139, 267, 5719, 3027];

/// The tokens of a text without start and end.
pub(super) fn text_tokens(text: &str) -> Option<&'static [u32]> {
    match text {
        INDOOR_PROMPT => Some(&INDOOR),
        STREET_PROMPT => Some(&STREET),
        NEGATIVE_PROMPT => Some(&NEGATIVE),
        "" => Some(&[]),
        _ => None,
    }
}
