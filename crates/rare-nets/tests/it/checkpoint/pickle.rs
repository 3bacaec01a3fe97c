//! Files of `torch.save`: the golden ones, hand-made ones, and hostile ones.

use std::path::Path;
use std::time::Instant;

use proptest::prelude::*;
use rare_nets::checkpoint::{ElementType, Object, Parameters, open_pickle};

use super::file;
use crate::shared;

/// The object that a hand-made pickle gives.
fn opened(pickle: &[u8]) -> rare::Result<Object> {
    let (_folder, path) = file(pickle);
    open_pickle(&path)
}

fn refusal(pickle: &[u8]) -> String {
    opened(pickle).unwrap_err().to_string()
}

#[test]
fn checkpoints_of_torch_read_exactly() {
    let Some(folder) = shared::path("golden/backbones/pth") else { return };
    let expected = Parameters::open_safetensors(&[folder.join("expected.safetensors")]).unwrap();
    for name in ["ckpt_zip.pth", "ckpt_legacy.pth", "ckpt_legacy_easydict.pth"] {
        let parameters = Parameters::open_pickle(&folder.join(name)).unwrap();
        let mut names: Vec<&str> = parameters.names().collect();
        assert_eq!(names.len(), 8);
        names.retain(|name| *name != "bn.num_batches_tracked");
        for tensor in names {
            let read = parameters.read(tensor, parameters.shape(tensor).unwrap()).unwrap();
            // The expected file has scalars as one element.
            let shape = expected.shape(tensor).unwrap();
            assert!(shape == read.shape || (shape == [1] && read.shape.is_empty()));
            assert_eq!(
                read.values,
                expected.read(tensor, shape).unwrap().values,
                "{name} {tensor}"
            );
        }
        let object = open_pickle(&folder.join(name)).unwrap();
        let state = object.get("model").or(object.get("state_dict")).unwrap();
        let batches = state.get("bn.num_batches_tracked").unwrap().tensor().unwrap();
        assert_eq!((batches.element(), batches.shape()), (ElementType::I64, &[][..]));
        assert_eq!(batches.read_i64().unwrap().len(), 1);
    }
}

#[test]
fn what_is_around_the_tensors_reads_too() {
    let Some(folder) = shared::path("golden/backbones/pth") else { return };
    for name in ["ckpt_zip.pth", "ckpt_legacy.pth"] {
        let object = open_pickle(&folder.join(name)).unwrap();
        assert_eq!(object.get("epoch").unwrap().integer(), Some(3));
        assert_eq!(object.get("best_loss").unwrap().number(), Some(0.25));
        assert_eq!(object.get("name").unwrap().text(), Some("x"));
        let group = &object.get("optimizer").unwrap().get("param_groups").unwrap().items()[0];
        let betas: Vec<f64> =
            group.get("betas").unwrap().items().iter().filter_map(Object::number).collect();
        assert_eq!(betas, [0.9, 0.999]);
    }
    let object = open_pickle(&folder.join("ckpt_legacy_easydict.pth")).unwrap();
    let Some(Object::Instance(config)) = object.get("config") else { panic!("{object:?}") };
    assert!(config.class.ends_with("EasyDict"), "{}", config.class);
    let config = object.get("config").unwrap();
    assert!(config.get("conv1_kernel_size").unwrap().integer().is_some(), "{config:?}");
}

#[test]
fn point_clouds_of_numpy_and_torch_read_exactly() {
    let Some(folder) = shared::path("golden/backbones/pth") else { return };
    let expected = Parameters::open_safetensors(&[folder.join("expected.safetensors")]).unwrap();
    let single = expected.read("fragment_f32", &[50, 3]).unwrap().to_f32();
    let single: Vec<f64> = single.into_iter().map(f64::from).collect();
    for name in ["fragment_f32_zip.pth", "fragment_tensor_zip.pth", "fragment_tensor_legacy.pth"] {
        let object = open_pickle(&folder.join(name)).unwrap();
        let tensor = object.tensor().unwrap();
        assert_eq!(tensor.shape(), [50, 3]);
        assert_eq!(tensor.read_f64().unwrap(), single, "{name}");
    }
    let object = open_pickle(&folder.join("fragment_f64_legacy.pth")).unwrap();
    let double = object.tensor().unwrap().read_f64().unwrap();
    let bytes = std::fs::read(folder.join("expected.safetensors")).unwrap();
    let header = 8 + usize::try_from(u64::from_le_bytes(bytes[..8].try_into().unwrap())).unwrap();
    let stored: Vec<f64> = bytes[header + 8..header + 1208]
        .as_chunks()
        .0
        .iter()
        .map(|bytes| f64::from_le_bytes(*bytes))
        .collect();
    assert_eq!(double, stored);
}

