//! What was typed after `rare icp`.

use std::path::PathBuf;

use clap::Args;
use rare::pose::{IcpMethod, RobustKernel};

use super::{Clouds, Direction};
use crate::options::choice;

const EXAMPLES: &str = "\
Examples:
  rare icp scan1.ply scan2.ply --init coarse.txt > transform.txt
  rare icp scan1.ply scan2.ply --method gicp --voxel 0.05 --json evidence.json
  rare icp scan1.ply scan2.ply --init coarse.txt --kernel huber --trim auto

ICP believes the initial transform and can make it worse; `rare refine` verifies what it does.
The exit code is 1 if the last round still moved the cloud, or the surfaces leave a motion open.";

#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct IcpArgs {
    #[command(flatten)]
    pub(crate) clouds: Clouds,
    /// The initial transform, in the formats of `rare refine` [default: none, the clouds stay as they are]
    #[arg(long, value_name = "FILE")]
    pub(crate) init: Option<PathBuf>,
    /// The direction in which the file holds it
    #[arg(long, value_name = "DIRECTION", value_enum, default_value_t = Direction::SourceToTarget)]
    pub(crate) init_direction: Direction,
    /// Which distances are made small
    #[arg(long, value_name = "METHOD", default_value = "point-to-plane", value_parser = method())]
    pub(crate) method: IcpMethod,
    /// How distances lose weight as they grow
    #[arg(long, value_name = "KERNEL", default_value = "tukey", value_parser = choice::<RobustKernel>(&["none", "huber", "tukey", "cauchy", "geman-mcclure"]))]
    pub(crate) kernel: RobustKernel,
    /// The share of the source that has a counterpart (above 0, at most 1), `auto` to estimate it, or `off`
    #[arg(long, value_name = "SHARE", default_value = "off", value_parser = trim)]
    pub(crate) trim: TrimChoice,
    /// Voxel size of the finest scale, metres [default: as `rare info` says]
    #[arg(long, value_name = "METRES")]
    pub(crate) voxel: Option<f64>,
    /// Scales, each twice as fine as the one before
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=8))]
    pub(crate) scales: u8,
    /// At most so many rounds in each of the three stages of a scale
    #[arg(long, value_name = "N", default_value_t = 30)]
    pub(crate) iterations: usize,
    /// Write the transform (source -> reference) as 4 lines of 4 numbers
    #[arg(long, alias = "out", value_name = "FILE")]
    pub(crate) output: Option<PathBuf>,
    /// Write the transform with all evidence and settings as JSON
    #[arg(long, value_name = "FILE")]
    pub(crate) json: Option<PathBuf>,
    /// Write the source cloud moved into the frame of the reference (.ply .pcd .xyz .npy)
    #[arg(long, value_name = "FILE")]
    pub(crate) save_aligned: Option<PathBuf>,
    /// Number of threads; the result does not depend on it [default: all cores]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub(crate) threads: usize,
    /// Print nothing but the transform and errors
    #[arg(short, long)]
    pub(crate) quiet: bool,
}

/// How much of the source is aligned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum TrimChoice {
    Off,
    Auto,
    Share(f64),
}

/// The methods by the names that they go by.
fn method() -> impl clap::builder::TypedValueParser<Value = IcpMethod> {
    use clap::builder::{PossibleValuesParser, TypedValueParser};
    let names = ["point-to-point", "point-to-plane", "symmetric", "gicp", "vgicp"];
    PossibleValuesParser::new(names).map(|name| match name.as_str() {
        "point-to-point" => IcpMethod::PointToPoint,
        "symmetric" => IcpMethod::Symmetric,
        "gicp" => IcpMethod::Generalised,
        "vgicp" => IcpMethod::VoxelisedGeneralised,
        _ => IcpMethod::PointToPlane,
    })
}

fn trim(text: &str) -> Result<TrimChoice, String> {
    match (text, text.parse::<f64>()) {
        ("off", _) => Ok(TrimChoice::Off),
        ("auto", _) => Ok(TrimChoice::Auto),
        (_, Ok(share)) if share > 0.0 && share <= 1.0 => Ok(TrimChoice::Share(share)),
        _ => Err("expected off, auto, or a share above 0 and at most 1".to_owned()),
    }
}
