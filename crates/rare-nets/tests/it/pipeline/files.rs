//! Weight files in every format, made of the tiny pipeline: what a user may have.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use zip::write::SimpleFileOptions;

use crate::shared;

/// A tensor as it lies in a file.
#[derive(Debug, Clone)]
pub(super) struct Raw {
    pub(super) element: String,
    pub(super) shape: Vec<usize>,
    pub(super) bytes: Vec<u8>,
}

pub(super) type Tensors = BTreeMap<String, Raw>;

/// The golden pipeline, and a folder in which a test rearranges it.
pub(super) struct Tiny {
    pub(super) golden: PathBuf,
    pub(super) folder: TempDir,
}

impl Tiny {
    /// An empty folder; `None` where the shared data are missing.
    pub(super) fn new() -> Option<Tiny> {
        let golden = shared::path("golden/rare/tiny-pipeline")?;
        Some(Tiny { golden, folder: tempfile::tempdir().unwrap() })
    }

    /// A copy of the golden pipeline.
    pub(super) fn copied() -> Option<Tiny> {
        let tiny = Tiny::new()?;
        for part in ["unet", "controlnet", "text_encoder", "tokenizer", "scheduler"] {
            tiny.copy(part, part);
        }
        tiny.copy_file("model_index.json", "model_index.json");
        Some(tiny)
    }

    pub(super) fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Copies the folder `part` of the golden pipeline to `to`.
    pub(super) fn copy(&self, part: &str, to: &str) {
        for entry in fs::read_dir(self.golden.join(part)).unwrap() {
            let name = entry.unwrap().file_name().into_string().unwrap();
            self.copy_file(&format!("{part}/{name}"), &format!("{to}/{name}"));
        }
    }

    pub(super) fn copy_file(&self, from: &str, to: &str) {
        self.write(to, &fs::read(self.golden.join(from)).unwrap());
    }

    pub(super) fn write(&self, to: &str, bytes: &[u8]) {
        let to = self.path().join(to);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::write(to, bytes).unwrap();
    }

    pub(super) fn remove(&self, path: &str) {
        fs::remove_file(self.path().join(path)).unwrap();
    }

    /// The tensors of a part of the golden pipeline.
    pub(super) fn tensors(&self, part: &str) -> Tensors {
        let name = if part == "text_encoder" { "model" } else { "diffusion_pytorch_model" };
        let bytes = fs::read(self.golden.join(part).join(format!("{name}.safetensors"))).unwrap();
        let data = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header: serde_json::Map<String, serde_json::Value> =
            serde_json::from_slice(&bytes[8..data]).unwrap();
        let tensors = header.into_iter().filter(|(name, _)| name != "__metadata__");
        tensors
            .map(|(name, entry)| {
                let sizes = |key: &str| -> Vec<usize> {
                    serde_json::from_value(entry[key].clone()).unwrap()
                };
                let offsets = sizes("data_offsets");
                let bytes = bytes[data + offsets[0]..data + offsets[1]].to_vec();
                let element = entry["dtype"].as_str().unwrap().to_owned();
                (name, Raw { element, shape: sizes("shape"), bytes })
            })
            .collect()
    }

    /// Changes one setting of a JSON file.
    pub(super) fn set(&self, file: &str, key: &str, value: serde_json::Value) {
        let bytes = fs::read(self.path().join(file)).unwrap();
        let mut json: serde_json::Value = serde_json::from_slice(&bytes).unwrap();
        json[key] = value;
        self.write(file, &serde_json::to_vec(&json).unwrap());
    }
}

/// A safetensors file.
pub(super) fn safetensors(tensors: &Tensors, metadata: Option<&str>) -> Vec<u8> {
    let mut header = serde_json::Map::new();
    let mut data = Vec::new();
    if let Some(text) = metadata {
        header.insert("__metadata__".to_owned(), serde_json::json!({ "note": text }));
    }
    for (name, Raw { element, shape, bytes }) in tensors {
        let offsets = [data.len(), data.len() + bytes.len()];
        let entry = serde_json::json!({"dtype": element, "shape": shape, "data_offsets": offsets});
        header.insert(name.clone(), entry);
        data.extend(bytes);
    }
    let header = serde_json::to_vec(&header).unwrap();
    [&(header.len() as u64).to_le_bytes()[..], &header, &data].concat()
}

/// In half precision; every value of the tiny pipeline is exact in it.
pub(super) fn halved(tensors: &Tensors) -> Tensors {
    let half = |bytes: &[u8]| {
        let values = bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
        values.flat_map(|value| half::f16::from_f32(value).to_le_bytes()).collect()
    };
    let convert = |raw: &Raw| match raw.element.as_str() {
        "F32" => {
            Raw { element: "F16".to_owned(), shape: raw.shape.clone(), bytes: half(&raw.bytes) }
        }
        _ => raw.clone(),
    };
    tensors.iter().map(|(name, raw)| (name.clone(), convert(raw))).collect()
}

