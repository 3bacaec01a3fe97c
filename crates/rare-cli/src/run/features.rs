//! `rare features`: the dense features by themselves, of a pair for a later run, of one cloud at its points.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use rare::io as files;

use crate::args::{Clouds, FeaturesArgs};
use crate::backbone::{Described, OpenNetworks};
use crate::given_weights::GivenWeights;
use crate::network::{self, NetworkEncoder, OpenPipeline};
use crate::options::Settings;
use crate::progress::Progress;
use crate::run::refine::read_initial;
use crate::run::{check_outputs, read_scan, start_threads, which};
use crate::{SUCCESS, record, summary};

pub(super) fn run(args: FeaturesArgs) -> Result<u8> {
    let settings = args.options.resolve()?;
    let output = output(&settings)?;
    let inputs = [Some(&args.source), args.reference.as_ref(), args.init.as_ref()];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(PathBuf::as_path).collect();
    check_outputs(&settings, &inputs)?;
    start_threads(&settings)?;
    let weights = GivenWeights::read(&settings.weights)?;
    let networks = OpenNetworks::describing(&settings, &weights)?;
    let written = match (args.reference, args.init) {
        (reference, None) if settings.backbone.is_some() => {
            let Some(reference) = reference else {
                bail!("a network looks at both clouds together: name the reference as well")
            };
            let clouds = Clouds { source: args.source, reference };
            by_network(&clouds, &settings, &networks, output)?
        }
        (_, Some(_)) if settings.backbone.is_some() => {
            bail!(
                "--backbone describes the clouds themselves, whatever lies between them: leave out --init"
            )
        }
        (Some(_), None) => bail!(
            "the depth maps of a pair are seen under an initial transform: add --init FILE (or --backbone NETWORK)"
        ),
        (Some(reference), Some(init)) => {
            let clouds = Clouds { source: args.source, reference };
            let initial = read_initial(&init, args.init_direction)?;
            of_pair(&clouds, &initial, &settings, &weights, output)?
        }
        (None, _) => of_cloud(&args.source, &settings, &weights, output)?,
    };
    if !settings.quiet {
        summary::say(&format!("wrote {written} to {}", output.display()));
    }
    Ok(SUCCESS)
}

/// The file to write. The options that this command shares with others, but has no use for, are refused.
fn output(settings: &Settings) -> Result<&Path> {
    let useless = [
        ("--json", &settings.json),
        ("--save-aligned", &settings.save_aligned),
        ("--depth-features", &settings.depth_features),
    ];
    if let Some((option, _)) = useless.into_iter().find(|(_, file)| file.is_some()) {
        bail!("{option} is of no use to `rare features`, which makes features and writes --output");
    }
    settings.output.as_deref().context("where to? add --output FILE.npz")
}

fn of_pair(
    clouds: &Clouds,
    initial: &rare::RigidTransform,
    settings: &Settings,
    weights: &GivenWeights,
    output: &Path,
) -> Result<String> {
    let progress = Progress::start(settings.quiet);
    progress.step("read");
    let pipeline = OpenPipeline::of(settings, weights)?;
    let (source, reference) = (read_scan(&clouds.source)?, read_scan(&clouds.reference)?);
    let (refiner, network) =
        network::refiner(pipeline, [&source, &reference], settings, &progress)?;
    let views =
        refiner.encode_views(&source, &reference, initial).with_context(|| which(clouds))?;
    warn(&network, settings);
    let network = network.as_ref().map(NetworkEncoder::record);
    let recorded = views.into_recorded(&refiner, record::features_to_json(settings, network)?);
    files::write_depth_features(output, &recorded)?;
    let maps = recorded.features();
    let layers = maps.first().map_or(0, Vec::len);
    Ok(format!("the features of {} depth maps ({layers} layers each)", maps.len()))
}

/// What a network on points says of a pair.
fn by_network(
    clouds: &Clouds,
    settings: &Settings,
    networks: &OpenNetworks,
    output: &Path,
) -> Result<String> {
    let progress = Progress::start(settings.quiet);
    progress.step("read");
    let (mut source, mut reference) = (read_scan(&clouds.source)?, read_scan(&clouds.reference)?);
    let described = networks.describe(&mut source, &mut reference, &progress);
    let Some(Described { description, .. }) = described.with_context(|| which(clouds))? else {
        bail!("--backbone names no network")
    };
    if !settings.quiet {
        let warnings = description.warnings.iter();
        warnings.for_each(|warning| summary::say(&format!("warning: {warning}")));
    }
    let pair = files::PairFeatures {
        source: (&description.source.features, &description.source.scores),
        reference: (&description.target.features, &description.target.scores),
        correspondences: &description.correspondences,
        target_from_source: description.target_from_source.as_ref().ok(),
    };
    files::write_pair_features(output, &pair)?;
    Ok(format!(
        "{} and {} keypoints with {} features each, {} correspondences and {} transform",
        pair.source.0.len(),
        pair.reference.0.len(),
        pair.source.0.dimension(),
        pair.correspondences.len(),
        if pair.target_from_source.is_some() { "a" } else { "no" }
    ))
}

fn of_cloud(
    cloud: &Path,
    settings: &Settings,
    weights: &GivenWeights,
    output: &Path,
) -> Result<String> {
    let progress = Progress::start(settings.quiet);
    progress.step("read");
    let pipeline = OpenPipeline::of(settings, weights)?;
    let scan = read_scan(cloud)?;
    let (refiner, network) = network::refiner(pipeline, [&scan, &scan], settings, &progress)?;
    let features = refiner.point_features(&scan).with_context(|| cloud.display().to_string())?;
    warn(&network, settings);
    if features.is_empty() {
        bail!(
            "{}: the cameras see nothing of this cloud: choose others with --camera",
            cloud.display()
        );
    }
    files::write_point_features(output, &features)?;
    Ok(format!("{} points with {} features each", features.len(), features.dimension()))
}

fn warn(network: &Option<NetworkEncoder>, settings: &Settings) {
    if !settings.quiet {
        let warnings = network.iter().flat_map(NetworkEncoder::warnings);
        warnings.for_each(|warning| summary::say(&format!("warning: {warning}")));
    }
}
