//! The folder of an evaluation: what was asked, and every answer as soon as it is known.
//!
//! | file | content |
//! |---|---|
//! | `benchmark.json` | the pairs with their truth, and the settings; written once |
//! | `results.jsonl` | a line of JSON per pair and method, only ever appended to |
//! | `claims/N.lock` | locked by the process that works on pair `N` |
//!
//! A process that is killed leaves at most half a line at the end, which the next one cuts off, and locks that the
//! system has released. Several processes may work in one folder: whoever locks a pair does it.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use nalgebra::{Matrix4, Matrix6};
use serde::{Deserialize, Serialize};

use super::comparison::MethodResult;
use super::protocol::Protocol;
use super::scored::{ScoredPair, TruePair};
use super::trajectory::at;
use crate::error::{Error, Result};
use crate::io::{read_text, write_whole};

/// What is evaluated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Benchmark {
    /// As tables name it.
    pub name: String,
    /// The protocol by which it is scored unless another is asked for.
    pub protocol: Protocol,
    /// Everything else on which results depend: the start, the settings of methods.
    pub settings: serde_json::Value,
    /// The pairs and their truth.
    pub pairs: Vec<PairRecord>,
}

/// A [`TruePair`] as files hold it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairRecord {
    scene: String,
    source: usize,
    reference: usize,
    target_from_source: [[f64; 4]; 4],
    information: Option<[[f64; 6]; 6]>,
    overlap: Option<f64>,
    is_first_of_scene: bool,
}

impl From<&TruePair> for PairRecord {
    fn from(pair: &TruePair) -> PairRecord {
        PairRecord {
            scene: pair.scene.clone(),
            source: pair.source,
            reference: pair.reference,
            target_from_source: rows_of(&pair.target_from_source),
            information: pair.information.map(|information| {
                std::array::from_fn(|row| std::array::from_fn(|column| information[(row, column)]))
            }),
            overlap: pair.overlap,
            is_first_of_scene: pair.is_first_of_scene,
        }
    }
}

impl From<&PairRecord> for TruePair {
    fn from(record: &PairRecord) -> TruePair {
        TruePair {
            scene: record.scene.clone(),
            source: record.source,
            reference: record.reference,
            target_from_source: matrix_of(&record.target_from_source),
            information: record
                .information
                .map(|rows| Matrix6::from_fn(|row, column| rows[row][column])),
            overlap: record.overlap,
            is_first_of_scene: record.is_first_of_scene,
        }
    }
}

/// What a method made of a pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// Which pair of the benchmark, from 0.
    pub pair: usize,
    /// The method.
    pub method: String,
    /// Moves the source into the frame of the reference; none if the method found nothing.
    pub target_from_source: Option<[[f64; 4]; 4]>,
    /// Why there is none.
    pub error: Option<String>,
    /// How sure the method is, 0 to 1, if it says so.
    pub confidence: Option<f64>,
    /// The finite numbers by name from which the confidence was computed, if the method tells them: with them the model
    /// of the confidence can be fitted anew without another run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signals: Option<BTreeMap<String, f64>>,
    /// Its verdict, if it has one.
    pub verdict: Option<String>,
    /// Wall time.
    pub seconds: f64,
}

impl Estimate {
    /// The transform of an estimate.
    #[must_use]
    pub fn matrix(&self) -> Option<Matrix4<f64>> {
        self.target_from_source.as_ref().map(matrix_of)
    }
}

/// The rows of a transform, as files hold them.
#[must_use]
pub fn rows_of(matrix: &Matrix4<f64>) -> [[f64; 4]; 4] {
    std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]))
}

fn matrix_of(rows: &[[f64; 4]; 4]) -> Matrix4<f64> {
    Matrix4::from_fn(|row, column| rows[row][column])
}

/// A folder of results.
#[derive(Debug, Clone)]
pub struct ResultsFolder {
    folder: PathBuf,
    benchmark: Benchmark,
}

/// The right to work on a pair; ends when it is dropped or the process dies.
#[derive(Debug)]
pub struct Claim {
    _lock: File,
}

