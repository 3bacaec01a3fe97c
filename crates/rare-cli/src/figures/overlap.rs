//! The result, coloured by what the sensors and the surfaces say of every point.

use anyhow::Result;
use rare::PointCloud;
use rare::nalgebra::Point3;
use rare::refine::IllustratedCloud;
use rare::verify::Visibility;
use rayon::prelude::*;

use crate::figures::alignment;
use crate::figures::canvas::Canvas;
use crate::figures::clouds::{self, Darkness, Dot, Frame, Look, Style};
use crate::figures::layout::{self, ColourBar, Grid, LINE, Room};
use crate::figures::{Pose, Subject};
use crate::images::{AGREE, OCCLUDED, VIOLATION, viridis};

/// Where no sensor says anything.
const UNSEEN: [u8; 3] = [226, 228, 232];
/// The colours of visibility.
const MEANINGS: [([u8; 3], &str); 4] = [
    (AGREE, "agree"),
    (OCCLUDED, "occluded"),
    (VIOLATION, "free-space violation"),
    (UNSEEN, "not seen"),
];
/// Where the colours of residuals end, by the distance up to which a correspondence is an inlier.
const LAST: f64 = 2.0;
/// The height of a panel by its width.
const ASPECTS: [f64; 2] = [0.5, 1.0];

pub(super) fn draw(subject: &Subject<'_>) -> Result<Canvas> {
    let Some(pose) = subject.poses.last() else { return layout::message("no transform") };
    let end = LAST * subject.illustration.acceptance_radius;
    let seen = |cloud: &IllustratedCloud, index: usize| {
        Some(colour_of(*cloud.visibility.get(pose.index)?.get(index)?))
    };
    let residual = |cloud: &IllustratedCloud, index: usize| {
        let residual = *cloud.residuals.get(pose.index)?.get(index)?;
        Some(viridis((f64::from(residual) / end) as f32))
    };
    let panels = [dots(subject, pose, seen), dots(subject, pose, residual)];
    let look = Look::oblique(subject.kind);
    let Some((grid, frame)) = fit(subject, &look, &panels[0]) else {
        return layout::message("no point was judged");
    };
    let mut canvas = grid.sheet(LINE)?;
    let radius = clouds::closing_radius(&panels[0], &look, &frame);
    let style = Style { radius, darkness: Darkness::FAINT };
    let images = panels.par_iter().map(|dots| clouds::render(dots, &look, &frame, style));
    let images: Vec<_> = images.collect();
    let captions = ["result, what the sensors say", "result, distance from the other cloud"];
    for (index, (image, caption)) in images.iter().zip(captions).enumerate() {
        canvas.image(image, grid.area(index));
        grid.caption(&mut canvas, index, caption);
    }
    layout::scale_bar(&mut canvas, grid.bottom(), frame.pixels_per_metre);
    ColourBar { range: [0.0, end], unit: "m", falling: false, open: true }
        .draw(&mut canvas, grid.area(1));
    layout::legend(&mut canvas, grid.bottom(), &MEANINGS);
    Ok(canvas)
}

/// Two panels that show all dots; `None` if there are none.
fn fit(subject: &Subject<'_>, look: &Look, dots: &[Dot]) -> Option<(Grid, Frame)> {
    let points: Vec<Point3<f64>> = dots.iter().map(|dot| dot.position).collect();
    let [low, high] = alignment::with_border(alignment::bounds(
        look,
        alignment::outlying(subject.kind),
        &points,
    )?);
    let [right, up] = [0, 1].map(|axis| (high[axis] - low[axis]).max(1e-6));
    let aspect = (up / right).clamp(ASPECTS[0], ASPECTS[1]);
    let grid = Grid::new(2, 2, aspect as f32, Room::COLOUR_BAR);
    let panel = grid.area(0);
    let frame = Frame {
        centre: [0, 1].map(|axis| low[axis] / 2.0 + high[axis] / 2.0),
        pixels_per_metre: (f64::from(panel.width) / right).min(f64::from(panel.height) / up),
        width: panel.width as usize,
        height: panel.height as usize,
    };
    Some((grid, frame))
}

fn colour_of(visibility: Visibility) -> [u8; 3] {
    match visibility {
        Visibility::Unseen => UNSEEN,
        Visibility::Occluded => OCCLUDED,
        Visibility::Agree => AGREE,
        Visibility::Violation | Visibility::GrossViolation => VIOLATION,
    }
}

/// The judged points of both clouds in the colours that `colour` gives them.
fn dots(
    subject: &Subject<'_>,
    pose: &Pose,
    colour: impl Fn(&IllustratedCloud, usize) -> Option<[u8; 3]>,
) -> Vec<Dot> {
    let illustration = subject.illustration;
    let clouds: [(&PointCloud, &IllustratedCloud, bool); 2] = [
        (subject.reference, &illustration.reference, false),
        (subject.source, &illustration.source, true),
    ];
    let of_cloud = |(cloud, judged, moves): (&PointCloud, &IllustratedCloud, bool)| {
        let dot = |(index, &point): (usize, &usize)| {
            let point = cloud.points().get(point)?;
            let position = if moves { pose.local.apply(point) } else { *point };
            Some(Dot { position, colour: colour(judged, index)? })
        };
        judged.indices.iter().enumerate().filter_map(dot).collect::<Vec<Dot>>()
    };
    clouds.into_iter().flat_map(of_cloud).collect()
}
