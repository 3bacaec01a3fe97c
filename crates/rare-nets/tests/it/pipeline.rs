//! Pipelines in every layout that users have: the same tensors must come out of all of them.

use std::fs;
use std::path::Path;

use rare_nets::checkpoint::Parameters;
use rare_nets::diffusion::{ControlNetConfig, Pipeline, SchedulerConfig, TextConfig, UnetConfig};
use serde_json::json;

mod files;
mod refused;

use files::{Raw, Tensors, Tiny, halved, original_name, safetensors, torch_archive};

/// All parts must hold the tensors of the golden pipeline, under the names of the diffusers library.
fn check(tiny: &Tiny, pipeline: &Pipeline) {
    check_part(&tiny.tensors("unet"), &pipeline.unet);
    check_part(&tiny.tensors("controlnet"), &pipeline.controlnet);
    check_part(&tiny.tensors("text_encoder"), &pipeline.text_encoder);
    let words = pipeline.remark.as_deref().unwrap();
    assert!(
        words.contains("cannot be the trained weights") && words.contains("[16, 24, 40, 40]"),
        "{words}"
    );
    let tokenizer = pipeline.tokenizer.as_ref().unwrap();
    assert!(tokenizer.vocabulary.ends_with("vocab.json"));
    assert!(tokenizer.merges.ends_with("merges.txt"));
    assert!(pipeline.files.iter().all(|file| file.is_file()));
    assert!(pipeline.files.contains(&tokenizer.merges));
}

fn check_part(expected: &Tensors, found: &Parameters) {
    let names: Vec<&str> = found.names().collect();
    let wanted: Vec<&str> = expected.keys().map(String::as_str).collect();
    assert_eq!(names, wanted);
    for (name, Raw { element, shape, bytes }) in expected {
        if element == "F32" {
            let values: Vec<f32> =
                bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
            assert_eq!(found.read(name, shape).unwrap().to_f32(), values, "{name}");
        } else {
            assert_eq!(found.shape(name), Some(&shape[..]));
        }
    }
}

fn tiny_unet() -> UnetConfig {
    UnetConfig {
        in_channels: 4,
        block_out_channels: [16, 24, 40, 40],
        heads: 8,
        cross_attention_dim: 24,
        groups: 8,
    }
}

fn check_configurations(pipeline: &Pipeline, text_heads: usize) {
    assert_eq!(pipeline.unet_config, tiny_unet());
    let controlnet = ControlNetConfig {
        unet: tiny_unet(),
        hint_channels: 3,
        hint_embedding_channels: [16, 32, 96, 256],
    };
    assert_eq!(pipeline.controlnet_config, controlnet);
    let text = TextConfig {
        hidden_size: 24,
        intermediate_size: 96,
        heads: text_heads,
        layers: 3,
        vocabulary: 49408,
        positions: 77,
        epsilon: 1e-5,
    };
    assert_eq!(pipeline.text_config, text);
    let scheduler =
        SchedulerConfig { beta_start: 0.000_85, beta_end: 0.012, training_steps: 1000, offset: 1 };
    assert_eq!(pipeline.scheduler, scheduler);
}

fn open(path: &Path) -> Pipeline {
    Pipeline::open(path).unwrap()
}

#[test]
fn the_folders_of_diffusers_open() {
    let Some(tiny) = Tiny::new() else { return };
    let pipeline = open(&tiny.golden);
    check(&tiny, &pipeline);
    check_configurations(&pipeline, 4);
    let names: Vec<String> = pipeline
        .files
        .iter()
        .map(|file| file.strip_prefix(&tiny.golden).unwrap().display().to_string())
        .collect();
    assert_eq!(
        names,
        [
            "controlnet/config.json",
            "controlnet/diffusion_pytorch_model.safetensors",
            "scheduler/scheduler_config.json",
            "text_encoder/config.json",
            "text_encoder/model.safetensors",
            "tokenizer/merges.txt",
            "tokenizer/vocab.json",
            "unet/config.json",
            "unet/diffusion_pytorch_model.safetensors",
        ]
    );
}

#[test]
fn the_controlnet_may_keep_its_own_name() {
    let Some(tiny) = Tiny::copied() else { return };
    for name in ["control_v11f1p_sd15_depth", "sd-controlnet-depth"] {
        let to = tiny.path().join(name);
        fs::rename(tiny.path().join("controlnet"), &to).unwrap();
        check(&tiny, &open(tiny.path()));
        fs::rename(to, tiny.path().join("controlnet")).unwrap();
    }
}

