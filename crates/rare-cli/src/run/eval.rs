//! `rare eval`: methods on a benchmark, resumable at every pair.
//!
//! Pass 1 works on the pairs and writes what methods found into a folder of results; pass 2 scores the folder. Nothing
//! that pass 2 prints depends on who found a result, when, or in which order.

mod listed;
mod method;
mod pages;
mod paper;
mod start;
mod work;

use anyhow::{Result, bail};
use method::{Filters, Method};
use rare::InitialMethod;
use rare::eval::dataset::{self, Dataset};
use rare::eval::results::{self, Benchmark, ResultsFolder};
use rare_nets::networks::Network;
use serde_json::json;
use start::Starts;

use crate::args::{DatasetKind, EvalArgs, Format};
use crate::backbone::OpenBackbone;
use crate::given_weights::{FilterIdentity, GivenWeights};
use crate::options::{Encoder, Settings};
use crate::report::{self, Index};
use crate::{SUCCESS, run, summary};

/// Everything that is to be done.
struct Plan {
    dataset: Dataset,
    starts: Starts,
    methods: Vec<Method>,
    settings: Settings,
    /// The network that describes the clouds.
    backbone: Option<OpenBackbone>,
    /// The weights that were given for networks which tell right correspondences from wrong ones.
    filters: Vec<FilterIdentity>,
    /// The pairs of this shard.
    pairs: Vec<usize>,
    jobs: usize,
}

pub(super) fn run(args: &EvalArgs) -> Result<u8> {
    if args.dataset == DatasetKind::Paper {
        let settings = resolve(args)?;
        if settings.report.is_some() {
            bail!(
                "--report shows one benchmark, the paper's tables are several: evaluate one of them"
            );
        }
        return paper::run(args, &settings);
    }
    let scoring = args.scoring.clone();
    let is_shard = args.shard.is_some();
    if is_shard && args.options.report.is_some() {
        bail!(
            "--report shows a whole evaluation: add it to the same command without --shard when all shards are done"
        );
    }
    let plan = Plan::new(args)?;
    let Some(folder) = plan.settings.output.clone() else {
        bail!("the results need a folder: add --out DIR");
    };
    let results = ResultsFolder::begin(&folder, plan.benchmark()?)?;
    work::finish(&plan, &results)?;
    if is_shard {
        summary::say("this shard is done: put all of them together with `rare score DIR...`");
        return Ok(SUCCESS);
    }
    let estimates = results.estimates()?;
    let methods = results::merge(&[results])?;
    let comparisons = super::score::compare(&methods, plan.dataset.protocol, &scoring);
    super::score::write_tables(&folder, &comparisons, &methods)?;
    if let Some((name, comparison)) = plan.settings.report.as_ref().zip(comparisons.first()) {
        let pages = pages::write_all(&plan, &folder)?;
        let title = format!("{}: {} pairs", plan.dataset.name, plan.dataset.pairs.len());
        let index = Index::new(title, comparison, &methods, &estimates, &pages);
        report::write_index(&folder.join(name), &index)?;
    }
    run::print(&super::score::in_format(&comparisons, Format::Text)?)?;
    Ok(SUCCESS)
}

impl Plan {
    fn new(args: &EvalArgs) -> Result<Plan> {
        let dataset = read_dataset(args)?;
        let settings = resolve(args)?;
        let weights = GivenWeights::read(&settings.weights)?;
        check_weights(&weights, &settings, &args.methods)?;
        let filters = Filters { weights: &weights, trained_on: None };
        let methods = Method::parse_all(&args.methods, &settings, &filters)?;
        let backbone = open_backbone(&settings, &weights)?;
        let starts = match (&args.init, &backbone) {
            (Some(init), _) => Starts::read(init, &args.root, &dataset)?,
            (None, Some(_)) => Starts::Described,
            (None, None) => Starts::Estimated(InitialMethod::default()),
        };
        let (index, count) = args.shard.unwrap_or((0, 1));
        let pairs = (0..dataset.pairs.len()).skip(index).step_by(count).collect();
        let jobs = usize::from(args.jobs);
        let filters = weights.filters()?;
        Ok(Plan { dataset, starts, methods, settings, backbone, filters, pairs, jobs })
    }

    /// What the results depend on.
    fn benchmark(&self) -> Result<Benchmark> {
        let mut settings = json!({
            "start": self.starts.description(),
            "refiner": serde_json::to_value(&self.settings.refiner)?,
            "version": env!("CARGO_PKG_VERSION"),
        });
        if let Some(backbone) = &self.backbone {
            settings["backbone"] = backbone.identity()?;
        }
        if !self.filters.is_empty() {
            settings["filters"] = serde_json::to_value(&self.filters)?;
            settings["vbreg_noise"] = self.settings.vbreg_noise.into();
        }
        Ok(Benchmark {
            name: self.dataset.name.clone(),
            protocol: self.dataset.protocol,
            settings,
            pairs: self.dataset.pairs.iter().map(|pair| (&pair.truth).into()).collect(),
        })
    }
}

/// Makes sure that there is a use for all weights.
fn check_weights(weights: &GivenWeights, settings: &Settings, methods: &[String]) -> Result<()> {
    let backbone = settings.backbone.as_ref().map(|backbone| backbone.network);
    let filters = [Network::PointDsc, Network::Vbreg];
    let filters = filters.into_iter().filter(|network| methods.iter().any(|m| m == network.name()));
    let used: Vec<Network> = backbone.into_iter().chain(filters).collect();
    weights.check_use(settings, &used)
}

fn open_backbone(settings: &Settings, weights: &GivenWeights) -> Result<Option<OpenBackbone>> {
    let Some(backbone) = &settings.backbone else { return Ok(None) };
    let file = weights.of(backbone.network, &format!("--backbone {}", backbone.network.name()))?;
    OpenBackbone::open(file, backbone, settings).map(Some)
}

/// The settings of the refiner, whose features are the built-in ones.
fn resolve(args: &EvalArgs) -> Result<Settings> {
    let settings = args.options.clone().resolve()?;
    if settings.encoder != Encoder::Builtin {
        bail!(
            "--encoder {}: evaluations are made with the built-in features; the example measure_refiner measures others",
            settings.encoder.name()
        );
    }
    Ok(settings)
}

fn read_dataset(args: &EvalArgs) -> Result<Dataset> {
    let mut dataset = match args.dataset {
        DatasetKind::Folder => dataset::read_folder(&args.root, &args.pairs, &args.truth)?,
        DatasetKind::Paper => bail!("the paper's tables are no single benchmark"),
        DatasetKind::ThreeDMatch => listed::read_three_d_match(&args.root, "3DMatch")?,
        DatasetKind::ThreeDLoMatch => listed::read_three_d_match(&args.root, "3DLoMatch")?,
        DatasetKind::Kitti => dataset::read_kitti(&args.root, args.kitti_gt.into())?,
    };
    if let Some(limit) = args.limit {
        dataset.pairs.truncate(limit);
    }
    if dataset.pairs.is_empty() {
        bail!("--limit 0 leaves no pair");
    }
    Ok(dataset)
}
