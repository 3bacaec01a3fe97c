//! Reading and writing poses.

use std::fs;

use nalgebra::{Matrix4, Rotation3, UnitQuaternion, Vector3};
use rare::RigidTransform;
use rare::io::{format_pose, read_pose, write_pose};

fn pose() -> RigidTransform {
    RigidTransform::new(
        Rotation3::new(Vector3::new(0.1, -0.7, 1.3)),
        Vector3::new(1.5, -2.25, 1e-7),
    )
}

fn rows(matrix: &Matrix4<f64>, between: &str, end: &str, count: usize) -> String {
    let row = |i: usize| {
        (0..4).map(|j| format!("{:?}", matrix[(i, j)])).collect::<Vec<_>>().join(between)
    };
    (0..count).map(|i| row(i) + end).collect()
}

fn read(name: &str, content: impl AsRef<[u8]>) -> rare::Result<RigidTransform> {
    let folder = tempfile::tempdir().unwrap();
    let file = name.split(':').next().unwrap();
    fs::write(folder.path().join(file), content).unwrap();
    read_pose(folder.path().join(name))
}

fn assert_same(read: &RigidTransform) {
    let error = read.error_to(&pose());
    assert!(error.rotation_degrees < 1e-12 && error.translation < 1e-14, "{error:?}");
}

#[test]
fn every_way_of_writing_a_pose_is_read() {
    let matrix = pose().to_matrix();
    let q = UnitQuaternion::from_rotation_matrix(pose().rotation());
    let tum = format!("1.5 -2.25 1e-7 {} {} {} {}", q.i, q.j, q.k, q.w);
    let nested = format!("[[{}]]", rows(&matrix, ", ", "], [", 4).trim_end_matches("], ["));
    for (name, text) in [
        ("plain.txt", format_pose(&pose())),
        ("tabs.txt", rows(&matrix, "\t", "\t\r\n", 4)),
        ("rows.txt", rows(&matrix, " ", "\n", 3)),
        ("kitti.txt", rows(&matrix, " ", " ", 3)),
        ("commas.txt", format!("# initial\n{}", rows(&matrix, ", ", ";\n", 4))),
        ("numpy.txt", format!("[[{}]]", rows(&matrix, "  ", "]\n [", 4).trim_end_matches("]\n ["))),
        ("nested.json", nested.clone()),
        ("report.json", format!("{{\"verdict\": \"accepted\", \"target_from_source\": {nested}}}")),
        ("quaternion.txt", tum.clone()),
        ("tum.txt", format!("# timestamp tx ty tz qx qy qz qw\n12.5 {tum}\n")),
        ("one.log", format!("0\t1\t60\n{}", rows(&matrix, "\t", "\t\n", 4))),
    ] {
        assert_same(&read(name, text).unwrap_or_else(|error| panic!("{error}")));
    }
    for (rows, fortran) in [(4, false), (3, false), (4, true)] {
        assert_same(&read("pose.npy", npy(&matrix, rows, fortran)).unwrap());
    }
}

fn npy(matrix: &Matrix4<f64>, rows: usize, fortran: bool) -> Vec<u8> {
    let order = if fortran { "True" } else { "False" };
    let header = format!("{{'descr': '<f8', 'fortran_order': {order}, 'shape': ({rows}, 4), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.bytes());
    let part = matrix.rows(0, rows).into_owned();
    // nalgebra stores columns, as Fortran does.
    let values =
        if fortran { part.as_slice().to_vec() } else { part.transpose().as_slice().to_vec() };
    bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    bytes
}

#[test]
fn a_block_of_a_log_is_chosen_by_its_fragments() {
    let block = |i, j, pose: RigidTransform| format!("{i} {j} 60\n{}", format_pose(&pose));
    let log = block(0, 1, RigidTransform::identity()) + &block(0, 2, pose());
    assert_same(&read("gt.log:0,2", &log).unwrap());
    for (name, part) in [
        ("gt.log", "2 blocks (0,1 0,2): name one"),
        ("gt.log:1,2", "no block 1,2, it has 0,1 0,2"),
        ("gt.log:first", "file.log:i,j"),
    ] {
        let message = read(name, &log).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains("gt.log"), "{message}");
    }
}

#[test]
fn what_is_no_pose_is_refused_with_a_remedy() {
    let transposed = rows(&pose().to_matrix().transpose(), " ", "\n", 4);
    let line = rows(&pose().to_matrix(), " ", " ", 3);
    for (content, part) in [
        ("1 0 0\n0 1 0\n0 0 1\n".to_owned(), "3 x 3"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 nan\n0 0 0 1\n".to_owned(), "not finite"),
        ("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n".to_owned(), "not a rotation"),
        (transposed, "last row"),
        ("1 0 0 0\n0 one 0 0\n".to_owned(), "line 2, column 3: \"one\""),
        ("0 0 0 0 0 0 2".to_owned(), "quaternion"),
        ("1 2 3 4 5".to_owned(), "5 numbers are no pose"),
        ("# nothing\n".to_owned(), "no number"),
        (format!("{line}\n{line}\n"), "2 poses, one per line"),
        ("{\"pose\": [1]}".to_owned(), "no entry target_from_source"),
        ("{\"target_from_source\": \"x\"}".to_owned(), "holds \"x\""),
        ("{".to_owned(), "JSON"),
        (format!("{{\"target_from_source\": {}", "[".repeat(100_000)), "JSON"),
        (String::new(), "empty"),
    ] {
        let message = read("initial.txt", &content).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains("initial.txt"), "{content}: {message}");
    }
    assert!(read_pose("/nowhere/pose.txt").unwrap_err().to_string().contains("no such file"));
}

#[test]
fn a_written_pose_reads_back_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pose.txt");
    write_pose(&path, &pose()).unwrap();
    assert_eq!(fs::read_to_string(&path).unwrap(), format_pose(&pose()));
    let numbers: Vec<f64> =
        format_pose(&pose()).split_whitespace().map(|number| number.parse().unwrap()).collect();
    assert_eq!(Matrix4::from_row_slice(&numbers), pose().to_matrix());
    assert_eq!(format_pose(&pose()).lines().count(), 4);
    assert_same(&read_pose(&path).unwrap());
}
