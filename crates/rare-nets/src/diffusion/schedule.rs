//! The noise schedule, and the steps from noise to image that follow it (Ho, Jain, Abbeel: Denoising Diffusion
//! Probabilistic Models, 2020; Song, Meng, Ermon: Denoising Diffusion Implicit Models, 2021, DDIM below).
//!
//! An image at time `t` is `sqrt(alpha) * image + sqrt(1 - alpha) * noise` with `alpha` the cumulative product that falls
//! from 1 to almost 0 with `t`. A step goes from one time to an earlier one. The times of a schedule are equally spaced
//! from the offset on; the last step ends at time 0, which still has a trace of noise.

use rare::{Error, Result};

use super::SchedulerConfig;

/// Most training timesteps that are believed; it bounds the table.
const MOST_TRAINING_STEPS: usize = 1_000_000;

/// `alpha` of every training timestep, rounded to single precision as the trained networks have it.
///
/// # Errors
/// `InvalidInput` if the number of timesteps is 0 or above a million, or the betas are not within `(0, 1)`.
pub fn cumulative_alphas(config: &SchedulerConfig) -> Result<Vec<f32>> {
    let &SchedulerConfig { beta_start, beta_end, training_steps, .. } = config;
    let valid = |beta: f64| beta > 0.0 && beta < 1.0;
    if !(1..=MOST_TRAINING_STEPS).contains(&training_steps)
        || !valid(beta_start)
        || !valid(beta_end)
    {
        return Err(Error::invalid(format!(
            "a noise schedule of {training_steps} training timesteps from beta {beta_start} to {beta_end}: there must be 1 to {MOST_TRAINING_STEPS}, betas between 0 and 1"
        )));
    }
    Ok(betas(config)
        .scan(1.0, |product: &mut f64, beta| {
            *product *= 1.0 - beta;
            Some(*product as f32)
        })
        .collect())
}

/// The variance that every training timestep adds: squares of equally spaced roots ("scaled linear").
fn betas(config: &SchedulerConfig) -> impl Iterator<Item = f64> {
    let (first, last) = (config.beta_start.sqrt(), config.beta_end.sqrt());
    let intervals = config.training_steps.saturating_sub(1).max(1) as f64;
    (0..config.training_steps).map(move |time| {
        let root = first + (last - first) * time as f64 / intervals;
        root * root
    })
}

/// One step from noise to image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// The training timestep that it starts from, which the network is told.
    pub time: usize,
    /// The cumulative `alpha` at the start.
    pub alpha: f64,
    /// The cumulative `alpha` at the end.
    pub next_alpha: f64,
    /// Standard deviation of the noise added anew (eta = 1 of DDIM, which makes the step as random as DDPM's).
    pub sigma: f64,
}

impl Step {
    fn new(time: usize, alpha: f64, next_alpha: f64) -> Step {
        let sigma = ((1.0 - next_alpha) / (1.0 - alpha)).sqrt() * (1.0 - alpha / next_alpha).sqrt();
        Step { time, alpha, next_alpha, sigma }
    }

    /// The factor of the predicted noise at the end of the step.
    #[must_use]
    pub fn direction(&self) -> f64 {
        (1.0 - self.next_alpha - self.sigma * self.sigma).max(0.0).sqrt()
    }

    /// The image without noise that a latent and the noise predicted in it amount to.
    #[must_use]
    pub fn denoised(&self, latent: f64, prediction: f64) -> f64 {
        (latent - (1.0 - self.alpha).sqrt() * prediction) / self.alpha.sqrt()
    }

    /// The latent at the end of the step, from that at the start, the noise predicted in it, and new noise; any order of
    /// the values, the same for all three.
    ///
    /// # Errors
    /// `Internal` if the numbers of values differ.
    pub fn advance(&self, latent: &[f32], prediction: &[f32], noise: &[f32]) -> Result<Vec<f32>> {
        if latent.len() != prediction.len() || latent.len() != noise.len() {
            return Err(Error::Internal(format!(
                "a latent of {} values, {} predicted, {} of noise",
                latent.len(),
                prediction.len(),
                noise.len()
            )));
        }
        let (scale, direction) = (self.next_alpha.sqrt(), self.direction());
        let values = latent.iter().zip(prediction).zip(noise);
        Ok(values
            .map(|((&latent, &prediction), &noise)| {
                let (latent, prediction) = (f64::from(latent), f64::from(prediction));
                let image = scale * self.denoised(latent, prediction);
                (image + direction * prediction + self.sigma * f64::from(noise)) as f32
            })
            .collect())
    }
}

