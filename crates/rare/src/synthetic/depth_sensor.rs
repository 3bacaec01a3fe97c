//! A depth camera: exact depths by ray casting, then the faults of structured light.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::{DepthMap, Intrinsics, RigidTransform};
use crate::random::Random;
use crate::synthetic::scene::{RayCaster, Scene};

/// The stream of the holes; the pixels use the streams from 0 up.
const HOLE_STREAM: u64 = u64::MAX;

/// A depth camera: z forward, x right, y down.
///
/// The noise is that of structured light (Nguyen, Izadi, Lovell: Modeling Kinect sensor noise for improved 3D
/// reconstruction and tracking, 3DIMPVT 2012): `sigma(z) = noise_floor + noise_growth (z - 0.4)^2`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthSensor {
    /// Image size, focal lengths and centre, pixels.
    pub intrinsics: Intrinsics,
    /// Standard deviation of the depth at 0.4 m, metres.
    pub noise_floor: f64,
    /// Growth of the standard deviation with the squared distance from 0.4 m, 1 / metre.
    pub noise_growth: f64,
    /// Distance between projector and camera, metres; with the focal length it turns depth into disparity.
    pub baseline: f64,
    /// Disparities are multiples of this, pixels; 0 for none.
    pub disparity_step: f64,
    /// Smallest depth that is measured, metres.
    pub nearest: f64,
    /// Largest depth that is measured, metres.
    pub furthest: f64,
    /// Surfaces whose normal is further than this from the ray are not measured, degrees.
    pub steepest: f64,
    /// Share of the pixels on a depth edge that measure nothing.
    pub lost_edges: f64,
    /// Share of the pixels on a depth edge that measure something between both sides.
    pub flying_pixels: f64,
    /// Number of round holes at random places in the image.
    pub holes: usize,
}

impl Default for DepthSensor {
    /// A Kinect-like camera with the inner geometry of the 3DMatch scans.
    fn default() -> DepthSensor {
        DepthSensor {
            intrinsics: Intrinsics::indoor(),
            noise_floor: 0.0012,
            noise_growth: 0.0019,
            baseline: 0.075,
            disparity_step: 0.125,
            nearest: 0.4,
            furthest: 8.0,
            steepest: 80.0,
            lost_edges: 0.9,
            flying_pixels: 0.1,
            holes: 12,
        }
    }
}

/// What a pixel would see without any fault.
#[derive(Debug, Clone, Copy)]
struct Sight {
    /// Metres along z; infinite where there is no surface.
    depth: f64,
    /// Cosine of the angle between ray and normal.
    facing: f64,
}

const NOTHING: Sight = Sight { depth: f64::INFINITY, facing: 1.0 };

impl DepthSensor {
    /// The same camera without any fault: exact depths, no holes but those out of range.
    #[must_use]
    pub fn without_faults(self) -> DepthSensor {
        DepthSensor {
            noise_floor: 0.0,
            noise_growth: 0.0,
            disparity_step: 0.0,
            steepest: 90.0,
            lost_edges: 0.0,
            flying_pixels: 0.0,
            holes: 0,
            ..self
        }
    }

    /// Standard deviation of a depth of `z` metres, before the disparity is quantised, metres.
    #[must_use]
    pub fn noise_at(&self, z: f64) -> f64 {
        self.noise_floor + self.noise_growth * (z - 0.4).powi(2)
    }

    /// Scans the scene; the points are in the camera's frame, metres, row by row. The same `seed` gives the same
    /// scan for any number of threads.
    #[must_use]
    pub fn scan(
        &self,
        scene: &Scene,
        world_from_camera: &RigidTransform,
        seed: u64,
    ) -> Vec<Point3<f64>> {
        let map = self.depth_map(scene, world_from_camera, seed);
        let width = self.intrinsics.width;
        let seen = map.depth().iter().enumerate().filter(|(_, depth)| **depth > 0.0);
        seen.map(|(pixel, depth)| {
            let (u, v) = ((pixel % width) as f64, (pixel / width) as f64);
            self.intrinsics.back_project(u, v, f64::from(*depth))
        })
        .collect()
    }

