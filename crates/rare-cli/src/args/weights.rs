//! What was typed after `rare weights`.

use std::path::PathBuf;

use clap::{Args, Subcommand};
#[cfg(feature = "fetch")]
use rare_nets::weights::{ControlNetVersion, Precision};

#[cfg(feature = "fetch")]
use crate::options::choice;

#[cfg(feature = "fetch")]
const FETCH_EXAMPLES: &str = "\
Examples:
  rare weights fetch
  rare weights fetch weights --precision f32
  HF_TOKEN=... rare weights fetch

The folder is printed. A download that broke off is continued. What is there already, or in the
cache of the hub, is verified instead of downloaded again. Nothing is overwritten.

Environment:
  HF_HOME, HF_HUB_CACHE  where the cache of the hub is [default: ~/.cache/huggingface]
  HF_ENDPOINT            the server [default: https://huggingface.co]
  HF_TOKEN               who asks, where the server wants to know
  HF_HUB_OFFLINE=1       no network: the cache is all there is";

#[derive(Debug, Args)]
pub(crate) struct WeightsArgs {
    #[command(subcommand)]
    pub(crate) command: WeightsCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum WeightsCommand {
    /// List what can be used, and what of it has been verified
    List,
    /// Download the weights of the diffusion features into a folder
    #[cfg(feature = "fetch")]
    Fetch(FetchArgs),
    /// Say which network a checkpoint is of and whether it is whole; or compare a folder with the record that was made when
    /// it was fetched, and open it
    Check(CheckArgs),
}

#[cfg(feature = "fetch")]
#[derive(Debug, Args)]
#[command(after_help = FETCH_EXAMPLES)]
pub(crate) struct FetchArgs {
    /// The folder; made if it does not exist [default: a folder beside the cache of the hub]
    #[arg(value_name = "DIR")]
    pub(crate) folder: Option<PathBuf>,
    /// The precision of the weight files: f16 has half the bytes
    #[arg(long, value_name = "PRECISION", default_value_t, value_parser = choice::<Precision>(&["f16", "f32"]))]
    pub(crate) precision: Precision,
    /// The release of the depth ControlNet
    #[arg(long, value_name = "VERSION", default_value_t, value_parser = choice::<ControlNetVersion>(&["v1.1", "v1.0"]))]
    pub(crate) controlnet: ControlNetVersion,
    /// The server [default: that of the environment, else the hub itself]
    #[arg(long, value_name = "URL")]
    pub(crate) endpoint: Option<String>,
    /// Print nothing but the folder and errors
    #[arg(short, long)]
    pub(crate) quiet: bool,
}

#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// A checkpoint, or a folder [default: the one that `rare weights fetch` makes]
    #[arg(value_name = "FILE|DIR")]
    pub(crate) path: Option<PathBuf>,
}
