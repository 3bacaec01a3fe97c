//! Step 8 against the golden aggregation, and its properties on simulated sets.

use nalgebra::{Point3, Rotation3, Vector3};
use proptest::prelude::*;
use rare::aggregate::{self, Aggregation, aggregate};
use rare::random::Random;
use rare::{Correspondence, CorrespondenceSet, CorrespondenceSets, RigidTransform, SetName};

use crate::shared::Golden;

const NAMES: [(SetName, &str); 5] = [
    (SetName::CommonReference, "common_ref"),
    (SetName::CommonSource, "common_src"),
    (SetName::DiffusionReference, "diffu_ref"),
    (SetName::DiffusionSource, "diffu_src"),
    (SetName::Features3d, "3d"),
];

fn golden_sets(golden: &mut Golden) -> CorrespondenceSets {
    let mut set = |(name, key): (SetName, &str)| {
        let source = golden.array(&format!("{key}_src")).points();
        let target = golden.array(&format!("{key}_ref")).points();
        let scores = golden.array(&format!("{key}_weights")).values;
        let pairs = source.into_iter().zip(target).zip(scores);
        let pairs = pairs.map(|((source, target), score)| Correspondence { source, target, score });
        CorrespondenceSet { name, pairs: pairs.collect() }
    };
    CorrespondenceSets { sets: NAMES.map(&mut set).to_vec() }
}

fn assert_is(found: &RigidTransform, golden: &mut Golden, name: &str) {
    let difference = found.to_matrix() - golden.array(name).matrix4();
    assert!(difference.amax() < 1e-6, "{name}: {difference}");
}

#[test]
fn golden_aggregation() {
    let Some(mut golden) = Golden::open("rare/s8_aggregation.npz") else { return };
    let sets = golden_sets(&mut golden);
    let config = Aggregation {
        acceptance_radius: golden.array("radius").values[0],
        reweighting_rounds: golden.array("n_refine").usize()[0],
        top: golden.array("top_k").usize()[0],
    };
    let found = aggregate(&sets, &config, None).unwrap();
    for (proposal, (name, key)) in found.proposals.iter().zip(NAMES) {
        let candidate = proposal.candidate.unwrap();
        assert_eq!(proposal.name, name);
        assert_is(&candidate.target_from_source, &mut golden, &format!("{key}_T"));
        let inliers = golden.array(&format!("{key}_inliers")).usize();
        assert_eq!([candidate.inliers], inliers[..]);
    }
    let best = golden.array("best").usize()[0];
    assert_eq!((found.consensus.best_candidate, found.best_set), (best, Some(NAMES[best].0)));
    let rounds = golden.array("inliers_per_iteration").usize();
    assert_eq!(found.consensus.inliers_per_round, rounds);
    assert_eq!(found.consensus.selected, golden.array("top_indices").usize());
    assert_is(&found.consensus.target_from_source, &mut golden, "T_final");
    let winner = found.proposals[best].candidate.unwrap().target_from_source;
    assert_is(&winner, &mut golden, "T_best");
    let (refined, _) = aggregate::reweight(&sets.union(), &winner, &config);
    assert_is(&refined, &mut golden, "T_refined");
}

/// A motion, and two sets of `count` pairs under it of which every `period`-th is wrong by half a metre.
fn simulated(count: usize, period: usize, seed: u64) -> (RigidTransform, CorrespondenceSets) {
    let mut random = Random::new(seed, 0);
    let mut vector = |scale: f64| Vector3::from([0; 3].map(|_| scale * random.normal()));
    let truth = RigidTransform::new(Rotation3::new(vector(0.5)), vector(2.0));
    let mut pair = |index: usize| {
        let source = Point3::from(vector(1.5));
        let wrong = if index.is_multiple_of(period) { 0.5 } else { 0.0 };
        let score = 0.2 + 0.1 * vector(1.0).x.abs();
        Correspondence {
            source,
            target: truth.apply(&source) + wrong * vector(1.0).normalize(),
            score,
        }
    };
    let mut set = |name| CorrespondenceSet { name, pairs: (0..count).map(&mut pair).collect() };
    let sets = vec![set(SetName::CommonReference), set(SetName::Features3d)];
    (truth, CorrespondenceSets { sets })
}

