//! Scenes of convex solids, and the rays that a sensor sends into them.
//!
//! A scene is a list of some hundred solids. All rays of a scan start in one point, so a [`RayCaster`] rewrites the
//! solids once for that point (its place in each solid's frame, a bounding cone) and sorts them near to far; after
//! that a plain loop costs about a nanosecond per ray and solid, and no tree is needed.

use nalgebra::{Matrix3, Point3, Vector3};

use crate::data::RigidTransform;

/// The shape of a solid in its own frame, centred at the origin; lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A box, by half its edges.
    Cuboid {
        /// Half the length along x, y and z.
        half: Vector3<f64>,
    },
    /// A cylinder with caps around the z axis.
    Cylinder {
        /// Radius.
        radius: f64,
        /// Half the height.
        half_height: f64,
    },
    /// A ball.
    Sphere {
        /// Radius.
        radius: f64,
    },
}

/// A convex solid somewhere in the world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solid {
    /// Size and kind.
    pub shape: Shape,
    /// The place: moves points of the solid's own frame into the world.
    pub world_from_solid: RigidTransform,
}

/// A list of solids; what lies inside one of them is never seen.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Scene {
    /// The solids, which may overlap each other.
    pub solids: Vec<Solid>,
}

/// Where a ray first meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance from the origin of the ray in units of its direction's length.
    pub distance: f64,
    /// Outward unit normal of the surface, world frame.
    pub normal: Vector3<f64>,
    /// Index into [`Scene::solids`].
    pub solid: usize,
}

impl Shape {
    /// Radius of the smallest ball around the centre that holds the shape.
    fn bounding_radius(&self) -> f64 {
        match self {
            Shape::Cuboid { half } => half.norm(),
            Shape::Cylinder { radius, half_height } => radius.hypot(*half_height),
            Shape::Sphere { radius } => *radius,
        }
    }

    /// Where the ray `origin + t direction` (frame of the solid) enters: `t > 0` and the outward normal there.
    fn enter(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
        let mut inside = Interval::whole();
        match self {
            Shape::Cuboid { half } => {
                for axis in 0..3 {
                    inside.cut_by_slab(axis, half[axis], origin, direction);
                }
            }
            Shape::Cylinder { radius, half_height } => {
                let flat = Vector3::new(1.0, 1.0, 0.0);
                inside.cut_by_slab(2, *half_height, origin, direction);
                inside.cut_by_quadric(&flat, *radius, origin, direction);
            }
            Shape::Sphere { radius } => {
                inside.cut_by_quadric(&Vector3::repeat(1.0), *radius, origin, direction);
            }
        }
        (inside.near > 0.0 && inside.near <= inside.far).then_some((inside.near, inside.normal))
    }
}

/// The part of a ray inside all half-spaces and quadrics cut so far, with the normal where it begins.
struct Interval {
    near: f64,
    far: f64,
    normal: Vector3<f64>,
}

impl Interval {
    fn whole() -> Interval {
        Interval { near: f64::NEG_INFINITY, far: f64::INFINITY, normal: Vector3::zeros() }
    }

    /// Keeps what lies within `half` of the plane through the centre across `axis`.
    fn cut_by_slab(&mut self, axis: usize, half: f64, origin: &Point3<f64>, ray: &Vector3<f64>) {
        if ray[axis] == 0.0 {
            if origin[axis].abs() > half {
                self.far = f64::NEG_INFINITY;
            }
            return;
        }
        let side = -ray[axis].signum();
        let near = (side * half - origin[axis]) / ray[axis];
        let far = (-side * half - origin[axis]) / ray[axis];
        if near > self.near {
            self.near = near;
            self.normal = Vector3::ith(axis, side);
        }
        self.far = self.far.min(far);
    }

    /// Keeps what lies within `radius` of the centre, measured along the axes whose `mask` is 1.
    fn cut_by_quadric(
        &mut self,
        mask: &Vector3<f64>,
        radius: f64,
        origin: &Point3<f64>,
        ray: &Vector3<f64>,
    ) {
        let start = origin.coords.component_mul(mask);
        let step = ray.component_mul(mask);
        // |start + t step|^2 = radius^2
        let (a, b, c) =
            (step.norm_squared(), start.dot(&step), start.norm_squared() - radius * radius);
        let discriminant = b * b - a * c;
        if discriminant < 0.0 || (a == 0.0 && c > 0.0) {
            self.far = f64::NEG_INFINITY;
        } else if a > 0.0 {
            let near = (-b - discriminant.sqrt()) / a;
            if near > self.near {
                self.near = near;
                self.normal = (start + step * near) / radius;
            }
            self.far = self.far.min((-b + discriminant.sqrt()) / a);
        }
    }
}

