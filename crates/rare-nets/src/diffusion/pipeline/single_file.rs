//! The layout of the original code: one file for U-Net and text encoder (and more that is not needed), one for the
//! `ControlNet`, no configurations. The sizes are those of the tensors; what tensors do not show is that of Stable
//! Diffusion 1.x.
//!
//! Left out knowingly: the running averages of training (`model_ema.`), the image decoder (`first_stage_model.`) and the
//! tables of the noise schedule.

use std::path::{Path, PathBuf};

use rare::{Error, Result};

use super::places::{Places, entries};
use super::{Network, ldm_names, versions};
use crate::checkpoint::Parameters;
use crate::diffusion::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};

const UNET: &str = "model.diffusion_model.";
const TEXT: &str = "cond_stage_model.transformer.";
const CONTROLNET: &str = "control_model.";

/// Attention heads of the U-Net at every level.
const HEADS: usize = 8;
/// Groups of its normalisations.
const GROUPS: usize = 32;
/// Attention heads of CLIP ViT-L/14.
const TEXT_HEADS: usize = 12;

/// U-Net, text encoder and noise schedule (with the file that says it: none).
type Base = (Network<UnetConfig>, Network<TextConfig>, (SchedulerConfig, Option<PathBuf>));

/// The parts in the file of the base model.
pub(super) fn base(places: &Places) -> Result<Base> {
    let Some(path) = find(places, &["v1-5", "sd-v1-5", "stable-diffusion-v1-5"], &[""]) else {
        let looked_for =
            "unet/ and v1-5-pruned.safetensors, v1-5-pruned-emaonly.safetensors or .ckpt";
        return Err(places.missing("Stable Diffusion 1.5", looked_for));
    };
    let file = Parameters::open(&path)?;
    refuse_other_models(&path, &file)?;
    let unet = file.clone().renamed(|name| ldm_names::unet(name.strip_prefix(UNET)?))?;
    let text = file.renamed(|name| name.strip_prefix(TEXT).map(str::to_owned))?;
    let network =
        Network { config: unet_config(&path, &unet)?, parameters: unet, config_file: None };
    let text = Network { config: text_config(&path, &text)?, parameters: text, config_file: None };
    Ok((network, text, (SchedulerConfig::stable_diffusion_1(), None)))
}

/// The `ControlNet`. Its file may contain the base model as well, as those of the first release do, or may already use the
/// names of the diffusers library.
pub(super) fn controlnet(places: &Places) -> Result<Network<ControlNetConfig>> {
    let folders = ["", "controlnet/", "control_v11f1p_sd15_depth/", "sd-controlnet-depth/"];
    let Some(path) = find(places, &["control_v11f1p_sd15_depth", "control_sd15_depth"], &folders)
    else {
        let looked_for = "controlnet/, control_v11f1p_sd15_depth/, sd-controlnet-depth/ with config.json, and control_v11f1p_sd15_depth.safetensors, control_sd15_depth.safetensors or .pth";
        return Err(places.missing("depth ControlNet", looked_for));
    };
    let file = Parameters::open(&path)?;
    let prefixed = file.names().any(|name| name.starts_with(CONTROLNET));
    let parameters = if file.contains("controlnet_mid_block.weight") {
        file
    } else if prefixed {
        file.renamed(|name| ldm_names::controlnet(name.strip_prefix(CONTROLNET)?))?
    } else {
        file.renamed(ldm_names::controlnet)?
    };
    let config = controlnet_config(&path, &parameters)?;
    Ok(Network { parameters, config, config_file: None })
}

/// The sizes of the `ControlNet`.
fn controlnet_config(path: &Path, parameters: &Parameters) -> Result<ControlNetConfig> {
    let hint = |part: &str, axis| {
        size(path, parameters, &format!("controlnet_cond_embedding.{part}.weight"), axis)
    };
    let hint_channels = hint("conv_in", 1)?;
    if hint_channels != 3 {
        let what = format!("the ControlNet takes images of {hint_channels} channels, expected 3");
        return Err(Error::in_file(path, what));
    }
    Ok(ControlNetConfig {
        unet: unet_config(path, parameters)?,
        hint_channels,
        hint_embedding_channels: [
            hint("conv_in", 0)?,
            hint("blocks.1", 0)?,
            hint("blocks.3", 0)?,
            hint("blocks.5", 0)?,
        ],
    })
}

