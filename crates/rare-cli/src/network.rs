//! `--encoder diffusion`: the pipeline is found and looked at before the clouds are read; its networks are loaded when
//! there is a depth map that no cache knows.

use std::env;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result};
use rare::data::LayeredFeatures;
use rare::encode::DepthEncoder;
use rare::scale::Scale;
use rare::{DepthMap, Refiner, Scan};
use rare_nets::cache::{CachedEncoder, WeightsIdentity};
use rare_nets::diffusion::{
    Cost, DiffusionEncoder, DiffusionSettings, Pipeline, Plan, latent_size,
};
use rare_nets::engine::CpuBackend;
use rare_nets::weights::Choice;
use serde::Serialize;

use crate::given_weights::GivenWeights;
use crate::options::{Diffusion, Settings};
use crate::progress::{Passes, Progress, duration_in_words};
use crate::{memory, speed, summary};

/// A pipeline that fits the settings, with no weight read yet.
pub(crate) struct OpenPipeline {
    pipeline: Pipeline,
    weights: PathBuf,
    identity: WeightsIdentity,
    diffusion: Diffusion,
}

/// The networks of a pipeline, loaded when they are needed.
struct Network {
    pipeline: Pipeline,
    settings: DiffusionSettings,
    passes: Arc<Passes>,
    quiet: bool,
    loaded: Mutex<Option<Loaded>>,
}

type Loaded = Arc<DiffusionEncoder<CpuBackend>>;

/// The encoder of a run, and what will be said of it.
pub(crate) struct NetworkEncoder {
    encoder: Arc<CachedEncoder<Network>>,
    record: NetworkRecord,
}

/// What the record says of the diffusion features.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct NetworkRecord {
    #[serde(flatten)]
    settings: DiffusionSettings,
    weights: String,
    /// SHA-256 of the names, lengths and samples of the weight files.
    weights_fingerprint: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    weights_remark: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cache: Option<String>,
    /// Depth maps that the networks encoded, and those whose features were known.
    maps_encoded: usize,
    maps_cached: usize,
}

/// The refiner of a run with the encoder that its settings want.
///
/// # Errors
/// As [`OpenPipeline::encoder`].
pub(crate) fn refiner(
    pipeline: Option<OpenPipeline>,
    clouds: [&Scan; 2],
    settings: &Settings,
    progress: &Progress,
) -> Result<(Refiner, Option<NetworkEncoder>)> {
    let refiner = Refiner::new(settings.refiner.clone()).with_progress(progress.callback());
    let Some(pipeline) = pipeline else { return Ok((refiner, None)) };
    let network = pipeline.encoder(clouds, settings, progress)?;
    let refiner = refiner.with_encoder(Box::new(Arc::clone(&network.encoder)));
    Ok((refiner, Some(network)))
}

impl OpenPipeline {
    /// Opens the pipeline if the settings want one; warns of weights that nobody trained.
    ///
    /// # Errors
    /// If there is none, if it does not fit, or if the settings are impossible with it.
    pub(crate) fn of(settings: &Settings, weights: &GivenWeights) -> Result<Option<OpenPipeline>> {
        let Some(diffusion) = settings.diffusion.clone() else { return Ok(None) };
        let weights = match weights.diffusion()? {
            Some(folder) => folder.to_owned(),
            None => Choice::default().default_folder(|name| env::var_os(name))?,
        };
        let pipeline = Pipeline::open(&weights)
            .context("--encoder diffusion needs weights: name their folder with --weights, or get them with `rare weights fetch`")?;
        Plan::new(&diffusion.settings, &pipeline.scheduler)?;
        let identity = WeightsIdentity::of(&pipeline.files)?;
        if let Some(remark) = pipeline.remark.as_ref().filter(|_| !settings.quiet) {
            summary::say(&format!("warning: {}: {remark}", weights.display()));
        }
        Ok(Some(OpenPipeline { pipeline, weights, identity, diffusion }))
    }

