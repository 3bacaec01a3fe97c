//! Clouds as images: points as discs before an orthographic camera, with a depth buffer and shading by depth.
//!
//! No normals are needed: a pixel is darkened by how far its neighbours stand before it (eye-dome lighting, Boucheny
//! 2009), which draws edges and gives slanted surfaces another tone than those that face the camera.

use rare::nalgebra::{Point3, Vector3};
use rare::scale::SceneKind;

use crate::figures::canvas::WHITE;
use crate::images::Image;

/// Pixels along each side of one of the image, so that edges are smooth.
const FINER: usize = 2;
/// Radii of discs, fine pixels.
const SMALLEST: f64 = 1.3;
const LARGEST: f64 = 5.0;
/// The radius of a disc by the usual distance of points, so that surfaces are closed.
const CLOSING: f64 = 0.9;
/// The side of the cells in which the density of points is counted, fine pixels.
const CELL: usize = 12;
/// How far apart the pixels are that shade one another, fine pixels.
const SHADING_REACH: isize = 3;
/// Steps in depth beyond this many times their distance in the image shade no more.
const STEEPEST: f64 = 4.0;
/// The light of a pixel is the mean of those within so many fine pixels, since the depths of scans are noisy.
const SMOOTHING: usize = 2;

/// How dark the steepest step on all sides makes a pixel: the exponent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Darkness(f64);

impl Darkness {
    /// Shows shape.
    pub(super) const DEEP: Darkness = Darkness(1.5);
    /// Leaves colours that mean something readable.
    pub(super) const FAINT: Darkness = Darkness(0.45);
}

/// How dots look.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Style {
    /// Fine pixels.
    pub(super) radius: f64,
    pub(super) darkness: Darkness,
}

/// A point to be drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Dot {
    pub(super) position: Point3<f64>,
    pub(super) colour: [u8; 3],
}

/// The directions of an orthographic camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Look {
    right: Vector3<f64>,
    up: Vector3<f64>,
    forward: Vector3<f64>,
}

impl Look {
    /// From behind and above, turned a little so that walls show.
    pub(super) fn oblique(kind: SceneKind) -> Look {
        let (degrees_aside, degrees_down) = match kind {
            SceneKind::Indoor => (24.0, 32.0),
            SceneKind::Lidar => (30.0, 42.0),
            SceneKind::Object => (35.0, 25.0),
        };
        Look::down(kind, degrees_aside, degrees_down)
    }

    /// From above; what lies ahead of the sensor is at the top.
    pub(super) fn above(kind: SceneKind) -> Look {
        Look::down(kind, 0.0, 90.0)
    }

    fn down(kind: SceneKind, degrees_aside: f64, degrees_down: f64) -> Look {
        let (ahead, above) = match kind {
            // The axes of a camera: z ahead, y down.
            SceneKind::Indoor => (Vector3::z(), -Vector3::y()),
            SceneKind::Lidar | SceneKind::Object => (Vector3::x(), Vector3::z()),
        };
        let (aside, down) = (f64::to_radians(degrees_aside), f64::to_radians(degrees_down));
        let level = ahead * aside.cos() + above.cross(&ahead) * aside.sin();
        let forward = level * down.cos() - above * down.sin();
        let right = level.cross(&above);
        Look { right, up: right.cross(&forward), forward }
    }

    /// To the right, upward and away from the camera, metres.
    pub(super) fn seen(&self, point: &Point3<f64>) -> [f64; 3] {
        [self.right, self.up, self.forward].map(|axis| axis.dot(&point.coords))
    }
}

/// The part of the world that an image shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Frame {
    /// To the right and upward as the camera sees it, metres.
    pub(super) centre: [f64; 2],
    pub(super) pixels_per_metre: f64,
    pub(super) width: usize,
    pub(super) height: usize,
}

impl Frame {
    /// Columns and rows of fine pixels.
    fn fine(&self) -> [usize; 2] {
        [self.width * FINER, self.height * FINER]
    }

