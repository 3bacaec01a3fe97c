//! The names of the original code (latent diffusion, Rombach et al., 2022; `ControlNet`, Zhang et al., 2023) as those of
//! the diffusers library.
//!
//! The original counts all blocks of the encoder in one sequence: the first convolution, then three per level, of which
//! the third is the step to the next level. The decoder has three per level, the step to the next level inside the
//! third.

/// Blocks per level in the sequence of the original.
const PER_LEVEL: usize = 3;

/// The name of a tensor of the U-Net without its prefix.
pub(super) fn unet(name: &str) -> Option<String> {
    let (part, rest) = name.split_once('.')?;
    match part {
        "output_blocks" => {
            let (block, module, rest) = numbers(rest)?;
            output_block(block, module, rest)
        }
        "out" => match rest.split_once('.')? {
            ("0", rest) => Some(format!("conv_norm_out.{rest}")),
            ("2", rest) => Some(format!("conv_out.{rest}")),
            _ => None,
        },
        _ => encoder_half(part, rest),
    }
}

/// The name of a tensor of the `ControlNet` without its prefix.
pub(super) fn controlnet(name: &str) -> Option<String> {
    let (part, rest) = name.split_once('.')?;
    match part {
        "zero_convs" => match numbers(rest)? {
            (block, 0, rest) => Some(format!("controlnet_down_blocks.{block}.{rest}")),
            _ => None,
        },
        "middle_block_out" => Some(format!("controlnet_mid_block.{}", rest.strip_prefix("0.")?)),
        "input_hint_block" => {
            let (index, rest) = rest.split_once('.')?;
            // Every other module is an activation.
            match index.parse::<usize>().ok()? {
                0 => Some(format!("controlnet_cond_embedding.conv_in.{rest}")),
                14 => Some(format!("controlnet_cond_embedding.conv_out.{rest}")),
                index @ 2..=12 if index % 2 == 0 => {
                    Some(format!("controlnet_cond_embedding.blocks.{}.{rest}", index / 2 - 1))
                }
                _ => None,
            }
        }
        _ => encoder_half(part, rest),
    }
}

/// What both networks have.
fn encoder_half(part: &str, rest: &str) -> Option<String> {
    match part {
        "time_embed" => match rest.split_once('.')? {
            ("0", rest) => Some(format!("time_embedding.linear_1.{rest}")),
            ("2", rest) => Some(format!("time_embedding.linear_2.{rest}")),
            _ => None,
        },
        "input_blocks" => {
            let (block, module, rest) = numbers(rest)?;
            input_block(block, module, rest)
        }
        "middle_block" => {
            let (module, rest) = rest.split_once('.')?;
            match module {
                "0" => resnet("mid_block.resnets.0", rest),
                "1" => Some(format!("mid_block.attentions.0.{rest}")),
                "2" => resnet("mid_block.resnets.1", rest),
                _ => None,
            }
        }
        _ => None,
    }
}

fn input_block(block: usize, module: usize, rest: &str) -> Option<String> {
    let Some(block) = block.checked_sub(1) else {
        return (module == 0).then(|| format!("conv_in.{rest}"));
    };
    let (level, place) = (block / PER_LEVEL, block % PER_LEVEL);
    match (place, module) {
        (2, 0) => {
            Some(format!("down_blocks.{level}.downsamplers.0.conv.{}", rest.strip_prefix("op.")?))
        }
        (0 | 1, 0) => resnet(&format!("down_blocks.{level}.resnets.{place}"), rest),
        (0 | 1, 1) => Some(format!("down_blocks.{level}.attentions.{place}.{rest}")),
        _ => None,
    }
}

fn output_block(block: usize, module: usize, rest: &str) -> Option<String> {
    let (level, place) = (block / PER_LEVEL, block % PER_LEVEL);
    // The lowest level has no attention, so there the step to the next level is the second module, not the third.
    match (module, rest.strip_prefix("conv.")) {
        (0, None) => resnet(&format!("up_blocks.{level}.resnets.{place}"), rest),
        (1 | 2, Some(rest)) if place == 2 => {
            Some(format!("up_blocks.{level}.upsamplers.0.conv.{rest}"))
        }
        (1, None) => Some(format!("up_blocks.{level}.attentions.{place}.{rest}")),
        _ => None,
    }
}

