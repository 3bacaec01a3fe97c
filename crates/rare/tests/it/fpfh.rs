//! FPFH against Open3D, from the same points and normals.

use nalgebra::{Point3, Vector3};
use rare::data::KdTree;
use rare::features::{fpfh, fpfh_at};

use crate::shared::Golden;

/// What the descriptors of the fixture were made with: 5 cm voxels.
const RADIUS: f64 = 0.25;
const MAX_NEIGHBOURS: usize = 100;

fn cloud(golden: &mut Golden, side: &str) -> (Vec<Point3<f64>>, Vec<Vector3<f64>>) {
    let normals = golden.array(&format!("{side}_normals")).points();
    (golden.array(side).points(), normals.into_iter().map(|normal| normal.coords).collect())
}

#[test]
fn descriptors_agree_with_open3d() {
    let Some(mut golden) = Golden::open("estimators/fpfh_open3d.npz") else { return };
    for side in ["src", "ref"] {
        let (points, normals) = cloud(&mut golden, side);
        let tree = KdTree::new(&points);
        let ours = fpfh(&points, &normals, &tree, RADIUS, MAX_NEIGHBOURS).unwrap();
        let theirs = golden.array(&format!("{side}_fpfh")).values;
        let worst: Vec<f64> = (ours.values().chunks(33).zip(theirs.chunks(33)))
            .map(|(ours, theirs)| {
                ours.iter().zip(theirs).map(|(a, b)| (f64::from(*a) - b).abs()).fold(0.0, f64::max)
            })
            .collect();
        let equal = worst.iter().filter(|&&difference| difference < 1e-3).count();
        println!("{side}: {equal} of {} equal", worst.len());
        assert_eq!(worst.len(), points.len());
        assert!(equal as f64 >= 0.999 * worst.len() as f64, "{side}: {equal} of {}", worst.len());
    }
}

#[test]
fn asking_for_some_points_gives_their_rows_of_all() {
    let Some(mut golden) = Golden::open("estimators/fpfh_open3d.npz") else { return };
    let (points, normals) = cloud(&mut golden, "src");
    let tree = KdTree::new(&points);
    let all = fpfh(&points, &normals, &tree, RADIUS, MAX_NEIGHBOURS).unwrap();
    let indices = [3000, 5, 5, 17, 3954];
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            fpfh_at(&points, &normals, &tree, RADIUS, MAX_NEIGHBOURS, &indices).unwrap()
        })
    };
    assert_eq!(run(1), all.select(&indices));
    assert_eq!(run(2), run(1));
}

#[test]
fn odd_clouds_have_finite_descriptors_and_wrong_sizes_are_errors() {
    let points = vec![
        Point3::origin(),
        Point3::origin(),
        Point3::new(0.0, 0.0, 0.1),
        Point3::new(9.0, 0.0, 0.0),
    ];
    let normals = vec![Vector3::z(), Vector3::zeros(), Vector3::z(), Vector3::x()];
    let tree = KdTree::new(&points);
    let features = fpfh(&points, &normals, &tree, RADIUS, MAX_NEIGHBOURS).unwrap();
    assert!(features.values().iter().all(|value| value.is_finite()));
    assert!(features.feature(3).iter().all(|&value| value == 0.0));
    assert!((features.feature(0).iter().sum::<f32>() - 600.0).abs() < 1e-3);
    for (normals, index, word) in [(&normals[..3], 0, "3 normals"), (&normals[..], 4, "point 4")] {
        let message =
            fpfh_at(&points, normals, &tree, RADIUS, 10, &[index]).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
    assert!(fpfh(&[], &[], &KdTree::new(&[]), RADIUS, 10).unwrap().is_empty());
}
