//! Weights by a formula: a hash of the name of a tensor and the place of a number in it.

use std::path::Path;

use rare_nets::checkpoint::{Layout, Parameters};

/// Numbers from -1 to 1 that single precision holds exactly.
pub(super) fn uniform(name: &str, count: usize) -> impl Iterator<Item = f64> {
    let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3)
    });
    (1..=count as u64).map(move |place| {
        let mut z = hash.wrapping_add(place.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^= z >> 31;
        (z >> 40) as f64 / 8_388_608.0 - 1.0
    })
}

/// The numbers of a tensor; `None` for kernel points, which have no formula.
pub(super) fn values(name: &str, shape: &[usize]) -> Option<Vec<f32>> {
    let count = shape.iter().product();
    let spread = |center: f64, width: f64| -> Option<Vec<f32>> {
        Some(uniform(name, count).map(|u| (center + width * u) as f32).collect())
    };
    if name.ends_with("kernel_points") {
        None
    } else if name.ends_with("div_term") {
        let term =
            |place: usize| (-(2.0 * place as f64) * 10_000_f64.ln() / (2 * count) as f64).exp();
        Some((0..count).map(|place| term(place) as f32).collect())
    } else if name.ends_with("alpha") {
        Some(vec![1.0])
    } else if name.ends_with("bias") {
        spread(0.0, 0.1)
    } else if name.ends_with("norm.weight") {
        spread(1.0, 0.2)
    } else if let [_, inputs, _] = shape {
        spread(0.0, (3.0 / *inputs as f64).sqrt())
    } else {
        let gain = if name.contains("decoder2") { 4.0 } else { 1.0 };
        spread(0.0, gain * (3.0 / shape[1] as f64).sqrt())
    }
}

/// A weight file of this layout in `folder`; `kernel_points` gives those of each convolution.
pub(super) fn parameters(
    folder: &Path,
    layout: &Layout,
    kernel_points: impl Fn(&str) -> Vec<f32>,
) -> Parameters {
    let tensor = |(name, shape): (&String, &Vec<usize>)| {
        let numbers = values(name, shape).unwrap_or_else(|| kernel_points(name));
        (name.clone(), shape.clone(), numbers)
    };
    open_tensors(folder, &layout.iter().map(tensor).collect::<Vec<_>>())
}

/// A weight file of these tensors in `folder`.
pub(super) fn open_tensors(
    folder: &Path,
    tensors: &[(String, Vec<usize>, Vec<f32>)],
) -> Parameters {
    let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
    for (name, shape, numbers) in tensors {
        let start = data.len();
        data.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        let entry = serde_json::json!({
            "dtype": "F32", "shape": shape, "data_offsets": [start, data.len()]
        });
        header.insert(name.clone(), entry);
    }
    let header = serde_json::to_vec(&header).unwrap();
    let file = folder.join("formula.safetensors");
    let length = (header.len() as u64).to_le_bytes();
    std::fs::write(&file, [&length[..], &header, &data].concat()).unwrap();
    Parameters::open(&file).unwrap()
}