proptest! {
    #[test]
    fn exact_pairs_among_wrong_ones_give_the_motion(
        count in 40_usize..200,
        period in 5_usize..9,
        seed in 0_u64..10_000,
    ) {
        let (truth, sets) = simulated(count, period, seed);
        let config = Aggregation { acceptance_radius: 0.25, reweighting_rounds: 10, top: count };
        let found = aggregate(&sets, &config, None).unwrap().consensus;
        let error = found.target_from_source.error_to(&truth);
        prop_assert!(found.inliers_per_round[0] > count);
        prop_assert!(error.rotation_degrees < 1e-9 && error.translation < 1e-9, "{error:?}");
    }

    #[test]
    fn the_order_of_the_pairs_does_not_matter(seed in 0_u64..10_000) {
        let (_, sets) = simulated(120, 4, seed);
        let mut shuffled = sets.clone();
        let mut random = Random::new(seed, 1);
        for set in &mut shuffled.sets {
            set.pairs = random.sample(120, 120).into_iter().map(|index| set.pairs[index]).collect();
        }
        let config = Aggregation { top: 100, ..Aggregation::indoor() };
        let found = [sets, shuffled].map(|sets| {
            aggregate(&sets, &config, None).unwrap().consensus.target_from_source.to_matrix()
        });
        prop_assert!((found[0] - found[1]).amax() < 1e-9);
    }
}

#[test]
fn the_initial_transform_wins_only_if_it_has_more_inliers() {
    let (truth, mut sets) = simulated(60, 1000, 3);
    let config = Aggregation::indoor();
    // Each set alone gives the motion but for its one wrong pair, the truth fits all the others: equal votes.
    let tied = aggregate(&sets, &config, Some(&truth)).unwrap();
    assert_eq!(tied.best_set, Some(SetName::CommonReference));
    for set in &mut sets.sets {
        for pair in set.pairs.iter_mut().take(30) {
            pair.target += Vector3::new(3.0, 0.0, 0.0);
        }
    }
    let helped = aggregate(&sets, &config, Some(&truth)).unwrap();
    assert_eq!((helped.best_set, helped.consensus.best_candidate), (None, 2));
    assert!(helped.consensus.target_from_source.error_to(&truth).translation < 1e-6);
}

#[test]
fn sets_that_determine_nothing_are_passed_over_or_reported() {
    let (truth, mut sets) = simulated(50, 1000, 4);
    let config = Aggregation::indoor();
    sets.sets[0].pairs.truncate(2);
    let found = aggregate(&sets, &config, None).unwrap();
    assert_eq!((found.proposals[0].candidate, found.proposals[0].pairs), (None, 2));
    assert_eq!((found.best_set, found.consensus.best_candidate), (Some(SetName::Features3d), 0));
    sets.sets[1].pairs.truncate(1);
    let message = aggregate(&sets, &config, None).unwrap_err().to_string();
    assert!(message.contains("common_ref has 2, features_3d has 1"), "{message}");
    // With an initial transform there is something to return, and nothing to improve it by.
    let kept = aggregate(&sets, &config, Some(&truth)).unwrap();
    assert_eq!((kept.best_set, kept.consensus.target_from_source), (None, truth));
    let none = CorrespondenceSets::default();
    assert!(aggregate(&none, &config, None).unwrap_err().to_string().contains("no set"));
}

#[test]
fn odd_numbers_do_not_panic() {
    let (truth, mut sets) = simulated(20, 1000, 5);
    for (index, pair) in sets.sets[0].pairs.iter_mut().enumerate() {
        pair.score = [f64::NAN, -1.0, 0.0][index % 3];
    }
    sets.sets[1].pairs[4].source.x = f64::NAN;
    for acceptance_radius in [0.1, 0.0, f64::NAN, f64::INFINITY] {
        let config = Aggregation { acceptance_radius, reweighting_rounds: 3, top: usize::MAX };
        let found = aggregate(&sets, &config, Some(&truth)).unwrap();
        assert_eq!(found.proposals[0].candidate, None);
        let none = Aggregation { reweighting_rounds: 0, top: 0, ..config };
        assert!(aggregate(&sets, &none, Some(&truth)).unwrap().consensus.selected.is_empty());
    }
}
