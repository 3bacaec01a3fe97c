//! A furnished room, different for every seed.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Point3, Vector3};

use crate::data::RigidTransform;
use crate::random::Random;
use crate::synthetic::scene::{Scene, upright};

/// Thickness of the walls, metres.
const WALL: f64 = 0.25;
/// How far windows and doors are set back from the wall, metres.
const RECESS: f64 = 0.15;

/// A furnished room: z up, the floor at z = 0, one corner at the origin, the furniture away from the wall y = 0, so
/// that a camera has space there.
#[derive(Debug, Clone, PartialEq)]
pub struct Room {
    /// Everything in it, walls, floor and ceiling included.
    pub scene: Scene,
    /// Inner width (x), depth (y) and height (z), metres.
    pub size: Vector3<f64>,
}

/// A random number from `low` to `high`.
pub(super) fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.uniform()
}

impl Room {
    /// Builds the room number `seed`: about 100 solids.
    #[must_use]
    pub fn new(seed: u64) -> Room {
        let mut random = Random::new(seed, 0);
        let size = Vector3::new(
            between(&mut random, 4.5, 6.0),
            between(&mut random, 4.2, 5.2),
            between(&mut random, 2.5, 2.8),
        );
        let mut room = Room { scene: Scene::default(), size };
        room.build_shell(&mut random);
        room.place_shelf(&mut random);
        room.place_sofa(&mut random);
        room.place_desk(&mut random);
        room.place_table(&mut random);
        room.place_odds_and_ends(&mut random);
        room
    }

    /// Floor, ceiling with a beam, and four walls with a window or a door each.
    fn build_shell(&mut self, random: &mut Random) {
        let size = self.size;
        let slab = Vector3::new(size.x + 2.0 * WALL, size.y + 2.0 * WALL, WALL);
        let middle = Point3::new(size.x / 2.0, size.y / 2.0, 0.0);
        self.scene.add_box(middle - Vector3::z() * WALL, slab, 0.0);
        self.scene.add_box(middle + Vector3::z() * size.z, slab, 0.0);
        let beam = Vector3::new(between(random, 0.15, 0.3), size.y, 0.2);
        let above = Point3::new(between(random, 0.3, 0.7) * size.x, size.y / 2.0, size.z - 0.2);
        self.scene.add_box(above, beam, 0.0);
        let corners = [
            (Point3::new(size.x, 0.0, 0.0), 2.0 * FRAC_PI_2, size.x),
            (Point3::new(size.x, size.y, 0.0), 3.0 * FRAC_PI_2, size.y),
            (Point3::new(0.0, size.y, 0.0), 0.0, size.x),
            (Point3::new(0.0, 0.0, 0.0), FRAC_PI_2, size.y),
        ];
        for (side, (corner, heading, length)) in corners.into_iter().enumerate() {
            let width = between(random, 0.8, 1.4);
            let left = between(random, 0.1, 0.9) * (length - width - 0.4) + 0.2;
            // The first wall, behind the camera, has a door, the others windows.
            let sill = if side == 0 { 0.0 } else { between(random, 0.7, 1.1) };
            let opening = Opening { left, width, sill, top: between(random, 1.9, 2.2) };
            let wall = opening.wall_around(length, size.z);
            self.scene.add_scene(&wall, &upright(corner, heading));
        }
    }

