//! The noise schedule and its steps, against the schedule that the networks were trained with.

use rare_nets::diffusion::{Schedule, SchedulerConfig, Step, cumulative_alphas};

use crate::shared::{Golden, relative_difference};

/// A constant of a step.
type Field = fn(&Step) -> f64;

fn config() -> SchedulerConfig {
    SchedulerConfig { beta_start: 0.00085, beta_end: 0.012, training_steps: 1000, offset: 1 }
}

#[test]
fn alphas_are_those_of_the_training() {
    let Some(mut golden) = Golden::open("rare/s4_ddim.npz") else { return };
    let alphas = cumulative_alphas(&config()).unwrap();
    let expected = golden.array("alphas_cumprod").values;
    // The smallest is 0.005: compare one by one.
    for (time, (alpha, expected)) in alphas.iter().zip(&expected).enumerate() {
        assert!((f64::from(*alpha) / expected - 1.0).abs() < 2e-6, "{time}: {alpha} {expected}");
    }
    assert_eq!(alphas.len(), expected.len());
    // The same from the golden betas.
    let mut product = 1.0;
    for (beta, alpha) in golden.array("betas").values.iter().zip(&alphas) {
        product *= 1.0 - beta;
        assert!((f64::from(*alpha) / product - 1.0).abs() < 2e-6);
    }
}

#[test]
fn constants_of_the_steps_are_golden() {
    let Some(mut golden) = Golden::open("rare/s4_ddim.npz") else { return };
    let schedule = Schedule::new(&config(), 20).unwrap();
    let times: Vec<usize> = schedule.steps.iter().rev().map(|step| step.time).collect();
    assert_eq!(times, golden.array("timesteps_ascending").usize());
    let fields: [(&str, Field); 5] = [
        ("alphas", |step| step.alpha),
        ("alphas_prev", |step| step.next_alpha),
        ("sigmas", |step| step.sigma),
        ("sqrt_one_minus_alphas", |step| (1.0 - step.alpha).sqrt()),
        ("dir_coeff", Step::direction),
    ];
    for (name, field) in fields {
        let golden = golden.array(name).values;
        assert_eq!(golden.len(), 20);
        for (step, expected) in schedule.steps.iter().rev().zip(golden) {
            let difference = (field(step) / expected - 1.0).abs();
            assert!(difference < 2e-6, "{name} at {}: {difference:e}", step.time);
        }
    }
}

#[test]
fn times_of_features_are_golden() {
    let Some(mut golden) = Golden::open("rare/s4_ddim.npz") else { return };
    let schedule = Schedule::new(&config(), 20).unwrap();
    let table = golden.array("t_index_table").usize();
    for row in table.chunks(5) {
        let index = schedule.feature_index(row[0]).unwrap();
        // The noise of a latent is that of the step that would follow; after the last step there is almost none.
        let noise_time = schedule.steps.get(index).map_or(0, |step| step.time);
        assert_eq!([index, schedule.feature_time(index), noise_time], [row[1], row[2], row[4]]);
    }
    assert_eq!(table.len(), 55);
}

#[test]
fn twenty_steps_follow_the_golden_case() {
    let Some(mut golden) = Golden::open("rare/s4_ddim.npz") else { return };
    let [latents, predictions, noise] =
        ["case_x", "case_eps", "case_noise"].map(|name| golden.array(name));
    let schedule = Schedule::new(&config(), 20).unwrap();
    let size = 4 * 8 * 8;
    let (predictions, noise) = (predictions.f32(), noise.f32());
    let mut latent: Vec<f32> = latents.f32()[..size].to_vec();
    for (index, step) in schedule.steps.iter().enumerate() {
        let range = index * size..(index + 1) * size;
        latent = step.advance(&latent, &predictions[range.clone()], &noise[range]).unwrap();
        let expected = &latents.values[(index + 1) * size..(index + 2) * size];
        let difference = relative_difference(&latent, expected);
        assert!(difference < 1e-5, "step {index}: {difference:e}");
    }
}