/// The scene as rays from one point meet it.
#[derive(Debug, Clone)]
pub struct RayCaster {
    /// Nearest possible hit first.
    obstacles: Vec<Obstacle>,
}

/// A solid rewritten for one origin of rays.
#[derive(Debug, Clone)]
struct Obstacle {
    /// From the origin of the rays to the centre, world frame.
    offset: Vector3<f64>,
    /// `|offset|^2 - bounding radius^2`; negative if the origin is inside the bounding ball.
    tangent_squared: f64,
    /// No point of the solid is nearer than this.
    nearest: f64,
    origin_in_solid: Point3<f64>,
    solid_from_world: Matrix3<f64>,
    shape: Shape,
    solid: usize,
}

impl Obstacle {
    fn new(index: usize, solid: &Solid, origin: &Point3<f64>) -> Obstacle {
        let solid_from_world = solid.world_from_solid.inverse();
        let offset = solid.world_from_solid.translation() - origin.coords;
        let radius = solid.shape.bounding_radius();
        Obstacle {
            offset,
            tangent_squared: offset.norm_squared() - radius * radius,
            nearest: offset.norm() - radius,
            origin_in_solid: solid_from_world.apply(origin),
            solid_from_world: *solid_from_world.rotation().matrix(),
            shape: solid.shape,
            solid: index,
        }
    }

    /// Whether the ray passes the bounding ball at a distance.
    fn is_missed(&self, direction: &Vector3<f64>, length_squared: f64) -> bool {
        let along = self.offset.dot(direction);
        self.tangent_squared > 0.0
            && (along <= 0.0 || along * along < self.tangent_squared * length_squared)
    }
}

impl RayCaster {
    /// Prepares rays that start at `origin` (world frame, metres).
    #[must_use]
    pub fn new(scene: &Scene, origin: &Point3<f64>) -> RayCaster {
        let solids = scene.solids.iter().enumerate();
        let mut obstacles: Vec<_> =
            solids.map(|(index, solid)| Obstacle::new(index, solid, origin)).collect();
        obstacles.sort_by(|a, b| a.nearest.total_cmp(&b.nearest));
        RayCaster { obstacles }
    }

    /// The first surface along `direction` (world frame, any length but zero).
    #[must_use]
    pub fn cast(&self, direction: &Vector3<f64>) -> Option<Hit> {
        let length_squared = direction.norm_squared();
        let length = length_squared.sqrt();
        let mut first: Option<Hit> = None;
        let mut limit = f64::INFINITY;
        for obstacle in &self.obstacles {
            if obstacle.nearest > limit * length {
                break;
            }
            if obstacle.is_missed(direction, length_squared) {
                continue;
            }
            let local = obstacle.solid_from_world * direction;
            let Some((distance, normal)) = obstacle.shape.enter(&obstacle.origin_in_solid, &local)
            else {
                continue;
            };
            if distance < limit {
                limit = distance;
                let normal = obstacle.solid_from_world.tr_mul(&normal);
                first = Some(Hit { distance, normal, solid: obstacle.solid });
            }
        }
        first
    }
}

/// Placing solids: bottom-centre coordinates and a heading are how furniture, cars and buildings are described.
impl Scene {
    /// Adds a box of edge lengths `size`, standing on `foot` (centre of its bottom), turned by `heading` radians
    /// about the vertical (z) axis.
    pub fn add_box(&mut self, foot: Point3<f64>, size: Vector3<f64>, heading: f64) {
        let world_from_foot = upright(foot, heading);
        let world_from_solid = world_from_foot * lifted(size.z / 2.0);
        self.solids.push(Solid { shape: Shape::Cuboid { half: size / 2.0 }, world_from_solid });
    }

    /// Adds an upright cylinder that stands on `foot`.
    pub fn add_cylinder(&mut self, foot: Point3<f64>, radius: f64, height: f64) {
        let half_height = height / 2.0;
        let world_from_solid = upright(foot, 0.0) * lifted(half_height);
        self.solids
            .push(Solid { shape: Shape::Cylinder { radius, half_height }, world_from_solid });
    }

    /// Adds a ball.
    pub fn add_sphere(&mut self, centre: Point3<f64>, radius: f64) {
        let world_from_solid = upright(centre, 0.0);
        self.solids.push(Solid { shape: Shape::Sphere { radius }, world_from_solid });
    }

    /// Adds the solids of `part`, moved by `world_from_part`.
    pub fn add_scene(&mut self, part: &Scene, world_from_part: &RigidTransform) {
        self.solids.extend(part.solids.iter().map(|solid| Solid {
            shape: solid.shape,
            world_from_solid: *world_from_part * solid.world_from_solid,
        }));
    }
}

