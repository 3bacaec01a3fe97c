//! A street between two rows of buildings, different for every seed.

use nalgebra::{Point3, Vector3};

use crate::data::RigidTransform;
use crate::random::Random;
use crate::synthetic::room::between;
use crate::synthetic::scene::{Scene, Shape, Solid, upright};

/// The street reaches this far from the origin to both sides, metres.
const REACH: f64 = 90.0;
/// Height of the pavement above the carriageway, metres.
const KERB: f64 = 0.12;

/// A street along x (y left, z up, the carriageway at z = 0 at the origin): ground that starts to climb on the way,
/// pavements, buildings with deep-set windows and gaps between them, parked cars, trees and poles.
#[derive(Debug, Clone, PartialEq)]
pub struct Street {
    /// Everything in it.
    pub scene: Scene,
    /// Climb per metre for x > 0; the street is level before that.
    pub slope: f64,
}

impl Street {
    /// Builds the street number `seed`: some 400 solids.
    #[must_use]
    pub fn new(seed: u64) -> Street {
        let mut random = Random::new(seed, 0);
        let slope = between(&mut random, 0.01, 0.03);
        let mut street = Street { scene: Scene::default(), slope };
        street.build_ground();
        for side in [-1.0, 1.0] {
            let edge = between(&mut random, 4.5, 5.5);
            street.build_row(&mut random, side, edge + 3.0);
            street.line_kerb(&mut random, side, edge);
        }
        street
    }

    /// The height of the carriageway at `x`, metres.
    #[must_use]
    pub fn ground(&self, x: f64) -> f64 {
        self.slope * x.max(0.0)
    }

    /// Two slabs: a level one before the origin, a climbing one after it.
    fn build_ground(&mut self) {
        let half = Vector3::new(REACH, REACH, 0.5);
        let below = RigidTransform::from_translation(Vector3::new(0.0, 0.0, -0.5));
        let ahead = RigidTransform::from_translation(Vector3::new(REACH, 0.0, -0.5));
        let climbing = nalgebra::Rotation3::new(Vector3::new(0.0, -self.slope.atan(), 0.0));
        let climbing = RigidTransform::new(climbing, Vector3::zeros());
        for world_from_solid in [below, climbing * ahead] {
            self.scene.solids.push(Solid { shape: Shape::Cuboid { half }, world_from_solid });
        }
    }

    /// A box whose bottom reaches into the ground below its place.
    fn stand_box(&mut self, x: f64, y: f64, size: Vector3<f64>, heading: f64) {
        let foot = Point3::new(x, y, self.ground(x) - 1.0);
        self.scene.add_box(foot, size + Vector3::z(), heading);
    }

    /// The buildings of one side with a gap now and then; their fronts are about `distance` from the middle.
    fn build_row(&mut self, random: &mut Random, side: f64, distance: f64) {
        let mut x = -REACH;
        while x < REACH {
            let width = between(random, 8.0, 16.0);
            let setback = distance + between(random, 0.0, 1.5);
            let height = between(random, 5.0, 12.0);
            self.build_house(random, x + width / 2.0, side, setback, width, height);
            let gap = if random.uniform() < 0.4 { between(random, 1.5, 5.0) } else { 0.0 };
            x += width + gap;
        }
    }

    /// A block with pilasters and sills before its front, so that the windows between them lie deep.
    fn build_house(
        &mut self,
        random: &mut Random,
        x: f64,
        side: f64,
        front: f64,
        width: f64,
        height: f64,
    ) {
        let depth = 9.0;
        let middle = side * (front + depth / 2.0);
        self.stand_box(x, middle, Vector3::new(width, depth, height), 0.0);
        let relief = between(random, 0.15, 0.4);
        let y = side * (front - relief / 2.0);
        let columns = (width / between(random, 2.5, 3.5)).floor().max(2.0);
        let pitch = width / columns;
        let pilaster = Vector3::new(between(random, 0.5, 1.2), relief, height);
        for column in 0..columns as usize {
            let along = x - width / 2.0 + pitch * (column as f64 + 0.5);
            self.stand_box(along, y, pilaster, 0.0);
        }
        for storey in 1..(height / 2.8) as usize {
            let z = self.ground(x) + 2.8 * storey as f64;
            let sill = Vector3::new(width, relief, between(random, 0.5, 1.0));
            self.scene.add_box(Point3::new(x, y, z), sill, 0.0);
        }
        let porch = x + between(random, -0.3, 0.3) * width;
        self.stand_box(porch, side * (front - 0.6), Vector3::new(1.6, 1.2, 0.4), 0.0);
    }