/// The first file whose name begins with one of `starts`: in the order of the places, then of the folders in them, then of
/// the starts, safetensors first, shorter names first (so that the original wins over variants of it).
fn find(places: &Places, starts: &[&str], folders: &[&str]) -> Option<PathBuf> {
    const ENDS: [&str; 5] = [".safetensors", ".ckpt", ".pth", ".pt", ".bin"];
    for place in &places.folders {
        for folder in folders.iter().map(|folder| place.join(folder)) {
            let names = entries(&folder).unwrap_or_default();
            let rank = |name: &String| {
                let start = starts.iter().position(|start| name.starts_with(start))?;
                let end = ENDS.iter().position(|end| name.ends_with(end))?;
                Some((start, end, name.len()))
            };
            let ranked = names.iter().filter_map(|name| Some((rank(name)?, name)));
            if let Some((_, name)) = ranked.min() {
                return Some(folder.join(name));
            }
        }
    }
    None
}

/// Files of later models have the same prefix, but other parts.
fn refuse_other_models(path: &Path, file: &Parameters) -> Result<()> {
    for (start, model) in [
        ("conditioner.embedders.", "Stable Diffusion XL"),
        ("model.diffusion_model.label_emb.", "Stable Diffusion XL"),
        ("cond_stage_model.model.", "Stable Diffusion 2.x"),
        ("model.diffusion_model.joint_blocks.", "Stable Diffusion 3"),
    ] {
        if file.names().any(|name| name.starts_with(start)) {
            return Err(Error::Unsupported(format!(
                "{}: the file holds {model} ({start}*): only Stable Diffusion 1.x is implemented",
                path.display()
            )));
        }
    }
    Ok(())
}

/// The sizes of the half that U-Net and `ControlNet` share.
fn unet_config(path: &Path, parameters: &Parameters) -> Result<UnetConfig> {
    let size = |name: &str, axis| size(path, parameters, name, axis);
    let level = |level: usize| size(&format!("down_blocks.{level}.resnets.0.conv1.weight"), 0);
    let block_out_channels = [level(0)?, level(1)?, level(2)?, level(3)?];
    let in_channels = size("conv_in.weight", 1)?;
    let context = "down_blocks.0.attentions.0.transformer_blocks.0.attn2.to_k.weight";
    let config = UnetConfig {
        in_channels,
        block_out_channels,
        heads: HEADS,
        cross_attention_dim: size(context, 1)?,
        // Networks that are too narrow for the usual number have the largest that fits.
        groups: block_out_channels
            .iter()
            .fold(GROUPS, |groups, &channels| common_divisor(groups, channels)),
    };
    let unsupported = |what: String| {
        Error::Unsupported(format!(
            "{}: {what}: only Stable Diffusion 1.x is implemented",
            path.display()
        ))
    };
    if in_channels != 4 {
        return Err(unsupported(format!(
            "the network takes {in_channels} channels, expected 4 (inpainting models take 9)"
        )));
    }
    let projection = parameters.shape("down_blocks.0.attentions.0.proj_in.weight");
    if projection.is_some_and(|shape| shape.len() == 2) {
        return Err(unsupported("linear projections, as Stable Diffusion 2.x has".to_owned()));
    }
    versions::check_sizes(&config).map_err(unsupported)?;
    Ok(config)
}

/// The sizes of the text encoder.
fn text_config(path: &Path, parameters: &Parameters) -> Result<TextConfig> {
    let size = |name: &str, axis| size(path, parameters, name, axis);
    let hidden_size = size("text_model.embeddings.token_embedding.weight", 1)?;
    let layers = (0..)
        .take_while(|layer| {
            parameters.contains(&format!("text_model.encoder.layers.{layer}.mlp.fc1.weight"))
        })
        .count();
    if !hidden_size.is_multiple_of(TEXT_HEADS) {
        let what = format!("the text encoder gives {hidden_size} values per token, expected 768");
        return Err(Error::in_file(path, what));
    }
    Ok(TextConfig {
        hidden_size,
        intermediate_size: size("text_model.encoder.layers.0.mlp.fc1.weight", 0)?,
        heads: TEXT_HEADS,
        layers,
        vocabulary: size("text_model.embeddings.token_embedding.weight", 0)?,
        positions: size("text_model.embeddings.position_embedding.weight", 0)?,
        epsilon: 1e-5,
    })
}

/// One size of a tensor that must be there.
fn size(path: &Path, parameters: &Parameters, name: &str, axis: usize) -> Result<usize> {
    let size = parameters.shape(name).and_then(|shape| shape.get(axis).copied());
    match size {
        Some(size @ 1..) => Ok(size),
        _ => Err(Error::in_file(
            path,
            format!(
                "the file lacks what Stable Diffusion 1.x calls {name} in the diffusers library: another model, or only a part of one"
            ),
        )),
    }
}

/// The greatest common divisor.
fn common_divisor(a: usize, b: usize) -> usize {
    if b == 0 { a } else { common_divisor(b, a % b) }
}