    /// The depth image of the scene with all faults of the sensor; see [`DepthSensor::scan`].
    #[must_use]
    pub fn depth_map(
        &self,
        scene: &Scene,
        world_from_camera: &RigidTransform,
        seed: u64,
    ) -> DepthMap {
        let sights = self.look(scene, world_from_camera);
        let mut map = DepthMap::empty(self.intrinsics);
        map.depth_mut().par_iter_mut().enumerate().with_min_len(4096).for_each(|(pixel, depth)| {
            *depth = self.measure(&sights, pixel, &mut Random::new(seed, pixel as u64));
        });
        self.punch_holes(&mut map, &mut Random::new(seed, HOLE_STREAM));
        map
    }

    /// The direction of the ray of a pixel, camera frame, z = 1, so that distances along it are depths.
    pub(super) fn ray(&self, u: usize, v: usize) -> Vector3<f64> {
        self.intrinsics.back_project(u as f64, v as f64, 1.0).coords
    }

    /// Whether a point (camera frame) is inside the image (pixel centres have whole coordinates) and the range.
    pub(super) fn reaches(&self, point: &Point3<f64>) -> bool {
        let k = &self.intrinsics;
        let u = k.fx * point.x / point.z + k.cx;
        let v = k.fy * point.y / point.z + k.cy;
        let in_image = u.round() >= 0.0
            && u.round() < k.width as f64
            && v.round() >= 0.0
            && v.round() < k.height as f64;
        in_image && point.z >= self.nearest && point.z <= self.furthest
    }

    /// The exact depths, row by row.
    fn look(&self, scene: &Scene, world_from_camera: &RigidTransform) -> Vec<Sight> {
        let (width, height) = (self.intrinsics.width, self.intrinsics.height);
        let caster = RayCaster::new(scene, &Point3::from(*world_from_camera.translation()));
        let mut sights = vec![NOTHING; width * height];
        sights.par_chunks_mut(width.max(1)).enumerate().for_each(|(v, row)| {
            for (u, sight) in row.iter_mut().enumerate() {
                let direction = world_from_camera.rotate(&self.ray(u, v));
                if let Some(hit) = caster.cast(&direction) {
                    let facing = -hit.normal.dot(&direction) / direction.norm();
                    *sight = Sight { depth: hit.distance, facing };
                }
            }
        });
        sights
    }

    /// What the sensor reports for a pixel; 0 for nothing.
    fn measure(&self, sights: &[Sight], pixel: usize, random: &mut Random) -> f32 {
        let sight = sights[pixel];
        if sight.facing < self.steepest.to_radians().cos() || !sight.depth.is_finite() {
            return 0.0;
        }
        let mut depth = sight.depth;
        if let Some(other_side) = self.depth_across_edge(sights, pixel) {
            let fate = random.uniform();
            if fate < self.lost_edges {
                return 0.0;
            } else if fate < self.lost_edges + self.flying_pixels && other_side.is_finite() {
                // The beam is split between both surfaces.
                depth += random.uniform() * (other_side - depth);
            }
        }
        let depth = self.quantised(depth + self.noise_at(depth) * random.normal());
        if depth >= self.nearest && depth <= self.furthest { depth as f32 } else { 0.0 }
    }

    /// The depth of the first of the four neighbours that lies across a depth edge.
    fn depth_across_edge(&self, sights: &[Sight], pixel: usize) -> Option<f64> {
        let width = self.intrinsics.width;
        let depth = sights[pixel].depth;
        // Twice what the steepest surface that is measured at all changes from one pixel to the next.
        let edge = 2.0 * self.steepest.min(85.0).to_radians().tan() * depth / self.intrinsics.fx;
        let column = pixel % width;
        let neighbours = [
            (column > 0).then(|| pixel - 1),
            (column + 1 < width).then_some(pixel + 1),
            pixel.checked_sub(width),
            Some(pixel + width),
        ];
        let mut depths =
            neighbours.iter().flatten().filter_map(|&n| sights.get(n)).map(|s| s.depth);
        depths.find(|other| (other - depth).abs() > edge)
    }

