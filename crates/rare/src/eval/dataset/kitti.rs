//! KITTI odometry: `sequences/SS/velodyne/FFFFFF.bin` and `poses/SS.txt`, below the root or its folder `dataset`.
//!
//! Pairs are chosen as FCGF does, and every publication since: from each scan the last one before the camera is more than
//! 10 m away; sequences 8, 9 and 10; 555 pairs. The earlier scan is the source.

use std::path::Path;

use nalgebra::{Matrix4, RowVector4};

use super::{Dataset, DatasetPair};
use crate::error::{Error, Result};
use crate::eval::trajectory::at;
use crate::eval::{Protocol, TruePair};
use crate::io::read_text;

/// The sequences whose pairs are tested.
const SEQUENCES: [usize; 3] = [8, 9, 10];
/// How far the camera may move, metres.
const DISTANCE: f64 = 10.0;
/// How many scans are looked ahead.
const AHEAD: usize = 100;
/// The pair that is left out: one of its scans lies wrong.
const LEFT_OUT: [usize; 3] = [8, 15, 58];

/// Moves points of the laser scanner into the frame of the camera: the one calibration that the official lists use for
/// all sequences (a fact of the data set, 3 x 4).
#[rustfmt::skip]
const CAMERA_FROM_SCANNER: [f64; 12] = [
    7.533745e-03, -9.999714e-01, -6.166020e-04, -4.069766e-03,
    1.480249e-02, 7.280733e-04, -9.998902e-01, -7.631618e-02,
    9.998621e-01, 7.523790e-03, 1.480755e-02, -2.717806e-01,
];

/// Whose calibration turns camera poses into scanner poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KittiTruth {
    /// One calibration for all sequences, as published.
    Official,
    /// That of each sequence, from `calib.txt`.
    Exact,
}

/// Reads the list of test pairs and their truth.
///
/// The official truth is further refined by ICP and composed in the wrong order (`M * D` for a correction `D` that was
/// found after `M`). Where the refined transforms lie beside the data (`icp/S_A_B.npy`, as the official scripts cache
/// them), [`KittiTruth::Official`] takes them; where they do not, the truth is that of the poses.
///
/// # Errors
/// `Io` or `InvalidInput`, naming file and line, if a sequence is missing or malformed.
pub fn read_kitti(root: impl AsRef<Path>, truth: KittiTruth) -> Result<Dataset> {
    let root = root.as_ref();
    let below = root.join("dataset");
    let base = if below.join("sequences").is_dir() { below.as_path() } else { root };
    let mut pairs = Vec::new();
    for sequence in SEQUENCES {
        pairs.extend(read_sequence(root, base, sequence, truth)?);
    }
    Ok(Dataset { name: "KITTI".to_owned(), protocol: Protocol::Kitti2m, pairs })
}

fn read_sequence(
    root: &Path,
    base: &Path,
    sequence: usize,
    truth: KittiTruth,
) -> Result<Vec<DatasetPair>> {
    let poses = read_poses(&base.join(format!("poses/{sequence:02}.txt")))?;
    let folder = base.join(format!("sequences/{sequence:02}"));
    let camera_from_scanner = match truth {
        KittiTruth::Official => matrix(&CAMERA_FROM_SCANNER),
        KittiTruth::Exact => read_calibration(&folder.join("calib.txt"))?,
    };
    let scan = |frame: usize| folder.join(format!("velodyne/{frame:06}.bin"));
    let mut pairs = Vec::new();
    for (earlier, later) in list(&poses, |frame| scan(frame).is_file()) {
        if [sequence, earlier, later] == LEFT_OUT {
            continue;
        }
        let refined = root.join(format!("icp/{sequence}_{earlier}_{later}.npy"));
        let target_from_source = if truth == KittiTruth::Official && refined.is_file() {
            crate::io::read_pose(&refined)?.to_matrix()
        } else {
            relative(&poses, earlier, later, &camera_from_scanner)?
        };
        pairs.push(DatasetPair {
            truth: TruePair {
                scene: format!("{sequence:02}"),
                source: earlier,
                reference: later,
                target_from_source,
                information: None,
                overlap: None,
                is_first_of_scene: pairs.is_empty(),
            },
            source: scan(earlier),
            reference: scan(later),
        });
    }
    if pairs.is_empty() {
        return Err(Error::in_file(&folder, "no pair of scans in velodyne/: are they there?"));
    }
    Ok(pairs)
}

