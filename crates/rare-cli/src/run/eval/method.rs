//! What can be compared: the names of `--methods` and what they do to a pair.

use std::collections::BTreeMap;

use anyhow::{Result, bail};
use rare::nalgebra::Matrix4;
use rare::pose::{FastMac, IcpMethod, Mac, MultiScaleIcp, PoseEstimator, Ransac, Sc2Pcr};
use rare::scale::{Profile, Scale};
use rare::verify::Verdict;
use rare::{
    Correspondence, InitialMethod, PointCloud, Recipe, Refinement, Refiner, RefinerConfig,
    RigidTransform, Scan,
};

use super::start::Start;
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

/// An estimator of the paper's tables.
#[derive(Clone, Copy)]
enum Estimator {
    /// With so many samples.
    Ransac(usize),
    Sc2Pcr,
    Sc2PcrPlusPlus,
    Mac,
    FastMac,
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
const NAMES: &str = "init, point-to-point, point-to-plane, symmetric, gicp, vgicp, ransac-50k, ransac-1m, sc2-pcr, sc2-pcr++, mac, fast-mac, refine, refine-paper, refine-no-pca, refine-no-transfer, refine-no-aggregation, refine-one-round, refine-no-polish, refine-no-consensus, refine-no-search, refine-no-verify";

impl Method {
    /// Reads a list of names.
    ///
    /// # Errors
    /// If one is unknown or comes twice.
    pub(super) fn parse_all(names: &[String], settings: &Settings) -> Result<Vec<Method>> {
        let mut methods: Vec<Method> = Vec::new();
        for name in names {
            if methods.iter().any(|method| method.name == *name) {
                bail!("--methods names {name} twice");
            }
            methods.push(Method { name: name.clone(), kind: Kind::parse(name, settings)? });
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
        let initial = &start.pose;
        match &self.kind {
            Kind::Init => {
                let target_from_source = *initial;
                Ok(Found { target_from_source, confidence: None, signals: None, verdict: None })
            }
            Kind::Icp(method, voxel) => {
                let initial = RigidTransform::from_matrix(initial)?;
                align(*method, *voxel, source, reference, &initial)
            }
            Kind::Estimate(estimator, config) => match &start.correspondences {
                Some(pairs) => estimator.on_pairs(pairs, source, reference, config),
                None => estimator.on_features(source, reference, config),
            },
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
    let initial = RigidTransform::from_matrix(&start.pose)?;
    match &start.correspondences {
        Some(pairs) => refiner.refine_matched(source, reference, &initial, pairs),
        None => refiner.refine(source, reference, &initial),
    }
}

impl Estimator {
    /// Applies it to given correspondences, with the presets that fit the size of the clouds.
    fn on_pairs(
        self,
        pairs: &[Correspondence],
        source: &Scan,
        reference: &Scan,
        config: &RefinerConfig,
    ) -> rare::Result<Found> {
        let (source, reference) = (&source.cloud, &reference.cloud);
        let voxel = Scale::new(config.profile, config.voxel, source, reference)?.voxel;
        let estimate = |estimator: &dyn PoseEstimator| estimator.estimate(source, reference, pairs);
        let estimate = match self {
            Estimator::Ransac(max_iterations) => {
                estimate(&Ransac { max_iterations, seed: config.seed, ..Ransac::for_voxel(voxel) })
            }
            Estimator::Sc2Pcr => estimate(&Sc2Pcr::for_voxel(voxel)),
            Estimator::Mac => estimate(&Mac::for_voxel(voxel)),
            Estimator::FastMac => {
                estimate(&FastMac { seed: config.seed, ..FastMac::for_voxel(voxel) })
            }
            Estimator::Sc2PcrPlusPlus => Err(rare::Error::Unsupported(
                "sc2-pcr++ needs the descriptors of all keypoints, which came not with the start"
                    .to_owned(),
            )),
        }?;
        Ok(Found::without_verdict(&estimate.target_from_source))
    }

    /// Applies it to matches of built-in features.
    fn on_features(
        self,
        source: &Scan,
        reference: &Scan,
        config: &RefinerConfig,
    ) -> rare::Result<Found> {
        let refiner = Refiner::new(config.clone());
        if let Estimator::Sc2PcrPlusPlus = self {
            let method = InitialMethod::Sc2PcrPlusPlus;
            let pose = refiner.estimate_initial(source, reference, method)?;
            return Ok(Found::without_verdict(&pose));
        }
        self.on_pairs(&refiner.initial_matches(source, reference)?, source, reference, config)
    }
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
    fn parse(name: &str, settings: &Settings) -> Result<Kind> {
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