    /// The nearest depth whose disparity is a multiple of the step.
    fn quantised(&self, depth: f64) -> f64 {
        if self.disparity_step <= 0.0 {
            return depth;
        }
        let scale = self.intrinsics.fx * self.baseline / self.disparity_step;
        scale / (scale / depth).round()
    }

    /// Empties discs of 0.5 to 2.5 % of the image's width in radius.
    fn punch_holes(&self, map: &mut DepthMap, random: &mut Random) {
        let (width, height) = (self.intrinsics.width, self.intrinsics.height);
        for _ in 0..self.holes {
            let radius = width as f64 * (0.005 + 0.02 * random.uniform());
            let (u, v) = (random.below(width), random.below(height));
            let reach = radius as usize;
            for y in v.saturating_sub(reach)..(v + reach + 1).min(height) {
                for x in u.saturating_sub(reach)..(u + reach + 1).min(width) {
                    if (x.abs_diff(u) as f64).hypot(y.abs_diff(v) as f64) <= radius {
                        map.depth_mut()[y * width + x] = 0.0;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Room;
    use crate::synthetic::scene::tests::distance_to_surface;
    use crate::synthetic::views::looking;

    /// A wall across the optical axis with its face at depth `z`.
    fn wall(z: f64) -> Scene {
        let mut scene = Scene::default();
        scene.add_box(Point3::new(0.0, 0.0, z), Vector3::new(40.0, 40.0, 1.0), 0.0);
        scene
    }

    /// A wall at 3 m whose half x < 0 is hidden behind a box at 2 m.
    fn step() -> Scene {
        let mut scene = wall(3.0);
        scene.add_box(Point3::new(-10.0, 0.0, 2.0), Vector3::new(20.0, 40.0, 0.5), 0.0);
        scene
    }

    fn depths(sensor: &DepthSensor, scene: &Scene) -> Vec<f64> {
        let map = sensor.depth_map(scene, &RigidTransform::identity(), 1);
        map.depth().iter().map(|&depth| f64::from(depth)).collect()
    }

    #[test]
    fn the_noise_is_that_of_the_model() {
        let sensor = DepthSensor { disparity_step: 0.0, holes: 0, ..DepthSensor::default() };
        for z in [1.0, 2.0, 4.0] {
            let errors: Vec<f64> =
                depths(&sensor, &wall(z)).iter().map(|depth| depth - z).collect();
            let count = errors.len() as f64;
            let mean = errors.iter().sum::<f64>() / count;
            let sigma = (errors.iter().map(|e| e * e).sum::<f64>() / count).sqrt();
            let expected = 0.0012 + 0.0019 * (z - 0.4) * (z - 0.4);
            assert!(mean.abs() < 0.01 * expected, "{mean} at {z}");
            assert!((sigma / expected - 1.0).abs() < 0.01, "{sigma} at {z}");
        }
    }

    #[test]
    fn disparities_are_whole_eighths_of_a_pixel() {
        let sensor = DepthSensor { holes: 0, ..DepthSensor::default() };
        let steps = depths(&sensor, &wall(3.0)).into_iter().map(|z| 585.0 * 0.075 * 8.0 / z);
        let mut levels = 0;
        for step in steps {
            assert!((step - step.round()).abs() < 1e-4, "{step}");
            levels += usize::from(step.round() == 117.0);
        }
        assert!(levels > 1000);
    }

    #[test]
    fn points_lie_on_surfaces_within_the_noise() {
        let room = Room::new(2);
        let pose = looking(Point3::new(2.0, 0.5, 1.5), 1.4, -0.3, 0.1);
        let furthest_off = |sensor: DepthSensor, allowed: &dyn Fn(f64) -> f64| {
            let points = sensor.scan(&room.scene, &pose, 4);
            assert!(points.len() > 250_000);
            let excess = points.iter().step_by(97).map(|point| {
                let world = pose.apply(point);
                let solids = room.scene.solids.iter();
                let distance = solids.map(|solid| distance_to_surface(solid, &world));
                distance.fold(f64::INFINITY, f64::min) / allowed(point.z)
            });
            excess.fold(0.0, f64::max)
        };
        let exact = DepthSensor::default().without_faults();
        // Depths are stored as f32.
        assert!(furthest_off(exact, &|_| 1e-6) < 1.0);
        let real = DepthSensor { flying_pixels: 0.0, ..DepthSensor::default() };
        // Five standard deviations and half a step of the disparity, along the longest ray (1.22 per metre of depth).
        let allowed =
            |z: f64| 1.22 * (5.0 * real.noise_at(z) + 0.6 * z * z * 0.125 / (585.0 * 0.075));
        let worst = furthest_off(real, &allowed);
        assert!(worst < 1.0 && worst > 0.2, "{worst}");
    }

    #[test]
    fn nothing_is_measured_out_of_range() {
        let sensor = DepthSensor { holes: 0, ..DepthSensor::default() };
        for (z, seen) in [(0.3, false), (0.5, true), (6.0, true), (9.5, false)] {
            assert_eq!(depths(&sensor, &wall(z)).iter().all(|&depth| depth > 0.0), seen, "{z}");
            assert_eq!(depths(&sensor, &wall(z)).iter().any(|&depth| depth > 0.0), seen, "{z}");
        }
    }

    #[test]
    fn steep_surfaces_are_not_measured() {
        // A floor 1 m below the camera is seen at more than 80 degrees beyond 1 / tan(10 degrees) = 5.67 m.
        let mut floor = Scene::default();
        floor.add_box(Point3::new(0.0, 2.0, -50.0), Vector3::new(100.0, 2.0, 100.0), 0.0);
        let exact = DepthSensor::default().without_faults();
        let furthest =
            |sensor: DepthSensor| depths(&sensor, &floor).into_iter().fold(0.0, f64::max);
        assert!(furthest(exact) > 7.0);
        let limited = furthest(DepthSensor { steepest: 80.0, ..exact });
        assert!(limited > 5.4 && limited < 5.68, "{limited}");
    }

    #[test]
    fn pixels_on_an_edge_are_lost_or_fly() {
        let exact = DepthSensor { steepest: 80.0, ..DepthSensor::default().without_faults() };
        let row = |sensor: DepthSensor| depths(&sensor, &step())[240 * 640..241 * 640].to_vec();
        assert!(row(exact).iter().all(|&z| (z - 2.0).abs() < 1e-6 || (z - 3.0).abs() < 1e-6));
        let lost = row(DepthSensor { lost_edges: 1.0, ..exact });
        let holes: Vec<usize> = (0..640).filter(|&u| lost[u] == 0.0).collect();
        assert_eq!(holes, [320, 321]);
        let flying = row(DepthSensor { flying_pixels: 1.0, ..exact });
        let between: Vec<usize> =
            (0..640).filter(|&u| flying[u] > 2.001 && flying[u] < 2.999).collect();
        assert_eq!(between, [320, 321]);
    }

    #[test]
    fn holes_are_punched_into_the_image() {
        let sensor = DepthSensor::default().without_faults();
        let empty = |holes| {
            let depths = depths(&DepthSensor { holes, ..sensor }, &wall(2.0));
            depths.iter().filter(|&&depth| depth == 0.0).count()
        };
        assert_eq!(empty(0), 0);
        // Radii from 3.2 to 16 pixels.
        assert!((30..=830).contains(&empty(1)), "{}", empty(1));
        assert!(empty(12) > empty(1));
    }
}