    /// `None` outside of the image.
    fn see(&self, dot: &Dot, look: &Look) -> Option<Seen> {
        let [right, up, away] = look.seen(&dot.position);
        let [width, height] = self.fine().map(|pixels| pixels as f64);
        let scale = self.pixels_per_metre * FINER as f64;
        let x = (right - self.centre[0]) * scale + width / 2.0;
        let y = (self.centre[1] - up) * scale + height / 2.0;
        let depth = away * scale;
        let inside = (0.0..width).contains(&x) && (0.0..height).contains(&y) && depth.is_finite();
        inside.then_some(Seen { x: x as isize, y: y as isize, depth, colour: dot.colour })
    }
}

/// The dots as the camera sees them on white.
pub(super) fn render(dots: &[Dot], look: &Look, frame: &Frame, style: Style) -> Image {
    let mut buffer = Buffer::new(frame);
    let disc = offsets(style.radius);
    for seen in dots.iter().filter_map(|dot| frame.see(dot, look)) {
        buffer.draw(&seen, &disc);
    }
    buffer.image(&buffer.light(style.darkness))
}

/// The radius of discs that close the surfaces of a cloud, fine pixels: from the usual distance of neighbouring dots
/// where they are rather sparse, that in the cell of the lower quartile of densities.
pub(super) fn closing_radius(dots: &[Dot], look: &Look, frame: &Frame) -> f64 {
    let [columns, rows] = frame.fine().map(|pixels| pixels.div_ceil(CELL));
    let mut counts = vec![0_usize; columns * rows];
    for dot in dots.iter().filter_map(|dot| frame.see(dot, look)) {
        let cell = dot.y as usize / CELL * columns + dot.x as usize / CELL;
        if let Some(count) = counts.get_mut(cell) {
            *count += 1;
        }
    }
    counts.retain(|&count| count > 0);
    counts.sort_unstable();
    let usual = counts.get(counts.len() / 4).copied().unwrap_or(1);
    (CLOSING * CELL as f64 / (usual as f64).sqrt()).clamp(SMALLEST, LARGEST)
}

/// A dot in the image, fine pixels.
struct Seen {
    x: isize,
    y: isize,
    depth: f64,
    colour: [u8; 3],
}

/// The nearest dot of every fine pixel.
struct Buffer {
    width: usize,
    height: usize,
    /// Fine pixels, as `x` and `y` are; infinite where nothing is.
    depth: Vec<f64>,
    colours: Vec<[u8; 3]>,
}

impl Buffer {
    fn new(frame: &Frame) -> Buffer {
        let [width, height] = frame.fine();
        let size = width * height;
        Buffer { width, height, depth: vec![f64::INFINITY; size], colours: vec![WHITE; size] }
    }

    fn draw(&mut self, dot: &Seen, disc: &[[isize; 2]]) {
        for [right, down] in disc {
            let Some(pixel) = self.pixel(dot.x + right, dot.y + down) else { continue };
            // Of equally near ones the first stays.
            if self.depth.get(pixel).is_some_and(|&nearest| dot.depth < nearest) {
                self.depth[pixel] = dot.depth;
                self.colours[pixel] = dot.colour;
            }
        }
    }

    fn pixel(&self, x: isize, y: isize) -> Option<usize> {
        let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
        (x < self.width && y < self.height).then_some(y * self.width + x)
    }

    /// How much of its light every fine pixel keeps, 0 to 1.
    fn light(&self, darkness: Darkness) -> Vec<f32> {
        let light = |(pixel, &depth): (usize, &f64)| {
            let (x, y) = (pixel % self.width, pixel / self.width);
            if depth.is_finite() { self.light_at(x, y, depth, darkness) as f32 } else { 1.0 }
        };
        let sharp: Vec<f32> = self.depth.iter().enumerate().map(light).collect();
        let across = self.smoothed(&sharp, 1);
        self.smoothed(&across, self.width as isize)
    }

