//! `rare eval paper`: the paper's tables on whatever data is there. A cell that cannot be filled says why.
//!
//! Below the root lie the benchmarks in any known layout, and in `features/NETWORK/BENCHMARK` what official runs of the
//! networks left: `SCENE/REF_SRC.npz` (GeoTransformer's `test.py`) or `SCENE/est.log`. Where there is nothing of a network,
//! but its weights were given, the network itself is run.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use rare::eval::dataset::{self, Dataset, KittiTruth};
use rare::eval::results::{self, ResultsFolder};
use rare::eval::{Comparison, MethodResult, Table};
use rare_nets::backbones::SelectionRule;
use rare_nets::networks::{Network, TrainedOn};

use super::listed;
use super::method::{Filters, Method};
use super::start::Starts;
use super::{Plan, work};
use crate::args::{EvalArgs, ScoringArgs};
use crate::backbone::OpenBackbone;
use crate::given_weights::GivenWeights;
use crate::options::{Backbone, Settings};
use crate::run::{print, score};
use crate::{SUCCESS, summary};

/// A table of the paper.
struct PaperTable {
    number: usize,
    caption: &'static str,
    benchmark: &'static str,
    rows: &'static [Row],
}

/// A row of a table: its name there, the network whose results are the start, and the method that makes it.
struct Row {
    name: &'static str,
    start: Network,
    /// A name of `--methods`, or why there is none.
    method: Result<&'static str, &'static str>,
}

const LAYERS: Result<&str, &str> = Err(
    "needs trained diffusion weights, and is not automatic with them: `rare refine --encoder diffusion --layers 0,3` takes any layers",
);

const fn row(
    name: &'static str,
    start: Network,
    method: Result<&'static str, &'static str>,
) -> Row {
    Row { name, start, method }
}

/// The rows of tables 1 and 2: estimators on the correspondences of GeoTransformer.
const ESTIMATORS: [Row; 9] = [
    row("RANSAC-50K", Network::GeoTransformer, Ok("ransac-50k")),
    row("RANSAC-1M", Network::GeoTransformer, Ok("ransac-1m")),
    row("SC2-PCR", Network::GeoTransformer, Ok("sc2-pcr")),
    row("PointDSC", Network::GeoTransformer, Ok("pointdsc")),
    row("VBReg", Network::GeoTransformer, Ok("vbreg")),
    row("SC2-PCR++", Network::GeoTransformer, Ok("sc2-pcr++")),
    row("MAC", Network::GeoTransformer, Ok("mac")),
    row("FastMAC", Network::GeoTransformer, Ok("fast-mac")),
    row("Ours", Network::GeoTransformer, Ok("refine")),
];

const TABLES: [PaperTable; 6] = [
    PaperTable {
        number: 1,
        caption: "Registration results on 3DMatch",
        benchmark: "3DMatch",
        rows: &ESTIMATORS,
    },
    PaperTable {
        number: 2,
        caption: "Registration results on 3DLoMatch",
        benchmark: "3DLoMatch",
        rows: &ESTIMATORS,
    },
    PaperTable {
        number: 3,
        caption: "Other methods, alone and refined, on 3DMatch",
        benchmark: "3DMatch",
        rows: &[
            row("FCGF", Network::Fcgf, Ok("init")),
            row("Predator", Network::Predator, Ok("init")),
            row("CoFiNet", Network::CoFiNet, Ok("init")),
            row("GeoTransformer", Network::GeoTransformer, Ok("init")),
            row("FCGF + Ours", Network::Fcgf, Ok("refine")),
            row("Predator + Ours", Network::Predator, Ok("refine")),
            row("CoFiNet + Ours", Network::CoFiNet, Ok("refine")),
            row("GeoTransformer + Ours", Network::GeoTransformer, Ok("refine")),
        ],
    },
    PaperTable {
        number: 4,
        caption: "Registration results on KITTI",
        benchmark: "KITTI",
        rows: &[
            row("GeoTransformer", Network::GeoTransformer, Ok("init")),
            row("RANSAC-50K", Network::GeoTransformer, Ok("ransac-50k")),
            row("SC2-PCR", Network::GeoTransformer, Ok("sc2-pcr")),
            row("PointDSC", Network::GeoTransformer, Ok("pointdsc")),
            row("VBReg", Network::GeoTransformer, Ok("vbreg")),
            row("MAC", Network::GeoTransformer, Ok("mac")),
            row("FastMAC", Network::GeoTransformer, Ok("fast-mac")),
            row("Ours", Network::GeoTransformer, Ok("refine")),
        ],
    },
    PaperTable {
        number: 5,
        caption: "Layers of the diffusion features",
        benchmark: "3DMatch",
        rows: &[
            row("0", Network::GeoTransformer, LAYERS),
            row("3", Network::GeoTransformer, LAYERS),
            row("6", Network::GeoTransformer, LAYERS),
            row("9", Network::GeoTransformer, LAYERS),
            row("0, 3", Network::GeoTransformer, LAYERS),
            row("0, 6", Network::GeoTransformer, LAYERS),
            row("0, 9", Network::GeoTransformer, LAYERS),
            row("0, 3, 6", Network::GeoTransformer, LAYERS),
            row("0, 3, 9", Network::GeoTransformer, LAYERS),
            row("0, 3, 6, 9", Network::GeoTransformer, LAYERS),
        ],
    },
    PaperTable {
        number: 6,
        caption: "Components",
        benchmark: "3DMatch",
        rows: &[
            row("GeoTransformer", Network::GeoTransformer, Ok("init")),
            row("w/o PCA", Network::GeoTransformer, Ok("refine-no-pca")),
            row("w/o Feature Transfer", Network::GeoTransformer, Ok("refine-no-transfer")),
            row("w/o Inlier Aggregation", Network::GeoTransformer, Ok("refine-no-aggregation")),
            row("Ours", Network::GeoTransformer, Ok("refine")),
        ],
    },
];

