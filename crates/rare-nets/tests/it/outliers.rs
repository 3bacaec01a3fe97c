//! Networks that tell right correspondences from wrong ones, against the values of the official code with seeded random
//! weights.
//!
//! A right pose proves little about such a network: with random weights the steps around it still register most pairs.
//! So everything on the way is compared.

mod pointdsc;
mod vbreg;

use rare::nalgebra::{Point3, Vector3};
use rare::pose::PoseEstimator;
use rare::random::Random;
use rare::{Correspondence, Error, PointCloud, RigidTransform};
use rare_nets::Matrix;
use rare_nets::checkpoint::{Layout, Parameters};

use crate::shared::{self, Golden, relative_difference};

/// A thousand matches of feature histograms, 75 of which are right.
fn golden_pairs() -> Option<Vec<Correspondence>> {
    let mut golden = Golden::open("estimators/corr_fpfh_1000.npz")?;
    let (source, target) = (golden.array("src"), golden.array("ref"));
    let points = source.values.chunks_exact(3).zip(target.values.chunks_exact(3));
    let pairs = points.map(|(source, target)| Correspondence {
        source: Point3::from_slice(source),
        target: Point3::from_slice(target),
        score: 1.0,
    });
    Some(pairs.collect())
}

/// Opens `golden/estimators/<name>`.
fn parameters(name: &str) -> Option<Parameters> {
    let path = shared::path(&format!("golden/estimators/{name}"))?;
    Some(Parameters::open(&path).unwrap())
}

/// Names and shapes as a list of tensors has them: a line `name (sizes) type` each.
fn listed_layout(name: &str) -> Option<Layout> {
    let text =
        std::fs::read_to_string(shared::path(&format!("golden/estimators/{name}"))?).unwrap();
    let tensor = |line: &str| {
        let mut parts = line.split('\t');
        let name = parts.next().unwrap().to_owned();
        let sizes = parts.next().unwrap().trim_matches(['(', ')']);
        let sizes = sizes.split(',').map(str::trim).filter(|size| !size.is_empty());
        (name, sizes.map(|size| size.parse().unwrap()).collect())
    };
    Some(text.lines().map(tensor).collect())
}

/// The largest difference of features to golden ones, a column for each correspondence, relative to the largest.
fn feature_error(golden: &mut Golden, name: &str, features: &Matrix) -> f64 {
    let array = golden.array(name);
    assert_eq!(array.shape, [features.columns(), features.rows()]);
    let columns = (0..features.columns())
        .flat_map(|column| (0..features.rows()).map(move |row| features.row(row)[column]));
    let error = relative_difference(&columns.collect::<Vec<f32>>(), &array.values);
    println!("{name}: {error:.1e}");
    error
}

/// The golden pose.
fn golden_pose(golden: &mut Golden) -> RigidTransform {
    let values = golden.array("trans").values;
    RigidTransform::from_matrix(&rare::nalgebra::Matrix4::from_row_slice(&values)).unwrap()
}

/// The largest difference of the entries of two poses.
fn pose_error(pose: &RigidTransform, golden: &RigidTransform) -> f64 {
    let error = (pose.to_matrix() - golden.to_matrix()).amax();
    println!("pose: {error:.1e}");
    error
}

/// Estimators that use the pairs alone do not look at the clouds.
fn no_cloud() -> PointCloud {
    PointCloud::new(vec![Point3::origin()]).unwrap()
}

/// Random pairs, of which the first `agreeing` follow a motion.
fn random_pairs(count: usize, agreeing: usize) -> Vec<Correspondence> {
    let mut random = Random::new(12, 3);
    let mut point = || Point3::from(Vector3::from_fn(|_, _| 2.0 * random.normal()));
    (0..count)
        .map(|i| {
            let (source, other) = (point(), point());
            let target = if i < agreeing { motion().apply(&source) } else { other };
            Correspondence { source, target, score: 1.0 }
        })
        .collect()
}

fn motion() -> RigidTransform {
    let rotation = rare::nalgebra::Rotation3::new(Vector3::new(0.4, -0.2, 0.9));
    RigidTransform::new(rotation, Vector3::new(0.3, 1.0, -2.0))
}

/// What `work` gives on so many threads.
fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// Right pairs are found among random ones; without right ones, or with nonsense, there is no pose.
fn solves_the_clear_and_refuses_the_hopeless(network: &dyn PoseEstimator) {
    let estimate = |pairs: &[Correspondence]| network.estimate(&no_cloud(), &no_cloud(), pairs);
    let clear = estimate(&random_pairs(300, 200)).unwrap();
    assert!((clear.target_from_source.to_matrix() - motion().to_matrix()).amax() < 1e-6);
    assert!((0..200).all(|i| clear.inliers.contains(&i)));
    assert!(clear.runner_up.is_none_or(|other| other <= clear.score));
    assert!(matches!(estimate(&random_pairs(300, 0)), Err(Error::NoPose { .. })));
    for few in 0..12 {
        if let Err(error) = estimate(&random_pairs(few, few)) {
            assert!(matches!(error, Error::NoPose { .. }), "{few}: {error}");
        }
    }
    let same = vec![random_pairs(1, 1)[0]; 50];
    assert!(matches!(estimate(&same), Err(Error::NoPose { .. })));
    let mut broken = random_pairs(20, 20);
    broken[7].target.y = f64::NAN;
    assert!(matches!(estimate(&broken), Err(Error::InvalidInput(_))));
    let far = random_pairs(20, 20).into_iter().map(|pair| {
        let [source, target] = [pair.source, pair.target].map(|point| point * 1e300);
        Correspondence { source, target, ..pair }
    });
    assert!(estimate(&far.collect::<Vec<_>>()).is_err());
}
