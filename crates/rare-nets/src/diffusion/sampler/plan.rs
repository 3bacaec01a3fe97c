//! Which steps are taken, and what the network is told when the features are read.

use rare::{Error, Result};

use crate::diffusion::schedule::{Schedule, Step, cumulative_alphas};
use crate::diffusion::{DiffusionSettings, SchedulerConfig};

/// The way from noise to features (paper section "Depth Diffusion Feature Extraction").
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The factor of the first noise: 1, or where no step is taken the standard deviation of noise at `time`.
    pub noise_scale: f64,
    /// The steps, in order.
    pub steps: Vec<Step>,
    /// Guidance of the steps; `None` asks for the conditional noise alone.
    pub guidance: Option<f32>,
    /// The time that the network is told when the features are read.
    pub time: usize,
}

impl Plan {
    /// Follows the settings through the noise schedule of a pipeline.
    ///
    /// # Errors
    /// `InvalidInput` if settings or schedule are impossible (see [`DiffusionSettings::validate`], [`Schedule::new`]),
    /// or if `time` is not a time of the schedule.
    pub fn new(settings: &DiffusionSettings, config: &SchedulerConfig) -> Result<Plan> {
        settings.validate()?;
        let guidance = settings.guided().then_some(settings.guidance);
        if settings.steps == 0 {
            let noise_scale = noise_at(settings.time, config)?;
            return Ok(Plan { noise_scale, steps: Vec::new(), guidance, time: settings.time });
        }
        let mut schedule = Schedule::new(config, settings.steps)?;
        let index = schedule.feature_index(settings.time)?;
        let time = schedule.feature_time(index);
        schedule.steps.truncate(index);
        Ok(Plan { noise_scale: 1.0, steps: schedule.steps, guidance, time })
    }

    /// How many images pass the networks in one step per map: conditional, and with guidance unconditional.
    #[must_use]
    pub fn branches(&self) -> usize {
        1 + usize::from(self.guidance.is_some())
    }

    /// How often each map passes the networks: the cost relative to a single pass.
    #[must_use]
    pub fn passes(&self) -> usize {
        self.steps.len() * self.branches() + 1
    }
}

/// The standard deviation of the noise in a latent at `time`.
fn noise_at(time: usize, config: &SchedulerConfig) -> Result<f64> {
    let alphas = cumulative_alphas(config)?;
    let alpha = alphas.get(time).ok_or_else(|| {
        Error::invalid(format!(
            "time {time}: without steps it must be below the {} training timesteps",
            alphas.len()
        ))
    })?;
    Ok((1.0 - f64::from(*alpha)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::Preset;

    fn config() -> SchedulerConfig {
        SchedulerConfig { beta_start: 0.00085, beta_end: 0.012, training_steps: 1000, offset: 1 }
    }

    #[test]
    fn presets_cost_what_they_say() {
        let plans = Preset::ALL.map(|preset| Plan::new(&preset.settings(), &config()).unwrap());
        assert_eq!(plans.each_ref().map(Plan::passes), [35, 18, 17, 1]);
        assert_eq!(plans.each_ref().map(|plan| plan.time), [150, 150, 200, 150]);
        // Times of the last steps: the latent then has the noise of the step that would follow, time 101.
        assert_eq!(
            plans.each_ref().map(|plan| plan.steps.last().map(|step| step.time)),
            [Some(151), Some(151), Some(201), None]
        );
        assert_eq!(plans[0].steps[16].next_alpha, plans[2].steps[7].next_alpha);
        assert_eq!(plans[0].noise_scale, 1.0);
        assert!((plans[3].noise_scale.powi(2) - (1.0 - 0.828)).abs() < 0.01);
    }

    #[test]
    fn impossible_times_are_refused() {
        for (steps, time) in [(0, 1000), (20, 1001), (0, usize::MAX), (20, usize::MAX)] {
            let settings = DiffusionSettings { steps, time, ..DiffusionSettings::default() };
            let message = Plan::new(&settings, &config()).unwrap_err().to_string();
            assert!(message.contains(&format!("time {time}")), "{message}");
        }
        let settings = DiffusionSettings { guidance: f32::NAN, ..DiffusionSettings::default() };
        assert!(Plan::new(&settings, &config()).is_err());
    }
}