impl ResultsFolder {
    /// Begins an evaluation in a folder, or goes on with one that was begun there.
    ///
    /// # Errors
    /// `Io` if the folder cannot be written; `InvalidInput` if it holds an evaluation of something else.
    pub fn begin(folder: impl Into<PathBuf>, benchmark: Benchmark) -> Result<ResultsFolder> {
        let folder = folder.into();
        fs::create_dir_all(folder.join("claims")).map_err(|cause| Error::io(&folder, cause))?;
        let path = folder.join("benchmark.json");
        if path.exists() {
            let found = ResultsFolder::open(&folder)?;
            if found.benchmark != benchmark {
                return Err(Error::in_file(
                    &path,
                    "this folder holds results of other pairs, another start or other settings: name another folder",
                ));
            }
            return Ok(found);
        }
        let json = serde_json::to_string(&benchmark)
            .map_err(|cause| Error::Internal(format!("the benchmark makes no json: {cause}")))?;
        write_whole(&path, |writer| writer.write_all((json + "\n").as_bytes()))?;
        Ok(ResultsFolder { folder, benchmark })
    }

    /// Opens the results of an evaluation.
    ///
    /// # Errors
    /// `Io` if there are none, `InvalidInput` if they are malformed.
    pub fn open(folder: impl Into<PathBuf>) -> Result<ResultsFolder> {
        let folder = folder.into();
        let path = folder.join("benchmark.json");
        let text = read_text(&path)?;
        let benchmark = serde_json::from_str(&text).map_err(|cause| {
            Error::in_file(&path, format!("this is no record of an evaluation: {cause}"))
        })?;
        Ok(ResultsFolder { folder, benchmark })
    }

    /// What is evaluated.
    #[must_use]
    pub fn benchmark(&self) -> &Benchmark {
        &self.benchmark
    }

    /// All results so far, in the order in which they were found.
    ///
    /// # Errors
    /// `Io` if they cannot be read; `InvalidInput`, with the line, if one is malformed or names a pair that is not there.
    pub fn estimates(&self) -> Result<Vec<Estimate>> {
        let path = self.results();
        if !path.exists() {
            return Ok(Vec::new());
        }
        let text = fs::read_to_string(&path).map_err(|cause| Error::io(&path, cause))?;
        // What follows the last end of line was being written when its process died.
        let whole = text.rfind('\n').map_or("", |end| &text[..end]);
        whole.lines().enumerate().map(|(index, line)| self.parse(&path, index + 1, line)).collect()
    }

    fn parse(&self, path: &Path, line: usize, text: &str) -> Result<Estimate> {
        let estimate: Estimate = serde_json::from_str(text)
            .map_err(|cause| at(path, line, &format!("this is no result: {cause}")))?;
        let count = self.benchmark.pairs.len();
        if estimate.pair >= count {
            let what = format!("there is no pair {}, the benchmark has {count}", estimate.pair);
            return Err(at(path, line, &what));
        }
        Ok(estimate)
    }

    /// Adds a result.
    ///
    /// # Errors
    /// `Io` if it cannot be written.
    pub fn append(&self, estimate: &Estimate) -> Result<()> {
        let path = self.results();
        let failed = |cause| Error::io(&path, cause);
        let mut line = serde_json::to_string(estimate)
            .map_err(|cause| Error::Internal(format!("a result makes no json: {cause}")))?;
        line.push('\n');
        let mut options = OpenOptions::new();
        let mut file = options
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .map_err(failed)?;
        file.lock().map_err(failed)?;
        let end = end_of_last_line(&mut file).map_err(failed)?;
        file.set_len(end).map_err(failed)?;
        file.seek(SeekFrom::Start(end)).map_err(failed)?;
        file.write_all(line.as_bytes()).map_err(failed)
        // The lock ends with the file.
    }

    /// Takes a pair to work on; `None` if another process has it.
    ///
    /// # Errors
    /// `Io` if the folder cannot be written.
    pub fn claim(&self, pair: usize) -> Result<Option<Claim>> {
        let path = self.folder.join("claims").join(format!("{pair}.lock"));
        let mut options = OpenOptions::new();
        let lock = options
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .map_err(|cause| Error::io(&path, cause))?;
        match lock.try_lock() {
            Ok(()) => Ok(Some(Claim { _lock: lock })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(cause)) => Err(Error::io(&path, cause)),
        }
    }

    fn results(&self) -> PathBuf {
        self.folder.join("results.jsonl")
    }
}

