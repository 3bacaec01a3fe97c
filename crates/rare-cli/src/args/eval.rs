//! What was typed after `rare eval` and `rare score`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use rare::eval::Protocol;
use rare::eval::dataset::KittiTruth;

use crate::options::{Options, choice};

const SCORE_EXAMPLES: &str = "\
Examples:
  rare score results
  rare score shard0 shard1 --protocol all
  rare score --est cofinet/5000 --gt benchmarks/3DMatch --protocol predator

DIR is a folder that `rare eval` made; several are shards of one evaluation.
--est has a folder per scene with est.log, --gt a folder per scene with gt.log and gt.info.
Every number that is published with a known trap is given as published; the exact one stands beside.";

const EVAL_EXAMPLES: &str = "\
Examples:
  rare eval folder redkitchen --init init_ransac.json --out results
  rare eval folder redkitchen --pairs pairs_lo.json --init sc2-pcr --methods init,refine,gicp --out results
  rare eval folder redkitchen --init init_ransac.json --out results --jobs 4 --shard 0/2
  rare eval 3dmatch data --init cofinet/5000 --out results
  rare eval kitti data --limit 20 --out results
  rare eval 3dmatch data --backbone geotransformer --weights geotransformer-3dmatch.pth.tar --out results
  rare eval paper data --weights geotransformer-3dmatch.pth.tar --weights predator/indoor.pth --out paper

Every result is written as soon as it is known: the same command goes on where it was interrupted.";

#[derive(Debug, Args)]
#[command(after_help = SCORE_EXAMPLES)]
pub(crate) struct ScoreArgs {
    /// Folders of results
    #[arg(value_name = "DIR", required_unless_present = "est", conflicts_with_all = ["est", "gt"])]
    pub(crate) results: Vec<PathBuf>,
    /// A folder of estimated transforms
    #[arg(long, value_name = "DIR", requires = "gt")]
    pub(crate) est: Option<PathBuf>,
    /// The folder of their truth
    #[arg(long, value_name = "DIR", requires = "est")]
    pub(crate) gt: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) scoring: ScoringArgs,
    /// Let pairs that an est.log lacks count as failures
    #[arg(long, requires = "est")]
    pub(crate) missing_as_failures: bool,
    /// How the tables are printed
    #[arg(long, value_name = "FORMAT", value_enum, default_value_t = Format::Text)]
    pub(crate) format: Format,
    /// Write tables (text, Markdown, CSV, JSON, LaTeX) and plots into a folder
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// How results are scored.
#[derive(Debug, Clone, Args)]
pub(crate) struct ScoringArgs {
    /// Whose numbers are to be compared with; all prints every one [default: that of the dataset; for --est predator]
    #[arg(long, value_name = "PROTOCOL", value_parser = choice::<ProtocolChoice>(&["predator", "dgr", "kitti-2m", "kitti-60cm", "plain", "all"]))]
    pub(crate) protocol: Option<ProtocolChoice>,
    /// The errors of a solved pair, degrees and metres, in the place of the protocol's
    #[arg(long, value_name = "DEGREES,METRES", value_parser = success)]
    pub(crate) success: Option<(f64, f64)>,
    /// Count the first pair of a scene, which Predator's script leaves out if it is not consecutive
    #[arg(long)]
    pub(crate) count_first_pair: bool,
    /// Measure against the rigid transform nearest to the truth, not against the truth as printed
    #[arg(long)]
    pub(crate) rigid_truth: bool,
}

/// One protocol or all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ProtocolChoice {
    All,
    One(Protocol),
}

impl<'de> serde::Deserialize<'de> for ProtocolChoice {
    fn deserialize<D: serde::Deserializer<'de>>(
        deserializer: D,
    ) -> Result<ProtocolChoice, D::Error> {
        let name = String::deserialize(deserializer)?;
        if name == "all" {
            return Ok(ProtocolChoice::All);
        }
        let protocol = Protocol::ALL.into_iter().find(|protocol| protocol.name() == name);
        protocol
            .map(ProtocolChoice::One)
            .ok_or_else(|| serde::de::Error::custom("no such protocol"))
    }
}

