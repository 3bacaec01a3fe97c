//! `rare score`: numbers out of results, at once.

use std::path::Path;

use anyhow::{Context, Result};
use rare::eval::log_folders::{self, Missing};
use rare::eval::results::{self, ResultsFolder};
use rare::eval::{Comparison, MethodResult, Protocol, Rules, Success, Table};
use rare::io::write_whole;

use crate::args::{Format, ProtocolChoice, ScoreArgs, ScoringArgs};
use crate::{SUCCESS, plots, run};

pub(super) fn run(args: &ScoreArgs) -> Result<u8> {
    let (methods, protocol) = read(args)?;
    let comparisons = compare(&methods, protocol, &args.scoring);
    run::print(&in_format(&comparisons, args.format)?)?;
    if let Some(folder) = &args.out {
        write_tables(folder, &comparisons, &methods)?;
    }
    Ok(SUCCESS)
}

/// The results, and the protocol under which such data are usually scored.
fn read(args: &ScoreArgs) -> Result<(Vec<MethodResult>, Protocol)> {
    if let (Some(est), Some(gt)) = (&args.est, &args.gt) {
        let missing =
            if args.missing_as_failures { Missing::CountAsFailures } else { Missing::Refuse };
        let pairs = log_folders::score(&log_folders::read_truth(gt)?, est, missing)?;
        let name = est.display().to_string();
        return Ok((vec![MethodResult { name, pairs, untried: 0 }], Protocol::Predator));
    }
    let folders = args.results.iter().map(ResultsFolder::open).collect::<rare::Result<Vec<_>>>()?;
    let protocol = folders.first().map_or(Protocol::Plain, |folder| folder.benchmark().protocol);
    Ok((results::merge(&folders)?, protocol))
}

/// Methods under the protocols that were asked for.
pub(super) fn compare(
    methods: &[MethodResult],
    protocol: Protocol,
    scoring: &ScoringArgs,
) -> Vec<Comparison> {
    let protocols = match scoring.protocol {
        None => vec![protocol],
        Some(ProtocolChoice::One(protocol)) => vec![protocol],
        Some(ProtocolChoice::All) => Protocol::ALL.to_vec(),
    };
    let rules = |protocol: Protocol| {
        let published = protocol.published();
        Rules {
            success: scoring.success.map_or(published.success, |(rotation, translation)| {
                Success::Pose { rotation, translation }
            }),
            predator_index_zero: published.predator_index_zero && !scoring.count_first_pair,
            official_errors: published.official_errors && !scoring.rigid_truth,
            ..published
        }
    };
    protocols
        .into_iter()
        .map(|protocol| Comparison::new(methods, protocol, rules(protocol)))
        .collect()
}

/// All tables in one text.
pub(super) fn in_format(comparisons: &[Comparison], format: Format) -> Result<String> {
    if format == Format::Json {
        return Ok(serde_json::to_string_pretty(comparisons)? + "\n");
    }
    let tables = |comparison: &Comparison| match format {
        Format::Latex => vec![comparison.paper_table()],
        Format::Csv => vec![comparison.table()],
        _ => vec![comparison.table(), comparison.scene_table()],
    };
    let text = |table: Table| match format {
        Format::Markdown => table.to_markdown(),
        Format::Csv => table.to_csv(),
        Format::Latex => table.to_latex(),
        Format::Text | Format::Json => table.to_text(),
    };
    Ok(comparisons.iter().flat_map(tables).map(text).collect::<Vec<_>>().join("\n"))
}

/// Writes all formats, the errors of every pair, and plots.
pub(super) fn write_tables(
    folder: &Path,
    comparisons: &[Comparison],
    methods: &[MethodResult],
) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (name, format) in [
        ("tables.txt", Format::Text),
        ("tables.md", Format::Markdown),
        ("tables.csv", Format::Csv),
        ("tables.json", Format::Json),
        ("tables.tex", Format::Latex),
    ] {
        write_text(&folder.join(name), &in_format(comparisons, format)?)?;
    }
    write_text(&folder.join("pairs.csv"), &pair_table(methods).to_csv())?;
    match comparisons.first() {
        Some(comparison) => plots::write_all(folder, methods, comparison.rules.success),
        None => Ok(()),
    }
}

pub(super) fn write_text(path: &Path, text: &str) -> Result<()> {
    Ok(write_whole(path, |writer| writer.write_all(text.as_bytes()))?)
}

/// The errors of every method on every pair.
fn pair_table(methods: &[MethodResult]) -> Table {
    let titles =
        ["method", "scene", "source", "reference", "overlap", "RE", "exact RE", "TE", "RMSE"];
    let number = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
    let rows = methods.iter().flat_map(|method| {
        method.pairs.iter().map(move |pair| {
            vec![
                method.name.clone(),
                pair.scene.clone(),
                pair.source.to_string(),
                pair.reference.to_string(),
                number(pair.overlap),
                number(pair.errors.map(|errors| errors.official_rotation)),
                number(pair.errors.map(|errors| errors.exact_rotation)),
                number(pair.errors.map(|errors| errors.translation)),
                number(pair.errors.and_then(|errors| errors.rmse)),
            ]
        })
    });
    Table { titles: titles.map(str::to_owned).to_vec(), rows: rows.collect(), ..Table::default() }
}
