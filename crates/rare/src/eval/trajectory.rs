//! The `.log` and `.info` files of the Redwood and 3DMatch benchmarks: blocks of a line `i j n` and a square matrix.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Matrix4, Matrix6, SMatrix};

use crate::error::{Error, Result};
use crate::io::read_text;

/// A block of a file: two fragments and the matrix that belongs to them.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<const N: usize> {
    /// The fragment in whose frame a pose is given (the target).
    pub first: usize,
    /// The fragment that is posed (the source).
    pub second: usize,
    /// The line of the file (from 1) on which the block begins.
    pub line: usize,
    /// The matrix as it stands there.
    pub matrix: SMatrix<f64, N, N>,
}

/// Reads poses (`gt.log`, `est.log`): the transform of each block moves fragment `second` into the frame of `first`.
///
/// # Errors
/// `Io` if the file cannot be read; `InvalidInput`, with the line, if a block is malformed or comes twice, or a number is
/// not finite.
pub fn read_log(path: impl AsRef<Path>) -> Result<Vec<Block<4>>> {
    let blocks = read_blocks::<4>(path.as_ref())?;
    let last_row = nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0);
    match blocks.iter().find(|block| (block.matrix.row(3) - last_row).amax() > 1e-6) {
        Some(block) => {
            Err(at(path.as_ref(), block.line + 4, "the last row of a pose must be 0 0 0 1"))
        }
        None => Ok(blocks),
    }
}

/// Reads information matrices (`gt.info`).
///
/// # Errors
/// As [`read_log`].
pub fn read_information(path: impl AsRef<Path>) -> Result<Vec<Block<6>>> {
    read_blocks::<6>(path.as_ref())
}

/// Reads overlaps (`gt_overlap.log`): lines `i,j,overlap`.
///
/// # Errors
/// As [`read_log`].
pub fn read_overlaps(path: impl AsRef<Path>) -> Result<BTreeMap<(usize, usize), f64>> {
    let path = path.as_ref();
    let text = read_text(path)?;
    let mut overlaps = BTreeMap::new();
    for (line, text) in content(&text) {
        let mut words = text.split([',', ' ', '\t']).filter(|word| !word.is_empty());
        let mut index = || words.next()?.parse::<usize>().ok();
        let (Some(first), Some(second)) = (index(), index()) else {
            return Err(at(path, line, "expected i,j,overlap"));
        };
        let overlap = words.next().and_then(|word| word.parse::<f64>().ok());
        let Some(overlap) = overlap.filter(|overlap| (0.0..=1.0).contains(overlap)) else {
            return Err(at(path, line, "expected an overlap between 0 and 1 after the fragments"));
        };
        if overlaps.insert((first, second), overlap).is_some() {
            return Err(at(path, line, &format!("the pair {first} {second} comes a second time")));
        }
    }
    Ok(overlaps)
}

/// Writes poses in the layout of the benchmarks, all digits kept.
#[must_use]
pub fn format_log<'a>(
    blocks: impl IntoIterator<Item = (usize, usize, &'a Matrix4<f64>)>,
    fragments: usize,
) -> String {
    let mut text = String::new();
    for (first, second, matrix) in blocks {
        text += &format!("{first}\t{second}\t{fragments}\n");
        for row in matrix.row_iter() {
            let row: Vec<String> =
                row.iter().map(|value| format!("{:.17e}", value + 0.0)).collect();
            text += &(row.join("\t") + "\n");
        }
    }
    text
}

/// The information matrices that belong to the pairs of a log, in its order.
///
/// # Errors
/// `InvalidInput`, with the line of the log, if a pair has none.
pub fn information_of(
    log: &[Block<4>],
    log_path: &Path,
    information: &[Block<6>],
) -> Result<Vec<Matrix6<f64>>> {
    let by_pair: BTreeMap<_, _> =
        information.iter().map(|block| ((block.first, block.second), block.matrix)).collect();
    log.iter()
        .map(|block| {
            by_pair.get(&(block.first, block.second)).copied().ok_or_else(|| {
                let what =
                    format!("no information matrix of the pair {} {}", block.first, block.second);
                at(log_path, block.line, &what)
            })
        })
        .collect()
}

fn read_blocks<const N: usize>(path: &Path) -> Result<Vec<Block<N>>> {
    let text = read_text(path)?;
    let lines: Vec<(usize, &str)> = content(&text).collect();
    let mut seen = BTreeMap::new();
    let mut blocks = Vec::with_capacity(lines.len() / (N + 1));
    for lines in lines.chunks(N + 1) {
        let block = parse_block::<N>(path, lines)?;
        if let Some(before) = seen.insert((block.first, block.second), block.line) {
            let pair = format!("{} {}", block.first, block.second);
            return Err(at(
                path,
                block.line,
                &format!("the pair {pair} was there on line {before} already"),
            ));
        }
        blocks.push(block);
    }
    Ok(blocks)
}

fn parse_block<const N: usize>(path: &Path, lines: &[(usize, &str)]) -> Result<Block<N>> {
    let Some(&(line, header)) = lines.first() else {
        return Err(Error::Internal("a block without lines".to_owned()));
    };
    let words: Vec<&str> = header.split_whitespace().collect();
    let index = |at: usize| words.get(at).and_then(|word| word.parse::<usize>().ok());
    let (Some(first), Some(second), true) = (index(0), index(1), words.len() <= 3) else {
        return Err(at(
            path,
            line,
            "expected the line `i j n` of a block, two fragments and their number",
        ));
    };
    if lines.len() != N + 1 {
        let what = format!(
            "the block has {} rows instead of {N}: the file ends too early",
            lines.len() - 1
        );
        return Err(at(path, line, &what));
    }
    let mut matrix = SMatrix::zeros();
    for (row, &(line, text)) in lines[1..].iter().enumerate() {
        let values =
            text.split_whitespace().map(|word| word.parse::<f64>().ok().filter(|v| v.is_finite()));
        let values: Option<Vec<f64>> = values.collect();
        let Some(values) = values.filter(|values| values.len() == N) else {
            return Err(at(path, line, &format!("expected {N} finite numbers")));
        };
        for (column, value) in values.into_iter().enumerate() {
            matrix[(row, column)] = value;
        }
    }
    Ok(Block { first, second, line, matrix })
}

/// Lines that are not empty, with their numbers from 1.
fn content(text: &str) -> impl Iterator<Item = (usize, &str)> {
    (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty())
}

pub(super) fn at(path: &Path, line: usize, what: &str) -> Error {
    Error::in_file(path, format!("line {line}: {what}"))
}
