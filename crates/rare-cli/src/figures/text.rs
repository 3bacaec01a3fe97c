//! Text as outlines, so that it is drawn as everything else is.

use ab_glyph::{Font, FontRef, GlyphId, OutlineCurve, Point};
use epaint_default_fonts::UBUNTU_LIGHT;
use tiny_skia::{Path, PathBuilder, Transform};

/// The width of a rim around the letters, by the size of the text.
pub(super) const RIM: f32 = 0.022;

/// Where along its line a text is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// A line of text.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Text<'a> {
    pub(super) content: &'a str,
    /// Where the anchor stands on the baseline, pixels.
    pub(super) place: [f32; 2],
    pub(super) anchor: Anchor,
    /// Of an em, pixels.
    pub(super) size: f32,
    pub(super) colour: [u8; 3],
    /// Whether it runs from below to above.
    pub(super) upward: bool,
}

/// The width of a line of text, pixels.
pub(super) fn width(content: &str, size: f32) -> f32 {
    let Some(font) = font() else { return 0.0 };
    let (_, end) = places(&font, content);
    end * per_unit(&font, size)
}

/// The outline of a text where it stands; `None` if there is no letter to be seen.
pub(super) fn outline(text: &Text<'_>) -> Option<Path> {
    let font = font()?;
    let (glyphs, end) = places(&font, text.content);
    let mut path = PathBuilder::new();
    for (glyph, x) in glyphs {
        add_glyph(&mut path, &font, glyph, x);
    }
    let before = match text.anchor {
        Anchor::Start => 0.0,
        Anchor::Middle => end / 2.0,
        Anchor::End => end,
    };
    let scale = per_unit(&font, text.size);
    let turn = if text.upward { -90.0 } else { 0.0 };
    // The letters' y runs upward, that of the sheet downward.
    let placed = Transform::from_translate(text.place[0], text.place[1])
        .pre_concat(Transform::from_rotate(turn))
        .pre_scale(scale, -scale)
        .pre_translate(-before, 0.0);
    path.finish()?.transform(placed)
}

fn font() -> Option<FontRef<'static>> {
    FontRef::try_from_slice(UBUNTU_LIGHT).ok()
}

/// Pixels per unit of the font.
fn per_unit(font: &FontRef<'_>, size: f32) -> f32 {
    size / font.units_per_em().unwrap_or(1000.0)
}

/// The glyphs with the places where they begin, and where the last one ends; units of the font.
fn places(font: &FontRef<'_>, content: &str) -> (Vec<(GlyphId, f32)>, f32) {
    let mut x = 0.0;
    let mut before = None;
    let mut glyphs = Vec::new();
    for letter in content.chars() {
        let glyph = font.glyph_id(letter);
        x += before.map_or(0.0, |before| font.kern_unscaled(before, glyph));
        glyphs.push((glyph, x));
        x += font.h_advance_unscaled(glyph);
        before = Some(glyph);
    }
    (glyphs, x)
}

fn add_glyph(path: &mut PathBuilder, font: &FontRef<'_>, glyph: GlyphId, x: f32) {
    let Some(outline) = font.outline(glyph) else { return };
    let mut pen: Option<Point> = None;
    for curve in &outline.curves {
        let (from, to) = ends(curve);
        // A contour that begins elsewhere closes the one before.
        if pen != Some(from) {
            path.close();
            path.move_to(from.x + x, from.y);
        }
        match curve {
            OutlineCurve::Line(..) => path.line_to(to.x + x, to.y),
            OutlineCurve::Quad(_, by, _) => path.quad_to(by.x + x, by.y, to.x + x, to.y),
            OutlineCurve::Cubic(_, by, and, _) => {
                path.cubic_to(by.x + x, by.y, and.x + x, and.y, to.x + x, to.y);
            }
        }
        pen = Some(to);
    }
    path.close();
}

fn ends(curve: &OutlineCurve) -> (Point, Point) {
    match *curve {
        OutlineCurve::Line(from, to)
        | OutlineCurve::Quad(from, _, to)
        | OutlineCurve::Cubic(from, _, _, to) => (from, to),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::figures::canvas::{BLACK, Canvas, WHITE};

    fn text(content: &str) -> Text<'_> {
        let place = [100.0, 100.0];
        Text { content, place, anchor: Anchor::Start, size: 40.0, colour: BLACK, upward: false }
    }

    fn drawn(text: &Text<'_>) -> Canvas {
        let mut canvas = Canvas::new(200, 200).unwrap();
        canvas.text(text);
        canvas
    }

    #[test]
    fn text_has_ink_where_it_stands() {
        let bounds = outline(&text("HH")).unwrap().bounds();
        assert!((bounds.bottom() - 100.0).abs() < 0.1, "{bounds:?}: H stands on the line");
        assert!((25.0..31.0).contains(&bounds.height()), "{bounds:?}: capitals are 0.7 em high");
        assert!((bounds.width() - width("HH", 40.0)).abs() < 8.0);
        assert!(drawn(&text("HH")).ink() > 200);
        assert_eq!(drawn(&text(" ")).ink(), 0);
    }

    #[test]
    fn letters_have_holes() {
        let bounds = outline(&text("O")).unwrap().bounds();
        let middle =
            [(bounds.left() + bounds.right()) / 2.0, (bounds.top() + bounds.bottom()) / 2.0];
        assert_eq!(drawn(&text("O")).at(middle[0] as u32, middle[1] as u32), WHITE);
    }

    #[test]
    fn anchors_and_turns_move_it() {
        let bounds = |text: Text<'_>| outline(&text).unwrap().bounds();
        let end = bounds(Text { anchor: Anchor::End, ..text("HHH") });
        assert!(end.right() < 100.0 && end.right() > 94.0);
        let middle = bounds(Text { anchor: Anchor::Middle, ..text("HHH") });
        assert!((middle.left() + middle.right() - 200.0).abs() < 1.0);
        let upward = bounds(Text { upward: true, ..text("HHH") });
        assert!(upward.bottom() < 100.0 && upward.right() < 100.1 && upward.height() > 70.0);
    }

    #[test]
    fn every_letter_that_figures_use_is_in_the_typeface() {
        let font = font().unwrap();
        for letter in "abcxyzABC0123456789 .,:;()%-+–≥×²°/".chars() {
            assert_ne!(font.glyph_id(letter), GlyphId(0), "{letter}");
        }
    }

    #[test]
    fn any_text_can_be_drawn() {
        for content in ["", "\u{1F600}\u{0}\n", "日本語", "<script>"] {
            drawn(&text(content));
        }
        drawn(&Text { size: f32::NAN, ..text("a") });
        drawn(&Text { place: [f32::INFINITY; 2], ..text("a") });
    }
}
