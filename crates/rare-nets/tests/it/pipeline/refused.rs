//! Folders that are not Stable Diffusion 1.5 with a depth `ControlNet`, or not whole.

use std::fs;

use rare_nets::diffusion::Pipeline;
use serde_json::json;

use super::files::{Tiny, safetensors};
use super::{original_base, original_controlnet};

/// The message must contain all these words.
fn refused(tiny: &Tiny, words: &[&str]) {
    let message = Pipeline::open(tiny.path()).unwrap_err().to_string();
    for word in words {
        assert!(message.contains(word), "no {word:?} in: {message}");
    }
}

#[test]
fn settings_that_are_not_implemented_are_refused() {
    let Some(tiny) = Tiny::copied() else { return };
    let (unet, control) = ("unet/config.json", "controlnet/config.json");
    let (text, schedule) = ("text_encoder/config.json", "scheduler/scheduler_config.json");
    for (file, key, value, words) in [
        (
            unet,
            "use_linear_projection",
            json!(true),
            &["use_linear_projection is true, expected false"][..],
        ),
        (unet, "in_channels", json!(9), &["in_channels is 9, expected 4"]),
        (unet, "act_fn", json!("gelu"), &["act_fn", "silu"]),
        (
            unet,
            "attention_head_dim",
            json!([5, 10, 20, 20]),
            &["attention_head_dim is [5,10,20,20]"],
        ),
        (unet, "attention_head_dim", json!(7), &["do not divide into 7 attention heads"]),
        (unet, "attention_head_dim", json!(0), &["attention_head_dim is 0"]),
        (unet, "cross_attention_dim", json!(1024), &["1024 values per token", "768"]),
        (
            unet,
            "cross_attention_dim",
            json!(48),
            &["another model", "context of 24", "context of 48"],
        ),
        (unet, "block_out_channels", json!([16, 24, 40]), &["block_out_channels", "four sizes"]),
        (
            unet,
            "block_out_channels",
            json!([16, 24, 40, -1]),
            &["block_out_channels", "four sizes"],
        ),
        (
            unet,
            "down_block_types",
            json!(["DownBlock2D"]),
            &["down_block_types", "CrossAttnDownBlock2D"],
        ),
        (
            unet,
            "addition_embed_type",
            json!("text_time"),
            &["addition_embed_type", "expected none"],
        ),
        (
            unet,
            "_class_name",
            json!("FluxTransformer2DModel"),
            &["_class_name", "UNet2DConditionModel"],
        ),
        (unet, "norm_eps", json!(1e-6), &["norm_eps"]),
        (unet, "norm_num_groups", json!(16), &["do not divide into 16 groups"]),
        (
            control,
            "norm_num_groups",
            json!(4),
            &["ControlNet for another model", "4 groups", "8 groups"],
        ),
        (control, "conditioning_channels", json!(1), &["conditioning_channels is 1, expected 3"]),
        (control, "controlnet_conditioning_channel_order", json!("bgr"), &["rgb"]),
        (control, "global_pool_conditions", json!(true), &["global_pool_conditions"]),
        (text, "hidden_act", json!("gelu"), &["hidden_act is \"gelu\", expected \"quick_gelu\""]),
        (text, "hidden_size", json!(48), &["48 values per token", "takes 24", "different models"]),
        (text, "num_attention_heads", json!(5), &["5 heads"]),
        (schedule, "prediction_type", json!("v_prediction"), &["prediction_type", "epsilon"]),
        (schedule, "beta_schedule", json!("linear"), &["beta_schedule", "scaled_linear"]),
        (schedule, "beta_end", json!(1.5), &["betas run from 0.00085 to 1.5"]),
        (schedule, "steps_offset", json!(7), &["steps_offset is 7"]),
        (
            "model_index.json",
            "text_encoder_2",
            json!(["transformers", "x"]),
            &["Stable Diffusion XL"],
        ),
        ("model_index.json", "_class_name", json!("StableDiffusionInpaintPipeline"), &["Inpaint"]),
    ] {
        let before = fs::read(tiny.path().join(file)).unwrap();
        tiny.set(file, key, value);
        refused(&tiny, &[words, &[file]].concat());
        tiny.write(file, &before);
    }
    // The values of the library's defaults may be spelled out.
    tiny.set(unet, "use_linear_projection", json!(false));
    tiny.set(unet, "mid_block_scale_factor", json!(1.0));
    tiny.set(schedule, "prediction_type", json!("epsilon"));
    assert!(Pipeline::open(tiny.path()).is_ok());
}

