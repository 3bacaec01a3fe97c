//! Whether a folder gives away that its weights are not trained.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::Network;
use super::places::Places;
use crate::diffusion::{ControlNetConfig, TextConfig, UnetConfig};

/// What a note about untrained weights contains. The plain words "random" and "not trained" also occur in the
/// descriptions of the trained models.
const PHRASES: [&str; 8] = [
    "untrained",
    "random weights",
    "random numbers",
    "random values",
    "randomly initiali",
    "random initiali",
    "weights are random",
    "weights are not trained",
];

/// Bytes of a text that are searched.
const SEARCHED: u64 = 1 << 16;

/// A sentence about weights that are not those of Stable Diffusion 1.5, if there is a sign of it.
pub(super) fn remark(
    places: &Places,
    unet: &Network<UnetConfig>,
    controlnet: &Network<ControlNetConfig>,
    text: &Network<TextConfig>,
) -> Option<String> {
    let mut files: Vec<_> =
        ["README.md", "model_index.json"].iter().filter_map(|name| places.file(name)).collect();
    let configs = [&unet.config_file, &controlnet.config_file, &text.config_file];
    files.extend(configs.into_iter().flatten().cloned());
    let noted = files.iter().find_map(|file| Some((file.display(), phrase(&read_start(file))?)));
    if let Some((file, phrase)) = noted {
        return Some(format!(
            "{file} says \"{phrase}\": these are not trained weights, and their features mean nothing"
        ));
    }
    let metadata =
        [unet.parameters.metadata(), controlnet.parameters.metadata(), text.parameters.metadata()];
    let noted = metadata.iter().flat_map(|texts| texts.values()).find_map(|text| phrase(text));
    if let Some(phrase) = noted {
        return Some(format!(
            "a weight file says \"{phrase}\": these are not trained weights, and their features mean nothing"
        ));
    }
    other_sizes(&unet.config)
}

/// Trained weights of Stable Diffusion 1.5 have one set of sizes only.
fn other_sizes(config: &UnetConfig) -> Option<String> {
    let (channels, context) = (config.block_out_channels, config.cross_attention_dim);
    if channels == [320, 640, 1280, 1280] && context == 768 {
        return None;
    }
    Some(format!(
        "these cannot be the trained weights of Stable Diffusion 1.5: the channels are {channels:?} with a context of {context}, not [320, 640, 1280, 1280] with 768"
    ))
}

fn phrase(text: &str) -> Option<&'static str> {
    let text = text.to_lowercase();
    PHRASES.into_iter().find(|phrase| text.contains(phrase))
}

/// The beginning of a text file; empty if it cannot be read, which is no reason to refuse the weights.
fn read_start(path: &Path) -> String {
    let mut bytes = Vec::new();
    if let Ok(file) = File::open(path)
        && file.take(SEARCHED).read_to_end(&mut bytes).is_err()
    {
        bytes.clear();
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
