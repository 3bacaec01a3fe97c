//! The results of an evaluation as curves, one SVG each.

use std::path::Path;

use anyhow::{Result, anyhow};
use plotters::prelude::*;
use rare::eval::{MethodResult, ScoredPair, Success};
use rare::io::write_whole;

/// The palette of Okabe and Ito, which colour-blind people can tell apart.
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];
const SIZE: (u32, u32) = (760, 480);
/// Points of a curve.
const STEPS: usize = 200;
/// Bars of a distribution, and bins of the overlap.
const BINS: usize = 20;
/// Bins of the overlap.
const OVERLAP_BINS: usize = 10;

/// One curve per method.
struct Plot<'a> {
    title: &'a str,
    x: &'a str,
    y: &'a str,
    x_end: f64,
    y_end: f64,
    curves: Vec<(&'a str, Vec<(f64, f64)>)>,
}

/// Draws recall against the thresholds of both errors, the distributions of the errors, and recall against overlap.
///
/// # Errors
/// If a file cannot be written.
pub(crate) fn write_all(folder: &Path, methods: &[MethodResult], success: Success) -> Result<()> {
    let (rotation, translation) = limits(success);
    recall_plot("rotation error below, degrees", 2.0 * rotation, methods, turned)
        .write(&folder.join("recall_rotation.svg"))?;
    recall_plot("translation error below, metres", 2.0 * translation, methods, moved)
        .write(&folder.join("recall_translation.svg"))?;
    distribution_plot("rotation error, degrees", rotation, methods, turned)
        .write(&folder.join("distribution_rotation.svg"))?;
    distribution_plot("translation error, metres", translation, methods, moved)
        .write(&folder.join("distribution_translation.svg"))?;
    let solved = |pair: &ScoredPair| turned(pair) < rotation && moved(pair) < translation;
    match overlap_plot(methods, solved) {
        Some(plot) => plot.write(&folder.join("recall_overlap.svg")),
        None => Ok(()),
    }
}

/// The errors of a solved pair, degrees and metres, or what comes near them.
pub(crate) fn limits(success: Success) -> (f64, f64) {
    match success {
        Success::Pose { rotation, translation } => (rotation, translation),
        Success::Rmse(limit) => (15.0, limit),
    }
}

/// The rotation error, degrees; of a pair without a transform infinite.
pub(crate) fn turned(pair: &ScoredPair) -> f64 {
    pair.errors.map_or(f64::INFINITY, |errors| errors.exact_rotation)
}

/// The translation error, metres; of a pair without a transform infinite.
pub(crate) fn moved(pair: &ScoredPair) -> f64 {
    pair.errors.map_or(f64::INFINITY, |errors| errors.translation)
}

/// The share of pairs whose error is below each threshold.
fn recall_plot<'a>(
    x: &'a str,
    x_end: f64,
    methods: &'a [MethodResult],
    error: impl Fn(&ScoredPair) -> f64,
) -> Plot<'a> {
    let curve = |method: &MethodResult| recall(&method.pairs, x_end, &error);
    let curves = methods.iter().map(|method| (method.name.as_str(), curve(method))).collect();
    Plot { title: "Recall", x, y: "pairs, %", x_end, y_end: 100.0, curves }
}

/// Thresholds from 0 to `end`, and the percentage of pairs whose error is below each.
pub(crate) fn recall(
    pairs: &[ScoredPair],
    end: f64,
    error: impl Fn(&ScoredPair) -> f64,
) -> Vec<(f64, f64)> {
    let threshold = |step: usize| end * step as f64 / STEPS as f64;
    let share = |limit: f64| share_of(pairs, |pair| error(pair) < limit);
    (0..=STEPS).map(threshold).map(|limit| (limit, 100.0 * share(limit))).collect()
}

/// The share of pairs in each bin of the error; the last one takes all that are worse.
fn distribution_plot<'a>(
    x: &'a str,
    x_end: f64,
    methods: &'a [MethodResult],
    error: impl Fn(&ScoredPair) -> f64,
) -> Plot<'a> {
    let bin = |pair: &ScoredPair| ((error(pair) / x_end * BINS as f64) as usize).min(BINS - 1);
    let curve = |method: &MethodResult| {
        let share = |index: usize| 100.0 * share_of(&method.pairs, |pair| bin(pair) == index);
        let ends = |index: usize| [index, index + 1].map(|edge| edge as f64 * x_end / BINS as f64);
        (0..BINS).flat_map(|index| ends(index).map(|edge| (edge, share(index)))).collect()
    };
    let curves: Vec<_> =
        methods.iter().map(|method| (method.name.as_str(), curve(method))).collect();
    let y_end = highest(&curves);
    Plot {
        title: "Distribution (the last bin has all that is worse)",
        x,
        y: "pairs, %",
        x_end,
        y_end,
        curves,
    }
}

/// Recall by overlap; `None` if the benchmark does not know overlaps.
fn overlap_plot<'a>(
    methods: &'a [MethodResult],
    solved: impl Fn(&ScoredPair) -> bool,
) -> Option<Plot<'a>> {
    let bin = |overlap: f64| ((overlap * OVERLAP_BINS as f64) as usize).min(OVERLAP_BINS - 1);
    let curve = |method: &MethodResult| -> Vec<(f64, f64)> {
        let of_bin = |index: usize| {
            let pairs: Vec<&ScoredPair> =
                (method.pairs.iter()).filter(|pair| pair.overlap.map(bin) == Some(index)).collect();
            let hits = pairs.iter().filter(|pair| solved(pair)).count();
            let middle = (index as f64 + 0.5) / OVERLAP_BINS as f64;
            (!pairs.is_empty()).then(|| (middle, 100.0 * hits as f64 / pairs.len() as f64))
        };
        (0..OVERLAP_BINS).filter_map(of_bin).collect()
    };
    let curves: Vec<_> =
        methods.iter().map(|method| (method.name.as_str(), curve(method))).collect();
    curves.iter().any(|(_, curve)| !curve.is_empty()).then_some(Plot {
        title: "Recall by overlap",
        x: "overlap",
        y: "pairs, %",
        x_end: 1.0,
        y_end: 100.0,
        curves,
    })
}

fn share_of(pairs: &[ScoredPair], holds: impl Fn(&ScoredPair) -> bool) -> f64 {
    pairs.iter().filter(|pair| holds(pair)).count() as f64 / pairs.len().max(1) as f64
}

fn highest(curves: &[(&str, Vec<(f64, f64)>)]) -> f64 {
    let values = curves.iter().flat_map(|(_, curve)| curve.iter().map(|(_, y)| *y));
    values.fold(1.0, f64::max) * 1.05
}

impl Plot<'_> {
    fn write(&self, path: &Path) -> Result<()> {
        let mut svg = String::new();
        self.draw(&mut svg).map_err(|error| anyhow!("{}: {error}", path.display()))?;
        Ok(write_whole(path, |writer| writer.write_all(svg.as_bytes()))?)
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&root)
            .caption(self.title, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(52)
            .build_cartesian_2d(0.0..self.x_end, 0.0..self.y_end)?;
        chart.configure_mesh().x_desc(self.x).y_desc(self.y).light_line_style(WHITE).draw()?;
        for ((name, curve), colour) in self.curves.iter().zip(COLOURS.iter().cycle()) {
            let style = colour.stroke_width(2);
            chart
                .draw_series(LineSeries::new(curve.iter().copied(), style))?
                .label(*name)
                .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], style));
        }
        chart
            .configure_series_labels()
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK)
            .draw()?;
        root.present()?;
        Ok(())
    }
}
