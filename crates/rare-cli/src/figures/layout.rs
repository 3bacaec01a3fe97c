//! Where panels stand on a figure, and what is written on and below them.

use anyhow::Result;

use crate::figures::canvas::{Area, BLACK, Canvas, Pen, from_points};
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
const TEXT_POINTS: f32 = 8.5;
/// Of ticks and what stands within panels, points.
const SMALL_POINTS: f32 = 7.5;
/// Text is made smaller rather than cut off, but not below this share of its size.
const SMALLEST: f32 = 0.6;
/// What a colour bar takes beside its row, pixels.
pub(super) const COLOUR_BAR: f32 = 185.0;
/// What a line of captions or of a legend takes, pixels.
pub(super) const LINE: f32 = 66.0;
/// From one line of a caption to the next, by the size of the text.
const LINE_PITCH: f32 = 1.25;
/// What a name of a row takes beside it, pixels.
pub(super) const ROW_NAME: f32 = 50.0;
/// Pixels.
const LONGEST_SCALE_BAR: f64 = 330.0;
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

/// What is left free beside and below panels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Room {
    /// Pixels.
    pub(super) left: f32,
    /// Pixels.
    pub(super) right: f32,
    /// Lines of every caption.
    pub(super) lines: usize,
}

impl Room {
    /// For captions of one line.
    pub(super) const CAPTIONS: Room = Room { left: 0.0, right: 0.0, lines: 1 };
    /// For a colour bar as well.
    pub(super) const COLOUR_BAR: Room = Room { left: 0.0, right: COLOUR_BAR, lines: 1 };
}

/// Panels of one size, row by row, with a caption below each.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    columns: usize,
    count: usize,
    /// Width and height, pixels.
    panel: [f32; 2],
    room: Room,
}

impl Grid {
    /// `aspect` is the height of a panel by its width.
    pub(super) fn new(count: usize, columns: usize, aspect: f32, room: Room) -> Grid {
        let columns = columns.max(1);
        let taken = 2.0 * MARGIN + room.left + room.right + GAP * (columns - 1) as f32;
        let width = ((WIDTH as f32 - taken) / columns as f32).floor().max(1.0);
        let height = (width * within_bounds(aspect)).round().max(1.0);
        Grid { columns, count, panel: [width, height], room }
    }

    pub(super) fn columns(&self) -> usize {
        self.columns
    }

    pub(super) fn area(&self, index: usize) -> Area {
        let [width, height] = self.panel;
        let (column, row) = (index % self.columns, index / self.columns);
        Area {
            x: MARGIN + self.room.left + column as f32 * (width + GAP),
            y: MARGIN + row as f32 * self.pitch(),
            width,
            height,
        }
    }

    /// Where the last row of captions ends.
    pub(super) fn bottom(&self) -> f32 {
        let rows = self.count.div_ceil(self.columns);
        MARGIN + rows as f32 * self.pitch()
    }

    /// From one row to the next.
    fn pitch(&self) -> f32 {
        let more = self.room.lines.saturating_sub(1) as f32;
        self.panel[1] + LINE + more * LINE_PITCH * text_size()
    }

    /// Writes what a row is about to the left of its first panel.
    pub(super) fn row_name(&self, canvas: &mut Canvas, row: usize, content: &str) {
        let first = self.area(row * self.columns);
        let place = [first.x - 0.45 * text_size(), first.y + first.height / 2.0];
        let (anchor, size) = (Anchor::Middle, text_size());
        canvas.text(&Text { content, place, anchor, size, colour: BLACK, upward: true });
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
    for (line, content) in content.lines().enumerate() {
        let below = (1.2 + LINE_PITCH * line as f32) * text_size();
        let place = [area.x + area.width / 2.0, area.bottom() + below];
        fitted(canvas, content, place, area.width + 0.8 * GAP);
    }
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
    /// Whether there may be more than the upper end says: it is then marked as such.
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
        let mut marks = scales::ticks(low, high, if bar.height > 250.0 { 3.0 } else { 1.5 });
        if self.open {
            let room = 1.2 * f64::from(small_size() / bar.height) * (high - low);
            marks.retain(|(value, _)| *value < high - room);
            marks.push((high, format!("≥{high:.2}")));
        }
        let last = marks.len().saturating_sub(1);
        for (index, (value, words)) in marks.into_iter().enumerate() {
            let y = bar.bottom() - bar.height * ((value - low) / (high - low)) as f32;
            let unit = if index == last { format!(" {}", self.unit) } else { String::new() };
            canvas.line([bar.right(), y], [bar.right() + 8.0, y], Pen { colour: BLACK, ..thin() });
            // The letters stay within the height of the panel.
            let baseline =
                (y + 0.35 * small_size()).clamp(bar.y + 0.7 * small_size(), bar.bottom());
            let place = [bar.right() + 14.0, baseline];
            small(canvas, &format!("{words}{unit}"), place, Anchor::Start);
        }
    }
}

/// Draws how long a round length is, at the left of the line of a legend; `y` is the top of the line.
pub(super) fn scale_bar(canvas: &mut Canvas, y: f32, pixels_per_metre: f64) {
    let Some(metres) = scales::round_step(LONGEST_SCALE_BAR / pixels_per_metre, 1.0) else {
        return;
    };
    let end = MARGIN + (metres * pixels_per_metre) as f32;
    let (size, half) = (text_size(), 8.0);
    let middle = y + 0.68 * size;
    let pen = Pen::new(from_points(0.8), BLACK);
    canvas.line([MARGIN, middle], [end, middle], pen);
    for x in [MARGIN, end] {
        canvas.line([x, middle - half], [x, middle + half], pen);
    }
    let content = &scales::round_length(metres);
    let (place, anchor) = ([end + 0.4 * size, y + size], Anchor::Start);
    canvas.text(&Text { content, place, anchor, size, colour: BLACK, upward: false });
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
    use crate::figures::canvas::WHITE;

    #[test]
    fn panels_fill_the_width_and_do_not_overlap() {
        let rooms = [Room::CAPTIONS, Room::COLOUR_BAR, Room { left: 50.0, right: 9.0, lines: 2 }];
        for (columns, room) in (1..5).flat_map(|columns| rooms.map(|room| (columns, room))) {
            let grid = Grid::new(2 * columns, columns, 0.75, room);
            let last = grid.area(columns - 1);
            let end = WIDTH as f32 - MARGIN - room.right;
            assert!(last.right() <= end && last.right() > end - columns as f32);
            let below = grid.area(columns);
            assert!(below.y > last.bottom() + 1.3 * room.lines as f32 * text_size());
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
            let grid = Grid::new(1, 0, aspect, Room::CAPTIONS);
            let mut canvas = grid.sheet(0.0).unwrap();
            for scale in [0.0, f64::NAN, f64::INFINITY, 1e-300, 1e300] {
                scale_bar(&mut canvas, 0.0, scale);
            }
            for range in [[0.0, 0.0], [f64::NAN, 1.0], [1.0, f64::INFINITY]] {
                let bar = ColourBar { range, unit: "m", falling: true, open: true };
                bar.draw(&mut canvas, grid.area(0));
            }
        }
    }
}