    /// Shelves with books along the wall opposite the camera.
    fn place_shelf(&mut self, random: &mut Random) {
        let (width, depth, height) =
            (between(random, 0.9, 1.4), between(random, 0.28, 0.36), between(random, 1.6, 2.0));
        let mut shelf = Scene::default();
        for side in [-width / 2.0, width / 2.0] {
            shelf.add_box(Point3::new(side, 0.0, 0.0), Vector3::new(0.03, depth, height), 0.0);
        }
        let back = Point3::new(0.0, depth / 2.0 - 0.01, 0.0);
        shelf.add_box(back, Vector3::new(width, 0.02, height), 0.0);
        let boards = 5;
        for board in 0..boards {
            let z = height * f64::from(board) / f64::from(boards - 1);
            shelf.add_box(Point3::new(0.0, 0.0, z), Vector3::new(width, depth, 0.03), 0.0);
            if board + 1 < boards {
                add_books(&mut shelf, random, z + 0.03, width);
            }
        }
        let x = between(random, 0.25, 0.75) * self.size.x;
        let foot = Point3::new(x, self.size.y - depth / 2.0, 0.0);
        self.scene.add_scene(&shelf, &upright(foot, 0.0));
    }

    /// A sofa with cushions along the wall x = 0.
    fn place_sofa(&mut self, random: &mut Random) {
        let (width, depth) = (between(random, 1.5, 2.1), between(random, 0.75, 0.95));
        let mut sofa = Scene::default();
        sofa.add_box(Point3::origin(), Vector3::new(width, depth, 0.42), 0.0);
        let back = Point3::new(0.0, depth / 2.0 - 0.1, 0.0);
        sofa.add_box(back, Vector3::new(width, 0.2, between(random, 0.7, 0.9)), 0.0);
        for side in [-1.0, 1.0] {
            let arm = Point3::new(side * (width / 2.0 - 0.08), 0.0, 0.0);
            sofa.add_box(arm, Vector3::new(0.16, depth, 0.6), 0.0);
        }
        for _ in 0..2 {
            let place = Point3::new(between(random, -0.3, 0.3) * width, 0.1, 0.42);
            let cushion = Vector3::new(0.4, 0.14, 0.38);
            sofa.add_box(place, cushion, between(random, -0.5, 0.5));
        }
        sofa.add_sphere(Point3::new(between(random, -0.3, 0.3) * width, -0.1, 0.5), 0.11);
        let y = between(random, 0.5, 0.65) * self.size.y;
        let foot = Point3::new(depth / 2.0 + 0.05, y, 0.0);
        self.scene.add_scene(&sofa, &upright(foot, FRAC_PI_2));
    }

    /// A desk with a screen, a drawer unit and a chair along the wall x = width.
    fn place_desk(&mut self, random: &mut Random) {
        let mut desk = Scene::default();
        let (width, height) = (between(random, 1.2, 1.6), between(random, 0.7, 0.76));
        add_table(&mut desk, Vector3::new(width, 0.7, height));
        let drawers = Point3::new(width / 2.0 - 0.25, 0.05, 0.0);
        desk.add_box(drawers, Vector3::new(0.4, 0.55, 0.6), 0.0);
        let screen = Point3::new(between(random, -0.2, 0.2), 0.15, height);
        desk.add_cylinder(screen, 0.1, 0.02);
        desk.add_box(screen, Vector3::new(0.06, 0.04, 0.3), 0.0);
        let panel = screen + Vector3::new(0.0, -0.03, 0.12);
        desk.add_box(panel, Vector3::new(0.55, 0.03, 0.33), between(random, -0.3, 0.3));
        let cup = Point3::new(-0.4 * width, -0.1, height);
        desk.add_cylinder(cup, 0.045, 0.11);
        add_chair(&mut desk, random, Point3::new(0.0, -0.65, 0.0), FRAC_PI_2 * 2.0);
        let y = between(random, 0.5, 0.68) * self.size.y;
        let foot = Point3::new(self.size.x - 0.4, y, 0.0);
        self.scene.add_scene(&desk, &upright(foot, -FRAC_PI_2));
    }

