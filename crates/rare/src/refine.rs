//! The arrows of the paper's figure: which step follows which. Nothing else in the crate knows the order.

mod config;
mod encoded_views;
mod hypotheses;
mod initial;
mod stopwatch;
mod views;
mod working_pair;

use nalgebra::Matrix6;

pub use config::{Recipe, RefinerConfig};
use encoded_views::DenseViews;
pub use encoded_views::EncodedViews;
use hypotheses::Candidate;
pub use initial::InitialMethod;
use stopwatch::Stopwatch;
pub use stopwatch::Timing;
use working_pair::WorkingPair;

use crate::aggregate::vote;
use crate::data::{
    Correspondence, CorrespondenceSet, CorrespondenceSets, RigidTransform, Scan, SetName,
};
use crate::encode::DepthEncoder;
use crate::error::Result;
use crate::scale::Scale;
use crate::transfer::Sampling;
use crate::verify::{DepthConsistency, Verdict, Verifier, confidence};

/// Refines initial transforms between clouds.
///
/// ```
/// use rare::{Refiner, RefinerConfig, Scan, synthetic};
/// // Two scans of a thing on a table, and a start that is 10 degrees and 3 cm off.
/// let pair = synthetic::object_pair(1)?;
/// let (source, target) = (Scan::from(pair.source), Scan::from(pair.target));
/// let refiner = Refiner::new(RefinerConfig::default());
/// let refinement = refiner.refine(&source, &target, &pair.initial)?;
/// let error = refinement.target_from_source.error_to(&pair.target_from_source);
/// assert!(error.rotation_degrees < 1.0 && error.translation < 0.005);
/// assert!(refinement.confidence > 0.5);
/// # Ok::<(), rare::Error>(())
/// ```
pub struct Refiner {
    config: RefinerConfig,
    encoder: Option<Box<dyn DepthEncoder>>,
    progress: Option<Box<dyn Fn(&'static str) + Send + Sync>>,
}

/// A transform and everything that speaks for or against it.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// Moves points of the source into the target's frame, both as the caller gave them.
    pub target_from_source: RigidTransform,
    /// What to make of it.
    pub verdict: Verdict,
    /// How sure, 0 to 1. Not calibrated: use it to rank.
    pub confidence: f64,
    /// Share of the source that lies on the target, 0 to 1.
    pub overlap: f64,
    /// Correspondences of all sets that agree with the transform.
    pub inliers: usize,
    /// Correspondences of all sets.
    pub correspondences: usize,
    /// The same by set.
    pub sets: Vec<SetEvidence>,
    /// The correspondences themselves, each side in its cloud's frame as the caller gave it, metres.
    pub matches: CorrespondenceSets,
    /// Two-way depth consistency of the clouds under the transform.
    pub consistency: DepthConsistency,
    /// The 6 x 6 information matrix of 3DMatch's `gt.info` (translation first, metres) over the overlapping source
    /// points (one per voxel), moved into the target's local frame. Element (0, 0) is their number.
    pub information: Matrix6<f64>,
    /// The lengths that were used, metres.
    pub scale: Scale,
    /// Wall time by step.
    pub timings: Vec<Timing>,
    /// What the caller should know, in words.
    pub warnings: Vec<String>,
}

/// What one set of correspondences says of the final transform.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SetEvidence {
    /// The set.
    pub name: SetName,
    /// How many correspondences it has.
    pub correspondences: usize,
    /// How many of them agree.
    pub inliers: usize,
}

impl Refiner {
    /// A refiner with the built-in depth features, sized for each pair of clouds.
    #[must_use]
    pub fn new(config: RefinerConfig) -> Refiner {
        Refiner { config, encoder: None, progress: None }
    }

    /// Takes another source of depth-map features.
    #[must_use]
    pub fn with_encoder(mut self, encoder: Box<dyn DepthEncoder>) -> Refiner {
        self.encoder = Some(encoder);
        self
    }

