//! `rare refine`: two clouds and an initial transform.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, bail};
use rare::encode::Recorded;
use rare::refine::Timing;
use rare::{Correspondence, Refinement, Refiner, RigidTransform, Scan, io as files};

use crate::args::{Clouds, Direction, RefineArgs, Start};
use crate::backbone::{Described, OpenNetworks};
use crate::given_weights::GivenWeights;
use crate::network::{self, NetworkEncoder, OpenPipeline};
use crate::options::Settings;
use crate::progress::Progress;
use crate::run::{
    Inputs, Registration, check_outputs, illustration, read_scan, start_threads, which,
};

pub(super) fn run(args: RefineArgs) -> Result<u8> {
    let settings = args.options.resolve()?;
    check_features(&args.start, &settings)?;
    check_outputs(&settings, &inputs(&args.clouds, &args.start))?;
    start_threads(&settings)?;
    registration(&args.clouds, &args.start, settings)?.finish()
}

/// Features of a file and of a network at once have no meaning.
fn check_features(start: &Start, settings: &Settings) -> Result<()> {
    let given = [
        ("--source-features", start.source_features.is_some()),
        ("--correspondences", start.correspondences.is_some()),
    ];
    match (given.into_iter().find(|(_, given)| *given), &settings.backbone) {
        (Some((option, _)), Some(backbone)) => bail!(
            "{option} and --backbone {} both say what matches: leave out one of them",
            backbone.network.name()
        ),
        _ => Ok(()),
    }
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
    networks: OpenNetworks,
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
    let described = problem.describe(&progress).with_context(|| which(clouds))?;
    let clouds_read = [&problem.source, &problem.reference];
    let (refiner, network) =
        network::refiner(problem.pipeline.take(), clouds_read, &settings, &progress)?;
    let refiner = match problem.recorded.take() {
        Some(recorded) => refiner.with_encoder(Box::new(recorded)),
        None => refiner,
    };
    let mut refinement = problem.solve(&refiner).with_context(|| which(clouds))?;
    refinement.warnings.extend(network.iter().flat_map(NetworkEncoder::warnings));
    if let Some(described) = &described {
        refinement.warnings.extend(described.description.warnings.iter().cloned());
        let timing = Timing { step: "describe".to_owned(), seconds: described.seconds };
        refinement.timings.insert(0, timing);
    }
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
        backbone: described.map(|described| described.record),
        filter: None,
        read_seconds,
        total_seconds,
    })
}

fn read(clouds: &Clouds, start: &Start, settings: &mut Settings) -> Result<Problem> {
    // The small files first: what is wrong with them need not wait for the clouds.
    let initial = read_initial(&start.init, start.init_direction)?;
    let recorded = read_recorded(settings, &initial)?;
    let weights = GivenWeights::read(&settings.weights)?;
    let networks = OpenNetworks::describing(settings, &weights)?;
    let pipeline = OpenPipeline::of(settings, &weights)?;
    let features = |file: &Option<PathBuf>, side| -> rare::Result<_> {
        file.as_ref().map(|file| files::read_features_of_side(file, side)).transpose()
    };
    let source_features = features(&start.source_features, files::Side::Source)?;
    let reference_features = features(&start.reference_features, files::Side::Reference)?;
    let correspondences =
        start.correspondences.as_ref().map(files::read_correspondences).transpose()?;
    Ok(Problem {
        source: Scan { features: source_features, ..read_scan(&clouds.source)? },
        reference: Scan { features: reference_features, ..read_scan(&clouds.reference)? },
        initial,
        correspondences,
        recorded,
        networks,
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
    /// Lets a network describe the clouds, if one is to.
    fn describe(&mut self, progress: &Progress) -> rare::Result<Option<Described>> {
        self.networks.describe(&mut self.source, &mut self.reference, progress)
    }

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
