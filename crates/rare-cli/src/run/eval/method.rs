//! What can be compared: the names of `--methods` and what they do to a pair.

use std::collections::BTreeMap;

use anyhow::{Result, bail};
use rare::nalgebra::Matrix4;
use rare::pose::{IcpMethod, MultiScaleIcp};
use rare::scale::{Profile, Scale};
use rare::verify::Verdict;
use rare::{
    InitialMethod, PointCloud, Recipe, Refinement, Refiner, RefinerConfig, RigidTransform, Scan,
};
use rare_nets::networks::{Network, TrainedOn};

use super::start::Start;
use crate::backbone::open_filter;
use crate::estimators::Estimator;
use crate::given_weights::GivenWeights;
use crate::options::Settings;

/// A method by its name.
pub(super) struct Method {
    pub(super) name: String,
    kind: Kind,
}

enum Kind {
    /// The initial transform as it is.
    Init,
    Refine(RefinerConfig),
    /// A method of the ICP family, from the initial transform; the voxel size if it is not the clouds' own.
    Icp(IcpMethod, Option<f64>),
    /// An estimator on the correspondences that came with the start, or else on matches of 3D features; the initial
    /// transform does not count.
    Estimate(Estimator, RefinerConfig),
}

/// Where the weights of networks come from that tell right correspondences from wrong ones.
pub(super) struct Filters<'a> {
    pub(super) weights: &'a GivenWeights,
    /// Which weights are meant where several were given; any, if `None`.
    pub(super) trained_on: Option<TrainedOn>,
}

impl Filters<'_> {
    fn open(&self, network: Network, settings: &Settings) -> Result<Estimator> {
        let option = format!("the method {}", network.name());
        let fitting = self.trained_on.and_then(|data| self.weights.trained_on(network, data));
        let file = match fitting {
            Some(file) => file,
            None => self.weights.of(network, &option)?,
        };
        Ok(Estimator::Filter(open_filter(file, network, settings)?.into()))
    }
}

/// What a method made of a pair.
pub(super) struct Found {
    pub(super) target_from_source: Matrix4<f64>,
    pub(super) confidence: Option<f64>,
    /// What the confidence was computed from.
    pub(super) signals: Option<BTreeMap<String, f64>>,
    pub(super) verdict: Option<String>,
}

/// All names, for help and errors.
const NAMES: &str = "init, point-to-point, point-to-plane, symmetric, gicp, vgicp, ransac-50k, ransac-1m, sc2-pcr, sc2-pcr++, mac, fast-mac, pointdsc, vbreg, refine, refine-paper, refine-no-pca, refine-no-transfer, refine-no-aggregation, refine-one-round, refine-no-polish, refine-no-consensus, refine-no-search, refine-no-verify";

impl Method {
    /// Reads a list of names.
    ///
    /// # Errors
    /// If one is unknown or comes twice.
    pub(super) fn parse_all(
        names: &[String],
        settings: &Settings,
        filters: &Filters<'_>,
    ) -> Result<Vec<Method>> {
        let mut methods: Vec<Method> = Vec::new();
        for name in names {
            if methods.iter().any(|method| method.name == *name) {
                bail!("--methods names {name} twice");
            }
            methods
                .push(Method { name: name.clone(), kind: Kind::parse(name, settings, filters)? });
        }
        Ok(methods)
    }

    /// Applies the method.
    ///
    /// # Errors
    /// What the method has: then the pair counts as not solved by it.
    pub(super) fn apply(
        &self,
        source: &Scan,
        reference: &Scan,
        start: &Start,
    ) -> rare::Result<Found> {
        match &self.kind {
            Kind::Init => {
                let target_from_source = start.pose()?;
                Ok(Found { target_from_source, confidence: None, signals: None, verdict: None })
            }
            Kind::Icp(method, voxel) => {
                let initial = RigidTransform::from_matrix(&start.pose()?)?;
                align(*method, *voxel, source, reference, &initial)
            }
            Kind::Estimate(estimator, config) => {
                estimate(estimator, source, reference, start, config)
            }
            Kind::Refine(config) => Ok(Found::refined(&refine(
                &Refiner::new(config.clone()),
                source,
                reference,
                start,
            )?)),
        }
    }

    /// The settings of the refiner, if the method is one.
    pub(super) fn refiner(&self) -> Option<&RefinerConfig> {
        match &self.kind {
            Kind::Refine(config) => Some(config),
            Kind::Init | Kind::Icp(..) | Kind::Estimate(..) => None,
        }
    }
}

/// Refines a start.
///
/// # Errors
/// What the refiner has, or if the start is no rigid transform.
pub(super) fn refine(
    refiner: &Refiner,
    source: &Scan,
    reference: &Scan,
    start: &Start,
) -> rare::Result<Refinement> {
    let initial = RigidTransform::from_matrix(&start.pose()?)?;
    match &start.correspondences {
        Some(pairs) => refiner.refine_matched(source, reference, &initial, pairs),
        None => refiner.refine(source, reference, &initial),
    }
}

