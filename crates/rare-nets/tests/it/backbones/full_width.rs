//! What networks of the published widths cost: run by hand, one at a time, with `--ignored --nocapture`.

use std::fs;

use rare::nalgebra::Point3;
use rare_nets::backbones::Selection;
use rare_nets::backbones::fcgf;

use crate::shared::GoldenTensors;

/// CPU seconds of this process so far, and its largest resident memory, MB (Linux).
fn used() -> (f64, f64) {
    let stat = fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    let ticks = fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap();
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    let peak: f64 = peak.trim().trim_end_matches(" kB").parse().unwrap();
    (ticks / 100.0, peak / 1024.0)
}

/// The recorded pair of rooms at 2.5 cm.
fn rooms() -> Option<[Vec<Point3<f64>>; 2]> {
    let golden = GoldenTensors::open("backbones/geotransformer_full3dmatch.safetensors")?;
    let values = golden.array("in.points.0").values;
    let points: Vec<_> = values.chunks_exact(3).map(|p| Point3::new(p[0], p[1], p[2])).collect();
    let (target, source) = points.split_at(golden.array("in.lengths.0").usize()[0]);
    Some([source.to_vec(), target.to_vec()])
}

fn measured<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let before = used();
    let result = work();
    let after = used();
    println!(
        "{what}: {:.2} s of CPU, peak {:.0} MB (before: {:.0} MB)",
        after.0 - before.0,
        after.1,
        before.1
    );
    result
}

#[test]
#[ignore = "measures"]
fn fcgf_on_rooms() {
    let Some([source, target]) = rooms() else { return };
    let config = fcgf::FcgfConfig::three_d_match();
    let network = fcgf::Fcgf::load(&super::fcgf::weights(&config, &[]), config).unwrap();
    measured("fcgf: source alone", || network.run(&source).unwrap());
    let selection = Selection { count: 5000, ..Selection::default() };
    let description =
        measured("fcgf: pair", || network.describe(&source, &target, &selection).unwrap());
    println!(
        "{} correspondences, {:?}",
        description.correspondences.len(),
        description.target_from_source.is_ok()
    );
}
