//! The maps of a view side by side, with lines between what matches: the paper's Figure 2.

use anyhow::Result;
use rare::DepthMap;
use rare::refine::{IllustratedView, PixelMatch};

use crate::figures::Subject;
use crate::figures::canvas::{Area, Canvas, Pen, from_points};
use crate::figures::layout::{self, Grid, LINE, Room};
use crate::figures::maps;
use crate::images;

/// More lines than that hide one another.
const MOST_LINES: usize = 250;
const INLIER: [u8; 3] = [0, 158, 115];
const OUTLIER: [u8; 3] = [213, 94, 0];

pub(super) fn draw(subject: &Subject<'_>) -> Result<Canvas> {
    let views = subject.views();
    let Some((_, first)) = views.first() else { return maps::no_views() };
    let map = &first.source.dense;
    let aspect = map.height() as f32 / map.width() as f32;
    let grid = Grid::new(2 * views.len(), 2, aspect, Room::CAPTIONS);
    let mut canvas = grid.sheet(LINE)?;
    for (index, (name, view)) in views.iter().enumerate() {
        let areas = [grid.area(2 * index), grid.area(2 * index + 1)];
        draw_view(&mut canvas, view, areas);
        let words = format!("{name} (source left, reference right): {}", counts(&view.matches));
        let [left, right] = areas;
        let both = Area { width: right.right() - left.x, ..left };
        layout::caption(&mut canvas, both, index, &words);
    }
    let entries = [(INLIER, "inlier of the result"), (OUTLIER, "outlier")];
    layout::legend(&mut canvas, grid.bottom(), &entries);
    Ok(canvas)
}

fn draw_view(canvas: &mut Canvas, view: &IllustratedView, areas: [Area; 2]) {
    let range = images::depth_range([&view.reference, &view.source]);
    let maps = [&view.source.dense, &view.reference.dense];
    for (map, area) in maps.into_iter().zip(areas) {
        canvas.image(&images::grey_depth_image(map, range), area);
        canvas.frame(area, layout::thin());
    }
    let shown = evenly(&view.matches);
    // Inliers last, so that they stand on the others.
    for (inlier, colour) in [(false, OUTLIER), (true, INLIER)] {
        for found in shown.iter().filter(|found| found.inlier == inlier) {
            let [source, reference] = ends(found, maps, areas);
            let pen = Pen { opacity: 0.8, ..Pen::new(from_points(0.4), colour) };
            canvas.line(source, reference, pen);
            for end in [source, reference] {
                canvas.rectangle(spot(end), colour, 1.0);
            }
        }
    }
}

/// Where both sides of a match stand on the sheet.
fn ends(found: &PixelMatch, maps: [&DepthMap; 2], areas: [Area; 2]) -> [[f32; 2]; 2] {
    let pixels = [found.source, found.reference];
    std::array::from_fn(|side| {
        let ((column, row), map, area) = (pixels[side], maps[side], areas[side]);
        let share = |pixel: usize, of: usize| ((pixel as f32 + 0.5) / of.max(1) as f32).min(1.0);
        [
            area.x + area.width * share(column, map.width()),
            area.y + area.height * share(row, map.height()),
        ]
    })
}

fn spot([x, y]: [f32; 2]) -> Area {
    let side = from_points(1.0);
    Area { x: x - side / 2.0, y: y - side / 2.0, width: side, height: side }
}

/// At most as many matches as can be told apart, evenly chosen.
fn evenly(matches: &[PixelMatch]) -> Vec<PixelMatch> {
    let shown = matches.len().min(MOST_LINES);
    let chosen = (0..shown).filter_map(|line| matches.get(line * matches.len() / shown.max(1)));
    chosen.copied().collect()
}

fn counts(matches: &[PixelMatch]) -> String {
    let inliers = matches.iter().filter(|found| found.inlier).count();
    let outliers = matches.len() - inliers;
    let shown = match evenly(matches).len() {
        0 => return "no matches".to_owned(),
        shown if shown < matches.len() => format!("; {shown} of {} shown", matches.len()),
        _ => String::new(),
    };
    format!("{inliers} inliers, {outliers} outliers{shown}")
}

#[cfg(test)]
mod tests {
    use rare::SetName;

    use super::*;

    fn found(index: usize) -> PixelMatch {
        let (source, reference) = ((index, 0), (0, 0));
        PixelMatch { set: SetName::CommonReference, source, reference, inlier: index < 1000 }
    }

    #[test]
    fn matches_are_chosen_evenly_and_what_is_left_out_is_said() {
        let matches: Vec<PixelMatch> = (0..2000).map(found).collect();
        let shown = evenly(&matches);
        assert_eq!(shown.len(), MOST_LINES);
        assert!(shown.windows(2).all(|pair| pair[1].source.0 - pair[0].source.0 == 8));
        assert_eq!(counts(&matches), "1000 inliers, 1000 outliers; 250 of 2000 shown");
        assert_eq!(counts(&matches[..2]), "2 inliers, 0 outliers");
        assert_eq!(counts(&[]), "no matches");
    }
}