/// From each scan the last one before the first that is too far away, then on from the one after it.
fn list(poses: &[Matrix4<f64>], exists: impl Fn(usize) -> bool) -> Vec<(usize, usize)> {
    let place =
        |frame: usize| poses.get(frame).map(|pose| pose.fixed_view::<3, 1>(0, 3).into_owned());
    let mut pairs = Vec::new();
    let mut frame = 0;
    while frame < poses.len() {
        let is_far = |other: usize| match (place(frame), place(other)) {
            (Some(here), Some(there)) => (there - here).norm() > DISTANCE,
            _ => false,
        };
        let far = (frame..(frame + AHEAD).min(poses.len())).find(|&other| is_far(other));
        match far.map(|far| far - 1).filter(|&last| last > frame && exists(frame) && exists(last)) {
            Some(last) => {
                pairs.push((frame, last));
                frame = last + 1;
            }
            None => frame += 1,
        }
    }
    pairs
}

/// Moves points of the earlier scan into the frame of the later one.
fn relative(
    poses: &[Matrix4<f64>],
    earlier: usize,
    later: usize,
    camera_from_scanner: &Matrix4<f64>,
) -> Result<Matrix4<f64>> {
    let world_from_scanner = |frame: usize| {
        poses.get(frame).map(|world_from_camera| world_from_camera * camera_from_scanner)
    };
    let relative = world_from_scanner(later)
        .and_then(|later| later.try_inverse())
        .zip(world_from_scanner(earlier))
        .map(|(later, earlier)| later * earlier);
    relative.ok_or_else(|| {
        Error::invalid(format!("the poses of scans {earlier} and {later} cannot be inverted"))
    })
}

fn read_poses(path: &Path) -> Result<Vec<Matrix4<f64>>> {
    let text = read_text(path)?;
    (1..).zip(text.lines()).map(|(line, text)| row(path, line, text.split_whitespace())).collect()
}

fn read_calibration(path: &Path) -> Result<Matrix4<f64>> {
    let text = read_text(path)?;
    for (line, text) in (1..).zip(text.lines()) {
        let mut words = text.split_whitespace();
        if matches!(words.next(), Some("Tr:" | "Tr" | "Tr_velo_to_cam:")) {
            return row(path, line, words);
        }
    }
    Err(Error::in_file(path, "no line Tr: with the transform from the scanner to the camera"))
}

fn row<'a>(path: &Path, line: usize, words: impl Iterator<Item = &'a str>) -> Result<Matrix4<f64>> {
    let numbers: Option<Vec<f64>> =
        words.map(|word| word.parse::<f64>().ok().filter(|number| number.is_finite())).collect();
    let numbers = numbers.and_then(|numbers| <[f64; 12]>::try_from(numbers).ok());
    numbers
        .map(|numbers| matrix(&numbers))
        .ok_or_else(|| at(path, line, "expected 12 finite numbers"))
}

fn matrix(rows: &[f64; 12]) -> Matrix4<f64> {
    let mut matrix = Matrix4::identity();
    for (index, row) in rows.chunks_exact(4).enumerate() {
        matrix.set_row(index, &RowVector4::from_row_slice(row));
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_end_before_the_first_scan_that_is_too_far() {
        let pose = |x: f64| {
            let mut pose = Matrix4::identity();
            pose[(0, 3)] = x;
            pose
        };
        let poses: Vec<Matrix4<f64>> = (0..20).map(|frame| pose(1.5 * f64::from(frame))).collect();
        // 7 * 1.5 is the first beyond 10 m.
        assert_eq!(list(&poses, |_| true), [(0, 6), (7, 13)]);
        assert_eq!(list(&poses, |frame| frame != 6), [(1, 7), (8, 14)]);
        let still = vec![pose(0.0); 300];
        assert_eq!(list(&still, |_| true), []);
    }
}
