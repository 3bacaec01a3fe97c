//! What is done and said when parts of the method are switched off.

use super::{default, paper, room};
use rare::{Recipe, Refinement, Refiner, RefinerConfig};

#[test]
fn the_papers_preset_improves_the_start() {
    let pair = room();
    let refinement = pair.refined(paper());
    let (degrees, metres) = pair.error(&refinement.target_from_source);
    println!("paper: {degrees} {metres} {:?}", refinement.sets);
    // Measured: 0.34 degrees, 9 mm.
    assert!(degrees < 1.5 && metres < 0.05, "{degrees} {metres}");
}

#[test]
fn every_step_can_be_switched_off() {
    let pair = room();
    let bare =
        Recipe { rounds: 1, verify: false, search: false, polish: false, ..Recipe::default() };
    let run = |recipe| pair.refined(RefinerConfig { recipe, ..default() });
    let steps = |refinement: &Refinement, step: &str| {
        refinement.timings.iter().any(|timing| timing.step == step)
    };
    // What is proposed first stands; it is judged, but compared with nothing.
    let proposed = run(bare.clone());
    assert_eq!(proposed.hypotheses.len(), 1);
    assert_eq!(proposed.hypotheses[0].target_from_source, proposed.target_from_source);
    assert_eq!(proposed.hypotheses[0].evidence, proposed.evidence);
    assert!(proposed.evidence.support.is_some() && proposed.evidence.consistency.agree > 0);
    assert!(!steps(&proposed, "search") && !steps(&proposed, "polish"));
    // Compared, among others with the initial transform, the first one wins.
    let verified = run(Recipe { verify: true, ..bare.clone() });
    assert!(verified.hypotheses.len() > 1);
    let compared = verified.hypotheses.iter().map(|one| one.target_from_source);
    assert!(compared.clone().any(|pose| pose.error_to(&pair.initial).translation < 1e-9));
    assert_eq!(verified.hypotheses[0].target_from_source, verified.target_from_source);
    // Every round compares once more.
    let rounds = run(Recipe { rounds: 2, ..bare.clone() });
    assert_eq!(rounds.hypotheses.len(), 2);
    assert_eq!(rounds.hypotheses[0], proposed.hypotheses[0]);
    // A polished pose is none of those compared.
    let polished = run(Recipe { polish: true, ..bare });
    assert!(steps(&polished, "polish"));
    assert_eq!(polished.hypotheses, proposed.hypotheses);
    assert_ne!(polished.target_from_source, proposed.target_from_source);
    let (before, after) = (proposed.target_from_source, polished.target_from_source);
    assert!(pair.error(&after).1 < pair.error(&before).1, "{before:?} {after:?}");
}

#[test]
fn progress_names_the_steps_in_order() {
    let pair = room();
    let (sender, steps) = std::sync::mpsc::channel();
    let refiner = Refiner::new(paper()).with_progress(move |step| sender.send(step).unwrap());
    let refinement = refiner.refine(&pair.source, &pair.target, &pair.initial).unwrap();
    drop(refiner);
    let steps: Vec<&str> = steps.into_iter().collect();
    assert_eq!(
        steps,
        [
            "prepare",
            "verify",
            "project",
            "densify",
            "encode",
            "reduce",
            "transfer",
            "fuse",
            "match",
            "aggregate",
            "verify"
        ]
    );
    assert_eq!(refinement.timings.len(), steps.len() - 1);
}

#[test]
fn parts_of_the_method_can_be_left_out() {
    use rare::data::SetName;
    use rare::pose::fit_weighted;
    let pair = room();
    let run = |recipe| {
        let config = RefinerConfig { recipe, ..default() };
        Refiner::new(config).refine(&pair.source, &pair.target, &pair.initial).unwrap()
    };
    let bare = Recipe { rounds: 1, polish: false, verify: false, ..Recipe::default() };
    let names = |refinement: &Refinement| -> Vec<SetName> {
        refinement.sets.iter().map(|set| set.name).collect()
    };
    let without = run(Recipe { feature_transfer: false, ..bare.clone() });
    let alone = [SetName::DiffusionReference, SetName::DiffusionSource, SetName::Features3d];
    assert_eq!(names(&without), alone);
    assert_eq!(names(&run(bare.clone())).len(), 5);
    // Without aggregation: one fit over everything.
    let fitted = run(Recipe { inlier_aggregation: false, ..bare });
    let pairs = fitted.matches.union();
    let one =
        fit_weighted(pairs.iter().map(|pair| (pair.source, pair.target, pair.score))).unwrap();
    let error = fitted.target_from_source.error_to(&one);
    assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-6, "{error:?}");
}
