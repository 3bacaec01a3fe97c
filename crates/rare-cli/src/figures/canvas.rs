//! The surface on which figures are drawn: rectangles, lines, images and text on white, and the PNG file in the end.

use anyhow::{Context, Result};
use tiny_skia::{
    FillRule, LineCap, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, StrokeDash, Transform,
};

use crate::figures::text::{self, Text};
use crate::images::Image;

/// The density of print.
const DOTS_PER_INCH: f32 = 300.0;
const METRES_PER_INCH: f32 = 0.0254;
const POINTS_PER_INCH: f32 = 72.0;

pub(super) const WHITE: [u8; 3] = [255; 3];
pub(super) const BLACK: [u8; 3] = [0; 3];

/// The pixels that a length in typographic points takes.
pub(super) fn from_points(points: f32) -> f32 {
    points * DOTS_PER_INCH / POINTS_PER_INCH
}

/// A part of a canvas, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Area {
    pub(super) x: f32,
    pub(super) y: f32,
    pub(super) width: f32,
    pub(super) height: f32,
}

impl Area {
    pub(super) fn right(&self) -> f32 {
        self.x + self.width
    }

    pub(super) fn bottom(&self) -> f32 {
        self.y + self.height
    }
}

/// How a line looks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pen {
    /// Pixels.
    pub(super) width: f32,
    pub(super) colour: [u8; 3],
    /// From 0, nothing, to 1.
    pub(super) opacity: f32,
    pub(super) dashed: bool,
}

impl Pen {
    pub(super) fn new(width: f32, colour: [u8; 3]) -> Pen {
        Pen { width, colour, opacity: 1.0, dashed: false }
    }
}

/// A white sheet.
pub(super) struct Canvas {
    sheet: Pixmap,
}

impl Canvas {
    /// # Errors
    /// If the sheet has no pixel or more than fit into memory.
    pub(super) fn new(width: usize, height: usize) -> Result<Canvas> {
        let size = u32::try_from(width).ok().zip(u32::try_from(height).ok());
        let sheet = size.and_then(|(width, height)| Pixmap::new(width, height));
        let mut sheet = sheet.with_context(|| format!("no figure can be {width} x {height}"))?;
        sheet.fill(tiny_skia::Color::WHITE);
        Ok(Canvas { sheet })
    }

    pub(super) fn rectangle(&mut self, area: Area, colour: [u8; 3], opacity: f32) {
        let rectangle = Rect::from_xywh(area.x, area.y, area.width, area.height);
        if let Some(rectangle) = rectangle {
            self.sheet.fill_rect(rectangle, &paint(colour, opacity), Transform::identity(), None);
        }
    }

    /// A frame along the edges of an area.
    pub(super) fn frame(&mut self, area: Area, pen: Pen) {
        let Some(edges) = Rect::from_xywh(area.x, area.y, area.width, area.height) else { return };
        self.stroke(&PathBuilder::from_rect(edges), pen);
    }

    pub(super) fn line(&mut self, from: [f32; 2], to: [f32; 2], pen: Pen) {
        self.lines(&[from, to], pen);
    }

    /// One line through all places in turn.
    pub(super) fn lines(&mut self, places: &[[f32; 2]], pen: Pen) {
        if let Some(path) = path_through(places) {
            self.stroke(&path, pen);
        }
    }

    /// The polygon with these corners.
    pub(super) fn polygon(&mut self, corners: &[[f32; 2]], colour: [u8; 3], opacity: f32) {
        if let Some(path) = path_through(corners) {
            self.fill(&path, colour, opacity);
        }
    }

    /// Text whose letters stand on `text.place`.
    pub(super) fn text(&mut self, text: &Text<'_>) {
        let Some(path) = text::outline(text) else { return };
        self.fill(&path, text.colour, 1.0);
        // The typeface is a light one; a thin rim gives it the weight of print.
        self.stroke(&path, Pen::new(text.size * text::RIM, text.colour));
    }

