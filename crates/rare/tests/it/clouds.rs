//! Reading and writing clouds, features and correspondences: every fixture holds the same 50 points
//! (`fixtures/make_clouds.py`).

use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Point3, Vector3};
use rare::io::{
    NpzFile, read_cloud, read_correspondences, read_point_features, write_cloud,
    write_coloured_ply, write_point_features,
};
use rare::{Error, PointCloud, PointFeatures};

/// Where the LAS fixtures stand.
const GEOREFERENCE: [f64; 3] = [500_000.0, 5_400_000.0, 100.0];

pub(crate) fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/clouds").join(name)
}

/// What `cloud()` of `make_clouds.py` computes.
fn expected() -> Vec<Point3<f64>> {
    let point = |i: i32| {
        let z = (f64::from(i) * 0.37).sin() + 2.0;
        let raw = Vector3::new(f64::from(i % 10) - 4.5, f64::from(i / 10) * 1.25 - 2.0, z);
        Point3::from((raw * 128.0).map(f64::round) / 128.0)
    };
    (0..50).map(point).collect()
}

fn largest_difference(cloud: &PointCloud, expected: &[Point3<f64>]) -> f64 {
    assert_eq!(cloud.len(), expected.len());
    cloud.world_points().iter().zip(expected).map(|(a, b)| (a - b).amax()).fold(0.0, f64::max)
}

fn message(path: &Path) -> String {
    read_cloud(path).unwrap_err().to_string()
}

#[test]
fn every_fixture_reads_as_the_same_points() {
    let georeferenced: Vec<_> =
        expected().iter().map(|p| p + Vector3::from(GEOREFERENCE)).collect();
    let mut read = 0;
    for entry in fs::read_dir(fixture("")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        let expected = match path.extension().unwrap().to_str().unwrap() {
            "las" | "laz" => georeferenced.clone(),
            _ => expected(),
        };
        // Halves keep 11 bits; the E57 scans are single precision up to 12 m from their own origins (half a unit in the
        // last place is 4.8e-7 m there, turned by the pose); scales of LAS leave ulps of 5e6; the rest is exact.
        let tolerance = match name {
            "half.npy" => 2e-3,
            "two_scans.e57" => 1e-6,
            "old.las" | "new.las" | "old.laz" | "layered.laz" => 1e-9,
            _ => 0.0,
        };
        let (path, dropped) = match name {
            "several.npz" => (PathBuf::from(format!("{}:first", path.display())), 0),
            "organised.pcd" => (path.clone(), 5),
            _ => (path.clone(), 0),
        };
        let cloud = read_cloud(&path).unwrap();
        let difference = largest_difference(&cloud, &expected);
        assert!(difference <= tolerance, "{}: {difference:e}", path.display());
        assert_eq!(cloud.dropped(), dropped, "{}", path.display());
        read += 1;
    }
    assert_eq!(read, 24);
}

#[test]
fn spherical_coordinates_are_converted_and_turned() {
    use e57::{
        E57Writer, Quaternion, Record, RecordDataType, RecordName, RecordValue, Transform,
        Translation,
    };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scan.e57");
    let half = 0.35f64;
    let mut file = E57Writer::from_file(&path, "file").unwrap();
    let spherical =
        [RecordName::SphericalRange, RecordName::SphericalAzimuth, RecordName::SphericalElevation];
    let mut prototype: Vec<Record> =
        spherical.into_iter().map(|name| Record { name, data_type: RecordDataType::F64 }).collect();
    prototype.push(Record::SPHERICAL_INVALID_STATE);
    let mut scan = file.add_pointcloud("scan", prototype).unwrap();
    scan.set_transform(Some(Transform {
        rotation: Quaternion { w: half.cos(), x: 0.0, y: 0.0, z: half.sin() },
        translation: Translation { x: 1.0, y: 2.0, z: 3.0 },
    }));
    for (index, point) in expected().iter().enumerate() {
        let range = point.coords.norm();
        scan.add_point(vec![
            RecordValue::Double(range),
            RecordValue::Double(point.y.atan2(point.x)),
            RecordValue::Double((point.z / range).asin()),
            RecordValue::Integer(if index == 7 { 2 } else { 0 }),
        ])
        .unwrap();
    }
    scan.finalize().unwrap();
    file.finalize().unwrap();
    let turn = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), 2.0 * half);
    let mut turned: Vec<_> =
        expected().iter().map(|p| turn * p + Vector3::new(1.0, 2.0, 3.0)).collect();
    turned.remove(7);
    assert!(largest_difference(&read_cloud(&path).unwrap(), &turned) < 1e-12);
}

#[test]
fn the_content_decides_the_format_not_the_name() {
    let folder = tempfile::tempdir().unwrap();
    for (content, name) in [
        ("big.ply", "a.pcd"),
        ("organised.pcd", "b.xyz"),
        ("old.laz", "c.ply"),
        ("single.npy", "d"),
    ] {
        let path = folder.path().join(name);
        fs::copy(fixture(content), &path).unwrap();
        assert_eq!(read_cloud(&path).unwrap(), read_cloud(fixture(content)).unwrap());
    }
    for (content, name, part) in [
        ("plain.xyz", "e.ply", "named .ply, but its content is not"),
        ("scan.bin", "f.las", "named .las"),
        ("scan.bin", "g.xyz", "zero bytes"),
        ("plain.xyz", "h.obj", ".obj is not a format that is read"),
    ] {
        let path = folder.path().join(name);
        fs::copy(fixture(content), &path).unwrap();
        let message = message(&path);
        assert!(message.contains(part) && message.contains(name), "{message}");
    }
}

