//! A sign of life on a terminal while something takes long.

use std::io::{self, IsTerminal};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget};

/// Work that takes less shows nothing.
const PATIENCE: Duration = Duration::from_secs(1);
/// How often the spinner turns.
const TURN: Duration = Duration::from_millis(100);

/// Names the current step beside a spinner until it is dropped.
pub(crate) struct Progress {
    spinner: ProgressBar,
    /// Waits for [`PATIENCE`] to pass or the sender to be dropped, whichever is first.
    waiting: Option<(Sender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// Shows nothing if `quiet`, or if stderr is no terminal.
    pub(crate) fn start(quiet: bool) -> Progress {
        let spinner = ProgressBar::new_spinner();
        spinner.set_draw_target(ProgressDrawTarget::hidden());
        let shown = !quiet && io::stderr().is_terminal();
        let waiting = shown.then(|| {
            let (sender, receiver) = mpsc::channel();
            let spinner = spinner.clone();
            let thread = thread::spawn(move || {
                if receiver.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout) {
                    spinner.set_draw_target(ProgressDrawTarget::stderr());
                    spinner.enable_steady_tick(TURN);
                }
            });
            (sender, thread)
        });
        Progress { spinner, waiting }
    }

    /// Says what is being done.
    pub(crate) fn step(&self, name: &'static str) {
        self.spinner.set_message(name);
    }

    /// The same for those who outlive this value.
    pub(crate) fn callback(&self) -> impl Fn(&'static str) + Send + Sync + 'static {
        let spinner = self.spinner.clone();
        move |step| spinner.set_message(step)
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some((sender, thread)) = self.waiting.take() {
            drop(sender);
            // The thread only waits; if it failed, there was no spinner.
            let _ = thread.join();
        }
        self.spinner.finish_and_clear();
    }
}