/// The parts of a residual block.
fn resnet(block: &str, rest: &str) -> Option<String> {
    const PARTS: [(&str, &str); 6] = [
        ("in_layers.0.", "norm1"),
        ("in_layers.2.", "conv1"),
        ("emb_layers.1.", "time_emb_proj"),
        ("out_layers.0.", "norm2"),
        ("out_layers.3.", "conv2"),
        ("skip_connection.", "conv_shortcut"),
    ];
    let (part, rest) =
        PARTS.iter().find_map(|(theirs, ours)| Some((ours, rest.strip_prefix(theirs)?)))?;
    Some(format!("{block}.{part}.{rest}"))
}

/// Takes `<block>.<module>.` off.
fn numbers(name: &str) -> Option<(usize, usize, &str)> {
    let (block, rest) = name.split_once('.')?;
    let (module, rest) = rest.split_once('.')?;
    Some((block.parse().ok()?, module.parse().ok()?, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_the_unet() {
        for (theirs, ours) in [
            ("time_embed.0.weight", "time_embedding.linear_1.weight"),
            ("time_embed.2.bias", "time_embedding.linear_2.bias"),
            ("input_blocks.0.0.weight", "conv_in.weight"),
            ("input_blocks.1.0.in_layers.0.weight", "down_blocks.0.resnets.0.norm1.weight"),
            ("input_blocks.1.1.proj_in.weight", "down_blocks.0.attentions.0.proj_in.weight"),
            ("input_blocks.3.0.op.weight", "down_blocks.0.downsamplers.0.conv.weight"),
            ("input_blocks.4.0.skip_connection.bias", "down_blocks.1.resnets.0.conv_shortcut.bias"),
            ("input_blocks.8.1.norm.bias", "down_blocks.2.attentions.1.norm.bias"),
            ("input_blocks.11.0.emb_layers.1.bias", "down_blocks.3.resnets.1.time_emb_proj.bias"),
            ("middle_block.0.out_layers.3.weight", "mid_block.resnets.0.conv2.weight"),
            (
                "middle_block.1.transformer_blocks.0.attn2.to_k.weight",
                "mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight",
            ),
            ("middle_block.2.out_layers.0.bias", "mid_block.resnets.1.norm2.bias"),
            ("output_blocks.2.0.in_layers.2.weight", "up_blocks.0.resnets.2.conv1.weight"),
            ("output_blocks.2.1.conv.weight", "up_blocks.0.upsamplers.0.conv.weight"),
            ("output_blocks.3.1.proj_out.bias", "up_blocks.1.attentions.0.proj_out.bias"),
            ("output_blocks.5.2.conv.bias", "up_blocks.1.upsamplers.0.conv.bias"),
            ("output_blocks.8.2.conv.weight", "up_blocks.2.upsamplers.0.conv.weight"),
            ("output_blocks.11.1.norm.weight", "up_blocks.3.attentions.2.norm.weight"),
            ("out.0.weight", "conv_norm_out.weight"),
            ("out.2.bias", "conv_out.bias"),
        ] {
            assert_eq!(unet(theirs).as_deref(), Some(ours));
        }
        for other in
            ["out.1.weight", "input_blocks.x.0.weight", "input_blocks.3.0.conv.weight", "betas", ""]
        {
            assert_eq!(unet(other), None);
        }
    }

    #[test]
    fn names_of_the_controlnet() {
        for (theirs, ours) in [
            ("zero_convs.11.0.weight", "controlnet_down_blocks.11.weight"),
            ("middle_block_out.0.bias", "controlnet_mid_block.bias"),
            ("input_hint_block.0.weight", "controlnet_cond_embedding.conv_in.weight"),
            ("input_hint_block.2.weight", "controlnet_cond_embedding.blocks.0.weight"),
            ("input_hint_block.12.bias", "controlnet_cond_embedding.blocks.5.bias"),
            ("input_hint_block.14.bias", "controlnet_cond_embedding.conv_out.bias"),
            ("input_blocks.6.0.op.bias", "down_blocks.1.downsamplers.0.conv.bias"),
        ] {
            assert_eq!(controlnet(theirs).as_deref(), Some(ours));
        }
        for other in
            ["input_hint_block.3.weight", "input_hint_block.16.weight", "output_blocks.0.0.weight"]
        {
            assert_eq!(controlnet(other), None);
        }
    }
}
