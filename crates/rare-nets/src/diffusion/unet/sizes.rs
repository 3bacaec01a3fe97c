//! Which sizes a U-Net can have.

use rare::{Error, Result};

use crate::diffusion::UnetConfig;
use crate::engine::Shape;

/// How often the latent image is halved, as a factor.
const COARSEST: usize = 8;

/// The groups and heads must divide the channels of all levels, and the time embedding wants an even number of them.
///
/// # Errors
/// `InvalidInput` with the first size that does not fit.
pub(crate) fn check_config(config: &UnetConfig) -> Result<()> {
    for channels in config.block_out_channels {
        for (parts, of) in [(config.groups, "groups"), (config.heads, "heads"), (2, "halves")] {
            if channels == 0 || parts == 0 || !channels.is_multiple_of(parts) {
                return Err(Error::invalid(format!(
                    "a U-Net cannot have a level of {channels} channels in {parts} {of}: the configuration is damaged or of another network than Stable Diffusion 1.5"
                )));
            }
        }
    }
    if config.in_channels == 0 || config.cross_attention_dim == 0 {
        return Err(Error::invalid(format!(
            "a U-Net cannot have {} latent channels and a text of width {}: the configuration is damaged",
            config.in_channels, config.cross_attention_dim
        )));
    }
    Ok(())
}

/// A latent image must have the channels of the network and be divisible by 8, so that the decoder half meets the sizes
/// of the encoder half again.
///
/// # Errors
/// `Internal` with the sizes.
pub(crate) fn check_latents(latents: Shape, config: &UnetConfig) -> Result<()> {
    let divisible =
        latents.height.is_multiple_of(COARSEST) && latents.width.is_multiple_of(COARSEST);
    if latents.values() == 0 || !divisible || latents.channels != config.in_channels {
        return Err(Error::Internal(format!(
            "latent images {latents:?}: height and width must be multiples of {COARSEST}, and {} the number of channels",
            config.in_channels
        )));
    }
    Ok(())
}