#[test]
fn missing_parts_are_named() {
    let Some(tiny) = Tiny::new() else { return };
    refused(&tiny, &["no Stable Diffusion 1.5", "unet/", "v1-5-pruned", "found nothing"]);
    tiny.write("holiday.jpg", b"");
    refused(&tiny, &["found holiday.jpg"]);
    tiny.copy("unet", "unet");
    refused(&tiny, &["no text encoder", "text_encoder/"]);
    tiny.copy("text_encoder", "text_encoder");
    refused(&tiny, &["no noise schedule", "scheduler/scheduler_config.json"]);
    tiny.copy("scheduler", "scheduler");
    refused(
        &tiny,
        &["no depth ControlNet", "control_v11f1p_sd15_depth", "found holiday.jpg, scheduler"],
    );
    tiny.copy("controlnet", "controlnet");
    tiny.copy_file("tokenizer/vocab.json", "vocab.json");
    refused(&tiny, &["no tokenizer", "tokenizer/merges.txt"]);
    tiny.copy_file("tokenizer/merges.txt", "merges.txt");
    assert!(Pipeline::open(tiny.path()).is_ok());
    tiny.remove("unet/diffusion_pytorch_model.safetensors");
    refused(&tiny, &["unet", "no weights", "diffusion_pytorch_model.fp16.safetensors"]);
    tiny.remove("unet/config.json");
    refused(&tiny, &["unet", "no config.json"]);
    let nowhere = Pipeline::open(&tiny.path().join("nowhere")).unwrap_err().to_string();
    assert!(nowhere.contains("nowhere"), "{nowhere}");
}

#[test]
fn damaged_files_are_named() {
    let Some(tiny) = Tiny::copied() else { return };
    let weights = "controlnet/diffusion_pytorch_model.safetensors";
    let bytes = fs::read(tiny.path().join(weights)).unwrap();
    tiny.write(weights, &bytes[..bytes.len() / 2]);
    refused(&tiny, &[weights, "truncated"]);
    tiny.write(weights, b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n");
    refused(&tiny, &[weights, "git lfs pull"]);
    tiny.write(weights, &bytes);
    tiny.write("unet/config.json", b"{");
    refused(&tiny, &["unet/config.json", "does not parse"]);
}

#[test]
fn single_files_of_other_models_are_refused() {
    let Some(tiny) = Tiny::new() else { return };
    tiny.copy("tokenizer", "tokenizer");
    let control = safetensors(&original_controlnet(&tiny, ""), None);
    tiny.write("control_v11f1p_sd15_depth.safetensors", &control);
    let base = original_base(&tiny);
    let with = |name: &str, shape: &[usize]| {
        let mut tensors = base.clone();
        let raw = tensors.entry(name.to_owned()).or_insert_with(|| base["betas"].clone());
        raw.shape = shape.to_vec();
        raw.bytes = vec![0; 4 * shape.iter().product::<usize>()];
        tiny.write("v1-5-pruned.safetensors", &safetensors(&tensors, None));
    };
    with("conditioner.embedders.0.x", &[1]);
    refused(&tiny, &["v1-5-pruned.safetensors", "Stable Diffusion XL"]);
    with("cond_stage_model.model.x", &[1]);
    refused(&tiny, &["Stable Diffusion 2.x"]);
    with("model.diffusion_model.input_blocks.0.0.weight", &[16, 9, 3, 3]);
    refused(&tiny, &["9 channels", "inpainting"]);
    with("model.diffusion_model.input_blocks.1.1.proj_in.weight", &[16, 16]);
    refused(&tiny, &["linear projections"]);
    with("model.diffusion_model.input_blocks.0.0.weight", &[0, 4, 3, 3]);
    assert!(Pipeline::open(tiny.path()).is_ok());
    // A file of the U-Net alone.
    let unet = base.iter().filter(|(name, _)| name.starts_with("model."));
    let unet = unet.map(|(name, raw)| (name.clone(), raw.clone())).collect();
    tiny.write("v1-5-pruned.safetensors", &safetensors(&unet, None));
    refused(&tiny, &["v1-5-pruned.safetensors", "text_model.embeddings.token_embedding.weight"]);
}
