//! A sign of life while something takes long: on a terminal a spinner, or a bar where passes can be counted; elsewhere a
//! line now and then, where it takes minutes.

use std::io::{self, IsTerminal};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::summary;

/// Work that takes less shows nothing.
const PATIENCE: Duration = Duration::from_secs(1);
/// How often the spinner turns.
const TURN: Duration = Duration::from_millis(100);
/// How often a line is written where there is no terminal.
const LINE: Duration = Duration::from_secs(15);

/// Names the current step beside a spinner until it is dropped.
pub(crate) struct Progress {
    spinner: ProgressBar,
    /// Whether lines are written, as there is somebody to read them and no terminal.
    lines: bool,
    /// Waits for [`PATIENCE`] to pass or the sender to be dropped, whichever is first.
    waiting: Option<(Sender<()>, JoinHandle<()>)>,
}

impl Progress {
    /// Shows nothing if `quiet`, or if stderr is no terminal.
    pub(crate) fn start(quiet: bool) -> Progress {
        let spinner = ProgressBar::new_spinner();
        spinner.set_draw_target(ProgressDrawTarget::hidden());
        let terminal = io::stderr().is_terminal();
        let shown = !quiet && terminal;
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
        Progress { spinner, lines: !quiet && !terminal, waiting }
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

impl Progress {
    /// Where passes are counted.
    pub(crate) fn passes(&self) -> Passes {
        Passes { bar: self.spinner.clone(), lines: self.lines.then(Mutex::default) }
    }
}

/// Counts the passes of the maps through the networks.
pub(crate) struct Passes {
    bar: ProgressBar,
    /// If lines are written: when counting began, and when the last line was written.
    lines: Option<Mutex<Option<[Instant; 2]>>>,
}

impl Passes {
    /// Begins to count to `total`.
    pub(crate) fn begin(&self, total: usize) {
        const BAR: &str = "{spinner} {msg} {wide_bar} {pos} of {len} passes, {eta} left";
        if let Ok(style) = ProgressStyle::with_template(BAR) {
            self.bar.set_style(style);
        }
        self.bar.set_length(total as u64);
        self.bar.set_position(0);
        self.bar.reset_eta();
        if let Some(lines) = &self.lines {
            *lock(lines) = Some([Instant::now(); 2]);
        }
    }

    /// So many are done, of so many.
    pub(crate) fn show(&self, done: usize, total: usize) {
        self.bar.set_position(done as u64);
        let Some(lines) = &self.lines else { return };
        let mut lines = lock(lines);
        let Some([begun, last]) = &mut *lines else { return };
        if last.elapsed() >= LINE {
            *last = Instant::now();
            let left = total.saturating_sub(done) as f64 / done.max(1) as f64;
            let left = duration_in_words(begun.elapsed().as_secs_f64() * left);
            summary::say(&format!("{done} of {total} passes, {left} left"));
        }
    }
}

/// What is inside, whatever happened to those who had it.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A time that is only an estimate, in seconds, minutes or hours.
pub(crate) fn duration_in_words(seconds: f64) -> String {
    match seconds {
        ..100.0 => format!("{seconds:.0} s"),
        ..6000.0 => format!("{:.0} min", seconds / 60.0),
        _ => format!("{:.1} h", seconds / 3600.0),
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

/// Counts the pairs of an evaluation: a bar with rate and time left on a terminal, elsewhere a line now and then.
pub(crate) struct Pairs {
    bar: ProgressBar,
    /// If lines are written: when counting began, when the last line was written, how many were done at first.
    lines: Option<Mutex<(Instant, Instant, Option<u64>)>>,
}

impl Pairs {
    /// Begins to count to `total`; shows nothing if `quiet`.
    pub(crate) fn start(quiet: bool, total: usize) -> Pairs {
        const BAR: &str = "{wide_bar} {pos} of {len} pairs, {per_sec}, {eta} left";
        let terminal = io::stderr().is_terminal();
        let bar = ProgressBar::new(total as u64);
        bar.set_draw_target(if !quiet && terminal {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        });
        if let Ok(style) = ProgressStyle::with_template(BAR) {
            bar.set_style(style);
        }
        let now = Instant::now();
        Pairs { bar, lines: (!quiet && !terminal).then(|| Mutex::new((now, now, None))) }
    }

    /// So many are done, by whomever.
    pub(crate) fn show(&self, done: usize) {
        self.bar.set_position(done as u64);
        if let Some(lines) = &self.lines {
            lock(lines).2.get_or_insert(done as u64);
        }
    }

    /// One more is done.
    pub(crate) fn advance(&self) {
        self.bar.inc(1);
        let Some(lines) = &self.lines else { return };
        let mut lines = lock(lines);
        let (begun, last, first) = &mut *lines;
        if last.elapsed() >= LINE {
            *last = Instant::now();
            let (done, total) = (self.bar.position(), self.bar.length().unwrap_or(0));
            let own = done.saturating_sub(first.unwrap_or(0)).max(1);
            let rate = begun.elapsed().as_secs_f64() / own as f64;
            let left = duration_in_words(rate * total.saturating_sub(done) as f64);
            summary::say(&format!("{done} of {total} pairs, {rate:.1} s each, {left} left"));
        }
    }
}

impl Drop for Pairs {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
