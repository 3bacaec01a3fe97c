//! What the configurations say, against what the networks implement.
//!
//! The networks are those of Stable Diffusion 1.x. A setting that is absent has the default of the diffusers library; one
//! that differs from what is implemented is refused with what is expected, because the weights would still load and the
//! features would silently be wrong.

use rare::{Error, Result};
use serde_json::{Value, json};

use super::files::Json;
use super::places::Places;
use crate::diffusion::{ControlNetConfig, SchedulerConfig, TextConfig, UnetConfig};

/// Settings that both networks share, and the only value of each that is implemented.
fn shared_settings() -> Vec<(&'static str, Value)> {
    vec![
        ("act_fn", json!("silu")),
        (
            "down_block_types",
            json!([
                "CrossAttnDownBlock2D",
                "CrossAttnDownBlock2D",
                "CrossAttnDownBlock2D",
                "DownBlock2D"
            ]),
        ),
        ("mid_block_type", json!("UNetMidBlock2DCrossAttn")),
        ("in_channels", json!(4)),
        ("layers_per_block", json!(2)),
        ("transformer_layers_per_block", json!(1)),
        ("use_linear_projection", json!(false)),
        ("only_cross_attention", json!(false)),
        ("downsample_padding", json!(1)),
        ("mid_block_scale_factor", json!(1)),
        ("norm_eps", json!(1e-5)),
        ("flip_sin_to_cos", json!(true)),
        ("freq_shift", json!(0)),
        ("resnet_time_scale_shift", json!("default")),
        ("resnet_out_scale_factor", json!(1)),
        ("attention_type", json!("default")),
    ]
}

/// Settings of additions that Stable Diffusion 1.x does not have.
const ADDITIONS: [&str; 12] = [
    "class_embed_type",
    "num_class_embeds",
    "addition_embed_type",
    "encoder_hid_dim",
    "encoder_hid_dim_type",
    "time_cond_proj_dim",
    "projection_class_embeddings_input_dim",
    "num_attention_heads",
    "timestep_post_act",
    "time_embedding_dim",
    "time_embedding_act_fn",
    "cross_attention_norm",
];

/// A folder of another kind of pipeline is refused by the name in its `model_index.json`, if it has one.
pub(super) fn check_model_index(places: &Places) -> Result<()> {
    let Some(path) = places.file("model_index.json") else { return Ok(()) };
    let index = Json::read(path)?;
    let class =
        index.get("_class_name").and_then(Value::as_str).unwrap_or("StableDiffusionPipeline");
    if index.get("text_encoder_2").is_some() || class.contains("XL") {
        return Err(another(&index, "the folder holds Stable Diffusion XL"));
    }
    if !["StableDiffusionPipeline", "StableDiffusionControlNetPipeline"].contains(&class) {
        return Err(another(&index, &format!("the folder holds a {class}")));
    }
    Ok(())
}

/// The sizes of a U-Net.
pub(super) fn unet(json: &Json) -> Result<UnetConfig> {
    require(json, "_class_name", &json!("UNet2DConditionModel"))?;
    require(json, "out_channels", &json!(4))?;
    let up = json!(["UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"]);
    require(json, "up_block_types", &up)?;
    for key in ["center_input_sample", "dual_cross_attention", "resnet_skip_time_act"] {
        require(json, key, &json!(false))?;
    }
    require(json, "conv_in_kernel", &json!(3))?;
    require(json, "conv_out_kernel", &json!(3))?;
    require(json, "time_embedding_type", &json!("positional"))?;
    shared(json)
}

/// The sizes of a `ControlNet`.
pub(super) fn controlnet(json: &Json) -> Result<ControlNetConfig> {
    require(json, "_class_name", &json!("ControlNetModel"))?;
    require(json, "controlnet_conditioning_channel_order", &json!("rgb"))?;
    require(json, "conditioning_channels", &json!(3))?;
    require(json, "global_pool_conditions", &json!(false))?;
    Ok(ControlNetConfig {
        unet: shared(json)?,
        hint_channels: 3,
        hint_embedding_channels: json
            .sizes("conditioning_embedding_out_channels", [16, 32, 96, 256])?,
    })
}

/// What both networks have.
fn shared(json: &Json) -> Result<UnetConfig> {
    for (key, expected) in shared_settings() {
        require(json, key, &expected)?;
    }
    for key in ADDITIONS {
        require(json, key, &Value::Null)?;
    }
    let config = UnetConfig {
        in_channels: 4,
        block_out_channels: json.sizes("block_out_channels", [320, 640, 1280, 1280])?,
        heads: json.size("attention_head_dim", 8)?,
        cross_attention_dim: json.size("cross_attention_dim", 1280)?,
        groups: json.size("norm_num_groups", 32)?,
    };
    check_sizes(&config).map_err(|what| another(json, &what))?;
    Ok(config)
}

