//! `rare refine`: two clouds and an initial transform.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use rare::encode::Recorded;
use rare::{Correspondence, Refinement, Refiner, RigidTransform, Scan, io as files};

use crate::args::{Clouds, Direction, RefineArgs, Start};
use crate::network::{self, NetworkEncoder, OpenPipeline};
use crate::options::Settings;
use crate::progress::Progress;
use crate::run::{
    Inputs, Registration, check_outputs, illustration, read_scan, start_threads, which,
};

pub(super) fn run(args: RefineArgs) -> Result<u8> {
    let settings = args.options.resolve()?;
    check_outputs(&settings, &inputs(&args.clouds, &args.start))?;
    start_threads(&settings)?;
    registration(&args.clouds, &args.start, settings)?.finish()
}

/// All files that are read.
fn inputs<'a>(clouds: &'a Clouds, start: &'a Start) -> Vec<&'a Path> {
    let optional = [&start.source_features, &start.reference_features, &start.correspondences];
    [&clouds.source, &clouds.reference, &start.init]
        .into_iter()
        .chain(optional.into_iter().flatten())
        .map(PathBuf::as_path)
        .collect()
}

/// Everything that was read.
struct Problem {
    source: Scan,
    reference: Scan,
    initial: RigidTransform,
    correspondences: Option<Vec<Correspondence>>,
    recorded: Option<Recorded>,
    pipeline: Option<OpenPipeline>,
}

pub(super) fn registration(
    clouds: &Clouds,
    start: &Start,
    mut settings: Settings,
) -> Result<Registration> {
    let clock = Instant::now();
    let progress = Progress::start(settings.quiet);
    progress.step("read");
    let mut problem = read(clouds, start, &mut settings)?;
    let read_seconds = clock.elapsed().as_secs_f64();
    let clouds_read = [&problem.source, &problem.reference];
    let (refiner, network) =
        network::refiner(problem.pipeline.take(), clouds_read, &settings, &progress)?;
    let refiner = match problem.recorded.take() {
        Some(recorded) => refiner.with_encoder(Box::new(recorded)),
        None => refiner,
    };
    let mut refinement = problem.solve(&refiner).with_context(|| which(clouds))?;
    refinement.warnings.extend(network.iter().flat_map(NetworkEncoder::warnings));
    let network = network.as_ref().map(NetworkEncoder::record);
    let total_seconds = clock.elapsed().as_secs_f64();
    let scans = [&problem.source, &problem.reference];
    let initial = Some(&problem.initial);
    let illustration = illustration(&refiner, scans, initial, &refinement, &settings)?;
    Ok(Registration {
        settings,
        inputs: named(clouds, start),
        source: problem.source,
        reference: problem.reference,
        initial: Some(problem.initial),
        refinement,
        illustration,
        network,
        read_seconds,
        total_seconds,
    })
}

fn read(clouds: &Clouds, start: &Start, settings: &mut Settings) -> Result<Problem> {
    // The small files first: what is wrong with them need not wait for the clouds.
    let initial = read_initial(&start.init, start.init_direction)?;
    let recorded = read_recorded(settings, &initial)?;
    let pipeline = OpenPipeline::of(settings)?;
    let features = |file: &Option<PathBuf>| -> rare::Result<_> {
        file.as_ref().map(files::read_point_features).transpose()
    };
    let source_features = features(&start.source_features)?;
    let reference_features = features(&start.reference_features)?;
    let correspondences =
        start.correspondences.as_ref().map(files::read_correspondences).transpose()?;
    Ok(Problem {
        source: Scan { features: source_features, ..read_scan(&clouds.source)? },
        reference: Scan { features: reference_features, ..read_scan(&clouds.reference)? },
        initial,
        correspondences,
        recorded,
        pipeline,
    })
}

/// Recorded features, if they are asked for; they have their say in the recipe.
fn read_recorded(settings: &mut Settings, initial: &RigidTransform) -> Result<Option<Recorded>> {
    let Some(file) = &settings.depth_features else { return Ok(None) };
    let recorded = files::read_depth_features(file)?;
    recorded.check_initial(initial).with_context(|| file.display().to_string())?;
    settings.refiner.recipe = settings.refiner.recipe.clone().for_recorded(&recorded);
    Ok(Some(recorded))
}

/// The initial transform from source to reference.
pub(super) fn read_initial(init: &Path, direction: Direction) -> Result<RigidTransform> {
    let given = files::read_pose(init)?;
    Ok(match direction {
        Direction::SourceToTarget => given,
        Direction::TargetToSource => given.inverse(),
    })
}

impl Problem {
    fn solve(&self, refiner: &Refiner) -> rare::Result<Refinement> {
        let Problem { source, reference, initial, .. } = self;
        match &self.correspondences {
            Some(pairs) => refiner.refine_matched(source, reference, initial, pairs),
            None => refiner.refine(source, reference, initial),
        }
    }
}

fn named(clouds: &Clouds, start: &Start) -> Inputs {
    let name = |file: &PathBuf| file.display().to_string();
    Inputs {
        source: name(&clouds.source),
        reference: name(&clouds.reference),
        start: super::Start::Given {
            init: name(&start.init),
            init_direction: start.init_direction,
            source_features: start.source_features.as_ref().map(name),
            reference_features: start.reference_features.as_ref().map(name),
            correspondences: start.correspondences.as_ref().map(name),
        },
    }
}