    fn light_at(&self, x: usize, y: usize, depth: f64, Darkness(darkness): Darkness) -> f64 {
        let sides = [[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]];
        let mut before = 0.0;
        for [right, down] in sides.map(|side: [isize; 2]| side.map(|step| step * SHADING_REACH)) {
            let Some(pixel) = self.pixel(x as isize + right, y as isize + down) else { continue };
            let steepness = (depth - self.depth[pixel]) / SHADING_REACH as f64;
            // Where nothing is, the difference is minus infinity: it casts no shade.
            before += steepness.clamp(0.0, STEEPEST) / STEEPEST;
        }
        // Half of the sides are the most that a plain step has before it.
        (-darkness * before / (sides.len() / 2) as f64).exp()
    }

    /// The means over neighbours that are `stride` apart, where something is.
    fn smoothed(&self, light: &[f32], stride: isize) -> Vec<f32> {
        let reach = SMOOTHING as isize;
        let mean = |(pixel, depth): (usize, &f64)| {
            if depth.is_infinite() {
                return 1.0;
            }
            let near = (-reach..=reach).filter_map(|step| {
                let pixel = pixel.checked_add_signed(step * stride)?;
                self.depth.get(pixel)?.is_finite().then_some(*light.get(pixel)?)
            });
            let (sum, count) =
                near.fold((0.0, 0.0), |(sum, count), light| (sum + light, count + 1.0));
            sum / f32::max(count, 1.0)
        };
        self.depth.iter().enumerate().map(mean).collect()
    }

    /// The image of fine pixels under some light, at its own size.
    fn image(&self, light: &[f32]) -> Image {
        let (width, height) = (self.width / FINER, self.height / FINER);
        let pixels = (0..width * height).map(|pixel| {
            let (x, y) = (pixel % width * FINER, pixel / width * FINER);
            let mut sum = [0.0; 3];
            for (right, down) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let fine = (y + down) * self.width + x + right;
                let (light, colour) = (light[fine], self.colours[fine]);
                sum = std::array::from_fn(|channel| {
                    sum[channel] + light * f32::from(colour[channel])
                });
            }
            sum.map(|channel| (channel / (FINER * FINER) as f32).round() as u8)
        });
        Image { width, height, pixels: pixels.collect() }
    }
}

