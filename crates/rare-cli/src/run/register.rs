//! `rare register`: two clouds, nothing known.

use std::time::Instant;

use anyhow::{Context, Result, bail};

use crate::args::{Clouds, RegisterArgs};
use crate::network::{self, NetworkEncoder, OpenPipeline};
use crate::options::{Options, Settings};
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
    let pipeline = OpenPipeline::of(&settings)?;
    let (source, reference) = (read_scan(&clouds.source)?, read_scan(&clouds.reference)?);
    let read_seconds = clock.elapsed().as_secs_f64();
    let (refiner, network) =
        network::refiner(pipeline, [&source, &reference], &settings, &progress)?;
    let mut refinement = refiner
        .register(&source, &reference, settings.init_method)
        .with_context(|| which(clouds))?;
    refinement.warnings.extend(network.iter().flat_map(NetworkEncoder::warnings));
    let inputs = Inputs {
        source: clouds.source.display().to_string(),
        reference: clouds.reference.display().to_string(),
        start: Start::Estimated { init_method: settings.init_method },
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
        read_seconds,
        total_seconds,
    })
}
