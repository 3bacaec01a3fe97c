//! What was typed.

mod eval;
mod icp;
mod weights;

use std::path::PathBuf;

use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;
use serde::Serialize;

pub(crate) use self::eval::{
    DatasetKind, EvalArgs, Format, ProtocolChoice, ScoreArgs, ScoringArgs,
};
pub(crate) use self::icp::{IcpArgs, TrimChoice};
#[cfg(feature = "fetch")]
pub(crate) use self::weights::FetchArgs;
pub(crate) use self::weights::{CheckArgs, WeightsArgs, WeightsCommand};
use crate::options::{InitMethod, Options, choice};

const EXAMPLES: &str = "\
Examples:
  rare demo
  rare register scan1.ply scan2.ply
  rare refine scan1.ply scan2.ply --init coarse.txt --output refined.txt --json evidence.json

The transform is printed as 4 lines of 4 numbers. It moves points of SRC into the frame of REF.
Coordinates are metres; angles are degrees.

Exit codes:
  0  the transform passed verification
  1  no transform can be trusted (a best guess is still written if there is one)
  2  the input or the options cannot be used";

const REGISTER_EXAMPLES: &str = "\
Examples:
  rare register scan1.ply scan2.ply > transform.txt
  rare register scan1.pcd scan2.pcd --save-aligned moved.ply --json evidence.json
  rare register 000000.bin 000010.bin --profile lidar
  rare register scan1.ply scan2.ply --backbone geotransformer --weights geotransformer-3dmatch.pth.tar
  rare register scan1.ply scan2.ply --init-method pointdsc --weights model_best.pkl";

const REFINE_EXAMPLES: &str = "\
Examples:
  rare refine scan1.ply scan2.ply --init coarse.txt > transform.txt
  rare refine a.ply b.ply --init b_to_a.txt --init-direction target-to-source
  rare refine a.ply b.ply --init 3dmatch.log:0,1 --source-features a.npz --reference-features b.npz
  rare refine a.ply b.ply --init coarse.txt --config indoor.toml --preset paper

Feature files are NPZ archives of `points` (N x 3, metres) and `features` (N x D).
Correspondences are `source` and `reference` (N x 3, metres) and optionally `score` (N).";

const FEATURES_EXAMPLES: &str = "\
Examples:
  rare features scan1.ply scan2.ply --init coarse.txt --output pair.npz
  rare refine scan1.ply scan2.ply --init coarse.txt --depth-features pair.npz
  rare features scan1.ply --output scan1.npz --encoder diffusion --weights sd15
  rare features scan1.ply --output scan1.npz --camera overlap
  rare features scan1.ply scan2.ply --backbone predator --weights indoor.pth --output pair.npz
  rare refine scan1.ply scan2.ply --init coarse.txt --source-features pair.npz --reference-features pair.npz

Of a pair, the features of all depth maps under the initial transform are written, for --depth-features.
Of one cloud, the features of its own depth maps are written at the points that they show: `points` (N x 3, metres)
and `features` (N x D), for --source-features and --reference-features.
With --backbone NETWORK, the keypoints, features, correspondences and transform that it finds for a pair are written,
for --source-features and --reference-features together, or for --correspondences.";

/// Register point clouds and refine given registrations, with a verdict on the result
#[derive(Debug, Parser)]
#[command(name = "rare", version, after_help = EXAMPLES)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Register two clouds of which nothing is known
    Register(RegisterArgs),
    /// Refine a given transform between two clouds
    Refine(RefineArgs),
    /// Align two clouds by a method of the ICP family, without the features and the verdict of `refine`
    Icp(IcpArgs),
    /// Write the dense features of the depth maps of a pair, or of one cloud at its points
    Features(FeaturesArgs),
    /// Say what is in cloud files, and which lengths would be used for them
    Info(InfoArgs),
    /// Write a cloud in another format
    Convert(ConvertArgs),
    /// Simulate two scans of a room, register them from a wrong start and compare with the truth
    Demo(DemoArgs),
    /// Get and check the weights of the diffusion features
    Weights(WeightsArgs),
    /// Compare methods on a benchmark; goes on where it was interrupted
    Eval(EvalArgs),
    /// Score results, or anybody's estimated transforms, by the protocols of the literature
    Score(ScoreArgs),
    /// Print the completion script of a shell
    Completions(CompletionsArgs),
}

/// The two clouds.
#[derive(Debug, Args)]
pub(crate) struct Clouds {
    /// The source: the cloud that is moved (.ply .pcd .xyz .npy .npz .bin .las .laz .e57; metres)
    #[arg(value_name = "SRC")]
    pub(crate) source: PathBuf,
    /// The reference (target): the cloud that stays; the transform leads from SRC to its frame
    #[arg(value_name = "REF")]
    pub(crate) reference: PathBuf,
}

