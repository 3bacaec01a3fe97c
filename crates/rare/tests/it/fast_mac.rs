//! FastMAC on real and on synthetic correspondences.

use rare::Correspondence;
use rare::pose::{FastMac, Mac, Mode};

use crate::mac::{refuses_wrong_pairs, solve, solves_all, swapped};
use crate::sc2_pcr::real_matches;
use crate::synthetic_pairs::{motion, synthetic};

fn in_mode(mode: Mode) -> FastMac {
    FastMac { mac: Mac { mode, ..Mac::three_d_match() }, ..FastMac::three_d_match() }
}

#[test]
fn real_matches_of_which_7_percent_are_right_are_solved() {
    let Some((pairs, truth)) = real_matches() else { return };
    for mode in [Mode::Faithful, Mode::Fixed] {
        for seed in 0..10 {
            let settings = FastMac { seed, ..in_mode(mode) };
            let found = &settings.hypotheses(&pairs, 2).unwrap()[0];
            let error = found.target_from_source.error_to(&truth);
            println!("{mode:?} {seed}: {error:?}, {} inliers", found.inliers.len());
            // An independent implementation of MAC, on all matches, reaches 2.22 degrees and 0.050 m.
            if mode == Mode::Fixed {
                assert!(error.rotation_degrees < 1.1 * 2.22 && error.translation < 1.1 * 0.05);
            }
            assert!(error.rotation_degrees < 4.0 && error.translation < 0.1, "{error:?}");
        }
    }
}

#[test]
fn outliers_are_survived_in_both_modes() {
    for (count, share) in [(1000, 0.2), (1000, 0.05), (200, 0.2), (12, 0.7)] {
        for mode in [Mode::Faithful, Mode::Fixed] {
            let pairs = synthetic(count, share, &motion(), 3);
            let settings = FastMac { ratio: if count == 12 { 1.0 } else { 0.5 }, ..in_mode(mode) };
            let found = &settings.hypotheses(&pairs, 2).unwrap()[0];
            let error = found.target_from_source.error_to(&motion());
            assert!(error.rotation_degrees < 0.5 && error.translation < 0.03, "{count} {error:?}");
            let true_inliers = (share * count as f64) as usize;
            assert!((0..true_inliers).all(|i| found.inliers.contains(&i)));
            assert!(!found.budget_exhausted);
        }
    }
}

#[test]
fn the_sample_favours_what_is_consistent() {
    // A fifth of the pairs is drawn; at random that would be 10 of the 50 right ones.
    let pairs = synthetic(1000, 0.05, &motion(), 4);
    for seed in 0..10 {
        let settings = FastMac { ratio: 0.2, seed, ..FastMac::three_d_match() };
        let found = &settings.hypotheses(&pairs, 1).unwrap()[0];
        assert!(found.target_from_source.error_to(&motion()).rotation_degrees < 0.5);
    }
}

#[test]
fn pairs_without_noise_give_the_pose_exactly() {
    for (count, inliers) in [(1000, 1000), (1000, 100), (60, 60), (8, 7), (3, 3)] {
        let mut pairs = synthetic(count, 0.0, &motion(), 4);
        for pair in &mut pairs[..inliers] {
            pair.target = motion().apply(&pair.source);
        }
        let found = &FastMac::three_d_match().hypotheses(&pairs, 1).unwrap()[0];
        let error = found.target_from_source.error_to(&motion());
        assert!(error.rotation_degrees < 1e-6 && error.translation < 1e-8, "{count} {error:?}");
        assert!((0..inliers).all(|i| found.inliers.contains(&i)));
    }
}

#[test]
fn swapping_the_clouds_inverts_the_pose() {
    let pairs = synthetic(300, 0.15, &motion(), 5);
    let settings = FastMac::three_d_match();
    let found = &settings.hypotheses(&pairs, 1).unwrap()[0];
    let back = &settings.hypotheses(&swapped(&pairs), 1).unwrap()[0];
    let error = back.target_from_source.error_to(&found.target_from_source.inverse());
    assert!(error.rotation_degrees < 1e-3 && error.translation < 1e-4, "{error:?}");
    assert_eq!(back.inliers, found.inliers);
}