#[test]
fn an_archive_says_what_it_holds() {
    let several = message(&fixture("several.npz"));
    assert!(several.contains("first, second could all be the cloud"), "{several}");
    let named = PathBuf::from(format!("{}:second", fixture("several.npz").display()));
    assert_eq!(read_cloud(&named).unwrap().points()[0], expected()[0] + Vector3::repeat(1.0));
    let wrong = message(&PathBuf::from(format!("{}:third", fixture("several.npz").display())));
    assert!(wrong.contains("third") && wrong.contains("[first, second]"), "{wrong}");
    let pose = message(&PathBuf::from(format!("{}:missing", fixture("only.npz").display())));
    assert!(pose.contains("[cloud, features, pose]"), "{pose}");
    let mut file = NpzFile::open(fixture("only.npz")).unwrap();
    assert_eq!(file.names(), ["cloud", "features", "pose"]);
    let features = file.array_f32("features").unwrap();
    assert_eq!((features.shape, features.values), (vec![50, 2], vec![1.0; 100]));
    assert_eq!(file.array_f64("pose").unwrap().values[15], 1.0);
}

#[test]
fn written_clouds_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let near = expected();
    let precise: Vec<_> = near.iter().map(|p| p + Vector3::new(1e6, 0.1, 0.0) / 3.0).collect();
    for extension in ["ply", "pcd", "xyz", "npy"] {
        for points in [&near, &precise] {
            let path = folder.path().join(format!("cloud.{extension}"));
            write_cloud(&path, points).unwrap();
            assert!(largest_difference(&read_cloud(&path).unwrap(), points) < 1e-10, "{extension}");
        }
    }
    // Single precision where it loses nothing.
    write_cloud(folder.path().join("small.ply"), &near).unwrap();
    write_cloud(folder.path().join("large.ply"), &precise).unwrap();
    let size = |name| fs::metadata(folder.path().join(name)).unwrap().len();
    assert!(size("small.ply") < 12 * 50 + 200 && size("large.ply") > 24 * 50);
    let refused = write_cloud(folder.path().join("cloud.las"), &near).unwrap_err();
    assert!(
        matches!(&refused, Error::Unsupported(what) if what.contains(".ply .pcd .xyz .npy")),
        "{refused}"
    );
    assert!(write_cloud(folder.path().join("none.ply"), &[]).is_err());
}

#[test]
fn aligned_clouds_are_written_in_their_colours() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pair.ply");
    let points = expected();
    write_coloured_ply(&path, &[(&points[..20], [255, 0, 1]), (&points[20..], [2, 3, 4])]).unwrap();
    assert_eq!(largest_difference(&read_cloud(&path).unwrap(), &points), 0.0);
    let bytes = fs::read(&path).unwrap();
    let records = &bytes[bytes.len() - 50 * 15..];
    assert_eq!(
        (&records[12..15], &records[20 * 15 + 12..21 * 15]),
        (&[255, 0, 1][..], &[2, 3, 4][..])
    );
}

#[test]
fn features_and_correspondences_read_back_and_must_agree() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("features.npz");
    let values: Vec<f32> = (0..150).map(|value| value as f32 * 0.1).collect();
    let features = PointFeatures::new(expected(), 3, values).unwrap();
    write_point_features(&path, &features).unwrap();
    assert_eq!(read_point_features(&path).unwrap(), features);
    let first = fs::read(&path).unwrap();
    write_point_features(&path, &features).unwrap();
    assert_eq!(fs::read(&path).unwrap(), first);

    let mut broken = features.values().to_vec();
    broken[7] = f32::NAN;
    write_point_features(&path, &PointFeatures::new(expected(), 3, broken).unwrap()).unwrap();
    let message = read_point_features(&path).unwrap_err().to_string();
    assert!(message.contains("row 2 of features"), "{message}");
    let message = read_correspondences(&path).unwrap_err().to_string();
    assert!(message.contains("source") && message.contains("[features, points]"), "{message}");
}

#[test]
fn correspondences_are_read_with_and_without_scores() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, arrays: &[(&str, &[u64], Vec<f64>)]| {
        use npyz::WriterBuilder;
        let path = folder.path().join(name);
        let mut file = npyz::npz::NpzWriter::create(&path).unwrap();
        for (name, shape, values) in arrays {
            let mut array = file
                .array(name, Default::default())
                .unwrap()
                .default_dtype()
                .shape(shape)
                .begin_nd()
                .unwrap();
            array.extend(values).unwrap();
            array.finish().unwrap();
        }
        path
    };
    let six = |start: f64| (0..6).map(|value| start + f64::from(value)).collect::<Vec<f64>>();
    let pairs: [(&str, &[u64], Vec<f64>); 2] =
        [("source", &[2, 3], six(0.0)), ("reference", &[2, 3], six(10.0))];
    let plain = read_correspondences(write("plain.npz", &pairs)).unwrap();
    assert_eq!((plain[1].source.x, plain[1].target.z, plain[1].score), (3.0, 15.0, 1.0));
    let scored = [pairs.to_vec(), vec![("score", &[2][..], vec![0.5, 0.25])]].concat();
    assert_eq!(read_correspondences(write("scored.npz", &scored)).unwrap()[1].score, 0.25);
    for (last, part) in [
        (("score", &[3][..], vec![1.0; 3]), "source has 2 rows and score 3"),
        (("score", &[2][..], vec![1.0, -1.0]), "score 1 is -1"),
        (("reference", &[1, 3][..], vec![1.0; 3]), "source has 2 rows and reference 1"),
        (("reference", &[2, 2][..], vec![1.0; 4]), "N x 3 is needed"),
    ] {
        let arrays = match last.0 {
            "score" => [pairs.to_vec(), vec![last]].concat(),
            _ => vec![pairs[0].clone(), last],
        };
        let message = read_correspondences(write("bad.npz", &arrays)).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains("bad.npz"), "{message}");
    }
}
