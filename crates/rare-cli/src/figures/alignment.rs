//! Both clouds as they were given, as they lay before and as they lie after.

use anyhow::Result;
use rare::PointCloud;
use rare::nalgebra::Point3;
use rare::scale::SceneKind;
use rayon::prelude::*;

use crate::figures::canvas::{Area, Canvas};
use crate::figures::clouds::{self, Darkness, Dot, Frame, Look, Style};
use crate::figures::layout::{self, LINE, MARGIN, WIDTH};
use crate::figures::{Pose, REFERENCE, SOURCE, Subject};

/// Of each cloud no more points are drawn: beyond, discs only cover one another.
const MOST_POINTS: usize = 600_000;
/// Points by which the part of the world is chosen that is shown.
const MOST_BOUNDS_POINTS: usize = 20_000;
/// What is free around the points, as a share of their extent.
const BORDER: f64 = 0.03;
/// A panel shows at most that many times the extent of the aligned clouds: clouds that start far apart are cut off.
const MOST_EXTENT: f64 = 1.7;
/// The height of a panel by its width.
const ASPECTS: [f64; 2] = [0.45, 1.0];

/// A rectangle in the image plane of a camera, metres: the lower corner, then the upper one.
type Bounds = [[f64; 2]; 2];

pub(super) fn draw(subject: &Subject<'_>) -> Result<Canvas> {
    let rows = [Look::oblique(subject.kind), Look::above(subject.kind)]
        .map(|look| Row::new(subject, look));
    let columns = subject.poses.len().max(1);
    let gap = 2.0 * MARGIN;
    let width = (WIDTH as f32 - 2.0 * MARGIN - gap * (columns - 1) as f32) / columns as f32;
    let scale = rows.iter().map(|row| row.largest_scale(f64::from(width)));
    let scale = scale.fold(f64::INFINITY, f64::min);
    let heights = rows.each_ref().map(|row| row.height(f64::from(width), scale) as f32);
    let below: f32 = heights.iter().map(|height| height + LINE).sum();
    let mut canvas = Canvas::new(WIDTH, (MARGIN + below + LINE) as usize)?;
    let mut y = MARGIN;
    for (number, (row, height)) in rows.iter().zip(heights).enumerate() {
        let x = |column: usize| MARGIN + column as f32 * (width + gap);
        let areas: Vec<Area> =
            (0..columns).map(|column| Area { x: x(column).round(), y, width, height }).collect();
        row.draw(subject, &mut canvas, &areas, scale, number * columns);
        y += height + LINE;
    }
    layout::scale_bar(&mut canvas, y, scale);
    layout::legend(&mut canvas, y, &[(SOURCE, "source"), (REFERENCE, "reference")]);
    Ok(canvas)
}

/// One camera's row of panels.
struct Row {
    look: Look,
    /// What all panels show.
    bounds: Bounds,
    /// Of every pose whether the panel shows all of it.
    whole: Vec<bool>,
}

impl Row {
    fn new(subject: &Subject<'_>, look: Look) -> Row {
        let bounds = |pose: &Pose| bounds(&look, outlying(subject.kind), &few(subject, pose));
        let of_poses: Vec<Option<Bounds>> = subject.poses.iter().map(bounds).collect();
        let result = of_poses.last().copied().flatten().unwrap_or([[-1.0; 2], [1.0; 2]]);
        let all = of_poses.iter().flatten().fold(result, |all, bounds| union(all, *bounds));
        let bounds = limited(all, result);
        let holds =
            |inner: &Option<Bounds>| inner.is_none_or(|inner| union(inner, bounds) == bounds);
        Row { look, bounds: with_border(bounds), whole: of_poses.iter().map(holds).collect() }
    }

    fn extent(&self) -> [f64; 2] {
        let [low, high] = self.bounds;
        [high[0] - low[0], high[1] - low[1]].map(|extent| extent.max(1e-6))
    }

    /// The largest scale, pixels per metre, at which a panel shows everything.
    fn largest_scale(&self, width: f64) -> f64 {
        let [right, up] = self.extent();
        (width / right).min(ASPECTS[1] * width / up)
    }

    fn height(&self, width: f64, scale: f64) -> f64 {
        let wanted = (self.extent()[1] * scale).round();
        if wanted.is_finite() {
            wanted.clamp(ASPECTS[0] * width, ASPECTS[1] * width)
        } else {
            width
        }
    }

    fn frame(&self, area: Area, scale: f64) -> Frame {
        let [low, high] = self.bounds;
        Frame {
            centre: std::array::from_fn(|axis| low[axis] / 2.0 + high[axis] / 2.0),
            pixels_per_metre: scale,
            width: area.width as usize,
            height: area.height as usize,
        }
    }

    /// Of the dots of all panels, so that nothing but the transform tells them apart.
    fn radius(&self, subject: &Subject<'_>, frame: &Frame) -> f64 {
        let source = subject.poses.last().map(|pose| source(subject, pose)).unwrap_or_default();
        let radius = |dots: &[Dot]| clouds::closing_radius(dots, &self.look, frame);
        radius(&reference(subject)).max(radius(&source))
    }

