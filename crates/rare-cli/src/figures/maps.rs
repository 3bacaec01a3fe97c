//! What the virtual cameras see: depth maps, features and masks, one panel each.

use anyhow::Result;
use rare::refine::IllustratedView;
use rare::verify::{Visibility, VisibilityMask};

use crate::figures::Subject;
use crate::figures::canvas::Canvas;
use crate::figures::layout::{self, COLOUR_BAR, ColourBar, Grid, LINE, ROW_NAME, Room};
use crate::images::{self, AGREE, Image, OCCLUDED, VIOLATION};

/// Panels of maps that are wider than that many times their height stand two in a row, others four.
const WIDE: f32 = 2.0;

/// An image with what stands below it.
struct Panel {
    image: Image,
    caption: String,
}

/// The points of both clouds before a camera, and the maps with the gaps closed.
pub(super) fn draw_depths(subject: &Subject<'_>) -> Result<Canvas> {
    let views = subject.views();
    let ranges: Vec<_> = views.iter().map(|(_, view)| depth_range(view)).collect();
    let panels: Vec<Panel> = views.iter().flat_map(|(_, view)| depths(view)).collect();
    let room = Room { left: ROW_NAME, right: COLOUR_BAR, lines: 1 };
    let Some(grid) = grid(&panels, room) else { return no_views() };
    let mut canvas = grid.sheet(0.0)?;
    draw_panels(&mut canvas, &grid, &panels);
    let rows_of_view = if grid.columns() == 4 { 1 } else { 2 };
    for (view, ((name, _), range)) in views.iter().zip(ranges).enumerate() {
        for row in view * rows_of_view..(view + 1) * rows_of_view {
            grid.row_name(&mut canvas, row, name);
            let Some(range) = range.map(|range| range.map(f64::from)) else { continue };
            let last = grid.area((row + 1) * grid.columns() - 1);
            let bar = ColourBar { range, unit: "m", falling: true, open: false };
            bar.draw(&mut canvas, last);
        }
    }
    Ok(canvas)
}

/// The features of both maps as colours.
pub(super) fn draw_features(subject: &Subject<'_>) -> Result<Canvas> {
    let views = subject.views();
    let panels = views.iter().flat_map(|(name, view)| {
        let images = images::feature_images([&view.reference.features, &view.source.features]);
        let captions = [format!("{name}, reference"), format!("{name}, source")];
        images.into_iter().zip(captions).map(|(image, caption)| Panel { image, caption })
    });
    let panels: Vec<Panel> = panels.collect();
    let Some(grid) = grid(&panels, Room::CAPTIONS) else { return no_views() };
    let mut canvas = grid.sheet(0.0)?;
    draw_panels(&mut canvas, &grid, &panels);
    Ok(canvas)
}

/// What the cameras say of the cloud that is moved, before and after.
pub(super) fn draw_masks(subject: &Subject<'_>) -> Result<Canvas> {
    let poses = subject.before_and_after();
    let views = subject.views();
    let panels = views.iter().flat_map(|(name, view)| {
        let masks = poses.iter().filter_map(|pose| Some((pose.name, view.masks.get(pose.index)?)));
        masks.map(move |(pose, mask)| Panel {
            image: images::mask_image(mask),
            caption: format!("{name}, {pose}\n{}", agreement(mask)),
        })
    });
    let panels: Vec<Panel> = panels.collect();
    let Some(grid) = grid(&panels, Room { lines: 2, ..Room::CAPTIONS }) else { return no_views() };
    let mut canvas = grid.sheet(LINE)?;
    draw_panels(&mut canvas, &grid, &panels);
    let entries = [
        (AGREE, "agree"),
        (OCCLUDED, "occluded"),
        (VIOLATION, "free-space violation"),
        (images::NOTHING, "not seen"),
    ];
    layout::legend(&mut canvas, grid.bottom(), &entries);
    Ok(canvas)
}

fn depths(view: &IllustratedView) -> Vec<Panel> {
    let range = depth_range(view);
    let maps = [
        ("reference, raw", &view.reference.sparse),
        ("reference, densified", &view.reference.dense),
        ("source, raw", &view.source.sparse),
        ("source, densified", &view.source.dense),
    ];
    let panel = |(what, map): (&str, &_)| Panel {
        image: images::depth_image(map, range),
        caption: what.to_owned(),
    };
    maps.into_iter().map(panel).collect()
}

fn depth_range(view: &IllustratedView) -> Option<[f32; 2]> {
    images::depth_range([&view.reference, &view.source])
}

/// Two or four panels in a row; `None` if there is none.
fn grid(panels: &[Panel], room: Room) -> Option<Grid> {
    let first = &panels.first()?.image;
    let (width, height) = (first.width as f32, first.height as f32);
    let columns = if width > WIDE * height { 2 } else { panels.len().min(4) };
    Some(Grid::new(panels.len(), columns, height / width, room))
}

fn draw_panels(canvas: &mut Canvas, grid: &Grid, panels: &[Panel]) {
    for (index, panel) in panels.iter().enumerate() {
        canvas.image(&panel.image, grid.area(index));
        grid.caption(canvas, index, &panel.caption);
    }
}

/// The shares of what is comparable in a mask that agree and do not.
fn agreement(mask: &VisibilityMask) -> String {
    let count =
        |kinds: &[Visibility]| mask.pixels.iter().filter(|kind| kinds.contains(kind)).count();
    let agree = count(&[Visibility::Agree]);
    let against = count(&[Visibility::Violation, Visibility::GrossViolation]);
    match agree + against {
        0 => "nothing in common".to_owned(),
        all => {
            let share = |count: usize| 100.0 * count as f64 / all as f64;
            format!("{:.1} % agree, {:.1} % violate", share(agree), share(against))
        }
    }
}

pub(super) fn no_views() -> Result<Canvas> {
    layout::message("no camera saw anything of the clouds")
}