    /// A table with things on it and two chairs in the middle of the room.
    fn place_table(&mut self, random: &mut Random) {
        let size = Vector3::new(
            between(random, 0.9, 1.2),
            between(random, 0.6, 0.8),
            between(random, 0.45, 0.74),
        );
        let mut group = Scene::default();
        add_table(&mut group, size);
        let mut on_top = || {
            let x = between(random, -0.4, 0.4) * size.x;
            Point3::new(x, between(random, -0.4, 0.4) * size.y, size.z)
        };
        let (bowl, vase, parcel) = (on_top(), on_top(), on_top());
        group.add_sphere(bowl, 0.12);
        group.add_cylinder(vase, 0.05, 0.28);
        group.add_box(parcel, Vector3::new(0.3, 0.2, 0.12), between(random, 0.0, 1.5));
        let turn = between(random, -0.4, 0.4);
        let (left, right) = (-size.x / 2.0 - 0.25, size.x / 2.0 + 0.3);
        add_chair(&mut group, random, Point3::new(left, 0.1, 0.0), FRAC_PI_2 + turn);
        add_chair(&mut group, random, Point3::new(right, -0.1, 0.0), -FRAC_PI_2 - turn);
        let x = between(random, 0.42, 0.58) * self.size.x;
        let foot = Point3::new(x, between(random, 0.5, 0.62) * self.size.y, 0.0);
        self.scene.add_scene(&group, &upright(foot, between(random, -0.6, 0.6)));
    }

    /// A cabinet, a lamp, a bin, boxes and a ball.
    fn place_odds_and_ends(&mut self, random: &mut Random) {
        let (width, depth) = (self.size.x, self.size.y);
        let cabinet = Vector3::new(0.8, 0.45, between(random, 0.8, 1.3));
        self.scene.add_box(Point3::new(0.45, depth - 0.25, 0.0), cabinet, 0.0);
        let parcel = Vector3::new(0.35, 0.25, 0.2);
        let top = Point3::new(0.45, depth - 0.25, cabinet.z);
        self.scene.add_box(top, parcel, between(random, 0.0, 1.5));
        let lamp = Point3::new(width - 0.35, depth - 0.4, 0.0);
        let stand = between(random, 1.3, 1.7);
        self.scene.add_cylinder(lamp, 0.15, 0.03);
        self.scene.add_cylinder(lamp, 0.02, stand);
        self.scene.add_sphere(lamp + Vector3::z() * (stand + 0.1), 0.16);
        let bin = Point3::new(between(random, 0.6, 0.8) * width, depth - 0.3, 0.0);
        self.scene.add_cylinder(bin, 0.16, 0.4);
        for _ in 0..3 {
            let foot = Point3::new(
                between(random, 0.2, 0.8) * width,
                between(random, 0.45, 0.85) * depth,
                0.0,
            );
            let mut edge = || between(random, 0.2, 0.45);
            let size = Vector3::new(edge(), edge(), edge());
            self.scene.add_box(foot, size, between(random, 0.0, 1.5));
        }
        let ball = Point3::new(between(random, 0.3, 0.7) * width, 0.4 * depth, 0.12);
        self.scene.add_sphere(ball, 0.12);
    }
}

/// A window or a door in a wall, metres from the wall's lower left corner.
struct Opening {
    left: f64,
    width: f64,
    sill: f64,
    top: f64,
}

impl Opening {
    /// The wall (along x, its inner face in the plane y = 0, the room at y < 0) with a pane set back in the opening.
    fn wall_around(&self, length: f64, height: f64) -> Scene {
        let mut wall = Scene::default();
        let mut panel = |from: f64, to: f64, low: f64, high: f64, setback: f64| {
            let foot = Point3::new((from + to) / 2.0, setback + WALL / 2.0, low);
            let size = Vector3::new(to - from, WALL, high - low);
            wall.add_box(foot, size, 0.0);
        };
        let right = self.left + self.width;
        panel(-WALL, self.left, 0.0, height, 0.0);
        panel(right, length + WALL, 0.0, height, 0.0);
        panel(self.left, right, self.top, height, 0.0);
        panel(self.left, right, self.sill, self.top, RECESS);
        if self.sill > 0.0 {
            panel(self.left, right, 0.0, self.sill, 0.0);
        }
        wall
    }
}

