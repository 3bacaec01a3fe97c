//! Generalised and point-to-plane ICP on real pairs, beside what Open3D and `small_gicp` reach from the same starts.

use nalgebra::{Rotation3, Vector3};
use rare::RigidTransform;
use rare::data::{KdTree, voxel_downsample};
use rare::features::estimate_normals;
use rare::pose::{Icp, IcpMethod, IcpTarget};

use crate::shared::{self, Golden};

const VOXEL: f64 = 0.05;

/// Rotation (degrees) and translation (metres) errors of Open3D 0.20.0's point-to-plane ICP, and the lower of those of
/// its generalised ICP and `small_gicp` 1.0.1's: `python crates/rare/benches/peers/icp.py PAIR.npz ...`.
const PEERS: [(&str, [f64; 2], [f64; 2]); 5] = [
    ("geo_demo", [2.345, 0.1223], [1.666, 0.1158]),
    ("kitchen_0_4_raw", [1.941, 0.0509], [1.464, 0.0353]),
    ("kitchen_1_5_raw", [2.248, 0.0526], [1.34, 0.0356]),
    ("regtr_hotel_um_8_15", [2.277, 0.0801], [2.094, 0.0777]),
    ("regtr_scenes_0_5", [1.809, 0.0794], [1.397, 0.0519]),
];

/// On `regtr_hotel_um_8_15` every method of every library ends 2.1 to 2.3 degrees and about 8 cm from the recorded pose:
/// the record is no better, and differences of a few per cent say nothing.
const SLACK: f64 = 1.05;

/// Five degrees and ten centimetres about the centroid of the source.
fn start(truth: &RigidTransform, centre: &Vector3<f64>) -> RigidTransform {
    let turn = Vector3::new(0.003033931306655539, 0.736797110260639, -0.676107102146101);
    let shift = Vector3::new(-0.6323984977372046, -0.32285622772920797, -0.7041562300201517);
    let disturbance = RigidTransform::new(Rotation3::new(turn * 5_f64.to_radians()), shift * 0.1);
    *truth
        * RigidTransform::from_translation(*centre)
        * disturbance
        * RigidTransform::from_translation(-centre)
}

#[test]
fn no_error_is_larger_than_that_of_the_peers() {
    for (name, planes, generalised) in PEERS {
        let Some(path) = shared::path(&format!("data/pairs/{name}.npz")) else { return };
        let mut pair = Golden::open_path(path).unwrap();
        let (source, target) = (pair.array("src").points(), pair.array("ref").points());
        let truth = RigidTransform::from_matrix(&pair.array("gt").matrix4()).unwrap();
        let sum: Vector3<f64> = source.iter().map(|point| point.coords).sum();
        let start = start(&truth, &(sum / source.len() as f64));
        let source = voxel_downsample(&source, VOXEL).unwrap();
        let target = voxel_downsample(&target, VOXEL).unwrap();
        let hybrid = estimate_normals(&target, &KdTree::new(&target), 2.0 * VOXEL, 30);
        let hybrid = IcpTarget::new(target.clone(), hybrid).unwrap();
        let nearest = IcpTarget::with_estimated_normals(target, 20).unwrap();
        for (method, target, [degrees, metres]) in [
            (IcpMethod::PointToPlane, &hybrid, planes),
            (IcpMethod::Generalised, &nearest, generalised),
        ] {
            let aligned = Icp::for_method(method, VOXEL).align(&source, target, &start).unwrap();
            let error = aligned.target_from_source.error_to(&truth);
            println!("{name} {method:?}: {error:?}, peers {degrees} {metres}");
            assert!(error.rotation_degrees < SLACK * degrees, "{name} {method:?} {error:?}");
            assert!(error.translation < SLACK * metres, "{name} {method:?} {error:?}");
        }
    }
}
