//! A thing to be scanned from all sides, different for every seed.

use nalgebra::{Point3, Rotation3, Vector3};

use crate::data::RigidTransform;
use crate::random::Random;
use crate::synthetic::room::between;
use crate::synthetic::scene::{Scene, Shape, Solid};

/// Builds a closed object of about 0.4 m around the origin: a body with parts of all kinds that stick out of it in
/// different directions, so that no turn maps it onto itself.
#[must_use]
pub fn object(seed: u64) -> Scene {
    let mut random = Random::new(seed, 0);
    let half = Vector3::new(
        between(&mut random, 0.1, 0.14),
        between(&mut random, 0.07, 0.1),
        between(&mut random, 0.05, 0.08),
    );
    let mut scene = Scene::default();
    scene.solids.push(Solid {
        shape: Shape::Cuboid { half },
        world_from_solid: RigidTransform::identity(),
    });
    for part in 0..12 {
        let direction = Vector3::from_fn(|_, _| random.normal());
        let place = surface_point(&half, &direction);
        let size = between(&mut random, 0.02, 0.05);
        let shape = match part % 3 {
            0 => Shape::Cuboid { half: Vector3::new(size, 0.6 * size, 1.5 * size) },
            1 => Shape::Cylinder { radius: 0.6 * size, half_height: 2.0 * size },
            _ => Shape::Sphere { radius: size },
        };
        let turn = Rotation3::new(Vector3::from_fn(|_, _| random.normal()));
        scene
            .solids
            .push(Solid { shape, world_from_solid: RigidTransform::new(turn, place.coords) });
    }
    scene
}

/// Where a ray from the centre leaves the box of half edges `half`.
fn surface_point(half: &Vector3<f64>, direction: &Vector3<f64>) -> Point3<f64> {
    let scale = direction.component_div(half).amax();
    if scale > 0.0 { Point3::from(direction / scale) } else { Point3::origin() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_stick_out_of_the_body() {
        let half = Vector3::new(0.1, 0.2, 0.3);
        let point = surface_point(&half, &Vector3::new(0.1, 1.0, -0.2));
        assert!((point.coords - Vector3::new(0.02, 0.2, -0.04)).norm() < 1e-12);
        for seed in 0..20 {
            let scene = object(seed);
            let Shape::Cuboid { half } = scene.solids[0].shape else { panic!("no body") };
            for part in &scene.solids[1..] {
                let share = part.world_from_solid.translation().component_div(&half);
                assert!((share.amax() - 1.0).abs() < 1e-9);
            }
        }
    }
}
