//! Where panels stand on a figure, and what is written on and below them.

use anyhow::Result;

use crate::figures::canvas::{Area, BLACK, Canvas, Pen, WHITE, from_points};
use crate::figures::scales;
use crate::figures::text::{self, Anchor, Text};
use crate::images::viridis;

/// 17.5 cm, the width of two columns of a paper.
pub(super) const WIDTH: usize = 2067;
/// Around everything, pixels.
pub(super) const MARGIN: f32 = 10.0;
/// Between panels, pixels.
const GAP: f32 = 22.0;
/// Of captions, points.
const TEXT_POINTS: f32 = 9.0;
/// Of ticks and what stands within panels, points.
const SMALL_POINTS: f32 = 8.0;
/// Text is made smaller rather than cut off, but not below this share of its size.
const SMALLEST: f32 = 0.6;
/// What a colour bar takes beside its row, pixels.
pub(super) const COLOUR_BAR: f32 = 125.0;
/// What a line of captions or of a legend takes, pixels.
pub(super) const LINE: f32 = 66.0;
const RULE: [u8; 3] = [150; 3];

pub(super) fn text_size() -> f32 {
    from_points(TEXT_POINTS)
}

pub(super) fn small_size() -> f32 {
    from_points(SMALL_POINTS)
}

/// The pen of frames and axes.
pub(super) fn thin() -> Pen {
    Pen::new(from_points(0.4), RULE)
}

/// Panels of one size, row by row, with a caption below each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    columns: usize,
    count: usize,
    /// Width and height, pixels.
    panel: [f32; 2],
}

impl Grid {
    /// `aspect` is the height of a panel by its width; `right` is left free beside the panels.
    pub(super) fn new(count: usize, columns: usize, aspect: f32, right: f32) -> Grid {
        let columns = columns.max(1);
        let free = WIDTH as f32 - 2.0 * MARGIN - right - GAP * (columns - 1) as f32;
        let width = (free / columns as f32).floor().max(1.0);
        let height = (width * within_bounds(aspect)).round().max(1.0);
        Grid { columns, count, panel: [width, height] }
    }

    pub(super) fn columns(&self) -> usize {
        self.columns
    }

    pub(super) fn area(&self, index: usize) -> Area {
        let [width, height] = self.panel;
        let (column, row) = (index % self.columns, index / self.columns);
        Area {
            x: MARGIN + column as f32 * (width + GAP),
            y: MARGIN + row as f32 * (height + LINE),
            width,
            height,
        }
    }

    /// Where the last row of captions ends.
    pub(super) fn bottom(&self) -> f32 {
        let rows = self.count.div_ceil(self.columns);
        MARGIN + rows as f32 * (self.panel[1] + LINE)
    }

    /// A sheet with room for the panels and `below` more pixels.
    pub(super) fn sheet(&self, below: f32) -> Result<Canvas> {
        Canvas::new(WIDTH, (self.bottom() + below).ceil() as usize)
    }

    /// Writes "(a) ..." below a panel and draws its frame.
    pub(super) fn caption(&self, canvas: &mut Canvas, index: usize, words: &str) {
        let area = self.area(index);
        canvas.frame(area, thin());
        caption(canvas, area, index, words);
    }
}

/// Writes "(a) ..." below an area.
pub(super) fn caption(canvas: &mut Canvas, area: Area, index: usize, words: &str) {
    let content = format!("({}) {words}", letter(index));
    let place = [area.x + area.width / 2.0, area.bottom() + 1.2 * text_size()];
    fitted(canvas, &content, place, area.width + 0.8 * GAP);
}

/// Text around the middle of its line, made smaller where it is wider than `most`.
pub(super) fn fitted(canvas: &mut Canvas, content: &str, place: [f32; 2], most: f32) {
    let wide = text::width(content, text_size());
    let size = text_size() * (most / wide.max(1.0)).clamp(SMALLEST, 1.0);
    canvas.text(&Text {
        content,
        place,
        anchor: Anchor::Middle,
        size,
        colour: BLACK,
        upward: false,
    });
}

/// A line of small text.
pub(super) fn small(canvas: &mut Canvas, content: &str, place: [f32; 2], anchor: Anchor) {
    let size = small_size();
    canvas.text(&Text { content, place, anchor, size, colour: BLACK, upward: false });
}

/// Coloured squares with their meaning, in one line around the middle of the sheet; `y` is its top.
pub(super) fn legend(canvas: &mut Canvas, y: f32, entries: &[([u8; 3], &str)]) {
    let size = text_size();
    let (square, space) = (0.75 * size, 0.4 * size);
    let widths: Vec<f32> = entries.iter().map(|(_, words)| text::width(words, size)).collect();
    let between = 1.3 * size;
    let all: f32 = widths.iter().map(|width| width + square + space + between).sum();
    let mut x = (WIDTH as f32 - (all - between)) / 2.0;
    for ((colour, content), width) in entries.iter().zip(widths) {
        let area = Area { x, y: y + 0.3 * size, width: square, height: square };
        canvas.rectangle(area, *colour, 1.0);
        canvas.frame(area, thin());
        let place = [area.right() + space, y + size];
        let (anchor, colour) = (Anchor::Start, BLACK);
        canvas.text(&Text { content, place, anchor, size, colour, upward: false });
        x += square + space + width + between;
    }
}

/// What the colours from dark to light mean.
pub(super) struct ColourBar<'a> {
    /// The values at the lower and the upper end.
    pub(super) range: [f64; 2],
    pub(super) unit: &'a str,
    /// Whether the lower end is bright.
    pub(super) falling: bool,
    /// Whether there may be more than the upper end says.
    pub(super) open: bool,
}

