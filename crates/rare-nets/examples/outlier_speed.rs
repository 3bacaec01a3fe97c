//! CPU time and peak memory of the networks that tell right correspondences from wrong ones:
//! `outlier_speed pointdsc|vbreg WEIGHTS COUNT [RIGHT]`.
//!
//! The pairs are random points of a room of 4 m, the share RIGHT (0.1) of them right; Linux only.
#![expect(clippy::print_stdout, reason = "the result")]

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use rare::nalgebra::{Point3, Rotation3, Vector3};
use rare::pose::{Mode, PoseEstimator};
use rare::random::Random;
use rare::{Correspondence, PointCloud, RigidTransform};
use rare_nets::checkpoint::Parameters;
use rare_nets::outliers::{PointDsc, PointDscConfig, Vbreg, VbregConfig};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [network, weights, count, right @ ..] = arguments.as_slice() else {
        return Err("outlier_speed pointdsc|vbreg WEIGHTS COUNT [RIGHT]".into());
    };
    let parameters = Parameters::open(Path::new(weights))?;
    let right: f64 = right.first().map_or(Ok(0.1), |right| right.parse())?;
    let pairs = pairs(count.parse()?, right);
    let estimator: Box<dyn PoseEstimator> = match network.as_str() {
        "pointdsc" => {
            Box::new(PointDsc::load(&parameters, PointDscConfig::three_d_match(Mode::Fixed))?)
        }
        "vbreg" => Box::new(Vbreg::load(&parameters, VbregConfig::three_d_match(Mode::Fixed))?),
        other => return Err(format!("no network {other}").into()),
    };
    let none = PointCloud::new(vec![Point3::origin()])?;
    let (before, started) = (cpu_seconds()?, Instant::now());
    let estimate = estimator.estimate(&none, &none, &pairs);
    println!(
        "{network} {count} pairs: {:.2} s CPU, {:.2} s, peak {} MB, {}",
        cpu_seconds()? - before,
        started.elapsed().as_secs_f64(),
        peak_kilobytes()? / 1024,
        match estimate {
            Ok(estimate) => format!("{} inliers", estimate.inliers.len()),
            Err(error) => error.to_string(),
        }
    );
    Ok(())
}

fn pairs(count: usize, right: f64) -> Vec<Correspondence> {
    let motion = RigidTransform::new(Rotation3::new(Vector3::new(0.4, -0.2, 0.9)), Vector3::x());
    let mut random = Random::new(1, 0);
    let mut vector = |size: f64| Vector3::from_fn(|_, _| size * (random.uniform() - 0.5));
    (0..count)
        .map(|i| {
            let source = Point3::from(vector(4.0));
            let other = Point3::from(vector(4.0));
            let target =
                motion.apply(if (i as f64) < right * count as f64 { &source } else { &other })
                    + vector(0.05);
            Correspondence { source, target, score: 1.0 }
        })
        .collect()
}

/// User and system time of all threads.
fn cpu_seconds() -> Result<f64, Box<dyn Error>> {
    let text = std::fs::read_to_string("/proc/self/stat")?;
    let fields: Vec<&str> = text.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks: f64 = fields.get(11..13).unwrap_or(&[]).iter().flat_map(|t| t.parse::<f64>()).sum();
    Ok(ticks / 100.0)
}

fn peak_kilobytes() -> Result<u64, Box<dyn Error>> {
    let text = std::fs::read_to_string("/proc/self/status")?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    Ok(line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or(0))
}