#[derive(Debug, Args)]
#[command(after_help = REGISTER_EXAMPLES)]
pub(crate) struct RegisterArgs {
    #[command(flatten)]
    pub(crate) clouds: Clouds,
    /// How the initial transform is estimated; pointdsc and vbreg are networks and need --weights [default: sc2-pcr;
    /// with --backbone NETWORK: as its authors do]
    #[arg(long, value_name = "METHOD", value_parser = choice::<InitMethod>(&["ransac", "sc2-pcr", "sc2-pcr++", "mac", "fast-mac", "pointdsc", "vbreg"]))]
    pub(crate) init_method: Option<InitMethod>,
    #[command(flatten)]
    pub(crate) options: Options,
}

#[derive(Debug, Args)]
#[command(after_help = REFINE_EXAMPLES)]
pub(crate) struct RefineArgs {
    #[command(flatten)]
    pub(crate) clouds: Clouds,
    #[command(flatten)]
    pub(crate) start: Start,
    #[command(flatten)]
    pub(crate) options: Options,
}

/// What is refined.
#[derive(Debug, Args)]
pub(crate) struct Start {
    /// The initial transform: 4 x 4 text or NPY, a TUM line, a 3DMatch log (FILE.log:i,j), or JSON of this program
    #[arg(long, value_name = "FILE")]
    pub(crate) init: PathBuf,
    /// The direction in which the file holds it; source-to-target moves points of SRC into the frame of REF
    #[arg(long, value_name = "DIRECTION", value_enum, default_value_t = Direction::SourceToTarget)]
    pub(crate) init_direction: Direction,
    /// 3D keypoints of SRC with features (NPZ) in the place of the built-in ones
    #[arg(long, value_name = "FILE", requires = "reference_features")]
    pub(crate) source_features: Option<PathBuf>,
    /// 3D keypoints of REF with features (NPZ)
    #[arg(long, value_name = "FILE", requires = "source_features")]
    pub(crate) reference_features: Option<PathBuf>,
    /// Correspondences of another method (NPZ) in the place of matches of 3D features
    #[arg(long, value_name = "FILE", conflicts_with = "source_features")]
    pub(crate) correspondences: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = FEATURES_EXAMPLES)]
pub(crate) struct FeaturesArgs {
    /// The cloud, or the source of a pair (.ply .pcd .xyz .npy .npz .bin .las .laz .e57; metres)
    #[arg(value_name = "SRC")]
    pub(crate) source: PathBuf,
    /// The reference of a pair
    #[arg(value_name = "REF")]
    pub(crate) reference: Option<PathBuf>,
    /// The initial transform of the pair, in the formats of `rare refine`
    #[arg(long, value_name = "FILE", requires = "reference")]
    pub(crate) init: Option<PathBuf>,
    /// The direction in which the file holds it
    #[arg(long, value_name = "DIRECTION", value_enum, default_value_t = Direction::SourceToTarget)]
    pub(crate) init_direction: Direction,
    #[command(flatten)]
    pub(crate) options: Options,
}

/// The command line. `features` has the options of the commands that register, but writes one file of its own.
pub(crate) fn command() -> clap::Command {
    Cli::command()
        .mut_subcommand("features", |features| {
            ["json", "save_aligned", "report", "figures", "depth_features", "verbose"]
                .into_iter()
                .fold(features, |features, option| features.mut_arg(option, |arg| arg.hide(true)))
                .mut_arg("output", |output| output.help("Write the features (NPZ)"))
        })
        .mut_subcommand("eval", |eval| {
            ["json", "save_aligned", "figures", "depth_features", "verbose"]
                .into_iter()
                .fold(eval, |eval, option| eval.mut_arg(option, |arg| arg.hide(true)))
                .mut_arg("output", |output| {
                    output
                        .value_name("DIR")
                        .help("The folder of the results; made if it does not exist")
                })
                .mut_arg("report", |report| {
                    report.num_args(0).default_missing_value("index.html").help(
                        "Write a page of all pairs, index.html, and one of each that was refined",
                    )
                })
        })
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Direction {
    /// It moves points of SRC into the frame of REF
    SourceToTarget,
    /// It moves points of REF into the frame of SRC
    TargetToSource,
}

#[derive(Debug, Args)]
pub(crate) struct InfoArgs {
    /// The files
    #[arg(value_name = "CLOUD", required = true)]
    pub(crate) clouds: Vec<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct ConvertArgs {
    /// The cloud to read (.ply .pcd .xyz .npy .npz .bin .las .laz .e57)
    #[arg(value_name = "IN")]
    pub(crate) input: PathBuf,
    /// The file to write (.ply .pcd .xyz .npy); only the coordinates are kept
    #[arg(value_name = "OUT")]
    pub(crate) output: PathBuf,
}

#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// The folder for clouds and results; made if it does not exist
    #[arg(long, value_name = "DIR", default_value = "rare-demo")]
    pub(crate) output_dir: PathBuf,
    /// Write a page (HTML) that shows what was done; opens in any browser, needs no network
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
    /// Draw figures (PNG, print resolution) into a folder, which is made if it does not exist
    #[arg(long, value_name = "DIR")]
    pub(crate) figures: Option<PathBuf>,
    /// Which room is simulated
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Print nothing but the transform and errors
    #[arg(short, long)]
    pub(crate) quiet: bool,
}

#[derive(Debug, Args)]
pub(crate) struct CompletionsArgs {
    /// The shell
    pub(crate) shell: Shell,
}