/// An archive of `torch.save`; the dictionary is under `state_dict` if `nested`.
pub(super) fn torch_archive(path: &Path, tensors: &Tensors, nested: bool) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut archive = zip::ZipWriter::new(File::create(path).unwrap());
    let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut add = |name: &str, bytes: &[u8]| {
        archive.start_file(format!("archive/{name}"), options).unwrap();
        archive.write_all(bytes).unwrap();
    };
    add("data.pkl", &pickle(tensors, nested));
    add("byteorder", b"little");
    for (key, raw) in tensors.values().enumerate() {
        add(&format!("data/{key}"), &raw.bytes);
    }
    add("version", b"3\n");
    archive.finish().unwrap();
}

/// The pickle of a dictionary of tensors.
fn pickle(tensors: &Tensors, nested: bool) -> Vec<u8> {
    let mut out = b"\x80\x02".to_vec();
    let text = |out: &mut Vec<u8>, text: &str| {
        out.push(b'X');
        out.extend((text.len() as u32).to_le_bytes());
        out.extend(text.as_bytes());
    };
    let sizes = |out: &mut Vec<u8>, sizes: &[usize]| {
        out.push(b'(');
        for &size in sizes {
            out.push(b'J');
            out.extend((size as i32).to_le_bytes());
        }
        out.push(b't');
    };
    if nested {
        out.push(b'}');
        text(&mut out, "state_dict");
    }
    out.extend(b"ccollections\nOrderedDict\n)R(");
    for (key, (name, raw)) in tensors.iter().enumerate() {
        text(&mut out, name);
        out.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        text(&mut out, "storage");
        let class = match raw.element.as_str() {
            "F32" => "FloatStorage",
            "I64" => "LongStorage",
            other => panic!("{other}"),
        };
        out.extend(format!("ctorch\n{class}\n").as_bytes());
        text(&mut out, &key.to_string());
        text(&mut out, "cpu");
        out.extend(b"K\x00tQK\x00");
        sizes(&mut out, &raw.shape);
        let stride = |axis: usize| raw.shape[axis + 1..].iter().product();
        sizes(&mut out, &(0..raw.shape.len()).map(stride).collect::<Vec<usize>>());
        out.extend(b"\x89ccollections\nOrderedDict\n)RtR");
    }
    out.push(b'u');
    if nested {
        out.push(b's');
    }
    out.push(b'.');
    out
}

/// The name of the original code for a tensor of the U-Net or the `ControlNet`.
pub(super) fn original_name(name: &str) -> String {
    let fixed = [
        ("time_embedding.linear_1.", "time_embed.0."),
        ("time_embedding.linear_2.", "time_embed.2."),
        ("conv_in.", "input_blocks.0.0."),
        ("conv_norm_out.", "out.0."),
        ("conv_out.", "out.2."),
        ("mid_block.resnets.0.", "middle_block.0."),
        ("mid_block.attentions.0.", "middle_block.1."),
        ("mid_block.resnets.1.", "middle_block.2."),
        ("controlnet_mid_block.", "middle_block_out.0."),
        ("controlnet_cond_embedding.conv_in.", "input_hint_block.0."),
        ("controlnet_cond_embedding.conv_out.", "input_hint_block.14."),
    ];
    let inside = |rest: &str| {
        let parts = [
            ("norm1.", "in_layers.0."),
            ("conv1.", "in_layers.2."),
            ("time_emb_proj.", "emb_layers.1."),
            ("norm2.", "out_layers.0."),
            ("conv2.", "out_layers.3."),
            ("conv_shortcut.", "skip_connection."),
        ];
        let part = parts.iter().find(|(ours, _)| rest.starts_with(ours));
        part.map_or(rest.to_owned(), |(ours, theirs)| rest.replacen(ours, theirs, 1))
    };
    if let Some((ours, theirs)) = fixed.iter().find(|(ours, _)| name.starts_with(ours)) {
        return format!("{theirs}{}", inside(&name[ours.len()..]));
    }
    let parts: Vec<&str> = name.splitn(5, '.').collect();
    let number = |at: usize| parts[at].parse::<usize>().unwrap();
    match (parts[0], parts.get(2).copied().unwrap_or_default()) {
        ("controlnet_down_blocks", _) => format!("zero_convs.{}.0.{}", parts[1], parts[2]),
        ("controlnet_cond_embedding", _) => {
            format!("input_hint_block.{}.{}", 2 + 2 * number(2), parts[3])
        }
        ("down_blocks", "resnets") => {
            format!("input_blocks.{}.0.{}", 1 + 3 * number(1) + number(3), inside(parts[4]))
        }
        ("down_blocks", "attentions") => {
            format!("input_blocks.{}.1.{}", 1 + 3 * number(1) + number(3), parts[4])
        }
        ("down_blocks", _) => {
            format!("input_blocks.{}.0.op.{}", 3 + 3 * number(1), &parts[4]["conv.".len()..])
        }
        (_, "resnets") => {
            format!("output_blocks.{}.0.{}", 3 * number(1) + number(3), inside(parts[4]))
        }
        (_, "attentions") => format!("output_blocks.{}.1.{}", 3 * number(1) + number(3), parts[4]),
        _ => {
            let module = if number(1) == 0 { 1 } else { 2 };
            format!("output_blocks.{}.{module}.{}", 3 * number(1) + 2, parts[4])
        }
    }
}
