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

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::thread::sleep;
    use std::time::Duration;

    use super::*;

    #[test]
    fn times_of_a_step_add_up_in_the_order_of_first_runs() {
        let announced = Mutex::new(Vec::new());
        let announce = |step| announced.lock().unwrap().push(step);
        let mut clock = Stopwatch::new(Some(&announce));
        let pause = |milliseconds| sleep(Duration::from_millis(milliseconds));
        let answer = clock.time("match", || {
            pause(4);
            42
        });
        clock.time("fuse", || ());
        clock.time("match", || pause(4));
        assert_eq!(answer, 42);
        let timings = clock.into_timings();
        let steps: Vec<&str> = timings.iter().map(|timing| timing.step.as_str()).collect();
        assert_eq!(steps, ["match", "fuse"]);
        assert!(timings[0].seconds >= 0.008, "{timings:?}");
        assert_eq!(*announced.lock().unwrap(), ["match", "fuse", "match"]);
    }
}