#[test]
fn nothing_is_called_and_what_would_run_code_is_refused_by_name() {
    // os.system("true"), which Python would run.
    let refused = opened(b"\x80\x02cos\nsystem\nX\x04\x00\x00\x00true\x85R.").unwrap_err();
    let message = refused.to_string();
    assert!(message.contains("os.system") && message.contains("not called"), "{message}");
    let refused = opened(b"\x80\x02c__builtin__\neval\nX\x01\x00\x00\x001\x85R.").unwrap_err();
    assert!(refused.to_string().contains("__builtin__.eval"), "{refused}");
    // A class that means nothing here is data.
    let object = opened(b"\x80\x02ceasydict\nEasyDict\nX\x04\x00\x00\x00true\x85R.").unwrap();
    let Object::Instance(instance) = object else { panic!("{object:?}") };
    assert_eq!(&*instance.class, "easydict.EasyDict");
    assert_eq!(instance.arguments.items()[0].text(), Some("true"));
}

#[test]
fn arrays_of_other_orders_read() {
    // A 2 x 3 array of big-endian 16-bit integers in Fortran order, as protocol 3 writes it.
    let mut pickle =
        b"\x80\x03cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
            .to_vec();
    pickle.extend(b"(K\x01K\x02K\x03\x86cnumpy\ndtype\nX\x02\x00\x00\x00i2K\x00K\x01\x87R");
    pickle.extend(b"(K\x03X\x01\x00\x00\x00>NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x88C\x0c");
    pickle.extend([1_i16, 4, 2, 5, 3, -6].iter().flat_map(|value| value.to_be_bytes()));
    pickle.extend(b"tb.");
    let object = opened(&pickle).unwrap();
    let array = object.tensor().unwrap();
    assert_eq!((array.element(), array.shape()), (ElementType::I16, &[2, 3][..]));
    assert_eq!(array.read_i64().unwrap(), [1, 2, 3, 4, 5, -6]);
    assert!(array.read_f64().unwrap_err().to_string().contains("I16"));
}