    /// The encoder for two clouds, whose kind chooses the prompt where nobody did.
    ///
    /// # Errors
    /// If the clouds have no scale, or the folder of the cache cannot be made.
    fn encoder(
        self,
        clouds: [&Scan; 2],
        settings: &Settings,
        progress: &Progress,
    ) -> Result<NetworkEncoder> {
        let [source, reference] = clouds.map(|scan| &scan.cloud);
        let config = &settings.refiner;
        let scale = Scale::new(config.profile, config.voxel, source, reference)?;
        let quiet = settings.quiet;
        let Diffusion { settings, cache, .. } = self.diffusion;
        let settings = settings.with_prompt_for(scale.kind);
        let record = NetworkRecord {
            weights: self.weights.display().to_string(),
            weights_fingerprint: self.identity.fingerprint,
            weights_remark: self.pipeline.remark.clone(),
            cache: cache.as_ref().map(|folder| folder.display().to_string()),
            settings: settings.clone(),
            maps_encoded: 0,
            maps_cached: 0,
        };
        let decisive = (&self.identity.on_this_machine, &settings, env!("CARGO_PKG_VERSION"));
        let decisive = serde_json::to_string(&decisive)?;
        let network = Network {
            pipeline: self.pipeline,
            settings,
            passes: Arc::new(progress.passes()),
            quiet,
            loaded: Mutex::default(),
        };
        let encoder =
            CachedEncoder::new(network, &decisive, cache.as_deref()).context("--cache")?;
        Ok(NetworkEncoder { encoder: Arc::new(encoder), record })
    }
}

impl NetworkEncoder {
    /// What the record says once the run is over.
    pub(crate) fn record(&self) -> NetworkRecord {
        NetworkRecord {
            maps_encoded: self.encoder.computed(),
            maps_cached: self.encoder.found(),
            ..self.record.clone()
        }
    }

    /// What the user should know of the cache.
    pub(crate) fn warnings(&self) -> Vec<String> {
        self.encoder.trouble().into_iter().collect()
    }
}

impl Network {
    /// Says what the maps will cost, and refuses them if there is no room.
    fn announce(&self, maps: &[(usize, &DepthMap)], backend: &CpuBackend) -> rare::Result<()> {
        let plan = Plan::new(&self.settings, &self.pipeline.scheduler)?;
        let sizes = maps.iter().map(|(_, map)| latent_size(map.intrinsics()));
        let sizes = sizes.collect::<rare::Result<Vec<_>>>()?;
        let cost = Cost::estimate(&self.pipeline, &plan, self.settings.precision, &sizes)?;
        cost.check_memory(memory::available())?;
        if self.quiet {
            return Ok(());
        }
        let seconds = cost.operations / speed::measured(backend)?;
        summary::say(&format!(
            "{} depth maps, passes through the networks for each: {}; weights {:.1} GB; the first round takes about {} and {:.1} GB of memory",
            maps.len(),
            plan.passes(),
            cost.weight_bytes as f64 / 1e9,
            duration_in_words(seconds),
            cost.bytes() as f64 / 1e9
        ));
        Ok(())
    }

    fn load(&self, maps: &[(usize, &DepthMap)]) -> rare::Result<Loaded> {
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(encoder) = &*loaded {
            return Ok(Arc::clone(encoder));
        }
        let backend = CpuBackend::new(self.settings.precision)?;
        self.announce(maps, &backend)?;
        let passes = Arc::clone(&self.passes);
        let encoder = DiffusionEncoder::load(backend, &self.pipeline, &self.settings)?
            .with_progress(move |done, total| passes.show(done, total));
        Ok(Arc::clone(loaded.insert(Arc::new(encoder))))
    }
}

impl DepthEncoder for Network {
    fn encode_at(&self, maps: &[(usize, &DepthMap)]) -> rare::Result<Vec<LayeredFeatures>> {
        let encoder = self.load(maps)?;
        self.passes.begin(maps.len() * encoder.plan().passes());
        encoder.encode_at(maps)
    }
}