/// Applies an estimator to what a network or official runs found, or else to matches of built-in features.
fn estimate(
    estimator: &Estimator,
    source: &Scan,
    reference: &Scan,
    start: &Start,
    config: &RefinerConfig,
) -> rare::Result<Found> {
    let pose = match (&start.correspondences, &start.description) {
        (Some(pairs), _) => estimator.on_pairs(pairs, source, reference, config),
        (None, Some(description)) => {
            estimator.on_description(description, source, reference, config)
        }
        (None, None) => on_built_in_features(estimator, source, reference, config),
    }?;
    Ok(Found::without_verdict(&pose))
}

fn on_built_in_features(
    estimator: &Estimator,
    source: &Scan,
    reference: &Scan,
    config: &RefinerConfig,
) -> rare::Result<RigidTransform> {
    let refiner = Refiner::new(config.clone());
    if let Estimator::Sc2PcrPlusPlus = estimator {
        return refiner.estimate_initial(source, reference, InitialMethod::Sc2PcrPlusPlus);
    }
    let pairs = refiner.initial_matches(source, reference)?;
    estimator.on_pairs(&pairs, source, reference, config)
}

impl Found {
    /// A method that only gives a transform.
    fn without_verdict(pose: &RigidTransform) -> Found {
        let target_from_source = pose.to_matrix();
        Found { target_from_source, confidence: None, signals: None, verdict: None }
    }

    fn refined(refinement: &Refinement) -> Found {
        Found {
            target_from_source: refinement.target_from_source.to_matrix(),
            confidence: Some(refinement.confidence),
            signals: signals(refinement),
            verdict: Some(verdict_name(refinement.verdict).to_owned()),
        }
    }
}

/// What the confidence of a refinement was computed from.
fn signals(refinement: &Refinement) -> Option<BTreeMap<String, f64>> {
    let signals = refinement.evidence.signals();
    Some(signals.into_iter().map(|(name, value)| (name.to_owned(), value)).collect())
}

fn align(
    method: IcpMethod,
    voxel: Option<f64>,
    source: &Scan,
    reference: &Scan,
    initial: &RigidTransform,
) -> rare::Result<Found> {
    let (source, reference) = (&source.cloud, &reference.cloud);
    let scale = Scale::new(Profile::Auto, voxel, source, reference)?;
    let local = PointCloud::to_local(reference, source, initial);
    let icp = MultiScaleIcp::for_voxel(method, scale.voxel);
    let pose = icp.align(source.points(), reference.points(), &local)?.target_from_source;
    Ok(Found::without_verdict(&PointCloud::to_world(reference, source, &pose)))
}

impl Kind {
    fn parse(name: &str, settings: &Settings, filters: &Filters<'_>) -> Result<Kind> {
        let given = &settings.refiner;
        let with = |recipe: Recipe| Kind::Refine(RefinerConfig { recipe, ..given.clone() });
        let recipe = given.recipe.clone();
        let icp = |method| Kind::Icp(method, given.voxel);
        let estimate = |method| Kind::Estimate(method, given.clone());
        Ok(match name {
            "init" => Kind::Init,
            "point-to-point" => icp(IcpMethod::PointToPoint),
            "point-to-plane" => icp(IcpMethod::PointToPlane),
            "symmetric" => icp(IcpMethod::Symmetric),
            "gicp" => icp(IcpMethod::Generalised),
            "vgicp" => icp(IcpMethod::VoxelisedGeneralised),
            "ransac-50k" => estimate(Estimator::Ransac(50_000)),
            "ransac-1m" => estimate(Estimator::Ransac(1_000_000)),
            "sc2-pcr" => estimate(Estimator::Sc2Pcr),
            "sc2-pcr++" => estimate(Estimator::Sc2PcrPlusPlus),
            "mac" => estimate(Estimator::Mac),
            "fast-mac" => estimate(Estimator::FastMac),
            "pointdsc" => estimate(filters.open(Network::PointDsc, settings)?),
            "vbreg" => estimate(filters.open(Network::Vbreg, settings)?),
            "refine" => with(recipe),
            "refine-paper" => with(Recipe::paper()),
            "refine-no-pca" => with(Recipe { components: None, ..recipe }),
            "refine-no-transfer" => with(Recipe { feature_transfer: false, ..recipe }),
            "refine-no-aggregation" => with(Recipe { inlier_aggregation: false, ..recipe }),
            "refine-one-round" => with(Recipe { rounds: 1, ..recipe }),
            "refine-no-polish" => with(Recipe { polish: false, ..recipe }),
            "refine-no-consensus" => with(Recipe { consensus: false, ..recipe }),
            "refine-no-search" => with(Recipe { search: false, ..recipe }),
            "refine-no-verify" => with(Recipe { verify: false, search: false, ..recipe }),
            _ => bail!("--methods {name}: unknown, choose from {NAMES}"),
        })
    }
}

/// The verdict as records name it.
fn verdict_name(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Refined => "refined",
        Verdict::KeptInitial => "kept-initial",
        Verdict::Rejected => "rejected",
    }
}