    fn draw(
        &self,
        subject: &Subject<'_>,
        canvas: &mut Canvas,
        areas: &[Area],
        scale: f64,
        first: usize,
    ) {
        let frame = |area: &Area| self.frame(*area, scale);
        let radius = areas.first().map_or(1.0, |area| self.radius(subject, &frame(area)));
        let style = Style { radius, darkness: Darkness::DEEP };
        let panels = areas.par_iter().zip(&subject.poses).map(|(area, pose)| {
            let dots = [reference(subject), source(subject, pose)].concat();
            clouds::render(&dots, &self.look, &frame(area), style)
        });
        let panels: Vec<_> = panels.collect();
        for (index, ((area, image), pose)) in
            areas.iter().zip(&panels).zip(&subject.poses).enumerate()
        {
            canvas.image(image, *area);
            canvas.frame(*area, layout::thin());
            let whole = self.whole.get(index).is_none_or(|&whole| whole);
            let note = if whole { "" } else { " (partly outside)" };
            layout::caption(canvas, *area, first + index, &format!("{}{note}", pose.name));
        }
    }
}

fn reference(subject: &Subject<'_>) -> Vec<Dot> {
    let points = evenly(subject.reference, MOST_POINTS);
    points.map(|&position| Dot { position, colour: REFERENCE }).collect()
}

fn source(subject: &Subject<'_>, pose: &Pose) -> Vec<Dot> {
    let points = evenly(subject.source, MOST_POINTS).map(|point| pose.local.apply(point));
    points.map(|position| Dot { position, colour: SOURCE }).collect()
}

/// Some points of both clouds under a pose.
fn few(subject: &Subject<'_>, pose: &Pose) -> Vec<Point3<f64>> {
    let source = evenly(subject.source, MOST_BOUNDS_POINTS).map(|point| pose.local.apply(point));
    evenly(subject.reference, MOST_BOUNDS_POINTS).copied().chain(source).collect()
}

fn evenly(cloud: &PointCloud, most: usize) -> impl Iterator<Item = &Point3<f64>> {
    cloud.points().iter().step_by(cloud.len().div_ceil(most).max(1))
}

/// The share of points on each side that may lie outside of the frame. A rotating scanner sees some far away.
pub(super) fn outlying(kind: SceneKind) -> f64 {
    if kind == SceneKind::Lidar { 0.03 } else { 0.001 }
}

/// The rectangle that holds nearly all points; `None` if there is none.
pub(super) fn bounds(look: &Look, outlying: f64, points: &[Point3<f64>]) -> Option<Bounds> {
    let seen: Vec<[f64; 3]> = points.iter().map(|point| look.seen(point)).collect();
    let range = |axis: usize| {
        let mut values: Vec<f64> = seen.iter().map(|place| place[axis]).collect();
        values.retain(|value| value.is_finite());
        values.sort_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        let cut = (outlying * last as f64) as usize;
        Some([*values.get(cut)?, *values.get(last - cut)?])
    };
    let (right, up) = (range(0)?, range(1)?);
    Some([[right[0], up[0]], [right[1], up[1]]])
}

pub(super) fn with_border([low, high]: Bounds) -> Bounds {
    let border = |axis: usize| BORDER * (high[axis] - low[axis]);
    [
        std::array::from_fn(|axis| low[axis] - border(axis)),
        std::array::from_fn(|axis| high[axis] + border(axis)),
    ]
}

fn union(a: Bounds, b: Bounds) -> Bounds {
    [
        std::array::from_fn(|axis| a[0][axis].min(b[0][axis])),
        std::array::from_fn(|axis| a[1][axis].max(b[1][axis])),
    ]
}

/// The part of `all` that lies around `main`.
fn limited(all: Bounds, main: Bounds) -> Bounds {
    let more = |axis: usize| (MOST_EXTENT - 1.0) / 2.0 * (main[1][axis] - main[0][axis]);
    [
        std::array::from_fn(|axis| all[0][axis].max(main[0][axis] - more(axis))),
        std::array::from_fn(|axis| all[1][axis].min(main[1][axis] + more(axis))),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn some_points_far_away_do_not_stretch_the_bounds() {
        let look = Look::above(SceneKind::Lidar);
        // x, ahead, is up in the image and -y to the right.
        let mut points: Vec<Point3<f64>> = (0..1000)
            .map(|i| Point3::new(f64::from(i) * 0.01, f64::from(i) * 0.002, 0.0))
            .collect();
        points.push(Point3::new(900.0, -900.0, 0.0));
        let [low, high] = bounds(&look, 0.005, &points).unwrap();
        assert!((high[1] - low[1] - 9.9).abs() < 0.2, "{low:?} {high:?}");
        assert!((high[0] - low[0] - 1.98).abs() < 0.2, "{low:?} {high:?}");
        assert!(bounds(&look, 0.005, &[]).is_none());
    }

    #[test]
    fn clouds_that_start_far_apart_are_cut_off() {
        let main = [[0.0, 0.0], [2.0, 1.0]];
        let cut = limited(union(main, [[-50.0, 0.1], [1.0, 0.9]]), main);
        assert!((cut[0][0] + 0.7).abs() < 1e-9 && cut[0][1] == 0.0 && cut[1] == main[1]);
    }
}