/// Where the last whole line of a file ends.
fn end_of_last_line(file: &mut File) -> std::io::Result<u64> {
    const STEP: u64 = 4096;
    let mut end = file.seek(SeekFrom::End(0))?;
    let mut buffer = Vec::new();
    while end > 0 {
        let start = end.saturating_sub(STEP);
        file.seek(SeekFrom::Start(start))?;
        buffer.clear();
        (&mut *file).take(end - start).read_to_end(&mut buffer)?;
        if let Some(last) = buffer.iter().rposition(|&byte| byte == b'\n') {
            return Ok(start + last as u64 + 1);
        }
        end = start;
    }
    Ok(0)
}

/// The results of all methods in some folders of the same benchmark (its shards), `init` first, then by name. A method
/// has every pair; one that was not reached counts as not estimated.
///
/// # Errors
/// `InvalidInput` if the folders hold different benchmarks, or a pair twice with different results.
pub fn merge(folders: &[ResultsFolder]) -> Result<Vec<MethodResult>> {
    let Some(first) = folders.first() else {
        return Err(Error::invalid("there is no folder of results"));
    };
    let mut methods: BTreeMap<String, BTreeMap<usize, Estimate>> = BTreeMap::new();
    for folder in folders {
        if folder.benchmark != first.benchmark {
            return Err(Error::in_file(
                &folder.folder,
                format!(
                    "this is another benchmark, start or setting than in {}",
                    first.folder.display()
                ),
            ));
        }
        for estimate in folder.estimates()? {
            let of_method = methods.entry(estimate.method.clone()).or_default();
            match of_method.get(&estimate.pair) {
                Some(known) if known.target_from_source != estimate.target_from_source => {
                    return Err(Error::in_file(
                        folder.results(),
                        format!(
                            "a second, different result of {} for pair {}",
                            estimate.method, estimate.pair
                        ),
                    ));
                }
                Some(_) => {}
                None => {
                    of_method.insert(estimate.pair, estimate);
                }
            }
        }
    }
    let truth: Vec<TruePair> = first.benchmark.pairs.iter().map(TruePair::from).collect();
    let mut results: Vec<MethodResult> = (methods.into_iter())
        .map(|(name, estimates)| {
            let estimate = |pair: usize| estimates.get(&pair).and_then(Estimate::matrix);
            let scored = truth.iter().enumerate();
            let pairs = scored.map(|(index, pair)| ScoredPair::new(pair, estimate(index).as_ref()));
            let untried = truth.len() - estimates.len();
            MethodResult { name, pairs: pairs.collect(), untried }
        })
        .collect();
    results.sort_by_key(|result| result.name != "init");
    Ok(results)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn benchmark() -> Benchmark {
        let pair = TruePair {
            scene: "room".to_owned(),
            source: 1,
            reference: 0,
            target_from_source: Matrix4::identity(),
            information: None,
            overlap: None,
            is_first_of_scene: true,
        };
        Benchmark {
            name: "room".to_owned(),
            protocol: Protocol::Plain,
            settings: serde_json::Value::Null,
            pairs: vec![(&pair).into()],
        }
    }

    fn estimate(method: &str, signals: Option<BTreeMap<String, f64>>) -> Estimate {
        Estimate {
            pair: 0,
            method: method.to_owned(),
            target_from_source: Some(rows_of(&Matrix4::identity())),
            error: None,
            confidence: Some(0.75),
            signals,
            verdict: Some("refined".to_owned()),
            seconds: 0.5,
        }
    }

    #[test]
    fn signals_are_read_back_exactly_and_may_be_missing() {
        let folder = tempfile::tempdir().unwrap();
        let results = ResultsFolder::begin(folder.path(), benchmark()).unwrap();
        let signals = [("agreement", 0.1 + 0.2), ("log_overlap", -1.0 / 3.0)];
        let signals = signals.map(|(name, value)| (name.to_owned(), value)).into();
        let written = [estimate("refine", Some(signals)), estimate("gicp", None)];
        for estimate in &written {
            results.append(estimate).unwrap();
        }
        assert_eq!(results.estimates().unwrap(), written);
        // Results of methods that tell none stay as small as they were, and older folders can be read.
        let text = fs::read_to_string(folder.path().join("results.jsonl")).unwrap();
        let mentions: Vec<bool> = text.lines().map(|line| line.contains("signals")).collect();
        assert_eq!(mentions, [true, false]);
    }
}
