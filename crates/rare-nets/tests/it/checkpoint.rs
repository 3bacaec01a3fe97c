//! Weight files: what is read must be what was written, and nothing hostile may do harm.

use std::path::PathBuf;

use rare_nets::checkpoint::Parameters;
use rare_nets::{Parameter, Values};
use tempfile::TempDir;

use crate::shared;

mod pickle;

/// A file with these bytes, in a folder that goes when the test ends.
fn file(bytes: &[u8]) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights");
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

/// A safetensors file with this header and data.
fn safetensors(header: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

fn refusal(bytes: &[u8]) -> String {
    let (_folder, path) = file(bytes);
    let message =
        Parameters::open_safetensors(std::slice::from_ref(&path)).unwrap_err().to_string();
    assert!(message.contains(&path.display().to_string()), "{message}");
    message
}

#[test]
fn a_safetensors_file_reads_in_its_own_precision() {
    let header = r#"{"__metadata__":{"format":"pt"},
        "a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},
        "b":{"dtype":"F16","shape":[1,2],"data_offsets":[8,12]},
        "c":{"dtype":"BF16","shape":[],"data_offsets":[12,14]},
        "d":{"dtype":"I64","shape":[1],"data_offsets":[14,22]},
        "e":{"dtype":"F32","shape":[0,3],"data_offsets":[22,22]}}"#;
    let mut data = Vec::new();
    data.extend([1.5_f32, -2.0].iter().flat_map(|value| value.to_le_bytes()));
    data.extend([0x3c00_u16, 0xc000, 0x3fc0].iter().flat_map(|value| value.to_le_bytes()));
    data.extend(7_i64.to_le_bytes());
    let (_folder, path) = file(&safetensors(header, &data));
    let parameters = Parameters::open_safetensors(&[path]).unwrap();
    assert_eq!(parameters.names().collect::<Vec<_>>(), ["a", "b", "c", "d", "e"]);
    assert_eq!(parameters.metadata()["format"], "pt");
    assert_eq!(parameters.shape("b"), Some(&[1, 2][..]));
    let read = |name: &str, shape: &[usize]| parameters.read(name, shape);
    assert_eq!(
        read("a", &[2]).unwrap(),
        Parameter { shape: vec![2], values: Values::F32(vec![1.5, -2.0]) }
    );
    let half = read("b", &[1, 2]).unwrap();
    assert!(matches!(half.values, Values::F16(_)));
    assert_eq!(half.to_f32(), [1.0, -2.0]);
    assert_eq!(read("c", &[]).unwrap().to_f32(), [1.5]);
    assert_eq!(read("e", &[0, 3]).unwrap().to_f32(), [0.0; 0]);
    for (name, shape, words) in [
        ("a", &[1, 2][..], &["weights", "tensor a", "[2]", "[1, 2]"][..]),
        ("d", &[1], &["tensor d", "I64"]),
        ("z", &[3], &["weights", "no tensor z", "[3]"]),
    ] {
        let message = read(name, shape).unwrap_err().to_string();
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
}

#[test]
fn values_that_are_not_finite_are_counted() {
    let header = r#"{"w":{"dtype":"F16","shape":[300000],"data_offsets":[0,600000]}}"#;
    let mut data = vec![0; 600_000];
    for at in [0, 131_072, 299_999] {
        data[2 * at..2 * at + 2].copy_from_slice(&half::f16::INFINITY.to_le_bytes());
    }
    let (_folder, path) = file(&safetensors(header, &data));
    let parameters = Parameters::open_safetensors(&[path]).unwrap();
    let message = parameters.read("w", &[300_000]).unwrap_err().to_string();
    assert!(message.contains("tensor w: 3 of 300000 values are not finite"), "{message}");
}

#[test]
fn malformed_safetensors_are_refused() {
    let one = |entry: &str| format!("{{\"w\":{entry}}}");
    let good = one(r#"{"dtype":"F32","shape":[2],"data_offsets":[0,8]}"#);
    for (bytes, word) in [
        (vec![1, 2, 3], "3 bytes"),
        (u64::MAX.to_le_bytes().to_vec(), "claims a header of 18446744073709551615"),
        (99_000_000_u64.to_le_bytes().to_vec(), "truncated"),
        (safetensors(&good, &[0; 7]), "truncated"),
        (safetensors(&good, &[0; 9]), "9 are there"),
        (safetensors("[]", &[]), "does not parse"),
        (safetensors("{\"w\": ", &[]), "does not parse"),
        (safetensors(&format!("{{\"w\":{}", "[".repeat(100_000)), &[]), "does not parse"),
        (safetensors(&one(r#"{"dtype":"F33","shape":[2],"data_offsets":[0,8]}"#), &[0; 8]), "F33"),
        (
            safetensors(&one(r#"{"dtype":"F32","shape":[3],"data_offsets":[0,8]}"#), &[0; 8]),
            "tensor w",
        ),
        (
            safetensors(&one(r#"{"dtype":"F32","shape":[2],"data_offsets":[8,0]}"#), &[0; 8]),
            "tensor w",
        ),
        (
            safetensors(
                &one(r#"{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}"#),
                &[],
            ),
            "tensor w",
        ),
        (
            safetensors(&one(r#"{"dtype":"F32","shape":[-2],"data_offsets":[0,8]}"#), &[0; 8]),
            "does not parse",
        ),
        (
            safetensors(
                r#"{"v":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"w":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}}"#,
                &[0; 12],
            ),
            "tensor w begins at byte 4",
        ),
        (
            safetensors(
                r#"{"w":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"w":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}}"#,
                &[0; 8],
            ),
            "occurs twice",
        ),
    ] {
        let message = refusal(&bytes);
        assert!(message.contains(word), "{message}");
    }
    let mut bytes = safetensors(&good, &[0; 8]);
    bytes[10] = 0xff;
    assert!(refusal(&bytes).contains("does not parse"));
}

#[test]
fn files_are_put_together_unless_they_share_a_name() {
    let with = |name: &str, value: f32| {
        let header = format!(r#"{{"{name}":{{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}}}"#);
        file(&safetensors(&header, &value.to_le_bytes()))
    };
    let (first, second) = (with("a", 1.0), with("b", 2.0));
    let both = [first.1.clone(), second.1];
    let parameters = Parameters::open_safetensors(&both).unwrap();
    assert_eq!(parameters.read("b", &[1]).unwrap().to_f32(), [2.0]);
    assert_eq!(parameters.files(), both);
    let again = with("a", 3.0);
    let message = Parameters::open_safetensors(&[first.1, again.1]).unwrap_err().to_string();
    assert!(message.contains("tensor a is also in"), "{message}");
}

#[test]
fn the_tiny_unet_opens() {
    let Some(path) =
        shared::path("golden/rare/tiny-pipeline/unet/diffusion_pytorch_model.safetensors")
    else {
        return;
    };
    let parameters = Parameters::open_safetensors(&[path]).unwrap();
    assert_eq!(parameters.names().count(), 686);
    let weight = parameters.read("conv_in.weight", &[16, 4, 3, 3]).unwrap();
    assert_eq!(weight.to_f32().len(), 576);
}