#[test]
fn threads_do_not_show_but_the_seed_and_the_ratio_do() {
    let pairs = synthetic(700, 0.1, &motion(), 8);
    let run = |threads, seed, ratio| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let settings = FastMac { seed, ratio, ..FastMac::three_d_match() };
        pool.install(|| settings.hypotheses(&pairs, 3).unwrap())
    };
    assert_eq!(run(1, 1, 0.5), run(2, 1, 0.5));
    let score = |seed| {
        let settings = FastMac { seed, ratio: 0.1, ..in_mode(Mode::Faithful) };
        settings.hypotheses(&pairs, 1).unwrap()[0].score
    };
    assert_ne!(score(1), score(2));
    let all = solve(&Mac::three_d_match(), &pairs);
    assert_eq!(run(1, 1, 1.0)[0], all);
    assert!(run(1, 1, 0.05)[0].iterations < all.iterations);
}

#[test]
fn the_released_code_judges_by_the_sample_alone() {
    let pairs = synthetic(1000, 0.2, &motion(), 9);
    let score = |mode| {
        let settings = FastMac { ratio: 0.1, ..in_mode(mode) };
        settings.hypotheses(&pairs, 1).unwrap()[0].score
    };
    assert!(score(Mode::Faithful) < 0.6 * score(Mode::Fixed));
}

#[test]
fn a_graph_that_is_too_dense_is_reported_and_leaves_a_good_pose() {
    let pairs = synthetic(1000, 0.9, &motion(), 10);
    let mut settings = FastMac::three_d_lo_match();
    settings.mac.max_work = 5_000_000;
    let found = &settings.hypotheses(&pairs, 1).unwrap()[0];
    assert!(found.budget_exhausted);
    assert!(found.target_from_source.error_to(&motion()).rotation_degrees < 0.1);
}

#[test]
fn wrong_pairs_alone_give_no_pose() {
    for mode in [Mode::Faithful, Mode::Fixed] {
        refuses_wrong_pairs(&in_mode(mode));
    }
    refuses_wrong_pairs(&FastMac::kitti());
}

#[test]
fn what_makes_no_sense_is_an_error() {
    let pairs = synthetic(10, 1.0, &motion(), 1);
    let mut broken = pairs.clone();
    broken[4].target.x = f64::NAN;
    let same: Vec<Correspondence> = vec![pairs[0]; 50];
    let default = FastMac::three_d_match();
    let none = FastMac { ratio: 0.0, ..default.clone() };
    let zero =
        FastMac { mac: Mac { bound: 0.0, ..Mac::three_d_match() }, ..FastMac::three_d_match() };
    for (settings, pairs, word) in [
        (&default, &pairs[..2], "at least 3"),
        (&default, &same, "no 3 of 50"),
        (&in_mode(Mode::Faithful), &same, "no 3 of 50"),
        (&default, &broken, "correspondence 4"),
        (&none, &pairs, "ratio"),
        (&zero, &pairs, "bound"),
    ] {
        let message = settings.hypotheses(pairs, 3).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}

/// Median errors (degrees, metres) of a plain implementation of the released FastMAC on the same matches, for each pair
/// of clouds.
const REFERENCE: [(f64, f64); 5] =
    [(2.1320, 0.0469), (1.1838, 0.0210), (1.1504, 0.0236), (2.2135, 0.0803), (1.4682, 0.0431)];

#[test]
fn every_set_of_matches_of_every_indoor_pair_is_solved() {
    for mode in [Mode::Faithful, Mode::Fixed] {
        let mac = Mac { mode, ..Mac::for_voxel(0.05) };
        let settings = FastMac { mac, ..FastMac::for_voxel(0.05) };
        // The released judgement by the sample alone hangs on the draws, which are not those of the reference.
        let tolerance = if mode == Mode::Faithful { 1.2 } else { 1.1 };
        solves_all(&format!("fastmac, {mode:?}"), &REFERENCE, tolerance, |pairs| {
            settings.hypotheses(pairs, 2)
        });
    }
}
