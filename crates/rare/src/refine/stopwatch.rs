//! How long each step took.

use std::time::Instant;

use serde::{Deserialize, Serialize};

/// Wall time of one step, over all rounds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// The step.
    pub step: String,
    /// Seconds.
    pub seconds: f64,
}

/// Adds up the times of the steps and announces each.
pub(super) struct Stopwatch<'a> {
    progress: Option<&'a (dyn Fn(&'static str) + Send + Sync)>,
    timings: Vec<Timing>,
}

impl<'a> Stopwatch<'a> {
    pub(super) fn new(progress: Option<&'a (dyn Fn(&'static str) + Send + Sync)>) -> Stopwatch<'a> {
        Stopwatch { progress, timings: Vec::new() }
    }

    /// Runs a step.
    pub(super) fn time<T>(&mut self, step: &'static str, run: impl FnOnce() -> T) -> T {
        if let Some(progress) = self.progress {
            progress(step);
        }
        let start = Instant::now();
        let result = run();
        let seconds = start.elapsed().as_secs_f64();
        match self.timings.iter_mut().find(|timing| timing.step == step) {
            Some(timing) => timing.seconds += seconds,
            None => self.timings.push(Timing { step: step.to_owned(), seconds }),
        }
        result
    }

    /// The steps in the order of their first run.
    pub(super) fn into_timings(self) -> Vec<Timing> {
        self.timings
    }
}