/// A top on four round legs, its centre above the origin.
fn add_table(scene: &mut Scene, size: Vector3<f64>) {
    let top = Point3::new(0.0, 0.0, size.z - 0.04);
    scene.add_box(top, Vector3::new(size.x, size.y, 0.04), 0.0);
    add_legs(scene, &RigidTransform::identity(), size, 0.03);
}

/// Four legs under the corners of a plate of the given size.
fn add_legs(scene: &mut Scene, place: &RigidTransform, size: Vector3<f64>, radius: f64) {
    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let corner = Point3::new(x * (size.x / 2.0 - radius), y * (size.y / 2.0 - radius), 0.0);
        scene.add_cylinder(place.apply(&corner), radius, size.z);
    }
}

/// A chair that looks along -y at heading 0.
fn add_chair(scene: &mut Scene, random: &mut Random, foot: Point3<f64>, heading: f64) {
    let mut chair = Scene::default();
    let seat = Vector3::new(0.44, 0.42, between(random, 0.42, 0.48));
    add_legs(&mut chair, &RigidTransform::identity(), seat, 0.02);
    chair.add_box(Point3::new(0.0, 0.0, seat.z - 0.04), Vector3::new(seat.x, seat.y, 0.05), 0.0);
    let back = Vector3::new(seat.x, 0.04, between(random, 0.35, 0.5));
    chair.add_box(Point3::new(0.0, seat.y / 2.0, seat.z), back, 0.0);
    scene.add_scene(&chair, &upright(foot, heading));
}

/// A few books and boxes of different sizes on a board of the given width.
fn add_books(shelf: &mut Scene, random: &mut Random, z: f64, width: f64) {
    let mut x = -width / 2.0 + 0.05;
    for _ in 0..3 {
        x += between(random, 0.0, 0.12);
        let size = Vector3::new(
            between(random, 0.06, 0.25),
            between(random, 0.12, 0.22),
            between(random, 0.15, 0.3),
        );
        if x + size.x < width / 2.0 {
            shelf.add_box(Point3::new(x + size.x / 2.0, 0.02, z), size, 0.0);
        }
        x += size.x;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::scene::RayCaster;
    use crate::synthetic::scene::tests::distance_to_surface;

    #[test]
    fn rooms_are_closed_furnished_and_leave_space_for_the_camera() {
        for seed in 0..30 {
            let room = Room::new(seed);
            assert!((80..130).contains(&room.scene.solids.len()));
            for share in [0.2, 0.5, 0.8] {
                let eye = Point3::new(share * room.size.x, 0.5, 1.5);
                let solids = room.scene.solids.iter();
                let free = solids.map(|solid| distance_to_surface(solid, &eye));
                assert!(free.fold(f64::INFINITY, f64::min) > 0.25, "room {seed} at {eye}");
                let caster = RayCaster::new(&room.scene, &eye);
                let mut random = Random::new(seed, 9);
                for _ in 0..500 {
                    let hit = caster.cast(&Vector3::from_fn(|_, _| random.normal()));
                    assert!(hit.is_some(), "room {seed} has a gap");
                }
            }
        }
        assert_ne!(Room::new(1), Room::new(2));
    }

    #[test]
    fn windows_are_set_back_from_their_wall() {
        let opening = Opening { left: 1.0, width: 1.0, sill: 0.9, top: 2.0 };
        let wall = opening.wall_around(4.0, 2.5);
        let depth_at = |x: f64, z: f64| {
            let caster = RayCaster::new(&wall, &Point3::new(x, -1.0, z));
            caster.cast(&Vector3::y()).unwrap().distance - 1.0
        };
        for (x, z) in [(0.5, 1.5), (2.5, 1.5), (1.5, 0.5), (1.5, 2.2)] {
            assert!(depth_at(x, z).abs() < 1e-12);
        }
        assert!((depth_at(1.5, 1.5) - RECESS).abs() < 1e-12);
    }
}
