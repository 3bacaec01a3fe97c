//! The commands, and what those that register have in common: read, register, write, say.

mod completions;
mod convert;
mod demo;
mod eval;
mod features;
mod icp;
mod info;
mod refine;
mod register;
mod score;
mod weights;

use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rare::refine::Illustration;
use rare::verify::Verdict;
use rare::{Refinement, Refiner, RigidTransform, Scan, io as files};
use rare_nets::official;
use serde::Serialize;

use crate::args::{Cli, Clouds, Command, Direction};
use crate::backbone::BackboneRecord;
use crate::given_weights::FilterIdentity;
use crate::network::NetworkRecord;
use crate::options::{InitMethod, Settings};
use crate::outputs::{self, Output};
use crate::progress::Progress;
use crate::{NO_POSE, SUCCESS, figures, record, report, summary};

/// Runs a command; gives the exit code.
pub(crate) fn run(cli: Cli) -> Result<u8> {
    match cli.command {
        Command::Register(args) => register::run(args),
        Command::Refine(args) => refine::run(args),
        Command::Icp(args) => icp::run(&args),
        Command::Features(args) => features::run(args),
        Command::Info(args) => info::run(&args),
        Command::Convert(args) => convert::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Weights(args) => weights::run(args),
        Command::Eval(args) => eval::run(&args),
        Command::Score(args) => score::run(&args),
        Command::Completions(args) => completions::run(&args),
    }
}

/// A finished registration.
pub(crate) struct Registration {
    pub(crate) settings: Settings,
    pub(crate) inputs: Inputs,
    pub(crate) source: Scan,
    pub(crate) reference: Scan,
    /// The transform that was given, source to reference.
    pub(crate) initial: Option<RigidTransform>,
    pub(crate) refinement: Refinement,
    /// What was seen and matched, if a report or figures were asked for.
    pub(crate) illustration: Option<Illustration>,
    /// The diffusion networks that were used.
    pub(crate) network: Option<NetworkRecord>,
    /// The network that described the clouds.
    pub(crate) backbone: Option<BackboneRecord>,
    /// The network that chose among correspondences for the initial transform.
    pub(crate) filter: Option<FilterIdentity>,
    pub(crate) read_seconds: f64,
    pub(crate) total_seconds: f64,
}

/// What was registered, as the record names it.
#[derive(Serialize)]
pub(crate) struct Inputs {
    pub(crate) source: String,
    pub(crate) reference: String,
    #[serde(flatten)]
    pub(crate) start: Start,
}

/// Where the initial transform came from.
#[derive(Serialize)]
#[serde(untagged)]
pub(crate) enum Start {
    /// As a network does that describes the clouds, if nothing is said.
    Estimated {
        #[serde(skip_serializing_if = "Option::is_none")]
        init_method: Option<InitMethod>,
    },
    Given {
        init: String,
        init_direction: Direction,
        #[serde(skip_serializing_if = "Option::is_none")]
        source_features: Option<String>,
        #[serde(skip_serializing_if = "Option::is_none")]
        reference_features: Option<String>,
        #[serde(skip_serializing_if = "Option::is_none")]
        correspondences: Option<String>,
    },
}

impl Registration {
    /// The verdict; where nothing was given, nothing can have been kept.
    pub(crate) fn verdict(&self) -> Verdict {
        match (self.refinement.verdict, &self.initial) {
            (Verdict::KeptInitial, None) => Verdict::Refined,
            (verdict, _) => verdict,
        }
    }

    /// Writes the files that were asked for, prints the transform, says what came of it; gives the exit code.
    fn finish(&self) -> Result<u8> {
        let pose = &self.refinement.target_from_source;
        let json = record::to_json(self)?;
        if let Some(file) = &self.settings.output {
            files::write_pose(file, pose)?;
        }
        if let Some(file) = &self.settings.json {
            files::write_whole(file, |writer| writer.write_all(json.as_bytes()))?;
        }
        if let Some(illustration) = &self.illustration {
            self.show(illustration)?;
        }
        if let Some(file) = &self.settings.save_aligned {
            files::write_cloud(file, &aligned(&self.source, &self.reference, pose))?;
        }
        print(&files::format_pose(pose))?;
        if !self.settings.quiet {
            self.say();
        }
        Ok(if self.verdict() == Verdict::Rejected { NO_POSE } else { SUCCESS })
    }

