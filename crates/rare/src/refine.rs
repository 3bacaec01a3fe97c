//! The arrows of the paper's figure: which step follows which. Nothing else in the crate knows the order.

mod config;
mod encoded_views;
mod hypotheses;
mod illustration;
mod initial;
mod search;
mod stopwatch;
mod views;
mod working_pair;

use nalgebra::Matrix6;

pub use config::{Recipe, RefinerConfig};
use encoded_views::DenseViews;
pub use encoded_views::EncodedViews;
use hypotheses::Candidate;
pub use illustration::{
    IllustratedCloud, IllustratedMap, IllustratedView, Illustration, IllustrationRequest,
    PixelMatch,
};
pub use initial::InitialMethod;
use search::Effort;
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
use crate::verify::{Evidence, Model, Verdict, Verifier};

/// Refines initial transforms between clouds.
///
/// ```
/// use rare::scale::Profile;
/// use rare::{Refiner, RefinerConfig, Scan, synthetic};
/// // Two scans of a thing on a table, and a start that is 10 degrees and 3 cm off.
/// let pair = synthetic::object_pair(1)?;
/// let (source, target) = (Scan::from(pair.source), Scan::from(pair.target));
/// // No sensor stood at the origin of its frame.
/// let refiner = Refiner::new(RefinerConfig { profile: Profile::Object, ..RefinerConfig::default() });
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
    /// The calibrated probability that the transform is right: within 15 degrees and 6 voxels (0.3 m in rooms), streets
    /// 5 degrees and 2 voxels (0.6 m).
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
    /// Why: what sensors, surfaces and depth maps say of the transform.
    pub evidence: Evidence,
    /// The transforms that were compared, with what was known of each.
    pub hypotheses: Vec<Hypothesis>,
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

/// A transform that was compared with others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// Moves points of the source into the target's frame, both as the caller gave them.
    pub target_from_source: RigidTransform,
    /// What was known of it; without support if it was only screened.
    pub evidence: Evidence,
    /// Whether it descends from the initial transform, not from a search of its own.
    pub from_initial: bool,
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
        Ok(pair.to_world_pairs(&search::putative(&pair)?))
    }

    /// A round of the paper's method from the initial transform; unless that was enough, from what searches find; and
    /// from the best until it settles. Then the polish.
    fn run(
        &self,
        pair: &WorkingPair<'_>,
        initial: &RigidTransform,
        given: Option<&[Correspondence]>,
        mut clock: Stopwatch<'_>,
    ) -> Result<Refinement> {
        let verifier = clock.time("verify", || self.verifier(pair, initial));
        let start = Candidate::judged(*initial, true, &verifier);
        let round = Round { refiner: self, pair, given, verifier: &verifier };
        let mut best = round.begin_at(&start, &mut clock)?;
        let recipe = &self.config.recipe;
        // Where nothing is compared, there is nothing to seek.
        if recipe.verify && recipe.search && !best.candidate.is_certain() {
            best = round.search_from(best, initial, &mut clock)?;
        }
        best = round.until_settled(best, &mut clock)?;
        if recipe.polish {
            best.candidate = clock.time("polish", || {
                hypotheses::finish(pair, &best.candidate, &best.sets, &verifier)
            });
        }
        let evidence = clock.time("verify", || self.evidence(pair, initial, &best));
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
        let DenseViews { viewpoints, maps, .. } = self.dense_views(pair, pose, clock);
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

    fn verifier<'a>(&self, pair: &'a WorkingPair<'_>, pose: &RigidTransform) -> Verifier<'a> {
        let viewpoints = self.viewpoints(pair, pose);
        Verifier::new(pair.target.judged(), pair.source.judged(), &viewpoints, pair.scale.voxel)
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
        best: &Outcome,
    ) -> Refinement {
        let Outcome { candidate, sets, compared } = best;
        let pose = &candidate.target_from_source;
        let radius = pair.scale.acceptance_radius;
        let of_set = |set: &CorrespondenceSet| SetEvidence {
            name: set.name,
            correspondences: set.pairs.len(),
            inliers: vote(&set.pairs, &[*pose], radius)[0],
        };
        let hypothesis = |candidate: &Candidate| Hypothesis {
            target_from_source: pair.to_world(&candidate.target_from_source),
            evidence: candidate.evidence,
            from_initial: candidate.from_initial,
        };
        let matches = pair.to_world_sets(sets);
        let sets: Vec<SetEvidence> = sets.sets.iter().map(of_set).collect();
        let overlap = pair.overlap(pose);
        let confidence = Model::confidence(pair.scale.kind).probability(&candidate.evidence);
        Refinement {
            target_from_source: pair.to_world(pose),
            verdict: Verdict::of(confidence, pose == initial),
            confidence,
            overlap: overlap.share,
            inliers: sets.iter().map(|set| set.inliers).sum(),
            correspondences: sets.iter().map(|set| set.correspondences).sum(),
            sets,
            matches,
            evidence: candidate.evidence,
            hypotheses: compared.iter().map(hypothesis).collect(),
            information: overlap.information,
            scale: pair.scale.in_units(1.0 / pair.unit),
            timings: Vec::new(),
            warnings: pair.warnings(),
        }
    }
}