/// Everything that tables are made of.
struct Sources<'a> {
    args: &'a EvalArgs,
    settings: &'a Settings,
    weights: GivenWeights,
    /// Where the results are kept.
    folder: &'a Path,
}

/// Fills all tables as far as the data below the root and the weights go.
pub(super) fn run(args: &EvalArgs, settings: &Settings) -> Result<u8> {
    let Some(folder) = &settings.output else { bail!("the results need a folder: add --out DIR") };
    if let Some(backbone) = &settings.backbone {
        bail!(
            "--backbone {} is one network, the paper's tables have several: give --weights of each",
            backbone.network.name()
        );
    }
    let weights = GivenWeights::read(&settings.weights)?;
    weights.check_use(settings, &Network::ALL)?;
    let sources = Sources { args, settings, weights, folder };
    let mut tables = Vec::new();
    for table in &TABLES {
        tables.push(table.fill(&sources)?);
    }
    let text: Vec<String> = tables.iter().map(Table::to_text).collect();
    let markdown: Vec<String> = tables.iter().map(Table::to_markdown).collect();
    let latex: Vec<String> = tables.iter().map(Table::to_latex).collect();
    std::fs::create_dir_all(folder)?;
    for (name, content) in [("paper.txt", &text), ("paper.md", &markdown), ("paper.tex", &latex)] {
        score::write_text(&folder.join(name), &content.join("\n"))?;
    }
    print(&text.join("\n"))?;
    Ok(SUCCESS)
}

impl PaperTable {
    fn fill(&self, sources: &Sources<'_>) -> Result<Table> {
        summary::say(&format!("table {}: {}", self.number, self.caption));
        let dataset = read_benchmark(self.benchmark, sources.args);
        let mut filled = Table {
            caption: format!("Table {}: {}", self.number, self.caption),
            titles: ["Method", "RR ↑", "RE ↓", "TE ↓"].map(str::to_owned).to_vec(),
            ..Table::default()
        };
        for row in self.rows {
            let cells = match &dataset {
                Ok(dataset) => row.fill(dataset, sources, self.benchmark)?,
                Err(error) => Err(error.to_string()),
            };
            match cells {
                Ok(cells) => filled.rows.push(cells),
                Err(why) => {
                    let dashes = std::iter::repeat_n("-".to_owned(), 3);
                    filled.rows.push(std::iter::once(row.name.to_owned()).chain(dashes).collect());
                    filled.notes.push(format!("{}: not run: {why}", row.name));
                }
            }
        }
        filled.notes.dedup_by(|a, b| reason(a) == reason(b));
        Ok(filled)
    }
}

/// What follows the name of a row.
fn reason(note: &str) -> Option<&str> {
    note.split_once(": not run: ").map(|(_, why)| why)
}

fn read_benchmark(name: &str, args: &EvalArgs) -> Result<Dataset> {
    let mut dataset = match name {
        "KITTI" => dataset::read_kitti(&args.root, KittiTruth::from(args.kitti_gt))?,
        name => listed::read_three_d_match(&args.root, name)?,
    };
    dataset.pairs.truncate(args.limit.unwrap_or(usize::MAX));
    Ok(dataset)
}

