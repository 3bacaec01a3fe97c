//! Files that are broken, cut off or made to do harm: an error that names the file, never a panic, a hang or memory
//! beyond measure.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use rare::io::{NpzFile, read_cloud, read_correspondences, read_point_features, read_pose};

use crate::clouds::fixture;

/// No small file may take longer; the machine may be busy.
const PATIENCE: Duration = Duration::from_secs(10);

/// Hands the bytes to every reader under every name.
fn read_with_everything(bytes: &[u8], extension: &str) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("file.{extension}"));
    fs::write(&path, bytes).unwrap();
    let start = Instant::now();
    let _ = read_cloud(&path);
    let _ = read_pose(&path);
    let _ = read_point_features(&path);
    let _ = read_correspondences(&path);
    if let Ok(mut file) = NpzFile::open(&path) {
        for name in file.names() {
            let _ = file.array_f32(&name);
        }
    }
    assert!(start.elapsed() < PATIENCE, "took {:?}", start.elapsed());
}

fn fixtures() -> Vec<(String, Vec<u8>)> {
    let mut names: Vec<_> = fs::read_dir(fixture(""))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names.into_iter().map(|name| (name.clone(), fs::read(fixture(&name)).unwrap())).collect()
}

/// Gives each page of an E57 file its right checksum again, so that damage gets past it.
fn restore_checksums(bytes: &mut [u8]) {
    for page in bytes.chunks_exact_mut(1024) {
        let (content, checksum) = page.split_at_mut(1020);
        // CRC-32C, most significant byte first.
        let sum = content.iter().fold(!0u32, |sum, &byte| {
            (0..8).fold(sum ^ u32::from(byte), |sum, _| (sum >> 1) ^ (0x82f6_3b78 * (sum & 1)))
        });
        checksum.copy_from_slice(&(!sum).to_be_bytes());
    }
}

#[test]
fn every_checksum_is_restored() {
    let intact = fs::read(fixture("two_scans.e57")).unwrap();
    let mut bytes = intact.clone();
    bytes[1020] ^= 1;
    restore_checksums(&mut bytes);
    assert_eq!(bytes, intact);
}

fn extension(name: &str) -> &str {
    name.rsplit('.').next().unwrap()
}

/// What readers recognise, so that random bytes get past the first look.
const BEGINNINGS: &[(&str, &[u8])] = &[
    ("ply", b"ply\nformat binary_little_endian 1.0\n"),
    ("ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"),
    ("pcd", b"VERSION 0.7\nFIELDS x y z\n"),
    ("pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 9\nDATA binary_compressed\n"),
    ("xyz", b""),
    ("csv", b"x,y,z\n1,2,"),
    ("pts", b"5\n"),
    ("npy", b"\x93NUMPY\x01\0"),
    ("npy", b"\x93NUMPY\x01\0\x10\0{'descr': '<f8',"),
    ("npz", b"PK\x03\x04"),
    ("bin", b""),
    ("las", b"LASF"),
    ("e57", b"ASTM-E57\x01\0\0\0\0\0\0\0"),
    ("log", b"0 1 2\n"),
    ("json", b"{\"target_from_source\": "),
];

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn every_reader_survives_random_bytes(
        which in 0..BEGINNINGS.len(),
        random in prop::collection::vec(any::<u8>(), 0..600),
        text in "[-0-9a-z.,;#/ \\[\\]{}'\":\n]{0,200}",
    ) {
        let (extension, beginning) = BEGINNINGS[which];
        read_with_everything(&[beginning, &random].concat(), extension);
        read_with_everything(&[beginning, text.as_bytes()].concat(), extension);
    }

    #[test]
    fn every_reader_survives_cut_off_fixtures(part in 0.0..1.0f64) {
        for (name, bytes) in fixtures() {
            read_with_everything(&bytes[..(bytes.len() as f64 * part) as usize], extension(&name));
        }
    }

    #[test]
    fn every_reader_survives_damaged_fixtures(
        damage in prop::collection::vec((0.0..1.0f64, prop::sample::select(vec![0u8, 1, 0x7f, 0x80, 0xff, b'9', b'-'])), 1..6),
        within in prop::sample::select(vec![1.0, 0.2]),
    ) {
        for (name, mut bytes) in fixtures() {
            for (place, value) in &damage {
                let at = (bytes.len() as f64 * place * within) as usize;
                bytes[at] = *value;
            }
            if extension(&name) == "e57" {
                restore_checksums(&mut bytes);
            }
            read_with_everything(&bytes, extension(&name));
        }
    }
}

