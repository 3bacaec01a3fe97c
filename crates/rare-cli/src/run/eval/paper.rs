//! `rare eval paper`: the paper's tables on whatever data is there. A cell that cannot be filled says why.
//!
//! Below the root lie the benchmarks in any known layout, and in `features/NETWORK/BENCHMARK` what official runs of the
//! networks left: `SCENE/REF_SRC.npz` (GeoTransformer's `test.py`) or `SCENE/est.log`.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use rare::eval::dataset::{self, Dataset, KittiTruth};
use rare::eval::results::{self, ResultsFolder};
use rare::eval::{Comparison, MethodResult, Table};

use super::listed;
use super::method::Method;
use super::start::Starts;
use super::{Plan, work};
use crate::args::{EvalArgs, ScoringArgs};
use crate::options::Settings;
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
    start: &'static str,
    /// A name of `--methods`, or why there is none.
    method: Result<&'static str, &'static str>,
}

const LEARNED: Result<&str, &str> =
    Err("needs trained weights and a network that this version does not have");
const LAYERS: Result<&str, &str> = Err(
    "needs trained diffusion weights, and is not automatic with them: `rare refine --encoder diffusion --layers 0,3` takes any layers",
);

const fn row(
    name: &'static str,
    start: &'static str,
    method: Result<&'static str, &'static str>,
) -> Row {
    Row { name, start, method }
}

/// The rows of tables 1 and 2: estimators on the correspondences of GeoTransformer.
const ESTIMATORS: [Row; 9] = [
    row("RANSAC-50K", "geotransformer", Ok("ransac-50k")),
    row("RANSAC-1M", "geotransformer", Ok("ransac-1m")),
    row("SC2-PCR", "geotransformer", Ok("sc2-pcr")),
    row("PointDSC", "geotransformer", LEARNED),
    row("VBReg", "geotransformer", LEARNED),
    row("SC2-PCR++", "geotransformer", Ok("sc2-pcr++")),
    row("MAC", "geotransformer", Ok("mac")),
    row("FastMAC", "geotransformer", Ok("fast-mac")),
    row("Ours", "geotransformer", Ok("refine")),
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
            row("FCGF", "fcgf", Ok("init")),
            row("Predator", "predator", Ok("init")),
            row("CoFiNet", "cofinet", Ok("init")),
            row("GeoTransformer", "geotransformer", Ok("init")),
            row("FCGF + Ours", "fcgf", Ok("refine")),
            row("Predator + Ours", "predator", Ok("refine")),
            row("CoFiNet + Ours", "cofinet", Ok("refine")),
            row("GeoTransformer + Ours", "geotransformer", Ok("refine")),
        ],
    },
    PaperTable {
        number: 4,
        caption: "Registration results on KITTI",
        benchmark: "KITTI",
        rows: &[
            row("GeoTransformer", "geotransformer", Ok("init")),
            row("RANSAC-50K", "geotransformer", Ok("ransac-50k")),
            row("SC2-PCR", "geotransformer", Ok("sc2-pcr")),
            row("PointDSC", "geotransformer", LEARNED),
            row("VBReg", "geotransformer", LEARNED),
            row("MAC", "geotransformer", Ok("mac")),
            row("FastMAC", "geotransformer", Ok("fast-mac")),
            row("Ours", "geotransformer", Ok("refine")),
        ],
    },
    PaperTable {
        number: 5,
        caption: "Layers of the diffusion features",
        benchmark: "3DMatch",
        rows: &[
            row("0", "geotransformer", LAYERS),
            row("3", "geotransformer", LAYERS),
            row("6", "geotransformer", LAYERS),
            row("9", "geotransformer", LAYERS),
            row("0, 3", "geotransformer", LAYERS),
            row("0, 6", "geotransformer", LAYERS),
            row("0, 9", "geotransformer", LAYERS),
            row("0, 3, 6", "geotransformer", LAYERS),
            row("0, 3, 9", "geotransformer", LAYERS),
            row("0, 3, 6, 9", "geotransformer", LAYERS),
        ],
    },
    PaperTable {
        number: 6,
        caption: "Components",
        benchmark: "3DMatch",
        rows: &[
            row("GeoTransformer", "geotransformer", Ok("init")),
            row("w/o PCA", "geotransformer", Ok("refine-no-pca")),
            row("w/o Feature Transfer", "geotransformer", Ok("refine-no-transfer")),
            row("w/o Inlier Aggregation", "geotransformer", Ok("refine-no-aggregation")),
            row("Ours", "geotransformer", Ok("refine")),
        ],
    },
];

/// Fills all tables as far as the data below the root goes.
pub(super) fn run(args: &EvalArgs, settings: &Settings) -> Result<u8> {
    let Some(folder) = &settings.output else { bail!("the results need a folder: add --out DIR") };
    let mut tables = Vec::new();
    for table in &TABLES {
        tables.push(table.fill(args, settings, folder)?);
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
    fn fill(&self, args: &EvalArgs, settings: &Settings, folder: &Path) -> Result<Table> {
        summary::say(&format!("table {}: {}", self.number, self.caption));
        let dataset = read_benchmark(self.benchmark, args);
        let mut filled = Table {
            caption: format!("Table {}: {}", self.number, self.caption),
            titles: ["Method", "RR ↑", "RE ↓", "TE ↓"].map(str::to_owned).to_vec(),
            ..Table::default()
        };
        for row in self.rows {
            let cells = match &dataset {
                Ok(dataset) => row.fill(dataset, args, settings, folder, self.benchmark)?,
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

impl Row {
    /// The cells of the row, or why there are none.
    fn fill(
        &self,
        dataset: &Dataset,
        args: &EvalArgs,
        settings: &Settings,
        folder: &Path,
        benchmark: &str,
    ) -> Result<Result<Vec<String>, String>> {
        let method = match self.method {
            Ok(method) => method,
            Err(why) => return Ok(Err(why.to_owned())),
        };
        let features: PathBuf = args.root.join("features").join(self.start).join(benchmark);
        let starts = match Starts::read(&features.to_string_lossy(), &args.root, dataset) {
            Ok(starts) => starts,
            Err(_) if !features.exists() => {
                return Ok(Err(format!(
                    "no results of {} in {}, as SCENE/REF_SRC.npz, N.pth or SCENE/est.log for every pair",
                    self.start,
                    features.display()
                )));
            }
            Err(error) => return Ok(Err(format!("{error:#}"))),
        };
        if starts.lack_correspondences() && needs_correspondences(method) {
            return Ok(Err(format!(
                "{} has transforms, but no correspondences",
                features.display()
            )));
        }
        let methods = Method::parse_all(&[method.to_owned()], settings)?;
        let pairs = (0..dataset.pairs.len()).collect();
        let plan = Plan {
            dataset: dataset.clone(),
            starts,
            methods,
            settings: settings.clone(),
            pairs,
            jobs: usize::from(args.jobs),
        };
        let results = ResultsFolder::begin(
            folder.join(format!("{benchmark}-{}", self.start)),
            plan.benchmark()?,
        )?;
        work::finish(&plan, &results)?;
        let found: Vec<MethodResult> = results::merge(&[results])?
            .into_iter()
            .filter(|result| result.name == method)
            .collect();
        Ok(cells(&found, dataset, &args.scoring, self.name))
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