/// The sizes must be possible, and not those of later models.
pub(super) fn check_sizes(config: &UnetConfig) -> std::result::Result<(), String> {
    if let 1024 | 1280 | 2048 = config.cross_attention_dim {
        return Err(format!(
            "the context has {} values per token (Stable Diffusion 1.x has 768, 2.x 1024, XL 2048)",
            config.cross_attention_dim
        ));
    }
    for (what, divisor) in [("attention heads", config.heads), ("groups", config.groups)] {
        let uneven =
            config.block_out_channels.iter().find(|channels| !channels.is_multiple_of(divisor));
        if let Some(channels) = uneven {
            return Err(format!("{channels} channels do not divide into {divisor} {what}"));
        }
    }
    Ok(())
}

/// The sizes of a text encoder.
pub(super) fn text_encoder(json: &Json) -> Result<TextConfig> {
    require(json, "model_type", &json!("clip_text_model"))?;
    // The default of the library is the value of Stable Diffusion 1.x; 2.x says "gelu".
    require(json, "hidden_act", &json!("quick_gelu"))?;
    let config = TextConfig {
        hidden_size: json.size("hidden_size", 512)?,
        intermediate_size: json.size("intermediate_size", 2048)?,
        heads: json.size("num_attention_heads", 8)?,
        layers: json.size("num_hidden_layers", 12)?,
        vocabulary: json.size("vocab_size", 49408)?,
        positions: json.size("max_position_embeddings", 77)?,
        epsilon: json.number("layer_norm_eps", 1e-5)? as f32,
    };
    if !config.hidden_size.is_multiple_of(config.heads) {
        let what =
            format!("{} values do not divide into {} heads", config.hidden_size, config.heads);
        return Err(Error::in_file(&json.path, what));
    }
    if !(config.epsilon > 0.0 && config.epsilon < 1.0) {
        return Err(Error::in_file(&json.path, format!("layer_norm_eps is {}", config.epsilon)));
    }
    Ok(config)
}

/// The noise schedule. Which sampler the file names does not matter, only the noise levels.
pub(super) fn scheduler(json: &Json) -> Result<SchedulerConfig> {
    require(json, "beta_schedule", &json!("scaled_linear"))?;
    require(json, "prediction_type", &json!("epsilon"))?;
    require(json, "trained_betas", &Value::Null)?;
    require(json, "rescale_betas_zero_snr", &json!(false))?;
    let known = SchedulerConfig::stable_diffusion_1();
    let offset = match json.get("steps_offset").map(|value| (value, value.as_u64())) {
        None => known.offset,
        Some((_, Some(0))) => 0,
        Some((_, Some(1))) => 1,
        Some((value, _)) => return Err(json.wrong("steps_offset", value, "0 or 1")),
    };
    let config = SchedulerConfig {
        beta_start: json.number("beta_start", known.beta_start)?,
        beta_end: json.number("beta_end", known.beta_end)?,
        training_steps: json.size("num_train_timesteps", known.training_steps)?,
        offset,
    };
    if !(config.beta_start > 0.0 && config.beta_start < config.beta_end && config.beta_end < 1.0) {
        let what = format!("the betas run from {} to {}", config.beta_start, config.beta_end);
        return Err(Error::in_file(&json.path, what));
    }
    Ok(config)
}

impl SchedulerConfig {
    /// The noise that Stable Diffusion 1.x was trained with, for weights without a configuration.
    #[must_use]
    pub fn stable_diffusion_1() -> SchedulerConfig {
        SchedulerConfig { beta_start: 0.000_85, beta_end: 0.012, training_steps: 1000, offset: 1 }
    }
}

/// Refuses a value other than `expected`; an absent one is the default of the library, which is the expected one.
fn require(json: &Json, key: &str, expected: &Value) -> Result<()> {
    match json.get(key) {
        None => Ok(()),
        Some(found) if same(found, expected) => Ok(()),
        Some(found) => {
            let wanted = if expected.is_null() { "none".to_owned() } else { expected.to_string() };
            Err(another(json, &format!("{key} is {found}, expected {wanted}")))
        }
    }
}

/// Numbers are compared by value: 1 and 1.0 are the same.
fn same(found: &Value, expected: &Value) -> bool {
    match (found.as_f64(), expected.as_f64()) {
        (Some(found), Some(expected)) => found == expected,
        _ => found == expected,
    }
}

fn another(json: &Json, what: &str) -> Error {
    Error::Unsupported(format!(
        "{}: {what}: only Stable Diffusion 1.x with its depth ControlNet is implemented",
        json.path.display()
    ))
}