    /// An image stretched to an area. A pixel of the sheet is the mean of what it covers.
    pub(super) fn image(&mut self, image: &Image, area: Area) {
        let left = area.x.round().max(0.0) as usize;
        let top = area.y.round().max(0.0) as usize;
        let columns = cover(image.width, area.width.round().max(0.0) as usize);
        let rows = cover(image.height, area.height.round().max(0.0) as usize);
        let width = self.sheet.width() as usize;
        let sheet_rows = self.sheet.data_mut().chunks_exact_mut(4 * width.max(1)).skip(top);
        for (pixels, row) in sheet_rows.zip(&rows) {
            let (pixels, _) = pixels.as_chunks_mut::<4>();
            for (pixel, column) in pixels.iter_mut().skip(left).zip(&columns) {
                let [red, green, blue] = mean(image, column, row);
                *pixel = [red, green, blue, u8::MAX];
            }
        }
    }

    /// The sheet as a PNG file that says its density.
    ///
    /// # Errors
    /// If the encoder fails.
    pub(super) fn to_png(&self) -> Result<Vec<u8>> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.sheet.width(), self.sheet.height());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let density = (DOTS_PER_INCH / METRES_PER_INCH).round() as u32;
        encoder.set_pixel_dims(Some(png::PixelDimensions {
            xppu: density,
            yppu: density,
            unit: png::Unit::Meter,
        }));
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.opaque())?;
        writer.finish()?;
        Ok(file)
    }

    /// Red, green and blue: everything is drawn on white, so nothing shines through.
    fn opaque(&self) -> Vec<u8> {
        let (pixels, _) = self.sheet.data().as_chunks::<4>();
        pixels.iter().flat_map(|&[red, green, blue, _]| [red, green, blue]).collect()
    }

    fn fill(&mut self, path: &Path, colour: [u8; 3], opacity: f32) {
        let paint = paint(colour, opacity);
        self.sheet.fill_path(path, &paint, FillRule::Winding, Transform::identity(), None);
    }

    fn stroke(&mut self, path: &Path, pen: Pen) {
        let dash = pen.dashed.then(|| StrokeDash::new(vec![4.0 * pen.width, 3.0 * pen.width], 0.0));
        let stroke = Stroke {
            width: pen.width,
            line_cap: LineCap::Butt,
            dash: dash.flatten(),
            ..Stroke::default()
        };
        let paint = paint(pen.colour, pen.opacity);
        self.sheet.stroke_path(path, &paint, &stroke, Transform::identity(), None);
    }
}

fn paint([red, green, blue]: [u8; 3], opacity: f32) -> Paint<'static> {
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    paint.set_color_rgba8(red, green, blue, (255.0 * opacity.clamp(0.0, 1.0)).round() as u8);
    paint
}

fn path_through(places: &[[f32; 2]]) -> Option<Path> {
    let mut path = PathBuilder::new();
    let (first, rest) = places.split_first()?;
    path.move_to(first[0], first[1]);
    for place in rest {
        path.line_to(place[0], place[1]);
    }
    path.finish()
}

/// Of each of `shown` pixels the pixels of an image that it covers, with the length that it covers of each.
fn cover(pixels: usize, shown: usize) -> Vec<Vec<(usize, f32)>> {
    let each = pixels as f64 / shown.max(1) as f64;
    let covered = |pixel: usize| {
        let (from, to) = (pixel as f64 * each, (pixel + 1) as f64 * each);
        let last = (to.ceil() as usize).min(pixels);
        let length = |index: usize| (index as f64 + 1.0).min(to) - (index as f64).max(from);
        (from as usize..last).map(|index| (index, length(index) as f32)).collect()
    };
    if pixels == 0 { Vec::new() } else { (0..shown).map(covered).collect() }
}

fn mean(image: &Image, columns: &[(usize, f32)], rows: &[(usize, f32)]) -> [u8; 3] {
    let mut sum = [0.0; 3];
    let mut weights = 0.0;
    for (row, height) in rows {
        for (column, width) in columns {
            let Some(pixel) = image.pixels.get(row * image.width + column) else { continue };
            let weight = width * height;
            sum = std::array::from_fn(|channel| sum[channel] + weight * f32::from(pixel[channel]));
            weights += weight;
        }
    }
    sum.map(|channel| (channel / f32::max(weights, f32::MIN_POSITIVE)).round() as u8)
}

