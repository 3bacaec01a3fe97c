//! The layout of the diffusers library: a folder per part, with `config.json` and weights.

use std::path::{Path, PathBuf};

use rare::{Error, Result};

use super::files::{self, Json, Names};
use super::places::Places;
use super::{Network, TokenizerFiles, versions};
use crate::checkpoint::Parameters;
use crate::diffusion::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};

/// Folders in which a `ControlNet` may be; the empty name is a repository of a `ControlNet` itself.
const CONTROLNET_FOLDERS: [&str; 4] =
    ["controlnet", "control_v11f1p_sd15_depth", "sd-controlnet-depth", ""];

/// The U-Net; `None` if there is no folder `unet`.
pub(super) fn unet(places: &Places) -> Result<Option<Network<UnetConfig>>> {
    let Some(folder) = places.folder("unet") else { return Ok(None) };
    network(&folder, &files::DIFFUSION_MODEL, versions::unet).map(Some)
}

/// The text encoder.
pub(super) fn text_encoder(places: &Places) -> Result<Network<TextConfig>> {
    let Some(folder) = places.folder("text_encoder") else {
        return Err(places.missing("text encoder", "text_encoder/"));
    };
    let text = network(&folder, &files::TEXT_MODEL, versions::text_encoder)?;
    Ok(Network { parameters: with_text_prefix(text.parameters)?, ..text })
}

/// Version 5 of the transformers library leaves out the prefix that all files before it have.
pub(super) fn with_text_prefix(parameters: Parameters) -> Result<Parameters> {
    if !parameters.contains("embeddings.token_embedding.weight") {
        return Ok(parameters);
    }
    parameters.renamed(|name| Some(format!("text_model.{name}")))
}

/// The `ControlNet`; `None` if there is none in this layout.
pub(super) fn controlnet(places: &Places) -> Result<Option<Network<ControlNetConfig>>> {
    for name in CONTROLNET_FOLDERS {
        for folder in &places.folders {
            let folder = if name.is_empty() { folder.clone() } else { folder.join(name) };
            if folder.join("config.json").is_file() {
                return network(&folder, &files::DIFFUSION_MODEL, versions::controlnet).map(Some);
            }
        }
    }
    Ok(None)
}

/// The noise schedule, and the file that says it.
pub(super) fn scheduler(places: &Places) -> Result<(SchedulerConfig, Option<PathBuf>)> {
    const NAME: &str = "scheduler/scheduler_config.json";
    let Some(path) = places.file(NAME) else { return Err(places.missing("noise schedule", NAME)) };
    let json = Json::read(path)?;
    Ok((versions::scheduler(&json)?, Some(json.path)))
}

/// The files of the tokenizer, in their folder or beside everything else; none where neither is there, as with single
/// weight files.
pub(super) fn tokenizer(places: &Places) -> Result<Option<TokenizerFiles>> {
    let file = |name: &str| places.file(&format!("tokenizer/{name}")).or_else(|| places.file(name));
    match (file("vocab.json"), file("merges.txt")) {
        (Some(vocabulary), Some(merges)) => Ok(Some(TokenizerFiles { vocabulary, merges })),
        (None, None) => Ok(None),
        (None, _) => Err(places.missing("tokenizer", "tokenizer/vocab.json and vocab.json")),
        (_, None) => Err(places.missing("tokenizer", "tokenizer/merges.txt and merges.txt")),
    }
}

/// One network of a folder.
fn network<C>(
    folder: &Path,
    names: &Names,
    read_config: fn(&Json) -> Result<C>,
) -> Result<Network<C>> {
    let config_file = folder.join("config.json");
    if !config_file.is_file() {
        let what =
            "there is no config.json beside the weights: take the whole folder of the repository";
        return Err(Error::in_file(folder, what));
    }
    let json = Json::read(config_file)?;
    let config = read_config(&json)?;
    let weights = files::weights(folder, names)?;
    let parameters = Parameters::open(&weights)?;
    Ok(Network { parameters, config, config_file: Some(json.path) })
}