    /// Calls `progress` with the name of every step as it begins.
    #[must_use]
    pub fn with_progress(
        mut self,
        progress: impl Fn(&'static str) + Send + Sync + 'static,
    ) -> Refiner {
        self.progress = Some(Box::new(progress));
        self
    }

    /// Makes a better transform out of `initial`, which moves the source into the target's frame.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is degenerate (fewer than three points, all on one line), the features of the sides
    /// do not fit, or a setting makes no sense.
    pub fn refine(
        &self,
        source: &Scan,
        target: &Scan,
        initial: &RigidTransform,
    ) -> Result<Refinement> {
        self.refine_with(source, target, initial, None)
    }

    /// The same with correspondences of another method (each side in its cloud's own frame, metres) in the place of
    /// the matches of 3D features.
    ///
    /// # Errors
    /// As [`Refiner::refine`].
    pub fn refine_matched(
        &self,
        source: &Scan,
        target: &Scan,
        initial: &RigidTransform,
        pairs: &[Correspondence],
    ) -> Result<Refinement> {
        self.refine_with(source, target, initial, Some(pairs))
    }

    fn refine_with(
        &self,
        source: &Scan,
        target: &Scan,
        initial: &RigidTransform,
        given: Option<&[Correspondence]>,
    ) -> Result<Refinement> {
        let mut clock = self.stopwatch();
        let pair = clock.time("prepare", || WorkingPair::new(source, target, &self.config))?;
        let given = given.map(|pairs| pair.to_working_pairs(pairs));
        self.run(&pair, &pair.to_working(initial), given.as_deref(), clock)
    }

    /// Registers clouds of which nothing is known: makes an initial transform, then refines it.
    ///
    /// # Errors
    /// As [`Refiner::refine`]; `NoPose` if the clouds have no consistent features in common.
    pub fn register(
        &self,
        source: &Scan,
        target: &Scan,
        method: InitialMethod,
    ) -> Result<Refinement> {
        let mut clock = self.stopwatch();
        let pair = clock.time("prepare", || WorkingPair::new(source, target, &self.config))?;
        let start = self.verifier(&pair, &RigidTransform::identity());
        let initial =
            clock.time("initial", || initial::estimate(&pair, method, self.config.seed, &start))?;
        self.run(&pair, &initial, None, clock)
    }

    /// The initial transform of [`Refiner::register`] alone.
    ///
    /// # Errors
    /// As [`Refiner::register`].
    pub fn estimate_initial(
        &self,
        source: &Scan,
        target: &Scan,
        method: InitialMethod,
    ) -> Result<RigidTransform> {
        let pair = WorkingPair::new(source, target, &self.config)?;
        let verifier = self.verifier(&pair, &RigidTransform::identity());
        Ok(pair.to_world(&initial::estimate(&pair, method, self.config.seed, &verifier)?))
    }

    /// The matches of fast point feature histograms from which [`Refiner::register`] begins: the best-scored ones, each
    /// side in its cloud's frame as the caller gave it, metres.
    ///
    /// # Errors
    /// As [`Refiner::refine`].
    pub fn initial_matches(&self, source: &Scan, target: &Scan) -> Result<Vec<Correspondence>> {
        let pair = WorkingPair::new(source, target, &self.config)?;
        Ok(pair.to_world_pairs(&initial::matches(&pair, self.config.seed)?))
    }

    /// Rounds of the paper's method, each from the pose of the one before.
    fn run(
        &self,
        pair: &WorkingPair<'_>,
        initial: &RigidTransform,
        given: Option<&[Correspondence]>,
        mut clock: Stopwatch<'_>,
    ) -> Result<Refinement> {
        let verifier = clock.time("verify", || self.verifier(pair, initial));
        let mut best = Candidate::judged(*initial, &verifier);
        let mut sets = CorrespondenceSets::default();
        for _ in 0..self.config.recipe.rounds {
            sets = self.correspondence_sets(pair, &best.target_from_source, given, &mut clock)?;
            let next = self.next_candidate(pair, &sets, &best, &verifier, &mut clock);
            let settled = next.settled(&best, pair.scale.voxel);
            best = next;
            if settled {
                break;
            }
        }
        if self.config.recipe.polish {
            best = clock.time("polish", || hypotheses::finish(pair, &best, &verifier));
        }
        let evidence = clock.time("verify", || self.evidence(pair, initial, &best, &sets));
        Ok(Refinement { timings: clock.into_timings(), ..evidence })
    }

    fn stopwatch(&self) -> Stopwatch<'_> {
        Stopwatch::new(self.progress.as_deref())
    }