#[test]
fn a_text_encoder_without_prefix_opens() {
    // As version 5 of the transformers library writes it.
    let Some(tiny) = Tiny::copied() else { return };
    let tensors = tiny.tensors("text_encoder").into_iter();
    let tensors =
        tensors.map(|(name, raw)| (name["text_model.".len()..].to_owned(), raw)).collect();
    tiny.write("text_encoder/model.safetensors", &safetensors(&tensors, None));
    check(&tiny, &open(tiny.path()));
}

#[test]
fn variants_shards_and_pickles_open() {
    let Some(tiny) = Tiny::copied() else { return };
    let unet = tiny.tensors("unet");
    // Half precision only.
    let half = safetensors(&halved(&unet), None);
    tiny.write("unet/diffusion_pytorch_model.fp16.safetensors", &half);
    let taken = |pipeline: &Pipeline| {
        pipeline
            .unet
            .files()
            .iter()
            .map(|file| file.file_name().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(taken(&open(tiny.path())), ["diffusion_pytorch_model.safetensors"]);
    tiny.remove("unet/diffusion_pytorch_model.safetensors");
    let pipeline = open(tiny.path());
    assert_eq!(taken(&pipeline), ["diffusion_pytorch_model.fp16.safetensors"]);
    check(&tiny, &pipeline);
    // Shards.
    let (mut shards, mut map) = ([Tensors::new(), Tensors::new()], serde_json::Map::new());
    for (index, (name, raw)) in unet.iter().enumerate() {
        shards[index % 2].insert(name.clone(), raw.clone());
        map.insert(name.clone(), json!(format!("part-{}.safetensors", index % 2)));
    }
    for (index, shard) in shards.iter().enumerate() {
        tiny.write(&format!("unet/part-{index}.safetensors"), &safetensors(shard, None));
    }
    let index = "unet/diffusion_pytorch_model.safetensors.index.json";
    tiny.write(index, &serde_json::to_vec(&json!({ "weight_map": map })).unwrap());
    let pipeline = open(tiny.path());
    assert_eq!(taken(&pipeline), ["part-0.safetensors", "part-1.safetensors"]);
    check(&tiny, &pipeline);
    for (file, word) in
        [("../part-0.safetensors", "not beside"), ("part-0.safetensors", "none of the files")]
    {
        let wrong = json!({ "weight_map": { "conv_in.weight": file, "x": file } });
        tiny.write(index, &serde_json::to_vec(&wrong).unwrap());
        let message = Pipeline::open(tiny.path()).unwrap_err().to_string();
        assert!(message.contains(word) && message.contains("index.json"), "{message}");
    }
    tiny.remove(index);
    // Pickles.
    tiny.remove("unet/diffusion_pytorch_model.fp16.safetensors");
    torch_archive(&tiny.path().join("unet/diffusion_pytorch_model.bin"), &unet, false);
    tiny.remove("text_encoder/model.safetensors");
    torch_archive(
        &tiny.path().join("text_encoder/pytorch_model.bin"),
        &tiny.tensors("text_encoder"),
        false,
    );
    check(&tiny, &open(tiny.path()));
}

/// The tensors of the golden base model as the original code names them, with everything else that its files contain.
fn original_base(tiny: &Tiny) -> Tensors {
    let unet = tiny.tensors("unet");
    let unet = unet.iter().flat_map(|(name, raw)| {
        let name = original_name(name);
        let averaged = format!("model_ema.diffusion_model{}", name.replace('.', ""));
        [(format!("model.diffusion_model.{name}"), raw.clone()), (averaged, raw.clone())]
    });
    let text = tiny.tensors("text_encoder");
    let text =
        text.into_iter().map(|(name, raw)| (format!("cond_stage_model.transformer.{name}"), raw));
    let other = ["betas", "first_stage_model.decoder.conv_in.weight", "model_ema.decay"];
    let one = Raw { element: "F32".to_owned(), shape: vec![1], bytes: vec![0; 4] };
    let other = other.map(|name| (name.to_owned(), one.clone()));
    unet.chain(text).chain(other).collect()
}

/// The tensors of the golden `ControlNet` as the original code names them, after `prefix`.
fn original_controlnet(tiny: &Tiny, prefix: &str) -> Tensors {
    let tensors = tiny.tensors("controlnet").into_iter();
    tensors.map(|(name, raw)| (format!("{prefix}{}", original_name(&name)), raw)).collect()
}

#[test]
fn the_files_of_the_original_code_open() {
    let Some(tiny) = Tiny::new() else { return };
    let base = original_base(&tiny);
    let bare = original_controlnet(&tiny, "");
    let prefixed = original_controlnet(&tiny, "control_model.");
    // The first release of the ControlNet holds the base model as well.
    let whole: Tensors = base.clone().into_iter().chain(prefixed.clone()).collect();
    tiny.copy("tokenizer", "tokenizer");
    tiny.write("v1-5-pruned-emaonly.safetensors", &safetensors(&base, None));
    tiny.write("control_v11f1p_sd15_depth.yaml", b"model:");
    for (name, tensors) in [
        ("control_v11f1p_sd15_depth.safetensors", &bare),
        ("control_v11f1p_sd15_depth.safetensors", &prefixed),
        ("controlnet/control_v11f1p_sd15_depth_ft.safetensors", &tiny.tensors("controlnet")),
        ("control_sd15_depth.safetensors", &whole),
    ] {
        tiny.write(name, &safetensors(tensors, None));
        let pipeline = open(tiny.path());
        check(&tiny, &pipeline);
        // The number of heads of the text encoder cannot be seen in the tensors.
        check_configurations(&pipeline, 12);
        tiny.remove(name);
    }
    for name in ["control_v11f1p_sd15_depth.pth", "control_sd15_depth.pth"] {
        let tensors = if name.contains("v11") { &prefixed } else { &whole };
        torch_archive(&tiny.path().join(name), tensors, false);
        check(&tiny, &open(tiny.path()));
    }
    tiny.remove("v1-5-pruned-emaonly.safetensors");
    torch_archive(&tiny.path().join("v1-5-pruned.ckpt"), &base, true);
    let pipeline = open(tiny.path());
    check(&tiny, &pipeline);
    assert!(pipeline.unet.files()[0].ends_with("v1-5-pruned.ckpt"));
    // A tensor is named as in the file, too.
    let message = pipeline.unet.read("conv_in.weight", &[1]).unwrap_err().to_string();
    assert!(message.contains("model.diffusion_model.input_blocks.0.0.weight"), "{message}");
}

#[test]
fn the_tokenizer_may_be_missing_but_not_halved() {
    let Some(tiny) = Tiny::copied() else { return };
    tiny.remove("tokenizer/merges.txt");
    let message = Pipeline::open(tiny.path()).unwrap_err().to_string();
    assert!(message.contains("merges.txt"), "{message}");
    tiny.remove("tokenizer/vocab.json");
    assert_eq!(open(tiny.path()).tokenizer, None);
}

#[test]
fn a_single_controlnet_goes_with_a_folder() {
    let Some(tiny) = Tiny::copied() else { return };
    fs::remove_dir_all(tiny.path().join("controlnet")).unwrap();
    let tensors = original_controlnet(&tiny, "control_model.");
    tiny.write("controlnet/control_v11f1p_sd15_depth.safetensors", &safetensors(&tensors, None));
    let pipeline = open(tiny.path());
    check(&tiny, &pipeline);
    check_configurations(&pipeline, 4);
}

#[test]
fn the_cache_of_the_hub_opens() {
    let Some(tiny) = Tiny::new() else { return };
    let base = "models--stable-diffusion-v1-5--stable-diffusion-v1-5";
    for part in ["unet", "text_encoder", "tokenizer", "scheduler"] {
        tiny.copy(part, &format!("{base}/snapshots/abc/{part}"));
    }
    tiny.copy_file("model_index.json", &format!("{base}/snapshots/abc/model_index.json"));
    tiny.write(&format!("{base}/snapshots/old/model_index.json"), b"not even JSON");
    // Another model beside it is left alone.
    tiny.write(
        "models--stable-diffusion-v1-5--stable-diffusion-inpainting/snapshots/1/unet/config.json",
        b"",
    );
    let controlnet = "models--lllyasviel--control_v11f1p_sd15_depth";
    tiny.copy("controlnet", &format!("{controlnet}/snapshots/def"));
    let message = Pipeline::open(tiny.path()).unwrap_err().to_string();
    assert!(message.contains("2 snapshots"), "{message}");
    tiny.write(&format!("{base}/refs/main"), b"abc");
    check(&tiny, &open(tiny.path()));
}

#[test]
fn notes_about_untrained_weights_are_found() {
    let Some(tiny) = Tiny::copied() else { return };
    let remark = || open(tiny.path()).remark.unwrap();
    let unet = tiny.tensors("unet");
    let noted = safetensors(&unet, Some("Randomly initialised for tests"));
    tiny.write("unet/diffusion_pytorch_model.safetensors", &noted);
    assert!(remark().contains("a weight file says \"randomly initiali\""), "{}", remark());
    tiny.set("unet/config.json", "_remark", json!("random weights"));
    assert!(remark().contains("config.json says \"random weights\""), "{}", remark());
    tiny.write("README.md", b"# Tiny\nAn UNTRAINED model");
    assert!(remark().contains("README.md says \"untrained\""), "{}", remark());
    // The description of the trained model talks of random prompts, and of what it was not trained for.
    tiny.write("README.md", b"10000 random prompts; the model was not trained to be factual");
    assert!(!remark().contains("README"), "{}", remark());
}
