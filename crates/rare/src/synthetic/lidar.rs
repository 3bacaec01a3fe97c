//! A spinning LiDAR: rings of rays, range noise, lost returns.

use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use crate::data::RigidTransform;
use crate::random::Random;
use crate::synthetic::scene::{RayCaster, Scene};

/// A spinning LiDAR: x forward, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lidar {
    /// Number of rings (lasers), evenly spaced between the two elevations.
    pub rings: usize,
    /// Rays per turn of a ring.
    pub steps: usize,
    /// Elevation of the lowest ring, degrees.
    pub lowest: f64,
    /// Elevation of the highest ring, degrees.
    pub highest: f64,
    /// Standard deviation of the range, metres.
    pub noise: f64,
    /// Smallest range that is measured, metres.
    pub nearest: f64,
    /// Largest range that is measured, metres.
    pub furthest: f64,
    /// Share of the returns that get lost at random; those from surfaces slanted by more than 80 degrees get lost
    /// ever more often.
    pub lost: f64,
}

impl Default for Lidar {
    /// A 64-ring sensor like KITTI's.
    fn default() -> Lidar {
        Lidar {
            rings: 64,
            steps: 1800,
            lowest: -24.8,
            highest: 2.0,
            noise: 0.02,
            nearest: 2.0,
            furthest: 80.0,
            lost: 0.02,
        }
    }
}

impl Lidar {
    /// Scans the scene; the points are in the sensor's frame, metres, ring by ring from the lowest. The same `seed`
    /// gives the same scan for any number of threads.
    #[must_use]
    pub fn scan(
        &self,
        scene: &Scene,
        world_from_sensor: &RigidTransform,
        seed: u64,
    ) -> Vec<Point3<f64>> {
        let caster = RayCaster::new(scene, &Point3::from(*world_from_sensor.translation()));
        let rings = (0..self.rings).into_par_iter().map(|ring| {
            let rays = (0..self.steps).filter_map(|step| {
                let mut random = Random::new(seed, (ring * self.steps + step) as u64);
                let ray = self.ray(ring, step);
                let direction = world_from_sensor.rotate(&ray);
                let hit = caster.cast(&direction)?;
                let facing = -hit.normal.dot(&direction);
                let range = hit.distance + self.noise * random.normal();
                let returned = random.uniform() < self.chance_of_return(facing);
                let kept = returned && range >= self.nearest && range <= self.furthest;
                kept.then(|| Point3::from(ray * range))
            });
            rays.collect::<Vec<_>>()
        });
        rings.collect::<Vec<_>>().concat()
    }

    /// The unit direction of a ray, sensor frame.
    pub(super) fn ray(&self, ring: usize, step: usize) -> Vector3<f64> {
        let elevation = (self.lowest + ring as f64 * self.ring_spacing()).to_radians();
        let azimuth = std::f64::consts::TAU * step as f64 / self.steps.max(1) as f64;
        let flat = elevation.cos();
        Vector3::new(flat * azimuth.cos(), flat * azimuth.sin(), elevation.sin())
    }

    /// The angle between neighbouring rings, degrees.
    fn ring_spacing(&self) -> f64 {
        (self.highest - self.lowest) / (self.rings.max(2) - 1) as f64
    }

    /// Whether a point (sensor frame) is within half a ring spacing of the rings and in range.
    pub(super) fn reaches(&self, point: &Point3<f64>) -> bool {
        let range = point.coords.norm();
        let elevation = (point.z / range).asin().to_degrees();
        let margin = self.ring_spacing() / 2.0;
        let in_view = elevation >= self.lowest - margin && elevation <= self.highest + margin;
        in_view && range >= self.nearest && range <= self.furthest
    }

    /// Surfaces along the ray send hardly anything back: from 80 degrees of slant the chance falls to 0 at 90.
    fn chance_of_return(&self, facing: f64) -> f64 {
        (1.0 - self.lost) * (facing / 10.0_f64.to_radians().sin()).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::Street;
    use crate::synthetic::scene::tests::distance_to_surface;

    /// A wall across the x axis at 10 m.
    fn wall() -> Scene {
        let mut scene = Scene::default();
        scene.add_box(Point3::new(10.5, 0.0, -50.0), Vector3::new(1.0, 100.0, 100.0), 0.0);
        scene
    }

    /// A sensor without loss.
    fn lossless() -> Lidar {
        Lidar { lost: 0.0, ..Lidar::default() }
    }

    #[test]
    fn the_noise_is_along_the_ray_and_of_the_size_asked_for() {
        let points = lossless().scan(&wall(), &RigidTransform::identity(), 3);
        let errors = points.iter().map(|point| point.coords.norm() * (1.0 - 10.0 / point.x));
        let sigma = (errors.map(|e| e * e).sum::<f64>() / points.len() as f64).sqrt();
        assert!(points.len() > 40_000);
        assert!((sigma / 0.02 - 1.0).abs() < 0.02, "{sigma}");
    }

    #[test]
    fn returns_get_lost() {
        let count = |lost| {
            let lidar = Lidar { lost, ..Lidar::default() };
            lidar.scan(&wall(), &RigidTransform::identity(), 3).len() as f64
        };
        let kept = count(0.3) / count(0.0);
        assert!((kept - 0.7).abs() < 0.01, "{kept}");
    }

    #[test]
    fn slanted_surfaces_return_less() {
        // Half a metre before the wall, 80 degrees of slant are reached 2.8 m to the side.
        let close = RigidTransform::from_translation(Vector3::new(9.5, 0.0, 0.0));
        let points = lossless().scan(&wall(), &close, 3);
        let returns_per_angle = |near: f64, far: f64| {
            let count = points.iter().filter(|p| p.y.abs() > near && p.y.abs() < far).count();
            count as f64 / ((far / 0.5).atan() - (near / 0.5).atan())
        };
        let share = returns_per_angle(8.0, 12.0) / returns_per_angle(2.1, 2.5);
        // 0.5 m / 10 m is the cosine of the slant there, the loss begins at sin 10 degrees; fewer rings hit the wall
        // nearby above and below.
        let expected = 0.05 / 10.0_f64.to_radians().sin();
        assert!((share / expected - 1.0).abs() < 0.2, "{share} {expected}");
    }

    #[test]
    fn points_lie_on_surfaces_and_in_range() {
        let street = Street::new(4);
        let pose = RigidTransform::from_translation(Vector3::new(0.0, 0.0, 1.8));
        let exact = Lidar { noise: 0.0, furthest: 30.0, nearest: 5.0, ..lossless() };
        let points = exact.scan(&street.scene, &pose, 3);
        assert!(points.len() > 20_000);
        for point in points.iter().step_by(37) {
            assert!((5.0..=30.0).contains(&point.coords.norm()));
            assert!(exact.reaches(point));
            let world = pose.apply(point);
            let distances = street.scene.solids.iter().map(|s| distance_to_surface(s, &world));
            assert!(distances.fold(f64::INFINITY, f64::min) < 1e-9);
        }
    }
}
