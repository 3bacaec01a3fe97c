//! Finding the parts of Stable Diffusion 1.5 and its depth `ControlNet` in a folder, whatever its layout.
//!
//! Three layouts are known, and each part may come in another one:
//! * the folders of the diffusers library: `unet/`, `text_encoder/`, `tokenizer/`, `scheduler/` and, beside them or on
//!   its own, the `ControlNet` (`folder`);
//! * the single files of the original code: `v1-5-pruned-emaonly.safetensors`, `control_v11f1p_sd15_depth.pth`
//!   (`single_file`, `ldm_names`);
//! * the cache of the Hugging Face hub, whose snapshots are folders of the first or second kind (`places`).
//!
//! What the networks do not implement is refused by name before any weight is read (`versions`). What no file says cannot
//! be checked: a `ControlNet` for something other than depth has the same tensors as one for depth.

mod files;
mod folder;
mod ldm_names;
mod places;
mod remark;
mod single_file;
mod versions;

use std::path::{Path, PathBuf};

use rare::{Error, Result};

use self::places::Places;
use super::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};
use crate::checkpoint::Parameters;

/// Everything that the diffusion features need, found and checked, but with no weight read yet.
#[derive(Debug)]
pub struct Pipeline {
    /// Weights of the denoising network.
    pub unet: Parameters,
    /// Its sizes.
    pub unet_config: UnetConfig,
    /// Weights of the network that sees the depth image.
    pub controlnet: Parameters,
    /// Its sizes.
    pub controlnet_config: ControlNetConfig,
    /// Weights of the text encoder.
    pub text_encoder: Parameters,
    /// Its sizes.
    pub text_config: TextConfig,
    /// The noise schedule.
    pub scheduler: SchedulerConfig,
    /// What turns a prompt into tokens, where the folder has it; the prompts of the presets do without.
    pub tokenizer: Option<TokenizerFiles>,
    /// A sentence that says that these are not trained weights, where the folder or the sizes give it away.
    pub remark: Option<String>,
    /// All files that the pipeline is made of, sorted.
    pub files: Vec<PathBuf>,
}

/// The two files of the byte-pair encoding of CLIP.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenizerFiles {
    /// `vocab.json`: the number of each token.
    pub vocabulary: PathBuf,
    /// `merges.txt`: the pairs that are joined, the most frequent first.
    pub merges: PathBuf,
}

/// One network: its weights, its sizes, and the files that say so.
#[derive(Debug)]
struct Network<C> {
    parameters: Parameters,
    config: C,
    /// The `config.json`; none for a single file.
    config_file: Option<PathBuf>,
}

impl Pipeline {
    /// Opens the pipeline in `folder`.
    ///
    /// Of several files with the same weights, those in full precision win over the variant `fp16`, then safetensors over
    /// pickles; a folder of the diffusers library wins over a single file.
    ///
    /// # Errors
    /// `InvalidInput` if a part is missing (the message says what was looked for), a file is malformed or truncated, or the
    /// parts do not belong together; `Unsupported` if the weights are of another model than Stable Diffusion 1.x or a
    /// setting differs from what the networks implement; `Io` if a file cannot be read.
    pub fn open(folder: &Path) -> Result<Pipeline> {
        let places = Places::open(folder)?;
        versions::check_model_index(&places)?;
        let (unet, text, scheduler) = match folder::unet(&places)? {
            Some(unet) => (unet, folder::text_encoder(&places)?, folder::scheduler(&places)?),
            None => single_file::base(&places)?,
        };
        let controlnet = match folder::controlnet(&places)? {
            Some(controlnet) => controlnet,
            None => single_file::controlnet(&places)?,
        };
        check_together(&unet, &controlnet, &text)?;
        let tokenizer = folder::tokenizer(&places)?;
        let remark = remark::remark(&places, &unet, &controlnet, &text);
        let of_tokenizer =
            |files: &TokenizerFiles| [files.vocabulary.clone(), files.merges.clone()];
        let mut files: Vec<PathBuf> = tokenizer.iter().flat_map(of_tokenizer).collect();
        files.extend(scheduler.1);
        files.extend(unet.files());
        files.extend(controlnet.files());
        files.extend(text.files());
        files.sort();
        files.dedup();
        Ok(Pipeline {
            unet: unet.parameters,
            unet_config: unet.config,
            controlnet: controlnet.parameters,
            controlnet_config: controlnet.config,
            text_encoder: text.parameters,
            text_config: text.config,
            scheduler: scheduler.0,
            tokenizer,
            remark,
            files,
        })
    }
}

impl<C> Network<C> {
    /// The weights and the `config.json`.
    fn files(&self) -> impl Iterator<Item = PathBuf> + '_ {
        self.parameters.files().iter().cloned().chain(self.config_file.clone())
    }

    /// The file to name in a message about the sizes.
    fn named_file(&self) -> PathBuf {
        self.files().last().unwrap_or_default()
    }
}

/// The `ControlNet` must be made for this U-Net, and the text encoder must give what both take.
fn check_together(
    unet: &Network<UnetConfig>,
    controlnet: &Network<ControlNetConfig>,
    text: &Network<TextConfig>,
) -> Result<()> {
    let (ours, theirs) = (&unet.config, &controlnet.config.unet);
    if ours != theirs {
        return Err(Error::in_file(
            controlnet.named_file(),
            format!(
                "a ControlNet for another model: it has {}, but the U-Net in {} has {}",
                shown(theirs),
                unet.named_file().display(),
                shown(ours)
            ),
        ));
    }
    if text.config.hidden_size != ours.cross_attention_dim {
        return Err(Error::in_file(
            text.named_file(),
            format!(
                "the text encoder gives {} values per token, but the U-Net in {} takes {}: they are of different models",
                text.config.hidden_size,
                unet.named_file().display(),
                ours.cross_attention_dim
            ),
        ));
    }
    Ok(())
}

/// The sizes in words, for a message.
fn shown(config: &UnetConfig) -> String {
    format!(
        "{} latent channels, channels {:?}, {} heads, a context of {}, {} groups",
        config.in_channels,
        config.block_out_channels,
        config.heads,
        config.cross_attention_dim,
        config.groups
    )
}