fn error_of(name: &str, bytes: &[u8]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    let message = read_cloud(&path).unwrap_err().to_string();
    assert!(message.contains(name), "{message}");
    message
}

/// A fixture with the first `from` in it replaced.
fn altered(name: &str, from: &str, to: &str) -> Vec<u8> {
    replaced(&fs::read(fixture(name)).unwrap(), from, to)
}

fn replaced(bytes: &[u8], from: &str, to: &str) -> Vec<u8> {
    let at = bytes.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
    [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
}

/// A fixture with some of its bytes replaced.
fn patched(name: &str, at: usize, with: &[u8]) -> Vec<u8> {
    let mut bytes = fs::read(fixture(name)).unwrap();
    bytes[at..at + with.len()].copy_from_slice(with);
    bytes
}

fn cut(name: &str, length: usize) -> Vec<u8> {
    fs::read(fixture(name)).unwrap()[..length].to_vec()
}

#[test]
fn what_is_no_readable_file_is_named() {
    let missing = read_cloud("/nowhere/cloud.ply").unwrap_err().to_string();
    assert!(missing.contains("/nowhere/cloud.ply: no such file: check the path"), "{missing}");
    let folder = tempfile::tempdir().unwrap();
    let message = read_cloud(folder.path()).unwrap_err().to_string();
    assert!(message.contains("this is a folder"), "{message}");
    let unknown = error_of("cloud.docx", b"words");
    assert!(unknown.contains(".ply .pcd .xyz"), "{unknown}");
    #[cfg(unix)]
    {
        let message = read_cloud("/dev/zero").unwrap_err().to_string();
        assert!(message.contains("not a regular file"), "{message}");
    }
}

#[test]
fn every_kind_of_bad_cloud_is_named_with_its_remedy() {
    let nan = altered(
        "plain.xyz",
        &fs::read_to_string(fixture("plain.xyz")).unwrap(),
        "nan nan nan\nnan nan nan\n",
    );
    for (name, bytes, part) in [
        ("empty.ply", Vec::new(), "the file is empty"),
        ("none.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n".to_vec(), "no point in it"),
        ("none.npy", b"\x93NUMPY\x01\0\x3a\0{'descr': '<f8', 'fortran_order': False, 'shape': (0, 3)} ".to_vec(), "no point in it"),
        ("nan.xyz", nan, "all 2 are NaN"),
        ("cut.ply", cut("little.ply", 600), "50 records of the element vertex"),
        ("cut.pcd", cut("organised.pcd", 1000), "promises 55 points"),
        ("cut2.pcd", cut("compressed.pcd", 400), "cut off"),
        ("cut.npy", cut("single.npy", 700), "needs 600 bytes"),
        ("cut.npz", cut("points.npz", 2000), "archive is damaged"),
        ("cut.bin", cut("scan.bin", 799), "16 bytes per point"),
        ("cut.las", cut("old.las", 1500), "promises 50 points"),
        ("cut.laz", cut("old.laz", 400), "the LAZ data are damaged"),
        ("cut.e57", cut("two_scans.e57", 6000), "E57 file is damaged"),
        ("text.bin", b"0.25 0.5 0.75 1\n".to_vec(), "name it .xyz"),
        ("bad.ply", altered("text.ply", "-4.5", "x4.5"), "line 22, column 3: \"x4.5\""),
        ("bad.pcd", altered("text.pcd", "-4.5", "x4.5"), "line 12, column 1: \"x4.5\""),
        ("bad.csv", altered("named.csv", "-4.5", "x4.5"), "line 2, column 14: \"x4.5\""),
        ("faces.ply", altered("text.ply", "element vertex", "element corner"), "no element vertex"),
        ("flat.ply", altered("text.ply", "property float z", "property float w"), "x, y and z are needed"),
        ("flat.pcd", altered("text.pcd", "normal z", "normal w"), "x, y and z are needed"),
        ("wide.npy", altered("single.npy", "(50, 3)", "(75, 2)"), "N x 3 is needed"),
        ("object.npy", altered("single.npy", "<f4", "|O8"), "not read"),
    ] {
        let message = error_of(name, &bytes);
        assert!(message.contains(part), "{name}: {message}");
    }
}

/// Headers that promise more than the file holds.
fn lies() -> Vec<(&'static str, Vec<u8>)> {
    let huge = [0xff; 8];
    vec![
        ("lie.ply", altered("little.ply", "vertex 50", "vertex 999999999999")),
        ("text.ply", altered("text.ply", "vertex 50", "vertex 18446744073709551615")),
        ("list.ply", altered("lists.ply", "ring 2", "ring 18446744073709551615")),
        (
            "lie.pcd",
            altered("organised.pcd", "WIDTH 11\nHEIGHT 5", "WIDTH 4294967295\nHEIGHT 4294967295"),
        ),
        ("text.pcd", altered("text.pcd", "POINTS 50", "POINTS 99999999999")),
        ("count.pcd", altered("text.pcd", "COUNT 1 1 2 1", "COUNT 1 1 99999999999 1")),
        ("lie.npy", altered("single.npy", "(50, 3), }   ", "(99999999, 3)")),
        ("header.npy", [b"\x93NUMPY\x02\0\xff\xff\xff\xff", &[b' '; 64][..]].concat()),
        ("lie.las", patched("old.las", 107, &huge[..4])),
        ("lie.laz", patched("old.laz", 107, &huge[..4])),
        ("large.las", patched("new.las", 107, &[&[0; 4][..]].concat())),
        ("records.laz", patched("old.laz", 100, &huge[..4])),
        ("layers.laz", layers_lie()),
        ("chunks.laz", chunks_lie()),
        ("lie.e57", patched("two_scans.e57", 32, &[0xff, 0xff, 0xff, 2, 0, 0, 0, 0])),
        ("constant.e57", constant_scan()),
        ("entries.npz", entries_lie()),
        ("lie.npz", altered("points.npz", "(50, 3)", "(99, 3)")),
    ]
}

/// Where the points of a LAZ file begin.
fn point_data(bytes: &[u8]) -> usize {
    u32::from_le_bytes(bytes[96..100].try_into().unwrap()) as usize
}

/// The first layer of the first chunk claims 4 GB: after the offset of the table, a point of format 7 and a count.
fn layers_lie() -> Vec<u8> {
    let bytes = fs::read(fixture("layered.laz")).unwrap();
    patched("layered.laz", point_data(&bytes) + 8 + 36 + 4, &[0xff, 0xff, 0xff, 0xfe])
}

/// The table of chunks claims 4 billion chunks.
fn chunks_lie() -> Vec<u8> {
    let bytes = fs::read(fixture("old.laz")).unwrap();
    let start = point_data(&bytes);
    let table = u64::from_le_bytes(bytes[start..start + 8].try_into().unwrap()) as usize;
    patched("old.laz", table + 4, &[0xff; 4])
}

/// A scan of 10 points whose columns are all constants, so that a point takes no bits.
fn constant_scan() -> Vec<u8> {
    use e57::{E57Writer, Record, RecordDataType, RecordName, RecordValue};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("constant.e57");
    let mut file = E57Writer::from_file(&path, "file").unwrap();
    let axes = [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ];
    let single_bit = RecordDataType::Integer { min: 0, max: 1 };
    let prototype = axes.map(|name| Record { name, data_type: single_bit.clone() }).to_vec();
    let mut scan = file.add_pointcloud("scan", prototype).unwrap();
    for _ in 0..10 {
        scan.add_point(vec![RecordValue::Integer(0); 3]).unwrap();
    }
    scan.finalize().unwrap();
    file.finalize().unwrap();
    let bytes = fs::read(&path).unwrap();
    let mut bytes = ["X", "Y", "Z"].iter().fold(bytes, |bytes, axis| {
        replaced(
            &bytes,
            &format!("<cartesian{axis} type=\"Integer\" minimum=\"0\" maximum=\"1\""),
            &format!("<cartesian{axis} type=\"Integer\" minimum=\"0\" maximum=\"0\""),
        )
    });
    restore_checksums(&mut bytes);
    bytes
}

/// A 64-bit end of the directory that claims as many entries as the file has bytes.
fn entries_lie() -> Vec<u8> {
    let mut bytes = b"PK\x03\x04".to_vec();
    bytes.resize(1 << 20, 0);
    let end = bytes.len() as u64;
    bytes.extend(b"PK\x06\x06");
    bytes.extend([44, 0, 0, 0, 0, 0, 0, 0, 45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    bytes.extend([end - 1000, end - 1000, 0, 0].map(u64::to_le_bytes).concat());
    bytes.extend(b"PK\x06\x07\0\0\0\0");
    bytes.extend(end.to_le_bytes());
    bytes.extend(
        b"\x01\0\0\0PK\x05\x06\0\0\0\0\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\0\0",
    );
    bytes
}

/// What an extended record claims has nothing to do with the points, so it is not even looked at.
#[test]
fn every_extended_record_is_passed_over() {
    let mut bytes = fs::read(fixture("layered.laz")).unwrap();
    let (start, count) = (235..243, 243..247);
    let end = bytes.len() as u64;
    bytes[start].copy_from_slice(&end.to_le_bytes());
    bytes[count].copy_from_slice(&1u32.to_le_bytes());
    // Its length, 8 bytes from byte 20 on, is 2^56 and more.
    bytes.extend([1; 60]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("extended.laz");
    fs::write(&path, bytes).unwrap();
    assert_eq!(read_cloud(&path).unwrap(), read_cloud(fixture("layered.laz")).unwrap());
}

#[test]
fn every_count_beyond_the_file_is_an_error() {
    for (name, bytes) in lies().into_iter().filter(|(name, _)| *name != "large.las") {
        let start = Instant::now();
        error_of(name, &bytes);
        assert!(start.elapsed() < PATIENCE, "{name}");
    }
}

/// An archive whose entry is 32 MB of deflated zeros, but whose array claims to be small.
#[test]
fn every_bomb_stays_packed() {
    let path =
        Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("bomb-{}.npz", std::process::id()));
    let mut file = npyz::npz::NpzWriter::create(&path).unwrap();
    file.zip_writer().start_file("points.npy", Default::default()).unwrap();
    let header = b"\x93NUMPY\x01\0\x3a\0{'descr': '<f8', 'fortran_order': False, 'shape': (9, 3)} ";
    std::io::Write::write_all(file.zip_writer(), header).unwrap();
    for _ in 0..32 {
        std::io::Write::write_all(file.zip_writer(), &[0; 1 << 20]).unwrap();
    }
    drop(file);
    let message = read_cloud(&path).unwrap_err().to_string();
    fs::remove_file(&path).unwrap();
    assert!(message.contains("[9, 3] does not fit"), "{message}");
}

/// Runs the tests named `every_` once more in a process that may not map more than 512 MB: an allocation that follows
/// a lying header would end it.
#[cfg(target_os = "linux")]
#[test]
fn all_of_this_needs_little_memory() {
    let limited = format!(
        "ulimit -v 524288; exec '{}' hostile_files::every_ --test-threads=1",
        std::env::current_exe().unwrap().display()
    );
    let output = std::process::Command::new("sh").args(["-c", &limited]).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success() && text.contains("8 passed"),
        "{text}{}",
        String::from_utf8_lossy(&output.stderr)
    );
}
