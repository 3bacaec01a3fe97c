//! Measures every ICP method on labelled pairs: errors, rounds and CPU time, one JSON object a line.
//!
//! `cargo run --release --example icp_methods -- VOXEL DISTANCE DEGREES METRES REPEATS PAIR.npz [PAIR.npz ...]`
//!
//! A pair holds `src` and `ref` (`N x 3`, `f32`, metres) and `gt` (`4 x 4`, moves `src` onto `ref`). Every method starts
//! from `gt` disturbed about the centroid of `src` by a fixed turn and shift of DEGREES and METRES, and pairs points up
//! to DISTANCE apart. `benches/peers/icp.py` runs this and other libraries on the same starts.
#![expect(clippy::print_stdout, clippy::unwrap_used, reason = "a measuring program")]

use nalgebra::{Matrix4, Point3, Rotation3, Vector3};
use rare::RigidTransform;
use rare::data::{KdTree, voxel_downsample};
use rare::features::estimate_normals;
use rare::pose::{Icp, IcpMethod, IcpResult, IcpSource, IcpTarget, MultiScaleIcp};
use serde_json::{Value, json};

/// Directions of the turn and the shift of the start.
const TURN: [f64; 3] = [0.003033931306655539, 0.736797110260639, -0.676107102146101];
const SHIFT: [f64; 3] = [-0.6323984977372046, -0.32285622772920797, -0.7041562300201517];

/// Nearest neighbours that a covariance is estimated from.
const NEIGHBOURS: usize = 20;

struct Pair {
    name: String,
    source: Vec<Point3<f64>>,
    target: Vec<Point3<f64>>,
    truth: RigidTransform,
    start: RigidTransform,
}

fn read(path: &str, degrees: f64, metres: f64) -> Pair {
    let mut archive = npyz::npz::NpzArchive::open(path).unwrap();
    let mut points = |name: &str| -> Vec<Point3<f64>> {
        let values: Vec<f32> = archive.by_name(name).unwrap().unwrap().into_vec().unwrap();
        let point = |row: &[f32]| Point3::new(row[0], row[1], row[2]).cast::<f64>();
        values.chunks_exact(3).map(point).collect()
    };
    let (source, target) = (points("src"), points("ref"));
    let truth: Vec<f64> = archive.by_name("gt").unwrap().unwrap().into_vec().unwrap();
    let truth = RigidTransform::from_matrix(&Matrix4::from_row_slice(&truth)).unwrap();
    let centre = source.iter().map(|p| p.coords).sum::<Vector3<f64>>() / source.len() as f64;
    let disturbance = RigidTransform::new(
        Rotation3::new(Vector3::from(TURN) * degrees.to_radians()),
        Vector3::from(SHIFT) * metres,
    );
    let start = truth
        * RigidTransform::from_translation(centre)
        * disturbance
        * RigidTransform::from_translation(-centre);
    let name = path.rsplit('/').next().unwrap().trim_end_matches(".npz").to_owned();
    Pair { name, source, target, truth, start }
}

/// Nanoseconds that this thread has run, from the scheduler's account.
fn cpu_nanoseconds() -> f64 {
    let account = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    account.split(' ').next().unwrap().parse().unwrap()
}

/// The last result and the mean CPU seconds; some schedulers count in steps of milliseconds, so runs are not told apart.
fn timed<T>(repeats: usize, mut run: impl FnMut() -> T) -> (T, f64) {
    let started = cpu_nanoseconds();
    let mut result = run();
    for _ in 1..repeats {
        result = run();
    }
    (result, (cpu_nanoseconds() - started) * 1e-9 / repeats as f64)
}

fn line(pair: &Pair, method: &str, seconds: f64, result: Option<&IcpResult>) {
    let mut record = json!({ "pair": pair.name, "method": method, "cpu_s": seconds });
    if let Some(result) = result {
        let error = result.target_from_source.error_to(&pair.truth);
        record["re_deg"] = error.rotation_degrees.into();
        record["te_m"] = error.translation.into();
        record["rounds"] = Value::from(result.iterations.clone());
        record["open"] = result.open_directions.len().into();
    }
    println!("{record}");
}

fn measure(pair: &Pair, voxel: f64, distance: f64, repeats: usize) {
    let thinned = || [&pair.source, &pair.target].map(|raw| voxel_downsample(raw, voxel).unwrap());
    let (clouds, _) = timed(1, thinned);
    let prepare = |[source, target]: [Vec<Point3<f64>>; 2]| {
        let target = IcpTarget::with_estimated_normals(target, NEIGHBOURS).unwrap();
        (IcpSource::with_estimated_normals(source, NEIGHBOURS).unwrap(), target)
    };
    let ((source, target), seconds) = timed(repeats, || prepare(thinned()));
    line(pair, "preprocess", seconds, None);
    let (_, seconds) = timed(repeats, || prepare(clouds.clone()));
    line(pair, "covariances", seconds, None);

    // As the target of Open3D: normals from 30 neighbours within two voxels; building the tree counts.
    let tree = KdTree::new(&clouds[1]);
    let normals = estimate_normals(&clouds[1], &tree, 2.0 * voxel, 30);
    let (result, seconds) = timed(repeats, || {
        let target = IcpTarget::new(clouds[1].clone(), normals.clone()).unwrap();
        Icp::plain(IcpMethod::PointToPlane, distance).align(&clouds[0], &target, &pair.start)
    });
    line(pair, "tree + point-to-plane", seconds, result.as_ref().ok());

    let hybrid = IcpTarget::new(clouds[1].clone(), normals).unwrap();
    let (voxels, seconds) = timed(repeats, || target.clone().with_voxels(4.0 * voxel).unwrap());
    line(pair, "voxels", seconds, None);
    for (name, method) in [
        ("point-to-point", IcpMethod::PointToPoint),
        ("point-to-plane", IcpMethod::PointToPlane),
        ("symmetric", IcpMethod::Symmetric),
        ("generalised", IcpMethod::Generalised),
        ("voxelised", IcpMethod::VoxelisedGeneralised),
    ] {
        let target = match method {
            IcpMethod::VoxelisedGeneralised => &voxels,
            IcpMethod::PointToPlane => &hybrid,
            _ => &target,
        };
        for (kind, icp) in [
            ("plain", Icp::plain(method, distance)),
            ("preset", Icp::for_method(method, distance / 3.0)),
        ] {
            let align = || icp.align_prepared(&source, target, &pair.start);
            let (result, seconds) = timed(repeats, align);
            line(pair, &format!("{kind} {name}"), seconds, result.as_ref().ok());
        }
        let icp = MultiScaleIcp::for_voxel(method, voxel);
        let (result, seconds) =
            timed(repeats, || icp.align(&pair.source, &pair.target, &pair.start));
        line(pair, &format!("multi {name}"), seconds, result.as_ref().ok());
    }
}

fn main() {
    // One thread, this one: what is reported is CPU time.
    rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global().unwrap();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |at: usize| arguments[at].parse::<f64>().unwrap();
    for path in &arguments[5..] {
        let pair = read(path, number(2), number(3));
        measure(&pair, number(0), number(1), number(4) as usize);
    }
}
