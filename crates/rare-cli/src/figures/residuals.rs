//! How far the source's points lie from the reference's surface, before and after.

use anyhow::Result;

use crate::figures::canvas::{Area, BLACK, Canvas, Pen, from_points};
use crate::figures::layout::{self, LINE, MARGIN, WIDTH};
use crate::figures::scales;
use crate::figures::text::{Anchor, Text};
use crate::figures::{Pose, Subject};

/// Bins from 0 to the end of the axis.
const BINS: usize = 60;
/// Where the axis ends, by the distance up to which a correspondence is an inlier.
const LAST: f64 = 3.0;
const HEIGHT: f32 = 820.0;
/// Before and after, from the palette of Okabe and Ito.
const COLOURS: [[u8; 3]; 2] = [[213, 94, 0], [0, 114, 178]];

/// The residuals under one transform.
struct Histogram {
    name: &'static str,
    /// Shares of all points, per cent.
    bins: Vec<f64>,
    median: f64,
    /// Share of the points beyond the axis, per cent.
    beyond: f64,
}

pub(super) fn draw(subject: &Subject<'_>) -> Result<Canvas> {
    let radius = subject.illustration.acceptance_radius;
    let end = LAST * radius;
    let of_pose = |pose: &Pose| {
        let residuals = subject.illustration.source.residuals.get(pose.index)?;
        Histogram::new(pose.name, residuals, end)
    };
    let histograms: Vec<Histogram> =
        subject.before_and_after().iter().filter_map(of_pose).collect();
    if histograms.is_empty() || !(end > 0.0 && end.is_finite()) {
        return layout::message("no point of the source has a residual");
    }
    let mut canvas = Canvas::new(WIDTH, HEIGHT as usize)?;
    let left = 2.4 * LINE;
    let width = WIDTH as f32 - left - 2.0 * MARGIN;
    let plot = Area { x: left, y: 2.0 * MARGIN, width, height: HEIGHT - 2.4 * LINE };
    let highest = histograms.iter().flat_map(|histogram| &histogram.bins).copied();
    let chart = Chart { plot, x_end: end, y_end: 1.08 * highest.fold(1.0, f64::max) };
    for (histogram, colour) in with_colours(&histograms) {
        chart.bars(&mut canvas, &histogram.bins, colour);
    }
    chart.limit(&mut canvas, radius);
    chart.axes(&mut canvas);
    chart.legend(&mut canvas, &histograms);
    Ok(canvas)
}

/// The last histogram has the last colour.
fn with_colours(histograms: &[Histogram]) -> impl Iterator<Item = (&Histogram, [u8; 3])> {
    let first = COLOURS.len().saturating_sub(histograms.len());
    histograms.iter().zip(COLOURS.into_iter().skip(first))
}

impl Histogram {
    /// `None` without a residual.
    fn new(name: &'static str, residuals: &[f32], end: f64) -> Option<Histogram> {
        let mut sorted: Vec<f64> = residuals.iter().copied().map(f64::from).collect();
        sorted.sort_by(f64::total_cmp);
        let each = 100.0 / sorted.len() as f64;
        let mut bins = vec![0.0; BINS];
        let mut beyond = 0.0;
        for residual in &sorted {
            let bin = (residual / end * BINS as f64) as usize;
            let inside = bins.get_mut(bin).filter(|_| *residual < end);
            *inside.unwrap_or(&mut beyond) += each;
        }
        let median = *sorted.get(sorted.len() / 2)?;
        Some(Histogram { name, bins, median, beyond })
    }

    fn words(&self, end: f64) -> String {
        let (median, end) = (scales::length(self.median), scales::length(end));
        let Histogram { name, beyond, .. } = self;
        format!("{name}: median {median}, {beyond:.0} % beyond {end}")
    }
}

/// The space in which the bars stand.
struct Chart {
    plot: Area,
    x_end: f64,
    y_end: f64,
}

impl Chart {
    fn place(&self, x: f64, y: f64) -> [f32; 2] {
        let (right, up) = ((x / self.x_end) as f32, (y / self.y_end) as f32);
        [self.plot.x + self.plot.width * right, self.plot.bottom() - self.plot.height * up]
    }

