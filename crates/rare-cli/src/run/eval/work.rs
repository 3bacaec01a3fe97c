//! Pass 1: the pairs are shared out among jobs and processes, every result is written at once.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rare::eval::dataset::DatasetPair;
use rare::eval::results::{Estimate, ResultsFolder, rows_of};
use rare::pose::Ransac;
use rare::{Refiner, Scan};

use super::Plan;
use super::method::{Found, Method};
use super::start::{Start, Starts};
use crate::progress::Pairs;
use crate::run::read_scan;

/// How long to wait for pairs that other processes work on.
const PATIENCE: Duration = Duration::from_millis(200);

/// Works until every pair of the plan has a result of every method.
///
/// # Errors
/// If a cloud cannot be read or a result cannot be written. A method that fails on a pair is a result.
pub(super) fn finish(plan: &Plan, results: &ResultsFolder) -> Result<()> {
    let progress = Pairs::start(plan.settings.quiet, plan.pairs.len());
    loop {
        let left = unfinished(plan, results)?;
        progress.show(plan.pairs.len() - left.len());
        if left.is_empty() {
            return Ok(());
        }
        let worked = work_on(&left, plan, results, &progress)?;
        if worked == 0 {
            // Others have all that is left. If they die, their pairs become free.
            thread::sleep(PATIENCE);
        }
    }
}

/// The pairs that lack a result, with the methods they lack.
fn unfinished(plan: &Plan, results: &ResultsFolder) -> Result<Vec<usize>> {
    let done = done(results)?;
    let lacks = |pair: &usize| {
        plan.methods.iter().any(|method| !done.contains(&(*pair, method.name.clone())))
    };
    Ok(plan.pairs.iter().copied().filter(lacks).collect())
}

fn done(results: &ResultsFolder) -> Result<BTreeSet<(usize, String)>> {
    let estimates = results.estimates()?;
    Ok(estimates.into_iter().map(|estimate| (estimate.pair, estimate.method)).collect())
}

/// Works on those pairs that nobody else works on; how many that were.
fn work_on(
    pairs: &[usize],
    plan: &Plan,
    results: &ResultsFolder,
    progress: &Pairs,
) -> Result<usize> {
    let (next, worked) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let failures = Mutex::new(Vec::new());
    let job = || {
        while let Some(&pair) = pairs.get(next.fetch_add(1, Ordering::Relaxed)) {
            match finish_pair(pair, plan, results) {
                Ok(true) => {
                    worked.fetch_add(1, Ordering::Relaxed);
                    progress.advance();
                }
                Ok(false) => {}
                // The others are worth having all the same.
                Err(error) => failures.lock().unwrap_or_else(PoisonError::into_inner).push(error),
            }
        }
    };
    let threads = thread_pools(plan)?;
    thread::scope(|scope| {
        for pool in &threads {
            scope.spawn(|| pool.install(job));
        }
    });
    let mut failures = failures.into_inner().unwrap_or_else(PoisonError::into_inner);
    let count = failures.len();
    match failures.pop() {
        None => Ok(worked.into_inner()),
        Some(error) => {
            Err(error
                .context(format!("{count} pairs could not be worked on, the last one because of")))
        }
    }
}

/// The threads of each job: an equal share of those that were asked for.
fn thread_pools(plan: &Plan) -> Result<Vec<rayon::ThreadPool>> {
    let all = match plan.settings.threads {
        0 => thread::available_parallelism().map_or(1, usize::from),
        threads => threads,
    };
    let pool = |_| rayon::ThreadPoolBuilder::new().num_threads((all / plan.jobs).max(1)).build();
    (0..plan.jobs).map(pool).collect::<Result<_, _>>().context("--threads")
}

/// Does what is left to do of a pair; false if another process has it.
fn finish_pair(index: usize, plan: &Plan, results: &ResultsFolder) -> Result<bool> {
    let Some(_claim) = results.claim(index)? else { return Ok(false) };
    // Another process may have finished it before the claim.
    let done = done(results)?;
    let left: Vec<&Method> = plan
        .methods
        .iter()
        .filter(|method| !done.contains(&(index, method.name.clone())))
        .collect();
    let Some(pair) = plan.dataset.pairs.get(index).filter(|_| !left.is_empty()) else {
        return Ok(true);
    };
    let mut loaded = Loaded::read(pair)?;
    let start = loaded.start(index, plan);
    for method in left {
        results.append(&loaded.estimate(index, method, &start))?;
    }
    Ok(true)
}

/// The clouds of a pair.
pub(super) struct Loaded {
    pub(super) source: Scan,
    pub(super) reference: Scan,
}

impl Loaded {
    pub(super) fn read(pair: &DatasetPair) -> Result<Loaded> {
        Ok(Loaded { source: read_scan(&pair.source)?, reference: read_scan(&pair.reference)? })
    }

    /// Where methods start, or why there is nothing to start from. Where a network describes the clouds, they have its
    /// features afterwards.
    pub(super) fn start(&mut self, index: usize, plan: &Plan) -> rare::Result<Start> {
        let Some(backbone) = &plan.backbone else { return self.start_of(index, plan) };
        let description = backbone.describe(&mut self.source, &mut self.reference)?.description;
        if !matches!(plan.starts, Starts::Described) {
            let start = self.start_of(index, plan)?;
            return Ok(Start { description: Some(description), ..start });
        }
        let pose = match &description.target_from_source {
            Ok(pose) => Ok(pose.to_matrix()),
            Err(error) => Err(error.to_string()),
        };
        Ok(Start { pose, correspondences: None, description: Some(description) })
    }

    fn start_of(&self, index: usize, plan: &Plan) -> rare::Result<Start> {
        let missing = || rare::Error::Internal(format!("pair {index} has no start"));
        match &plan.starts {
            Starts::Given(poses) => poses.get(index).copied().map(Start::at).ok_or_else(missing),
            Starts::Dumped(files) => {
                let (most, ransac) = if plan.dataset.protocol.is_outdoors() {
                    (1000, Ransac::kitti())
                } else {
                    (500, Ransac::three_d_match())
                };
                Start::read(files.get(index).ok_or_else(missing)?, most, &ransac)
            }
            Starts::Estimated(method) => {
                let refiner = Refiner::new(plan.settings.refiner.clone());
                let pose = refiner.estimate_initial(&self.source, &self.reference, *method)?;
                Ok(Start::at(pose.to_matrix()))
            }
            Starts::Described => Err(missing()),
        }
    }

    fn estimate(&self, pair: usize, method: &Method, start: &rare::Result<Start>) -> Estimate {
        let clock = Instant::now();
        let found = match start {
            Ok(start) => method.apply(&self.source, &self.reference, start),
            Err(error) => Err(rare::Error::no_pose(error.to_string())),
        };
        let seconds = clock.elapsed().as_secs_f64();
        let method = method.name.clone();
        match found {
            Ok(Found { target_from_source, confidence, signals, verdict }) => Estimate {
                pair,
                method,
                target_from_source: Some(rows_of(&target_from_source)),
                error: None,
                confidence,
                signals,
                verdict,
                seconds,
            },
            Err(error) => Estimate {
                pair,
                method,
                target_from_source: None,
                error: Some(error.to_string()),
                confidence: None,
                signals: None,
                verdict: None,
                seconds,
            },
        }
    }
}