/// What networks must have been trained on to be of use for a benchmark.
fn training_for(benchmark: &str) -> TrainedOn {
    match benchmark {
        "KITTI" => TrainedOn::Kitti,
        _ => TrainedOn::ThreeDMatch,
    }
}

impl Row {
    /// The cells of the row, or why there are none.
    fn fill(
        &self,
        dataset: &Dataset,
        sources: &Sources<'_>,
        benchmark: &str,
    ) -> Result<Result<Vec<String>, String>> {
        let method = match self.method {
            Ok(method) => method,
            Err(why) => return Ok(Err(why.to_owned())),
        };
        if let Some(why) = sources.lacks_filter(method, benchmark) {
            return Ok(Err(why));
        }
        let (starts, backbone) = match sources.starts(self.start, dataset, benchmark)? {
            Ok(found) => found,
            Err(why) => return Ok(Err(why)),
        };
        if starts.lack_correspondences() && needs_correspondences(method) {
            return Ok(Err(format!("{} has transforms, but no correspondences", self.start)));
        }
        let trained_on = Some(training_for(benchmark));
        let filters = Filters { weights: &sources.weights, trained_on };
        let methods = Method::parse_all(&[method.to_owned()], sources.settings, &filters)?;
        let pairs = (0..dataset.pairs.len()).collect();
        let plan = Plan {
            dataset: dataset.clone(),
            starts,
            methods,
            settings: sources.settings.clone(),
            backbone,
            filters: sources.weights.filters()?,
            pairs,
            jobs: usize::from(sources.args.jobs),
        };
        let results = ResultsFolder::begin(
            sources.folder.join(format!("{benchmark}-{}", self.start.name())),
            plan.benchmark()?,
        )?;
        work::finish(&plan, &results)?;
        let found: Vec<MethodResult> = results::merge(&[results])?
            .into_iter()
            .filter(|result| result.name == method)
            .collect();
        Ok(cells(&found, dataset, &sources.args.scoring, self.name))
    }
}

impl Sources<'_> {
    /// Where methods start with a network: from what official runs of it left, else from the network itself, if its
    /// weights are there. Otherwise why there is nothing.
    fn starts(
        &self,
        network: Network,
        dataset: &Dataset,
        benchmark: &str,
    ) -> Result<Result<(Starts, Option<OpenBackbone>), String>> {
        let root = &self.args.root;
        let features: PathBuf = root.join("features").join(network.name()).join(benchmark);
        if features.exists() {
            let starts = Starts::read(&features.to_string_lossy(), root, dataset);
            return Ok(starts.map(|starts| (starts, None)).map_err(|error| format!("{error:#}")));
        }
        let trained_on = training_for(benchmark);
        let Some(file) = self.weights.trained_on(network, trained_on) else {
            return Ok(Err(format!(
                "no --weights of {network} for {trained_on}, and no results of it in {}, as SCENE/REF_SRC.npz, N.pth or SCENE/est.log for every pair",
                features.display()
            )));
        };
        let backbone = Backbone {
            network,
            neighbour_limits: None,
            keypoints: self.settings.refiner.recipe.keypoints,
            rule: SelectionRule::default(),
        };
        let backbone = OpenBackbone::open(file, &backbone, self.settings)?;
        Ok(Ok((Starts::Described, Some(backbone))))
    }

    /// Why a network cannot tell right correspondences from wrong ones here, if the method is one.
    fn lacks_filter(&self, method: &str, benchmark: &str) -> Option<String> {
        let filters = [Network::PointDsc, Network::Vbreg];
        let network = filters.into_iter().find(|network| network.name() == method)?;
        let trained_on = training_for(benchmark);
        match self.weights.trained_on(network, trained_on) {
            Some(_) => None,
            None => Some(format!("no --weights of {network} for {trained_on}")),
        }
    }
}

/// Recall and errors of one method.
fn cells(
    found: &[MethodResult],
    dataset: &Dataset,
    scoring: &ScoringArgs,
    name: &str,
) -> Result<Vec<String>, String> {
    if found.iter().all(|result| result.pairs.iter().all(|pair| pair.errors.is_none())) {
        return Err("the method gave no transform for any pair".to_owned());
    }
    let comparisons: Vec<Comparison> = score::compare(found, dataset.protocol, scoring);
    let row = comparisons.first().and_then(|comparison| comparison.paper_table().rows.pop());
    let mut row = row.ok_or_else(|| "no result".to_owned())?;
    if let Some(first) = row.first_mut() {
        name.clone_into(first);
    }
    Ok(row)
}

/// Whether a method is of no use without correspondences of the network.
fn needs_correspondences(method: &str) -> bool {
    method != "init" && !method.starts_with("refine")
}
