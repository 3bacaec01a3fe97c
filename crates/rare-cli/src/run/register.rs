//! `rare register`: two clouds, nothing known.

use std::time::Instant;

use anyhow::{Context, Result, bail};
use rare::refine::Timing;
use rare::{InitialMethod, Refinement, Refiner, RigidTransform, Scan};

use crate::args::{Clouds, RegisterArgs};
use crate::backbone::{Described, OpenNetworks, filtered};
use crate::estimators::Estimator;
use crate::given_weights::GivenWeights;
use crate::network::{self, NetworkEncoder, OpenPipeline};
use crate::options::{InitMethod, Options, Settings};
use crate::progress::Progress;
use crate::run::{
    Inputs, Registration, Start, check_outputs, illustration, read_scan, start_threads, which,
};

pub(super) fn run(args: RegisterArgs) -> Result<u8> {
    let options = Options { init_method: args.init_method, ..args.options };
    let settings = options.resolve()?;
    if let Some(file) = &settings.depth_features {
        bail!(
            "{}: recorded features belong to a known initial transform: use `rare refine --init FILE`",
            file.display()
        );
    }
    check_outputs(&settings, &[&args.clouds.source, &args.clouds.reference])?;
    start_threads(&settings)?;
    registration(&args.clouds, settings)?.finish()
}

fn registration(clouds: &Clouds, settings: Settings) -> Result<Registration> {
    let clock = Instant::now();
    let progress = Progress::start(settings.quiet);
    progress.step("read");
    let weights = GivenWeights::read(&settings.weights)?;
    let networks = OpenNetworks::of(&settings, &weights)?;
    let pipeline = OpenPipeline::of(&settings, &weights)?;
    let filter = weights.filters()?.into_iter().next().filter(|_| networks.filter.is_some());
    let (mut source, mut reference) = (read_scan(&clouds.source)?, read_scan(&clouds.reference)?);
    let read_seconds = clock.elapsed().as_secs_f64();
    let described =
        networks.describe(&mut source, &mut reference, &progress).with_context(|| which(clouds))?;
    let (refiner, network) =
        network::refiner(pipeline, [&source, &reference], &settings, &progress)?;
    let problem = Problem { source, reference, described };
    let mut refinement =
        problem.solve(&refiner, &networks, &settings).with_context(|| which(clouds))?;
    refinement.warnings.extend(network.iter().flat_map(NetworkEncoder::warnings));
    let Problem { source, reference, described } = problem;
    let inputs = Inputs {
        source: clouds.source.display().to_string(),
        reference: clouds.reference.display().to_string(),
        start: Start::Estimated { init_method: init_method(&settings) },
    };
    let network = network.as_ref().map(NetworkEncoder::record);
    let total_seconds = clock.elapsed().as_secs_f64();
    let illustration = illustration(&refiner, [&source, &reference], None, &refinement, &settings)?;
    Ok(Registration {
        settings,
        inputs,
        source,
        reference,
        initial: None,
        refinement,
        illustration,
        network,
        backbone: described.map(|described| described.record),
        filter,
        read_seconds,
        total_seconds,
    })
}

/// How the initial transform is estimated; `None`: as the network does that describes the clouds.
fn init_method(settings: &Settings) -> Option<InitMethod> {
    match (settings.init_method, &settings.backbone) {
        (None, None) => Some(InitMethod::Builtin(InitialMethod::default())),
        (method, _) => method,
    }
}

/// Two clouds, and what a network said of them.
struct Problem {
    source: Scan,
    reference: Scan,
    described: Option<Described>,
}

impl Problem {
    fn solve(
        &self,
        refiner: &Refiner,
        networks: &OpenNetworks,
        settings: &Settings,
    ) -> rare::Result<Refinement> {
        let Problem { source, reference, described } = self;
        if let (None, Some(InitMethod::Builtin(method))) = (described, init_method(settings)) {
            return refiner.register(source, reference, method);
        }
        let clock = Instant::now();
        let initial = self.initial(refiner, networks, settings)?;
        let seconds = clock.elapsed().as_secs_f64();
        let refinement = refiner.refine(source, reference, &initial)?;
        let step = |step: &str, seconds| Timing { step: step.to_owned(), seconds };
        let mut timings: Vec<Timing> =
            described.iter().map(|described| step("describe", described.seconds)).collect();
        timings.push(step("initial", seconds));
        timings.extend(refinement.timings);
        let mut warnings = refinement.warnings;
        warnings.extend(described.iter().flat_map(|one| one.description.warnings.clone()));
        Ok(Refinement { timings, warnings, ..refinement })
    }

    /// The initial transform where a network has a part in it.
    fn initial(
        &self,
        refiner: &Refiner,
        networks: &OpenNetworks,
        settings: &Settings,
    ) -> rare::Result<RigidTransform> {
        let Problem { source, reference, described } = self;
        let description = described.as_ref().map(|described| &described.description);
        match (&networks.filter, init_method(settings), description) {
            (Some(filter), _, description) => {
                let pairs = match description {
                    Some(description) => description.correspondences.clone(),
                    None => refiner.initial_matches(source, reference)?,
                };
                filtered(&**filter, &source.cloud, &reference.cloud, &pairs)
            }
            (None, Some(InitMethod::Builtin(method)), Some(description)) => Estimator::from(method)
                .on_description(description, source, reference, &settings.refiner),
            (None, _, Some(description)) => match &description.target_from_source {
                Ok(pose) => Ok(*pose),
                Err(error) => Err(rare::Error::no_pose(format!(
                    "the network found no transform ({error}): try another estimator on its correspondences, --init-method sc2-pcr"
                ))),
            },
            (None, _, None) => Err(rare::Error::Internal("no initial transform".to_owned())),
        }
    }
}