#[cfg(test)]
impl Canvas {
    /// The colour of a pixel.
    pub(super) fn at(&self, x: u32, y: u32) -> [u8; 3] {
        let pixel = self.sheet.pixel(x, y).unwrap();
        [pixel.red(), pixel.green(), pixel.blue()]
    }

    /// How many pixels are not white.
    pub(super) fn ink(&self) -> usize {
        self.sheet.pixels().iter().filter(|p| [p.red(), p.green(), p.blue()] != WHITE).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RED: [u8; 3] = [200, 0, 0];

    #[test]
    fn a_line_covers_the_pixels_between_its_ends_and_no_others() {
        let mut canvas = Canvas::new(40, 20).unwrap();
        canvas.line([5.0, 10.0], [35.0, 10.0], Pen::new(2.0, RED));
        for x in 5..35 {
            assert_eq!([canvas.at(x, 9), canvas.at(x, 10)], [RED; 2], "column {x}");
        }
        assert_eq!(canvas.ink(), 60);
    }

    #[test]
    fn a_dashed_line_has_gaps() {
        let mut canvas = Canvas::new(100, 10).unwrap();
        canvas.line([0.0, 5.0], [100.0, 5.0], Pen { dashed: true, ..Pen::new(2.0, RED) });
        assert!((90..130).contains(&canvas.ink()), "{} pixels", canvas.ink());
    }

    #[test]
    fn a_larger_image_is_averaged_and_a_smaller_one_repeated() {
        let mut canvas = Canvas::new(8, 4).unwrap();
        let pixels = vec![[0; 3], [100; 3], [200, 0, 0], [200, 0, 0]];
        let image = Image { width: 4, height: 1, pixels };
        canvas.image(&image, Area { x: 1.0, y: 1.0, width: 2.0, height: 2.0 });
        assert_eq!([canvas.at(1, 1), canvas.at(2, 2)], [[50; 3], RED]);
        assert_eq!(canvas.ink(), 4);
        canvas.image(&image, Area { x: 0.0, y: 3.0, width: 8.0, height: 1.0 });
        assert_eq!([canvas.at(1, 3), canvas.at(2, 3), canvas.at(7, 3)], [[0; 3], [100; 3], RED]);
    }

    #[test]
    fn an_image_that_does_not_fit_or_has_no_pixels_is_cut_off() {
        let mut canvas = Canvas::new(4, 4).unwrap();
        let area = Area { x: 3.0, y: 3.0, width: 5.0, height: 5.0 };
        canvas.image(&Image { width: 0, height: 0, pixels: Vec::new() }, area);
        assert_eq!(canvas.ink(), 0);
        canvas.image(&Image { width: 1, height: 1, pixels: vec![RED] }, area);
        assert_eq!(canvas.ink(), 1);
    }

    #[test]
    fn lines_without_a_finite_place_draw_nothing() {
        let mut canvas = Canvas::new(10, 10).unwrap();
        canvas.line([f32::NAN, 1.0], [3.0, f32::INFINITY], Pen::new(2.0, RED));
        canvas.lines(&[], Pen::new(2.0, RED));
        canvas.polygon(&[[1.0, 1.0]], RED, 1.0);
        let nowhere = Area { x: 0.0, y: 0.0, width: f32::NAN, height: -1.0 };
        canvas.rectangle(nowhere, RED, 1.0);
        canvas.frame(nowhere, Pen::new(1.0, RED));
        assert_eq!(canvas.ink(), 0);
        assert!(Canvas::new(0, 10).is_err());
    }

    #[test]
    fn the_file_has_the_density_of_print() {
        let file = Canvas::new(3, 2).unwrap().to_png().unwrap();
        let reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let density = reader.info().pixel_dims.unwrap();
        assert_eq!((density.xppu, density.yppu), (11811, 11811));
        assert_eq!((reader.info().width, reader.info().height), (3, 2));
    }
}