impl ColourBar<'_> {
    /// Draws the bar in the space that a grid left free on the right of a panel.
    pub(super) fn draw(&self, canvas: &mut Canvas, beside: Area) {
        let bar = Area { x: beside.right() + GAP, width: 26.0, ..beside };
        let steps = bar.height.max(1.0) as usize;
        for step in 0..steps {
            let share = (step as f32 + 0.5) / steps as f32;
            let colour = viridis(if self.falling { share } else { 1.0 - share });
            let y = bar.y + bar.height * step as f32 / steps as f32;
            canvas.rectangle(Area { y, height: 1.5, ..bar }, colour, 1.0);
        }
        canvas.frame(bar, thin());
        let [low, high] = self.range;
        let marks = scales::ticks(low, high, if bar.height > 250.0 { 3.0 } else { 1.5 });
        let last = marks.len().saturating_sub(1);
        for (index, (value, words)) in marks.into_iter().enumerate() {
            let y = bar.bottom() - bar.height * ((value - low) / (high - low)) as f32;
            let at_end = self.open && index == last && value >= high * 0.999_999;
            let sign = if at_end { "≥" } else { "" };
            let unit = if index == last { format!(" {}", self.unit) } else { String::new() };
            canvas.line([bar.right(), y], [bar.right() + 8.0, y], Pen { colour: BLACK, ..thin() });
            // The letters stay within the height of the panel.
            let baseline =
                (y + 0.35 * small_size()).clamp(bar.y + 0.7 * small_size(), bar.bottom());
            let place = [bar.right() + 14.0, baseline];
            small(canvas, &format!("{sign}{words}{unit}"), place, Anchor::Start);
        }
    }
}

/// Draws how long a round length is, in the lower left corner of a panel.
pub(super) fn scale_bar(canvas: &mut Canvas, panel: Area, pixels_per_metre: f64) {
    let longest = 0.45 * f64::from(panel.width) / pixels_per_metre;
    let Some(metres) = scales::round_step(longest, 1.0) else { return };
    let long = (metres * pixels_per_metre) as f32;
    let words = scales::round_length(metres);
    let (pad, size) = (10.0, small_size());
    let wide = long.max(text::width(&words, size));
    let high = 1.2 * size + 12.0;
    let ground = Area {
        x: panel.x + pad,
        y: panel.bottom() - high - 2.0 * pad,
        width: wide + 2.0 * pad,
        height: high + pad,
    };
    canvas.rectangle(ground, WHITE, 0.8);
    let (middle, y) = (ground.x + ground.width / 2.0, ground.bottom() - pad);
    let pen = Pen::new(from_points(1.0), BLACK);
    canvas.line([middle - long / 2.0, y], [middle + long / 2.0, y], pen);
    small(canvas, &words, [middle, y - 12.0], Anchor::Middle);
}

/// A sheet with nothing but words: a figure that was asked for says why it is empty.
pub(super) fn message(words: &str) -> Result<Canvas> {
    let mut canvas = Canvas::new(WIDTH, 4 * LINE as usize)?;
    fitted(&mut canvas, words, [WIDTH as f32 / 2.0, 2.0 * LINE], WIDTH as f32);
    Ok(canvas)
}

fn letter(index: usize) -> char {
    (b'a'..=b'z').nth(index % 26).map_or('a', char::from)
}

/// No panel is a line.
fn within_bounds(aspect: f32) -> f32 {
    if aspect.is_finite() { aspect.clamp(0.1, 1.5) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panels_fill_the_width_and_do_not_overlap() {
        for (columns, right) in [(1, 0.0), (2, COLOUR_BAR), (3, 0.0), (4, COLOUR_BAR)] {
            let grid = Grid::new(2 * columns, columns, 0.75, right);
            let last = grid.area(columns - 1);
            let end = WIDTH as f32 - MARGIN - right;
            assert!(last.right() <= end && last.right() > end - columns as f32);
            let below = grid.area(columns);
            assert!(below.y > last.bottom() + 1.2 * text_size() && below.x == MARGIN);
            assert!(columns == 1 || grid.area(0).right() < grid.area(1).x);
            assert!(grid.bottom() >= grid.area(2 * columns - 1).bottom() + LINE);
        }
    }

    #[test]
    fn long_captions_are_made_smaller() {
        let inked = |words: &str| {
            let mut canvas = Canvas::new(WIDTH, 200).unwrap();
            let area = Area { x: 800.0, y: 10.0, width: 300.0, height: 50.0 };
            caption(&mut canvas, area, 1, words);
            let has_ink = |x: &u32| (0..200).any(|y| canvas.at(*x, y) != WHITE);
            let columns: Vec<u32> = (0..WIDTH as u32).filter(has_ink).collect();
            columns[columns.len() - 1] - columns[0]
        };
        let short = inked("short");
        assert!((100..200).contains(&short), "{short}");
        assert!(inked("somewhat longer than it is") < 330);
    }

    #[test]
    fn odd_aspects_and_scales_are_drawn() {
        for aspect in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e9] {
            let grid = Grid::new(1, 0, aspect, 0.0);
            let mut canvas = grid.sheet(0.0).unwrap();
            for scale in [0.0, f64::NAN, f64::INFINITY, 1e-300, 1e300] {
                scale_bar(&mut canvas, grid.area(0), scale);
            }
            for range in [[0.0, 0.0], [f64::NAN, 1.0], [1.0, f64::INFINITY]] {
                let bar = ColourBar { range, unit: "m", falling: true, open: true };
                bar.draw(&mut canvas, grid.area(0));
            }
        }
    }
}