fn success(text: &str) -> Result<(f64, f64), String> {
    let limit = |text: &str| text.trim().parse::<f64>().ok().filter(|limit| *limit > 0.0);
    text.split_once(',')
        .and_then(|(rotation, translation)| Some((limit(rotation)?, limit(translation)?)))
        .ok_or_else(|| "expected two positive numbers, degrees and metres: 15,0.3".to_owned())
}

/// How tables are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    Text,
    Markdown,
    Csv,
    Json,
    Latex,
}

#[derive(Debug, Args)]
#[command(after_help = EVAL_EXAMPLES)]
pub(crate) struct EvalArgs {
    /// How the benchmark lies on disk
    #[arg(value_name = "DATASET", value_enum)]
    pub(crate) dataset: DatasetKind,
    /// Its folder
    #[arg(value_name = "ROOT")]
    pub(crate) root: PathBuf,
    /// The initial transforms: a JSON file of the folder layout, an est.log, a folder of scenes
    /// with est.log or with what official runs left, or how they are
    /// estimated (sc2-pcr, ransac, ...) [default: sc2-pcr; with --backbone NETWORK: its own]
    #[arg(long, value_name = "FILE|DIR|METHOD")]
    pub(crate) init: Option<String>,
    /// What is compared, separated by commas
    #[arg(long, value_name = "METHODS", value_delimiter = ',', default_value = "init,refine")]
    pub(crate) methods: Vec<String>,
    /// The list of pairs of the folder layout
    #[arg(long, value_name = "FILE", default_value = "pairs.json")]
    pub(crate) pairs: String,
    /// The key of the true transform in that list
    #[arg(long, value_name = "KEY", default_value = "gt")]
    pub(crate) truth: String,
    /// Which truth of KITTI
    #[arg(long, value_name = "TRUTH", value_enum, default_value_t = KittiGt::Official)]
    pub(crate) kitti_gt: KittiGt,
    /// Only the first pairs
    #[arg(long, value_name = "N")]
    pub(crate) limit: Option<usize>,
    /// Only every n-th pair, beginning with the i-th (from 0): the results of all shards are put together by `rare score`
    #[arg(long, value_name = "i/n", value_parser = shard)]
    pub(crate) shard: Option<(usize, usize)>,
    /// Pairs worked on at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: u16,
    #[command(flatten)]
    pub(crate) scoring: ScoringArgs,
    #[command(flatten)]
    pub(crate) options: Options,
}

/// Layouts of benchmarks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[expect(clippy::doc_markdown, reason = "help texts show their words as they are")]
pub(crate) enum DatasetKind {
    /// cloud_bin_N.ply, lists of pairs and initial transforms as JSON
    Folder,
    /// 3DMatch: gt.log and gt.info of each scene, fragments as .pth or .ply
    #[value(name = "3dmatch")]
    ThreeDMatch,
    /// 3DLoMatch: the same with the pairs of 10 to 30 % overlap
    #[value(name = "3dlomatch")]
    ThreeDLoMatch,
    /// The tables of the paper, as far as the data goes: these benchmarks, and features/NETWORK/BENCHMARK with what official runs of the networks left, or --weights of the networks
    Paper,
    /// KITTI odometry: sequences 8, 9 and 10, scans as velodyne/*.bin
    Kitti,
}

/// Which truth of KITTI.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum KittiGt {
    /// One calibration for all sequences, and the refined transforms of icp/*.npy where they are
    Official,
    /// The poses with each sequence's calib.txt
    Exact,
}

impl From<KittiGt> for KittiTruth {
    fn from(truth: KittiGt) -> KittiTruth {
        match truth {
            KittiGt::Official => KittiTruth::Official,
            KittiGt::Exact => KittiTruth::Exact,
        }
    }
}

fn shard(text: &str) -> Result<(usize, usize), String> {
    text.split_once('/')
        .and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)))
        .filter(|(index, count)| index < count)
        .ok_or_else(|| "expected i/n with i from 0 to n - 1: 0/4".to_owned())
}