    /// Writes what people look at.
    fn show(&self, illustration: &Illustration) -> Result<()> {
        let progress = Progress::start(self.settings.quiet);
        if let Some(file) = &self.settings.report {
            progress.step("report");
            report::write(file, self, illustration)?;
        }
        if let Some(folder) = &self.settings.figures {
            progress.step("figures");
            figures::write_all(folder, self, illustration).context("--figures")?;
        }
        Ok(())
    }

    fn say(&self) {
        for warning in &self.refinement.warnings {
            summary::say(&format!("warning: {warning}"));
        }
        summary::say(&summary::describe(self));
        if self.settings.verbose {
            summary::say(&summary::describe_details(&self.refinement));
        }
    }
}

/// Refuses outputs that must not be written, before any cloud is read.
fn check_outputs(settings: &Settings, inputs: &[&Path]) -> Result<()> {
    let named = [
        ("--output", &settings.output),
        ("--json", &settings.json),
        ("--save-aligned", &settings.save_aligned),
        ("--report", &settings.report),
    ];
    let output = |(option, path): (_, _)| Some(Output { option, path: Option::as_deref(path)? });
    let outputs: Vec<Output<'_>> = named.into_iter().filter_map(output).collect();
    let configured = [&settings.config, &settings.depth_features];
    let configured = configured.into_iter().filter_map(Option::as_deref);
    let weights = settings.weights.iter().map(PathBuf::as_path);
    let read: Vec<&Path> = inputs.iter().copied().chain(configured).chain(weights).collect();
    outputs::check(&read, &outputs)?;
    if let Some(folder) = &settings.figures {
        outputs::check_folder("--figures", folder)?;
    }
    match &settings.save_aligned {
        Some(file) => files::check_writable_format(file).context("--save-aligned"),
        None => Ok(()),
    }
}

fn start_threads(settings: &Settings) -> Result<()> {
    start_pool(settings.threads)
}

/// As many threads as that, 0 for all cores.
fn start_pool(threads: usize) -> Result<()> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()
        .with_context(|| format!("--threads {threads}"))
}

fn read_scan(file: &Path) -> Result<Scan> {
    let is_fragment = official::is_fragment(file);
    let cloud = if is_fragment { official::read_fragment(file) } else { files::read_cloud(file) };
    Ok(Scan::from(cloud?))
}

/// What was seen and matched, if it is to be shown.
fn illustration(
    refiner: &Refiner,
    scans: [&Scan; 2],
    initial: Option<&RigidTransform>,
    refinement: &Refinement,
    settings: &Settings,
) -> rare::Result<Option<Illustration>> {
    let asked = settings.report.is_some() || settings.figures.is_some();
    asked.then(|| report::illustrate(refiner, scans, initial, refinement)).transpose()
}

/// What an error of the registration is about.
fn which(clouds: &Clouds) -> String {
    format!(
        "registering {} (source) onto {} (reference)",
        clouds.source.display(),
        clouds.reference.display()
    )
}

/// The points of the source in the frame of the reference.
fn aligned(
    source: &Scan,
    reference: &Scan,
    pose: &RigidTransform,
) -> Vec<rare::nalgebra::Point3<f64>> {
    let (source, reference) = (&source.cloud, &reference.cloud);
    // Near the origin the millimetres are kept, the shift is added last.
    let local = rare::PointCloud::to_local(reference, source, pose);
    source.points().iter().map(|point| local.apply(point) + reference.shift()).collect()
}

/// Prints on stdout. A reader that has seen enough and closed it is no failure.
fn print(text: &str) -> Result<()> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => result.context("stdout"),
    }
}