/// What a round comes to.
struct Outcome {
    candidate: Candidate,
    /// The correspondences that were seen from where the round began.
    sets: CorrespondenceSets,
    /// All that were compared on the way.
    compared: Vec<Candidate>,
}

impl Outcome {
    /// The other outcome, which follows this one.
    fn then(self, next: Outcome) -> Outcome {
        Outcome { compared: [self.compared, next.compared].concat(), ..next }
    }
}

/// Steps 1 to 9 once, from any pose.
struct Round<'a> {
    refiner: &'a Refiner,
    pair: &'a WorkingPair<'a>,
    given: Option<&'a [Correspondence]>,
    verifier: &'a Verifier<'a>,
}

impl Round<'_> {
    /// The best of the starting pose and what the sets that are seen from it propose.
    fn begin_at(&self, start: &Candidate, clock: &mut Stopwatch<'_>) -> Result<Outcome> {
        let (refiner, pair) = (self.refiner, self.pair);
        let recipe = &refiner.config.recipe;
        let pose = &start.target_from_source;
        let sets = refiner.correspondence_sets(pair, pose, self.given, clock)?;
        // Sets that determine nothing propose nothing: then the pose stands.
        let proposed = clock
            .time("aggregate", || hypotheses::propose(recipe, &pair.scale, &sets))
            .unwrap_or_default();
        let compared = if recipe.verify {
            clock
                .time("verify", || hypotheses::ranked(pair, start, &proposed, &sets, self.verifier))
        } else {
            let first = proposed.first().unwrap_or(pose);
            vec![Candidate::judged(*first, true, self.verifier).supported(&sets, pair.scale.voxel)]
        };
        let candidate = *compared.first().unwrap_or(start);
        Ok(Outcome { candidate, sets, compared })
    }

    /// Further rounds from where an outcome leads, while it moves.
    fn until_settled(&self, mut best: Outcome, clock: &mut Stopwatch<'_>) -> Result<Outcome> {
        for _ in 1..self.refiner.config.recipe.rounds {
            let next = self.begin_at(&best.candidate, clock)?;
            let settled = next.candidate.settled(&best.candidate, self.pair.scale.voxel);
            best = best.then(next);
            if settled {
                break;
            }
        }
        Ok(best)
    }

    /// Rounds from the most believable of the poses that searches find, until one is certain: first those of the usual
    /// descriptors and around the initial transform, then those of others.
    fn search_from(
        &self,
        mut best: Outcome,
        initial: &RigidTransform,
        clock: &mut Stopwatch<'_>,
    ) -> Result<Outcome> {
        let (pair, seed) = (self.pair, self.refiner.config.seed);
        for effort in [Effort::Usual, Effort::Thorough] {
            let found = clock.time("search", || search::by_features(pair, self.given, effort))?;
            let around = match effort {
                Effort::Usual => search::around(pair, initial, seed),
                Effort::Thorough => Vec::new(),
            };
            let starts = clock.time("verify", || {
                hypotheses::screened(pair, &found, &around, &best.candidate, self.verifier)
            });
            best = self.best_of(best, &starts, clock)?;
            if best.candidate.is_certain() {
                break;
            }
        }
        Ok(best)
    }

    /// Rounds from the first few starts, until one is certain; the best outcome.
    fn best_of(
        &self,
        mut best: Outcome,
        starts: &[Candidate],
        clock: &mut Stopwatch<'_>,
    ) -> Result<Outcome> {
        best.compared.extend(starts);
        for start in starts.iter().take(hypotheses::SCREENED) {
            let next = self.begin_at(start, clock)?;
            if next.candidate.score() > best.candidate.score() {
                best = best.then(next);
            } else {
                best.compared.extend(next.compared);
            }
            if best.candidate.is_certain() {
                break;
            }
        }
        Ok(best)
    }
}