    /// Pavement, parked cars, trees and poles of one side; `edge` is the distance of the kerb from the middle.
    fn line_kerb(&mut self, random: &mut Random, side: f64, edge: f64) {
        self.build_pavement(side, edge);
        let mut x = -REACH + between(random, 0.0, 8.0);
        while x < REACH {
            match random.below(5) {
                0 | 1 => self.park_car(random, x, side * (edge - 1.1)),
                2 => self.plant_tree(random, x, side * (edge + 0.8)),
                3 => {
                    let foot = Point3::new(x, side * (edge + 0.4), self.ground(x));
                    self.scene.add_cylinder(foot, 0.08, between(random, 3.0, 7.0));
                }
                _ => self.stand_box(x, side * (edge + 0.9), Vector3::new(0.6, 0.4, 1.1), 0.0),
            }
            x += between(random, 3.0, 8.0);
        }
    }

    /// Two slabs along the kerb that follow the ground.
    fn build_pavement(&mut self, side: f64, edge: f64) {
        let mut level = Scene::default();
        let size = Vector3::new(REACH, 5.0, 0.5 + KERB);
        level.add_box(Point3::new(-REACH / 2.0, side * (edge + 2.5), -0.5), size, 0.0);
        let mut climbing = Scene::default();
        climbing.add_box(Point3::new(REACH / 2.0, side * (edge + 2.5), -0.5), size, 0.0);
        let tilt = nalgebra::Rotation3::new(Vector3::new(0.0, -self.slope.atan(), 0.0));
        self.scene.add_scene(&level, &RigidTransform::identity());
        self.scene.add_scene(&climbing, &RigidTransform::new(tilt, Vector3::zeros()));
    }

    /// Body, cabin and four wheels.
    fn park_car(&mut self, random: &mut Random, x: f64, y: f64) {
        let mut car = Scene::default();
        let (length, width) = (between(random, 3.6, 4.8), between(random, 1.65, 1.9));
        let body = between(random, 0.6, 0.75);
        car.add_box(Point3::new(0.0, 0.0, 0.25), Vector3::new(length, width, body), 0.0);
        let cabin = Vector3::new(0.55 * length, width - 0.2, between(random, 0.45, 0.9));
        let shift = between(random, -0.12, 0.12) * length;
        car.add_box(Point3::new(shift, 0.0, 0.25 + body), cabin, 0.0);
        let axle = nalgebra::Rotation3::new(Vector3::new(std::f64::consts::FRAC_PI_2, 0.0, 0.0));
        for (along, across) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let hub = Vector3::new(along * 0.31 * length, across * (width / 2.0 - 0.1), 0.32);
            car.solids.push(Solid {
                shape: Shape::Cylinder { radius: 0.32, half_height: 0.11 },
                world_from_solid: RigidTransform::new(axle, hub),
            });
        }
        let place = upright(Point3::new(x, y, self.ground(x)), between(random, -0.05, 0.05));
        self.scene.add_scene(&car, &place);
    }

    /// A trunk with a crown of three balls.
    fn plant_tree(&mut self, random: &mut Random, x: f64, y: f64) {
        let foot = Point3::new(x, y, self.ground(x));
        let trunk = between(random, 2.0, 3.2);
        self.scene.add_cylinder(foot, between(random, 0.12, 0.25), trunk);
        for _ in 0..3 {
            let offset = Vector3::new(
                between(random, -0.7, 0.7),
                between(random, -0.7, 0.7),
                trunk + between(random, 0.2, 1.2),
            );
            self.scene.add_sphere(foot + offset, between(random, 0.7, 1.2));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::scene::RayCaster;

    fn drop_from_above(street: &Street, x: f64, y: f64) -> f64 {
        let eye = Point3::new(x, y, 40.0);
        40.0 - RayCaster::new(&street.scene, &eye).cast(&-Vector3::z()).unwrap().distance
    }

    #[test]
    fn the_carriageway_is_free_and_climbs_as_stated() {
        for seed in 0..10 {
            let street = Street::new(seed);
            for x in [-60.0, -20.0, -1.0, 1.0, 10.0, 50.0] {
                for y in [-1.5, 0.0, 1.5] {
                    let height = drop_from_above(&street, x, y);
                    assert!((height - street.ground(x)).abs() < 1e-3, "{height} at {x} {y}");
                }
            }
        }
    }

    #[test]
    fn buildings_stand_on_both_sides() {
        let street = Street::new(3);
        for y in [-12.0, 12.0] {
            let built = (-80..80).filter(|&x| drop_from_above(&street, f64::from(x), y) > 4.0);
            assert!(built.count() > 110);
        }
        assert_ne!(Street::new(1), Street::new(2));
    }
}
