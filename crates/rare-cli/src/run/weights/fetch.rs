//! `rare weights fetch`.

use std::env;
use std::io::{self, IsTerminal};

use anyhow::Result;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rare_nets::weights::fetch::{Event, Origin, fetch};
use rare_nets::weights::{Choice, Hub};

use super::default_folder;
use crate::SUCCESS;
use crate::args::FetchArgs;
use crate::run::print;
use crate::summary;

/// How a download is drawn on a terminal.
const BAR: &str = "{msg} [{wide_bar}] {bytes}/{total_bytes} {bytes_per_sec} {eta}";

pub(super) fn run(args: FetchArgs) -> Result<u8> {
    let choice = Choice { controlnet: args.controlnet, precision: args.precision };
    let hub = Hub::from_environment(|name| env::var_os(name))?;
    let hub = match &args.endpoint {
        Some(address) => hub.with_endpoint(address)?,
        None => hub,
    };
    let folder = match args.folder {
        Some(folder) => folder,
        None => default_folder(choice)?,
    };
    let mut report = Report::new(args.quiet)?;
    let lock = fetch(&folder, choice, &hub, &mut |event| report.tell(event))?;
    let bytes: u64 = lock.files().iter().map(|file| file.bytes).sum();
    print(&format!("{}\n", folder.display()))?;
    report.say(&format!(
        "{} files, {:.1} MB: {} downloaded, {} from the cache of the hub, {} there already",
        lock.files().len(),
        megabytes(bytes),
        report.downloaded,
        report.cached,
        report.present
    ));
    Ok(SUCCESS)
}

/// Says what happens: in lines, and on a terminal with a bar for the file that is on its way.
struct Report {
    quiet: bool,
    bar: ProgressBar,
    downloaded: usize,
    cached: usize,
    present: usize,
}

impl Report {
    fn new(quiet: bool) -> Result<Report> {
        let bar = ProgressBar::new(0).with_style(ProgressStyle::with_template(BAR)?);
        let shown = !quiet && io::stderr().is_terminal();
        bar.set_draw_target(if shown {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        });
        Ok(Report { quiet, bar, downloaded: 0, cached: 0, present: 0 })
    }

    fn say(&self, line: &str) {
        if !self.quiet {
            self.bar.suspend(|| summary::say(line));
        }
    }

    fn tell(&mut self, event: Event<'_>) {
        match event {
            Event::Licence { name, url } => {
                self.say(&format!("these weights are under the licence {name}: {url}"));
            }
            Event::Start { file, bytes, done } => self.start(file, bytes, done),
            Event::Bytes { done } => self.bar.set_position(done),
            Event::Retry { file, why } => self.say(&format!("{file}: trying again: {why}")),
            Event::End { file, bytes, origin } => self.end(file, bytes, origin),
            Event::SinglePrecision { file } => {
                self.say(&format!("{file}: there is none in half precision"));
            }
        }
    }

    fn start(&self, file: &str, bytes: u64, done: u64) {
        self.bar.reset();
        self.bar.set_length(bytes);
        self.bar.set_position(done);
        self.bar.set_message(file.to_owned());
        // On a terminal, the bar says it.
        if self.bar.is_hidden() {
            let rest = megabytes(bytes.saturating_sub(done));
            self.say(&format!("{file}: downloading {rest:.1} MB"));
        }
    }

    fn end(&mut self, file: &str, bytes: u64, origin: Origin) {
        let megabytes = megabytes(bytes);
        let (count, words) = match origin {
            Origin::Folder => (&mut self.present, "there already"),
            Origin::Cache => (&mut self.cached, "from the cache of the hub"),
            Origin::Server => (&mut self.downloaded, "downloaded and verified"),
        };
        *count += 1;
        self.bar.finish_and_clear();
        self.say(&format!("{file}: {megabytes:.1} MB {words}"));
    }
}

fn megabytes(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}