/// The frame that stands at `foot`, z up, x turned by `heading` radians.
pub(super) fn upright(foot: Point3<f64>, heading: f64) -> RigidTransform {
    let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), heading);
    RigidTransform::new(rotation, foot.coords)
}

/// A shift along z.
pub(super) fn lifted(height: f64) -> RigidTransform {
    RigidTransform::from_translation(Vector3::new(0.0, 0.0, height))
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::random::Random;

    /// Distance from a point to the surface of a solid (from outside or inside), by the usual distance functions
    /// and independent of the ray casting.
    pub(crate) fn distance_to_surface(solid: &Solid, point: &Point3<f64>) -> f64 {
        let local = solid.world_from_solid.inverse().apply(point);
        let outside = |excess: &[f64]| {
            let beyond = excess.iter().map(|e| e.max(0.0).powi(2)).sum::<f64>().sqrt();
            beyond + excess.iter().copied().fold(f64::NEG_INFINITY, f64::max).min(0.0)
        };
        match solid.shape {
            Shape::Cuboid { half } => outside((local.coords.abs() - half).as_slice()),
            Shape::Cylinder { radius, half_height } => {
                outside(&[local.x.hypot(local.y) - radius, local.z.abs() - half_height])
            }
            Shape::Sphere { radius } => local.coords.norm() - radius,
        }
        .abs()
    }

    fn jumble(seed: u64) -> Scene {
        let mut random = Random::new(seed, 0);
        let mut scene = Scene::default();
        for kind in 0..30 {
            let mut in_reach = |low: f64, high: f64| low + (high - low) * random.uniform();
            let place = Point3::new(in_reach(-4.0, 4.0), in_reach(-4.0, 4.0), in_reach(-4.0, 4.0));
            let size = Vector3::new(in_reach(0.1, 2.0), in_reach(0.1, 2.0), in_reach(0.1, 2.0));
            match kind % 3 {
                0 => scene.add_box(place, size, in_reach(0.0, 3.0)),
                1 => scene.add_cylinder(place, size.x / 2.0, size.y),
                _ => scene.add_sphere(place, size.x / 2.0),
            }
        }
        scene
    }

    proptest! {
        /// Sphere tracing with the distance functions finds the same first surface as the closed forms.
        #[test]
        fn a_ray_stops_at_the_first_surface(seed in 0_u64..50, d in prop::array::uniform3(-1.0..1.0)) {
            let scene = jumble(seed);
            let origin = Point3::new(9.0, -8.0, 7.0);
            let towards = -origin.coords.normalize() + 0.3 * Vector3::from(d);
            let hit = RayCaster::new(&scene, &origin).cast(&towards);
            let mut travelled = 0.0;
            while travelled < 40.0 {
                let point = origin + towards.normalize() * travelled;
                let free = scene.solids.iter().map(|s| distance_to_surface(s, &point)).fold(f64::INFINITY, f64::min);
                if free < 1e-7 { break; }
                travelled += free;
            }
            match hit {
                Some(hit) => {
                    prop_assert!((hit.distance * towards.norm() - travelled).abs() < 1e-4);
                    prop_assert!(hit.normal.dot(&towards) < 0.0);
                    prop_assert!((hit.normal.norm() - 1.0).abs() < 1e-9);
                    let solid = &scene.solids[hit.solid];
                    let surface = origin + towards * hit.distance;
                    prop_assert!(distance_to_surface(solid, &surface) < 1e-9);
                    // A step along the outward normal leaves the solid at the same speed.
                    prop_assert!((distance_to_surface(solid, &(surface + hit.normal * 1e-3)) - 1e-3).abs() < 1e-5);
                }
                None => prop_assert!(travelled >= 40.0),
            }
        }
    }

    #[test]
    fn a_ray_along_a_face_or_an_axis_is_no_trouble() {
        let mut scene = Scene::default();
        scene.add_box(Point3::origin(), Vector3::new(2.0, 2.0, 2.0), 0.0);
        scene.add_cylinder(Point3::new(5.0, 0.0, 0.0), 0.5, 1.0);
        let from_above = RayCaster::new(&scene, &Point3::new(5.0, 0.0, 3.0));
        assert_eq!(from_above.cast(&-Vector3::z()).unwrap().distance, 2.0);
        let beside = RayCaster::new(&scene, &Point3::new(1.5, -3.0, 1.0));
        assert_eq!(beside.cast(&Vector3::y()), None);
        let inside = RayCaster::new(&scene, &Point3::new(0.0, 0.0, 1.0));
        assert!(inside.cast(&Vector3::x()).unwrap().solid == 1);
    }
}
