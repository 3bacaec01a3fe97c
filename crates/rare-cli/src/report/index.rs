//! The page of an evaluation: all pairs of all methods, worst first, with recall curves.

use std::collections::BTreeMap;

use rare::eval::results::Estimate;
use rare::eval::{Comparison, MethodResult, MethodSummary};
use serde::Serialize;

use crate::plots;

/// What the page is made of, as its scripts read it.
#[derive(Serialize)]
pub(crate) struct Index {
    pub(super) title: String,
    version: &'static str,
    success: Limits,
    methods: Vec<Method>,
    pairs: Vec<Pair>,
}

/// The errors of a solved pair, degrees and metres.
#[derive(Serialize)]
struct Limits {
    rotation: f64,
    translation: f64,
}

#[derive(Serialize)]
struct Method {
    name: String,
    pairs: usize,
    solved: usize,
    mean_rotation: Option<f64>,
    mean_translation: Option<f64>,
    recall_rotation: Vec<(f64, f64)>,
    recall_translation: Vec<(f64, f64)>,
}

#[derive(Serialize)]
struct Pair {
    method: String,
    scene: String,
    source: String,
    reference: String,
    overlap: Option<f64>,
    rotation: Option<f64>,
    translation: Option<f64>,
    solved: bool,
    confidence: Option<f64>,
    verdict: Option<String>,
    seconds: Option<f64>,
    page: Option<String>,
    error: Option<String>,
}

/// Where the page of a pair lies, relative to the index: by its method and its number.
pub(crate) type Pages = BTreeMap<(String, usize), String>;

impl Index {
    pub(crate) fn new(
        title: String,
        comparison: &Comparison,
        results: &[MethodResult],
        estimates: &[Estimate],
        pages: &Pages,
    ) -> Index {
        let (rotation, translation) = plots::limits(comparison.rules.success);
        let estimates: BTreeMap<(&str, usize), &Estimate> = estimates
            .iter()
            .map(|estimate| ((estimate.method.as_str(), estimate.pair), estimate))
            .collect();
        let methods = results.iter().zip(&comparison.methods);
        let pairs = results.iter().flat_map(|result| {
            let estimates = &estimates;
            (0..result.pairs.len()).filter_map(move |number| {
                let estimate = estimates.get(&(result.name.as_str(), number))?;
                Pair::new(comparison, result, number, estimate, pages)
            })
        });
        Index {
            title,
            version: env!("CARGO_PKG_VERSION"),
            success: Limits { rotation, translation },
            methods: methods
                .map(|(result, summary)| Method::new(result, summary, rotation, translation))
                .collect(),
            pairs: pairs.collect(),
        }
    }
}

impl Method {
    fn new(
        result: &MethodResult,
        summary: &MethodSummary,
        rotation: f64,
        translation: f64,
    ) -> Method {
        let averages = &summary.summary.of_solved;
        Method {
            name: result.name.clone(),
            pairs: summary.summary.pairs,
            solved: summary.summary.solved,
            mean_rotation: averages.rotation.pairs.mean,
            mean_translation: averages.translation.pairs.mean,
            recall_rotation: plots::recall(&result.pairs, 2.0 * rotation, plots::turned),
            recall_translation: plots::recall(&result.pairs, 2.0 * translation, plots::moved),
        }
    }
}

impl Pair {
    fn new(
        comparison: &Comparison,
        result: &MethodResult,
        number: usize,
        estimate: &Estimate,
        pages: &Pages,
    ) -> Option<Pair> {
        let pair = result.pairs.get(number)?;
        Some(Pair {
            method: result.name.clone(),
            scene: pair.scene.clone(),
            source: pair.source.to_string(),
            reference: pair.reference.to_string(),
            overlap: pair.overlap,
            rotation: pair.errors.map(|errors| errors.exact_rotation),
            translation: pair.errors.map(|errors| errors.translation),
            solved: comparison.rules.solved(pair),
            confidence: estimate.confidence,
            verdict: estimate.verdict.clone(),
            seconds: Some(estimate.seconds),
            page: pages.get(&(result.name.clone(), number)).cloned(),
            error: estimate.error.clone(),
        })
    }
}
