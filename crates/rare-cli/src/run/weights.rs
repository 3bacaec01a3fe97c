//! `rare weights`: what can be used, getting it, and whether it is intact.

mod checkpoint;
#[cfg(feature = "fetch")]
mod fetch;

use std::env;
use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::Result;
use rare_nets::weights::{self, Choice, PUBLISHED, SOURCES, Source};

use crate::SUCCESS;
use crate::args::{CheckArgs, WeightsArgs, WeightsCommand};
use crate::run::print;
use crate::summary;

pub(super) fn run(args: WeightsArgs) -> Result<u8> {
    match args.command {
        WeightsCommand::List => list(),
        #[cfg(feature = "fetch")]
        WeightsCommand::Fetch(args) => fetch::run(args),
        WeightsCommand::Check(args) => check(args),
    }
}

fn list() -> Result<u8> {
    let mut parts = vec!["Diffusion features, which `rare weights fetch` gets:\n".to_owned()];
    parts.extend(SOURCES.iter().map(describe));
    parts.push(describe_published());
    print(&parts.join("\n"))?;
    if SOURCES.iter().any(|source| source.files.iter().any(|file| !file.is_verified())) {
        summary::say(
            "unverified: neither length nor hash is known beforehand; a download is compared with what the server announces",
        );
    }
    Ok(SUCCESS)
}

/// The checkpoints of the networks on points, a line for each.
fn describe_published() -> String {
    let mut text = String::from(
        "Networks on points, whose checkpoints a person must download; `rare weights check FILE` says what one is:\n",
    );
    let mut place = "";
    for file in &PUBLISHED {
        if file.place != place {
            place = file.place;
            writeln!(text, "\n{}: {place}", file.network).unwrap_or_default();
        }
        let bytes = file.bytes.map_or_else(|| "unknown".to_owned(), |bytes| bytes.to_string());
        let (trained_on, remark) = (file.trained_on.to_string(), file.remark);
        let sha256 = file.sha256.unwrap_or("unknown");
        writeln!(
            text,
            "  {trained_on:<8} {:<48} {remark}; bytes {bytes}, SHA-256 {sha256}",
            file.file
        )
        .unwrap_or_default();
    }
    text
}

/// A repository and its files, a line for each.
fn describe(source: &Source) -> String {
    let revision = source.revision.unwrap_or("newest commit, unverified");
    let mut text = format!("{}: {}\n", source.repository, source.title);
    let mut line = |words: String| writeln!(text, "  {words}").unwrap_or_default();
    line(format!("licence: {} ({})", source.licence, source.licence_url));
    line(format!("revision: {revision}"));
    for file in source.files {
        let precision = file.precision.map_or_else(|| "any".to_owned(), |own| own.to_string());
        let state = match (file.bytes, file.sha256) {
            (Some(bytes), Some(sha256)) => format!("{bytes} bytes, SHA-256 {sha256}"),
            _ => "unverified".to_owned(),
        };
        line(format!("{precision}  {:<48}  {state}", file.path));
    }
    text
}

/// Prints the hash and name of every file, as `sha256sum` does, if all are what was fetched and the networks can use
/// them.
fn check(args: CheckArgs) -> Result<u8> {
    let folder = match args.path {
        Some(file) if !file.is_dir() => return checkpoint::check(&file),
        Some(folder) => folder,
        None => default_folder(Choice::default())?,
    };
    let checked = weights::check(&folder)?;
    let pipeline = weights::open(&folder)?;
    let line = |file: &weights::LockedFile| format!("{}  {}\n", file.sha256, file.file);
    print(&checked.lock.files().iter().map(line).collect::<String>())?;
    summary::say(&format!(
        "{}: {} files, {:.1} MB, as they were fetched; all tensors have their names and shapes",
        folder.display(),
        checked.lock.files().len(),
        checked.bytes as f64 / 1e6
    ));
    if let Some(remark) = pipeline.remark {
        summary::say(&format!("warning: {remark}"));
    }
    Ok(SUCCESS)
}

fn default_folder(choice: Choice) -> Result<PathBuf> {
    Ok(choice.default_folder(|name| env::var_os(name))?)
}
