//! The `.log` files of the Redwood and 3DMatch benchmarks: blocks of a line `i j n` and the four rows of a matrix.

use nalgebra::Matrix4;

use super::pose::matrix;
use crate::error::{Error, Result};

/// How many pairs a message lists.
const LISTED: usize = 5;

/// A log: the fragments of each block and its matrix.
pub(super) struct Log {
    blocks: Vec<Block>,
}

struct Block {
    fragments: (usize, usize),
    numbers: Vec<f64>,
}

impl Log {
    /// Takes the lines of a text apart; `None` if they are not those of a log.
    pub(super) fn of(rows: &[Vec<f64>]) -> Option<Log> {
        if rows.is_empty() || !rows.len().is_multiple_of(5) {
            return None;
        }
        let blocks: Option<Vec<Block>> = rows.chunks_exact(5).map(Block::of).collect();
        Some(Log { blocks: blocks? })
    }
}

impl Block {
    fn of(rows: &[Vec<f64>]) -> Option<Block> {
        let (&[first, second] | &[first, second, _]) = rows.first()?.as_slice() else {
            return None;
        };
        let matrix = rows.get(1..)?;
        let fragment =
            |value: f64| (value >= 0.0 && value.fract() == 0.0).then_some(value as usize);
        matrix.iter().all(|row| row.len() == 4).then_some(Block {
            fragments: (fragment(first)?, fragment(second)?),
            numbers: matrix.concat(),
        })
    }
}

/// The matrix of the only block, or of the block that `pair` (`i,j`) names.
///
/// # Errors
/// `InvalidInput` if there are several blocks and no pair, or no block of that pair.
pub(super) fn select(log: &Log, pair: Option<&str>) -> Result<Matrix4<f64>> {
    let block = match (pair, log.blocks.as_slice()) {
        (None, [only]) => Some(only),
        (None, blocks) => {
            return Err(Error::invalid(format!(
                "the log has {} blocks ({}): name one by its fragments, file.log:i,j",
                blocks.len(),
                listed(blocks)
            )));
        }
        (Some(pair), blocks) => {
            let wanted = parse_pair(pair)?;
            blocks.iter().find(|block| block.fragments == wanted)
        }
    };
    let block = block.ok_or_else(|| {
        Error::invalid(format!(
            "the log has no block {}, it has {}",
            pair.unwrap_or_default(),
            listed(&log.blocks)
        ))
    })?;
    matrix(&block.numbers)
}

fn parse_pair(pair: &str) -> Result<(usize, usize)> {
    let parsed = pair.split_once(',').and_then(|(first, second)| {
        Some((first.trim().parse().ok()?, second.trim().parse().ok()?))
    });
    parsed.ok_or_else(|| {
        Error::invalid(format!(
            "the block {pair} is not named by two fragments: write file.log:i,j"
        ))
    })
}

fn listed(blocks: &[Block]) -> String {
    let pairs = blocks
        .iter()
        .take(LISTED)
        .map(|block| format!("{},{}", block.fragments.0, block.fragments.1));
    let more = if blocks.len() > LISTED { " ..." } else { "" };
    pairs.collect::<Vec<_>>().join(" ") + more
}
