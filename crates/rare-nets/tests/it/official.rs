//! Fragments and lists of pairs as the official repositories store them.

use std::io::Write;

use rare::nalgebra::Point3;
use rare_nets::official::{is_fragment, read_fragment, read_network_dump, read_pairs};

use crate::pickle_writer::Pickle;
use crate::shared;

#[test]
fn fragments_of_every_container_are_clouds() {
    let Some(folder) = shared::path("golden/backbones/pth") else { return };
    let expected =
        rare_nets::checkpoint::Parameters::open_safetensors(&[folder.join("expected.safetensors")])
            .unwrap();
    let expected = expected.read("fragment_f32", &[50, 3]).unwrap().to_f32();
    for name in [
        "fragment_f64_legacy.pth",
        "fragment_f32_zip.pth",
        "fragment_tensor_zip.pth",
        "fragment_tensor_legacy.pth",
    ] {
        assert!(is_fragment(&folder.join(name)));
        let cloud = read_fragment(&folder.join(name)).unwrap();
        assert_eq!(cloud.len(), 50);
        for (point, row) in cloud.world_points().iter().zip(expected.chunks_exact(3)) {
            for axis in 0..3 {
                assert!(
                    (point[axis] - f64::from(row[axis])).abs() < 1e-6,
                    "{name} {point} {row:?}"
                );
            }
        }
    }
    for name in ["ckpt_zip.pth", "ckpt_legacy.pth"] {
        let message = read_fragment(&folder.join(name)).unwrap_err().to_string();
        assert!(message.contains(name) && message.contains("N x 3"), "{message}");
    }
}

const TURN: [f64; 9] = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

fn file(pickle: Pickle) -> tempfile::NamedTempFile {
    let mut file = tempfile::Builder::new().suffix(".pkl").tempfile().unwrap();
    file.write_all(&pickle.into_file()).unwrap();
    file
}

#[test]
fn both_lists_of_pairs_are_read() {
    let list = Pickle(b"](}(".to_vec())
        .text("overlap")
        .number(0.5)
        .text("pcd0")
        .text("test/room/cloud_bin_1.pth")
        .text("pcd1")
        .text("test/room/cloud_bin_4.pth")
        .text("rotation")
        .array(&[3, 3], &TURN)
        .text("translation")
        .array(&[3], &[1.0, 2.0, 3.0])
        .text("scene_name")
        .text("room")
        .text("frag_id0")
        .integer(1)
        .text("frag_id1")
        .integer(4)
        .raw(b"ue");
    let dictionary = Pickle(b"}(".to_vec())
        .text("src")
        .raw(b"](")
        .text("test/room/cloud_bin_4.pth")
        .raw(b"e")
        .text("tgt")
        .raw(b"](")
        .text("test/room/cloud_bin_1.pth")
        .raw(b"e")
        .text("rot")
        .raw(b"](")
        .array(&[3, 3], &TURN)
        .raw(b"e")
        .text("trans")
        .raw(b"](")
        .array(&[3, 1], &[1.0, 2.0, 3.0])
        .raw(b"e")
        .text("overlap")
        .raw(b"](")
        .number(0.5)
        .raw(b"e")
        .raw(b"u");
    for pickle in [list, dictionary] {
        let pairs = read_pairs(file(pickle).path()).unwrap();
        assert_eq!(pairs.len(), 1);
        let pair = &pairs[0];
        assert_eq!(pair.source, "test/room/cloud_bin_4.pth");
        assert_eq!(pair.reference, "test/room/cloud_bin_1.pth");
        let truth = &pair.truth;
        assert_eq!((truth.scene.as_str(), truth.source, truth.reference), ("room", 4, 1));
        assert_eq!((truth.overlap, truth.is_first_of_scene), (Some(0.5), true));
        assert_eq!(truth.target_from_source[(0, 1)], -1.0);
        assert_eq!(truth.target_from_source[(2, 3)], 3.0);
        assert_eq!(truth.target_from_source[(3, 3)], 1.0);
    }
    let lacking = Pickle(b"](}(".to_vec()).text("pcd0").text("a").raw(b"ue");
    let message = read_pairs(file(lacking).path()).unwrap_err().to_string();
    assert!(message.contains("pair 0"), "{message}");
    let message = read_pairs(file(Pickle(b"}".to_vec())).path()).unwrap_err().to_string();
    assert!(message.contains("no list of pairs"), "{message}");
}

#[test]
fn dumps_of_cofinet_and_predator_become_correspondences() {
    let points = [0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 2.0];
    let moved: Vec<f64> = points.iter().map(|value| value + 0.5).collect();
    let cofinet = Pickle(b"}(".to_vec())
        .text("src_pcd")
        .array(&[3, 3], &points)
        .text("tgt_pcd")
        .array(&[3, 3], &moved)
        .text("correspondences")
        .array(&[2, 2], &[0.0, 1.0, 2.0, 2.0])
        .text("confidence")
        .array(&[2], &[0.25, 0.75])
        .raw(b"u");
    let pairs = read_network_dump(file(cofinet).path()).unwrap();
    assert_eq!(pairs.iter().map(|pair| pair.score).collect::<Vec<_>>(), [0.75, 0.25]);
    assert_eq!(pairs[0].source, Point3::new(0.0, 1.0, 2.0));
    assert_eq!(pairs[1].target, Point3::new(1.5, 0.5, 1.5));

    // Three points of each cloud, the features of the target in another order.
    let features = [1.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 1.0, 1.0, 0.0, -1.0, 0.0];
    let predator = |count: u8| {
        Pickle(b"}(".to_vec())
            .text("pcd")
            .array(&[6, 3], &[&points[..], &moved].concat())
            .text("feats")
            .array(&[6, 2], &features)
            .text("overlaps")
            .array(&[6], &[0.5; 6])
            .text("saliency")
            .array(&[6], &[0.1, 0.2, 0.3, 0.1, 0.2, 0.3])
            .text("len_src")
            .integer(count)
            .raw(b"u")
    };
    let pairs = read_network_dump(file(predator(3)).path()).unwrap();
    assert_eq!(pairs.len(), 3);
    let of = |source: Point3<f64>| pairs.iter().find(|pair| pair.source == source).unwrap().target;
    assert_eq!(of(Point3::new(0.0, 0.0, 1.0)), Point3::new(1.5, 0.5, 1.5));
    assert_eq!(of(Point3::new(1.0, 0.0, 1.0)), Point3::new(0.5, 0.5, 1.5));

    for (pickle, words) in [
        (predator(9), "len_src"),
        (Pickle(b"}(".to_vec()).text("pcd").integer(1).raw(b"u"), "no array pcd"),
    ] {
        let message = read_network_dump(file(pickle).path()).unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    }
}