/// An old stream with one storage of five numbers, 0 to 4, of which the tensor takes what `view`, `offset`, `shape` and
/// `strides` say.
fn stream(view: &[u8], offset: u8, shape: &[u8], strides: &[u8]) -> Vec<u8> {
    let sizes = |sizes: &[u8]| {
        let sizes: Vec<u8> = sizes.iter().flat_map(|&size| [b'K', size]).collect();
        [b"(".as_slice(), &sizes, b"t"].concat()
    };
    let mut bytes =
        b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}.".to_vec();
    bytes.extend(b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((U\x07storagectorch\nFloatStorage\nU\x01kU\x03cpuK\x05");
    bytes.extend([view, b"tQK", &[offset], &sizes(shape), &sizes(strides)].concat());
    bytes.extend(b"\x89)tR.\x80\x02]U\x01ka.\x05\0\0\0\0\0\0\0");
    bytes.extend((0..5).flat_map(|value| (value as f32).to_le_bytes()));
    bytes
}

#[test]
fn parts_of_a_storage_read() {
    for (view, offset, shape, strides, expected) in [
        (&b"N"[..], 0, &[5][..], &[1][..], &[0.0, 1.0, 2.0, 3.0, 4.0][..]),
        (b"N", 1, &[2, 2], &[1, 2], &[1.0, 3.0, 2.0, 4.0]),
        (b"N", 4, &[1, 3], &[9, 0], &[4.0, 4.0, 4.0]),
        (b"N", 5, &[0, 2], &[1, 1], &[]),
        (b"(U\x01vK\x02K\x03t", 1, &[2], &[1], &[3.0, 4.0]),
    ] {
        let object = opened(&stream(view, offset, shape, strides)).unwrap();
        assert_eq!(object.tensor().unwrap().read_f64().unwrap(), expected);
    }
    for (view, offset, shape, strides) in [
        (&b"N"[..], 0, &[6][..], &[1][..]),
        (b"N", 1, &[5], &[1]),
        (b"N", 0, &[2, 2], &[4, 1]),
        (b"N", 0, &[2], &[1, 1]),
        (b"(U\x01vK\x02K\x03t", 0, &[4], &[1]),
        (b"N", 0, &[255, 255, 255, 255], &[0, 0, 0, 0]),
    ] {
        let message = refusal(&stream(view, offset, shape, strides));
        assert!(message.contains("does not fit its storage"), "{message}");
    }
}

#[test]
fn integers_of_every_width_read() {
    for (pickle, value) in [
        (&b"\x80\x02K\xff."[..], 255),
        (b"\x80\x02M\xff\xff.", 65_535),
        (b"\x80\x02J\xfe\xff\xff\xff.", -2),
        (b"\x80\x02\x8a\x00.", 0),
        (b"\x80\x02\x8a\x01\x80.", -128),
        (b"\x80\x02\x8a\x09\x00\x00\x00\x00\x00\x00\x00\x80\x00.", 1 << 63),
    ] {
        assert_eq!(opened(pickle).unwrap().integer(), Some(value));
    }
}

#[test]
fn cycles_and_depths_are_cut() {
    // A list that holds itself.
    let object = opened(b"\x80\x02]q\x00h\x00a.").unwrap();
    assert!(matches!(object.items(), [Object::Cut]));
    // A list in a list in a list ...
    let mut deep = b"\x80\x02".to_vec();
    deep.extend(b"]".repeat(100_000));
    deep.extend(b"a".repeat(99_999));
    deep.push(b'.');
    let mut object = opened(&deep).unwrap();
    let mut levels = 0;
    while let [inner] = object.items() {
        object = inner.clone();
        levels += 1;
    }
    assert!(matches!(object, Object::Cut));
    assert_eq!(levels, 201);
}

#[test]
fn pickles_that_grow_without_end_are_refused() {
    let start = Instant::now();
    // Lists of lists of lists, ten references each: 10^60 elements for whoever copies.
    let mut lists = b"\x80\x02]q\x00".to_vec();
    for level in 0..60_u8 {
        lists.extend([b"]".as_slice(), &[b'q', level + 1], b"("].concat());
        lists.extend([b'h', level].repeat(10));
        lists.push(b'e');
    }
    lists.push(b'.');
    assert_eq!(opened(&lists).unwrap().items().len(), 10);
    // A text of 100 kB that is encoded ten thousand times.
    let mut encoded = b"\x80\x02c_codecs\nencode\nq\x00X\xa0\x86\x01\x00".to_vec();
    encoded.extend(b"a".repeat(100_000));
    encoded.extend(b"\x85q\x01");
    encoded.extend(b"0h\x00h\x01R".repeat(10_000));
    encoded.push(b'.');
    assert!(refusal(&encoded).contains("repeats its content"));
    // Operations without end.
    let mut marks = b"\x80\x02".to_vec();
    marks.extend(b"(".repeat((1 << 24) + 1));
    assert!(refusal(&marks).contains("operations"));
    assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
}

#[test]
fn malformed_pickles_are_refused() {
    for (pickle, word) in [
        (&b""[..], "neither"),
        (b"<!DOCTYPE html>", "neither"),
        (b"version https://git-lfs.github.com/spec/v1", "git lfs pull"),
        (b"\x80\x02", "truncated"),
        (b"\x80\x02.", "stack"),
        (b"\x80\x02N(.", "stack"),
        (b"\x80\x02t.", "no mark"),
        (b"\x80\x02h\x07.", "object 7"),
        (b"\x80\x02NNs.", "stack"),
        (b"\x80\x02NNNs.", "holds nothing"),
        (b"\x80\x02}(Nu.", "key without"),
        (b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7f.", "truncated"),
        (b"\x80\x02X\x01\x00\x00\x00\xff.", "UTF-8"),
        (b"\x80\x02c\xff\na\n.", "UTF-8"),
        (b"\x80\x02\x82\x01.", "0x82"),
        (b"\x80\x02I1\n.", "protocol 0"),
        (b"PK\x03\x04nothing", "zip"),
    ] {
        let message = refusal(pickle);
        assert!(message.contains(word), "{message}");
        assert!(message.contains("weights"), "{message}");
    }
}

#[test]
fn a_file_without_tensors_is_no_network() {
    let (_folder, path) = file(b"\x80\x02}X\x01\x00\x00\x00aK\x01s.");
    let message = Parameters::open_pickle(&path).unwrap_err().to_string();
    assert!(message.contains("no dictionary of tensors"), "{message}");
}

/// Opens a file and reads all that it offers; whether it fails does not matter.
fn read_all(path: &Path) {
    if let Ok(parameters) = Parameters::open_pickle(path) {
        for name in parameters.names() {
            let _ = parameters.read(name, parameters.shape(name).unwrap());
        }
    }
    if let Ok(object) = open_pickle(path)
        && let Some(tensor) = object.tensor()
    {
        let _ = tensor.read_f64();
    }
}

/// Some byte, or an operation of the machine.
fn damage() -> impl Strategy<Value = u8> {
    prop_oneof![
        any::<u8>(),
        prop::sample::select(b".(012tld)]}abesuhqRQc\x81\x85\x86\x87\x8a\x90\x94".to_vec())
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_files_do_no_harm(
        which in 0_usize..7,
        changes in prop::collection::vec((any::<prop::sample::Index>(), damage()), 0..6),
        early in any::<bool>(),
        length in prop::option::weighted(0.2, any::<prop::sample::Index>()),
    ) {
        const NAMES: [&str; 7] = [
            "ckpt_zip", "ckpt_legacy", "ckpt_legacy_easydict", "fragment_f32_zip",
            "fragment_f64_legacy", "fragment_tensor_legacy", "fragment_tensor_zip",
        ];
        let Some(folder) = shared::path("golden/backbones/pth") else { return Ok(()) };
        let mut bytes = std::fs::read(folder.join(format!("{}.pth", NAMES[which]))).unwrap();
        for (place, byte) in changes {
            // The pickle is at the beginning.
            let place = place.index(if early { 800 } else { bytes.len() });
            bytes[place] = byte;
        }
        if let Some(length) = length {
            bytes.truncate(length.index(bytes.len()));
        }
        let (_folder, path) = file(&bytes);
        let start = Instant::now();
        read_all(&path);
        prop_assert!(start.elapsed().as_secs() < 5);
    }
}