/// The pixels of a disc around its middle.
fn offsets(radius: f64) -> Vec<[isize; 2]> {
    let reach = radius.ceil() as isize;
    let inside = |[x, y]: &[isize; 2]| ((x * x + y * y) as f64) <= radius * radius;
    let square = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| [x, y]));
    square.filter(inside).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const RED: [u8; 3] = [200, 0, 0];
    const BLUE: [u8; 3] = [0, 0, 200];
    const FRAME: Frame = Frame { centre: [0.0; 2], pixels_per_metre: 20.0, width: 60, height: 40 };

    const STYLE: Style = Style { radius: 3.0, darkness: Darkness::DEEP };

    fn dots(points: &[[f64; 3]], colour: [u8; 3]) -> Vec<Dot> {
        points.iter().map(|&position| Dot { position: position.into(), colour }).collect()
    }

    /// The colour of the middle.
    fn middle(dots: &[Dot], look: &Look) -> [u8; 3] {
        render(dots, look, &FRAME, STYLE).pixels[20 * 60 + 30]
    }

    #[test]
    fn a_cloud_nearer_to_the_camera_hides_the_farther_one() {
        // Of a scanner z is up: from above the higher one is seen, from wherever it stands in the list.
        let (low, high) = (dots(&[[0.0; 3]], RED), dots(&[[0.0, 0.0, 1.0]], BLUE));
        let above = Look::above(SceneKind::Lidar);
        assert_eq!(middle(&[low.clone(), high.clone()].concat(), &above), BLUE);
        assert_eq!(middle(&[high, low].concat(), &above), BLUE);
        // Of a camera y is down.
        let (low, high) = (dots(&[[0.0, 1.0, 0.0]], RED), dots(&[[0.0; 3]], BLUE));
        assert_eq!(middle(&[high, low].concat(), &Look::above(SceneKind::Indoor)), BLUE);
    }

    #[test]
    fn looks_are_right_handed_and_what_is_ahead_is_above() {
        for kind in [SceneKind::Indoor, SceneKind::Lidar, SceneKind::Object] {
            for look in [Look::oblique(kind), Look::above(kind)] {
                assert!((look.right.cross(&look.up) + look.forward).norm() < 1e-9);
                assert!((look.right.norm() - 1.0).abs() < 1e-9);
            }
        }
        let above = Look::above(SceneKind::Lidar);
        assert!(
            (above.up - Vector3::x()).norm() < 1e-9 && (above.right + Vector3::y()).norm() < 1e-9
        );
        let room = Look::oblique(SceneKind::Indoor);
        assert!(room.up.y < -0.5 && room.forward.z > 0.5 && room.forward.y > 0.0);
    }

    #[test]
    fn places_are_to_scale() {
        // 20 pixels per metre: half a metre to the left (y of a scanner) is 10 pixels to the left.
        let image =
            render(&dots(&[[0.0, 0.5, 0.0]], RED), &Look::above(SceneKind::Lidar), &FRAME, STYLE);
        let inked = (0..image.pixels.len()).filter(|&pixel| image.pixels[pixel] != WHITE);
        let columns: Vec<usize> = inked.map(|pixel| pixel % 60).collect();
        let mean = columns.iter().sum::<usize>() as f64 / columns.len() as f64;
        assert!((mean - 20.0).abs() <= 0.5, "column {mean}");
    }

    #[test]
    fn a_dense_surface_has_no_gaps_and_an_edge_casts_shade() {
        let grid = |z: f64, from: i32, to: i32| -> Vec<[f64; 3]> {
            let row =
                |x: i32| (-24..=24).map(move |y| [f64::from(x) * 0.05, f64::from(y) * 0.05, z]);
            (from..=to).flat_map(row).collect()
        };
        let floor = dots(&grid(0.0, -24, 24), RED);
        let above = Look::above(SceneKind::Lidar);
        let radius = closing_radius(&floor, &above, &FRAME);
        assert!(radius < LARGEST);
        let image = render(&floor, &above, &FRAME, Style { radius, ..STYLE });
        let shown = (10..30).flat_map(|y| (10..50).map(move |x| y * 60 + x));
        assert!(shown.clone().all(|pixel| image.pixels[pixel] == RED), "flat and closed");
        let with_step = [floor, dots(&grid(1.0, 0, 24), RED)].concat();
        let image = render(&with_step, &above, &FRAME, STYLE);
        assert!(shown.clone().any(|pixel| image.pixels[pixel][0] < 150), "the step is dark");
    }

    #[test]
    fn hostile_dots_are_left_out() {
        let odd = [[1e300, -1e300, 1e300], [f64::MAX; 3], [0.0, 0.0, 1e308], [0.0, 0.0, f64::MAX]];
        let look = Look::oblique(SceneKind::Object);
        render(&dots(&odd, RED), &look, &FRAME, STYLE);
        assert_eq!(closing_radius(&[], &look, &FRAME), LARGEST);
        assert!(render(&[], &look, &FRAME, STYLE).pixels.iter().all(|&pixel| pixel == WHITE));
        for pixels_per_metre in [0.0, f64::INFINITY, f64::NAN, 1e-300] {
            render(&dots(&odd, RED), &look, &Frame { pixels_per_metre, ..FRAME }, STYLE);
        }
        let nothing = Frame { width: 0, height: 0, ..FRAME };
        assert!(render(&dots(&odd, RED), &look, &nothing, STYLE).pixels.is_empty());
    }
}
