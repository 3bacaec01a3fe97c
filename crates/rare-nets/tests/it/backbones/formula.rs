//! Weights that follow from their names, and lists of the tensors of official checkpoints.

use std::collections::BTreeMap;

use rare_nets::checkpoint::{Layout, Parameters};

use crate::shared;

/// Uniform numbers in -1..1 that depend on a tensor's name alone.
pub(crate) fn uniform(name: &str, count: usize) -> Vec<f32> {
    let seed = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
    });
    let number = |index: u64| {
        let step = (index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mut bits = seed.wrapping_add(step);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^= bits >> 31;
        ((bits >> 40) as f64 / f64::from(1 << 23) - 1.0) as f32
    };
    (0..count as u64).map(number).collect()
}

/// Opens `F32` tensors as a file would give them. The file is left to the system: it is read when it is asked for.
pub(crate) fn open_tensors(tensors: &[(String, Vec<usize>, Vec<f32>)]) -> Parameters {
    let mut header = BTreeMap::new();
    let mut data: Vec<u8> = Vec::new();
    for (name, shape, values) in tensors {
        assert_eq!(shape.iter().product::<usize>(), values.len(), "{name}");
        let begin = data.len();
        data.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let entry = serde_json::json!({
            "dtype": "F32", "shape": shape, "data_offsets": [begin, data.len()]
        });
        header.insert(name, entry);
    }
    let header = serde_json::to_vec(&header).unwrap();
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header);
    bytes.extend(data);
    let path = tempfile::tempdir().unwrap().keep().join("weights.safetensors");
    std::fs::write(&path, bytes).unwrap();
    Parameters::open(&path).unwrap()
}

/// The tensors of an official checkpoint: `golden/backbones/<name>.state_dict.txt`.
pub(crate) fn official_layout(name: &str) -> Option<Layout> {
    let path = shared::path(&format!("golden/backbones/{name}.state_dict.txt"))?;
    let text = std::fs::read_to_string(path).unwrap();
    let entry = |line: &str| {
        let (name, shape) = line.split_once(char::is_whitespace).unwrap();
        let sizes = shape.trim().trim_matches(['(', ')']).split(',');
        let sizes = sizes.map(str::trim).filter(|size| !size.is_empty());
        (name.to_owned(), sizes.map(|size| size.parse().unwrap()).collect())
    };
    Some(text.lines().filter(|line| !line.trim().is_empty()).map(entry).collect())
}