    /// The outline of all bars, so that two histograms can be told apart where they overlap.
    fn bars(&self, canvas: &mut Canvas, bins: &[f64], colour: [u8; 3]) {
        let edge = |bin: usize| self.x_end * bin as f64 / BINS as f64;
        let tops = bins.iter().enumerate();
        let tops = tops.flat_map(|(bin, &share)| [(edge(bin), share), (edge(bin + 1), share)]);
        let ends = [(0.0, 0.0), (self.x_end, 0.0)];
        let corners = ends[..1].iter().copied().chain(tops).chain(ends[1..].iter().copied());
        let corners: Vec<[f32; 2]> = corners.map(|(x, y)| self.place(x, y)).collect();
        canvas.polygon(&corners, colour, 0.22);
        canvas.lines(&corners, Pen::new(from_points(0.9), colour));
    }

    /// The distance up to which a correspondence is an inlier.
    fn limit(&self, canvas: &mut Canvas, radius: f64) {
        let [from, to] = [self.place(radius, 0.0), self.place(radius, self.y_end)];
        let pen = Pen { dashed: true, ..Pen::new(from_points(0.6), [90; 3]) };
        canvas.line(from, to, pen);
        let words = format!("inlier radius {}", scales::length(radius));
        let place = [to[0] + 12.0, self.plot.y + 1.1 * layout::small_size()];
        layout::small(canvas, &words, place, Anchor::Start);
    }

    fn axes(&self, canvas: &mut Canvas) {
        let axis = Pen::new(from_points(0.6), BLACK);
        let origin = self.place(0.0, 0.0);
        canvas.line(origin, self.place(self.x_end, 0.0), axis);
        canvas.line(origin, self.place(0.0, self.y_end), axis);
        for (value, words) in scales::ticks(0.0, self.x_end, 5.0) {
            let [x, y] = self.place(value, 0.0);
            canvas.line([x, y], [x, y + 10.0], axis);
            let below = [x, y + 14.0 + layout::small_size()];
            layout::small(canvas, &words, below, Anchor::Middle);
        }
        for (value, words) in scales::ticks(0.0, self.y_end, 4.0) {
            let [x, y] = self.place(0.0, value);
            canvas.line([x - 10.0, y], [x, y], axis);
            let beside = [x - 16.0, y + 0.35 * layout::small_size()];
            layout::small(canvas, &words, beside, Anchor::End);
        }
        let middle = self.plot.x + self.plot.width / 2.0;
        let words = "distance of a source point from the reference's surface, m";
        layout::fitted(canvas, words, [middle, HEIGHT - 0.35 * LINE], self.plot.width);
        canvas.text(&Text {
            content: "source points, %",
            place: [MARGIN + layout::text_size(), self.plot.y + self.plot.height / 2.0],
            anchor: Anchor::Middle,
            size: layout::text_size(),
            colour: BLACK,
            upward: true,
        });
    }

    /// In the upper right corner, where residuals are rare.
    fn legend(&self, canvas: &mut Canvas, histograms: &[Histogram]) {
        let size = layout::text_size();
        for (line, (histogram, colour)) in with_colours(histograms).enumerate() {
            let y = self.plot.y + 1.5 * size * (line as f32 + 1.0);
            let right = self.plot.right() - size;
            let square =
                Area { x: right - size, y: y - 0.75 * size, width: size, height: 0.8 * size };
            canvas.rectangle(square, colour, 0.3);
            canvas.frame(square, Pen::new(from_points(0.9), colour));
            let place = [square.x - 0.5 * size, y];
            let content = &histogram.words(self.x_end);
            let (anchor, colour) = (Anchor::End, BLACK);
            canvas.text(&Text { content, place, anchor, size, colour, upward: false });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_residual_is_in_a_bin_or_beyond() {
        let residuals = [0.0, 0.05, 0.051, 0.299, 0.3, 5.0, f32::INFINITY, f32::NAN];
        let histogram = Histogram::new("result", &residuals, 0.3).unwrap();
        assert!((histogram.bins.iter().sum::<f64>() + histogram.beyond - 100.0).abs() < 1e-9);
        assert!((histogram.beyond - 50.0).abs() < 1e-9);
        assert!((histogram.bins[10] - 25.0).abs() < 1e-9 && histogram.bins[BINS - 1] > 0.0);
        assert_eq!(histogram.words(0.3), "result: median 30 cm, 50 % beyond 30 cm");
        assert!(Histogram::new("result", &[], 0.3).is_none());
    }
}