/// The steps from pure noise to an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// In the order of processing: from the most noise to none.
    pub steps: Vec<Step>,
    training_steps: usize,
    stride: usize,
}

impl Schedule {
    /// `steps` steps at equal distances (the "leading" times of DDIM: `offset`, `offset + stride`, ...).
    ///
    /// # Errors
    /// `InvalidInput` if `steps` is 0 or more than the training timesteps leave room for, or the configuration is wrong
    /// (see [`cumulative_alphas`]).
    pub fn new(config: &SchedulerConfig, steps: usize) -> Result<Schedule> {
        let alphas = cumulative_alphas(config)?;
        let training_steps = config.training_steps;
        let stride = training_steps.checked_div(steps).unwrap_or(0);
        let alpha = |time: usize| alphas.get(time).copied().map(f64::from);
        let step = |index: usize| {
            let time = (index * stride).checked_add(config.offset)?;
            Some(Step::new(time, alpha(time)?, alpha(time.saturating_sub(stride))?))
        };
        // More steps than times have stride 0; there may be too many of them to count.
        let descending = (0..steps).rev().take_while(|_| stride > 0).map(step);
        match descending.collect::<Option<Vec<Step>>>() {
            Some(steps) if !steps.is_empty() => Ok(Schedule { steps, training_steps, stride }),
            _ => Err(Error::invalid(format!(
                "{steps} steps with offset {} do not fit into {training_steps} training timesteps: choose fewer, at least 1",
                config.offset
            ))),
        }
    }

    /// How many steps are taken before the features of `time` are read (FreeReg's rule, halves to even).
    ///
    /// # Errors
    /// `InvalidInput` if `time` is above the number of training timesteps.
    pub fn feature_index(&self, time: usize) -> Result<usize> {
        let Some(remaining) = self.training_steps.checked_sub(time) else {
            return Err(Error::invalid(format!(
                "time {time} is outside of 0 to {}, the training timesteps",
                self.training_steps
            )));
        };
        let index = (remaining as f64 / self.stride as f64).round_ties_even() as usize;
        Ok(index.min(self.steps.len()))
    }

    /// The time that the network is told when features are read after `index` steps.
    ///
    /// It is not the time of the latent: after 17 of 20 steps that has the noise of time 101, and the network is told
    /// 150 (a quirk of FreeReg, whose features the paper uses).
    #[must_use]
    pub fn feature_time(&self, index: usize) -> usize {
        self.steps.len().saturating_sub(index) * self.stride
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> SchedulerConfig {
        SchedulerConfig { beta_start: 0.00085, beta_end: 0.012, training_steps: 1000, offset: 1 }
    }

    #[test]
    fn the_true_noise_leads_back_to_the_image() {
        let schedule = Schedule::new(&config(), 10).unwrap();
        let (image, noise) = (0.7, -1.3);
        for step in &schedule.steps {
            let latent = step.alpha.sqrt() * image + (1.0 - step.alpha).sqrt() * noise;
            assert!((step.denoised(latent, noise) - image).abs() < 1e-12);
            let variance = step.direction().powi(2) + step.sigma.powi(2);
            assert!((variance - (1.0 - step.next_alpha)).abs() < 1e-12);
        }
    }

    #[test]
    fn times_fall_to_the_offset_for_any_number_of_steps() {
        for steps in [1, 3, 7, 20, 999] {
            let schedule = Schedule::new(&config(), steps).unwrap();
            assert_eq!((schedule.steps.len(), schedule.steps[steps - 1].time), (steps, 1));
            assert!(schedule.steps.windows(2).all(|pair| pair[0].alpha < pair[1].alpha));
            let index = schedule.feature_index(150).unwrap();
            assert!(index <= steps);
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        for steps in [0, 1000, 1001, usize::MAX] {
            let message = Schedule::new(&config(), steps).unwrap_err().to_string();
            assert!(message.contains(&steps.to_string()), "{message}");
        }
        for config in [
            SchedulerConfig { training_steps: 0, ..config() },
            SchedulerConfig { training_steps: usize::MAX, ..config() },
            SchedulerConfig { beta_start: f64::NAN, ..config() },
            SchedulerConfig { beta_end: 1.0, ..config() },
            SchedulerConfig { offset: usize::MAX, ..config() },
        ] {
            assert!(Schedule::new(&config, 20).is_err(), "{config:?}");
        }
        let schedule = Schedule::new(&config(), 20).unwrap();
        assert!(schedule.feature_index(1001).unwrap_err().to_string().contains("1001"));
        assert!(schedule.steps[0].advance(&[0.0], &[0.0, 0.0], &[0.0]).is_err());
    }
}