    /// Steps 1 to 7: the correspondence sets seen under a pose.
    fn correspondence_sets(
        &self,
        pair: &WorkingPair<'_>,
        pose: &RigidTransform,
        given: Option<&[Correspondence]>,
        clock: &mut Stopwatch<'_>,
    ) -> Result<CorrespondenceSets> {
        let recipe = &self.config.recipe;
        let DenseViews { viewpoints, maps } = self.dense_views(pair, pose, clock);
        let layers = clock.time("encode", || self.encode(pair, &maps))?;
        let features = clock.time("reduce", || views::reduce_all(layers, recipe.components))?;
        let lifted = clock.time("transfer", || {
            views::transfer_all(pair, &viewpoints, pose, &maps, &features, self.sampling())
        });
        let fused = clock.time("fuse", || views::fuse_all(pair, &lifted));
        let sets =
            clock.time("match", || views::match_all(pair, &viewpoints, &lifted, &fused, given))?;
        Ok(if recipe.feature_transfer { sets } else { sets.without_common_points() })
    }

    /// Steps 8 and 9: the hypotheses of the sets, and the one that depth consistency prefers.
    fn next_candidate(
        &self,
        pair: &WorkingPair<'_>,
        sets: &CorrespondenceSets,
        current: &Candidate,
        verifier: &Verifier<'_>,
        clock: &mut Stopwatch<'_>,
    ) -> Candidate {
        let recipe = &self.config.recipe;
        // Sets that determine nothing propose nothing: then the current pose stands.
        let proposed = clock
            .time("aggregate", || hypotheses::propose(recipe, &pair.scale, sets))
            .unwrap_or_default();
        if !recipe.keep_initial {
            let first = proposed.first().unwrap_or(&current.target_from_source);
            return Candidate::judged(*first, verifier);
        }
        let ranked = clock
            .time("verify", || hypotheses::rank(&proposed, current, verifier, pair.scale.voxel));
        if !recipe.polish {
            return ranked.into_iter().next().unwrap_or(*current);
        }
        clock.time("polish", || hypotheses::polish(pair, &ranked, verifier))
    }

    fn verifier<'a>(&self, pair: &'a WorkingPair<'_>, pose: &RigidTransform) -> Verifier<'a> {
        Verifier::new(
            &pair.target.fine,
            &pair.source.fine,
            &self.viewpoints(pair, pose),
            pair.scale.voxel,
        )
    }

    fn sampling(&self) -> Sampling {
        if self.config.recipe.aligned_corners {
            Sampling::AlignedCorners
        } else {
            Sampling::OwnCell
        }
    }

    /// Everything that is known of the final pose.
    fn evidence(
        &self,
        pair: &WorkingPair<'_>,
        initial: &RigidTransform,
        best: &Candidate,
        sets: &CorrespondenceSets,
    ) -> Refinement {
        let pose = &best.target_from_source;
        let radius = pair.scale.acceptance_radius;
        let of_set = |set: &CorrespondenceSet| SetEvidence {
            name: set.name,
            correspondences: set.pairs.len(),
            inliers: vote(&set.pairs, &[*pose], radius)[0],
        };
        let matches = pair.to_world_sets(sets);
        let sets: Vec<SetEvidence> = sets.sets.iter().map(of_set).collect();
        let overlap = pair.overlap(pose);
        let inliers: usize = sets.iter().map(|set| set.inliers).sum();
        let correspondences: usize = sets.iter().map(|set| set.correspondences).sum();
        let inlier_ratio = inliers as f64 / correspondences.max(1) as f64;
        let confidence = confidence(best.consistency.agreement(), overlap.share, inlier_ratio);
        Refinement {
            target_from_source: pair.to_world(pose),
            verdict: Verdict::of(confidence, pose == initial),
            confidence,
            overlap: overlap.share,
            inliers,
            correspondences,
            sets,
            matches,
            consistency: best.consistency,
            information: overlap.information,
            scale: pair.scale.in_units(1.0 / pair.unit),
            timings: Vec::new(),
            warnings: pair.warnings(),
        }
    }
}
