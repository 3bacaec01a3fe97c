//! The tensors of `ResUNetBN2C`.

use super::FcgfConfig;
use crate::checkpoint::{Layout, Parameters};

/// Channels of the four strides on the way down.
pub(super) const DOWN: [usize; 4] = [32, 64, 128, 256];
/// Channels of the strides 1, 2 and 4 on the way up.
pub(super) const UP: [usize; 3] = [64, 64, 128];
/// Channels before the last layer.
pub(super) const LAST: usize = 64;
/// The kernels with one offset: older files write `1 x inputs x outputs`, newer ones `inputs x outputs`.
const POINTWISE: [&str; 2] = ["conv1_tr.kernel", "final.kernel"];

/// The shape of every tensor of a model, kernels as `offsets x inputs x outputs`, as current files write them.
#[must_use]
pub fn layout(config: &FcgfConfig) -> Layout {
    let mut layout = Layout::new();
    let offsets = config.first_kernel.saturating_pow(3);
    layout.insert("conv1.kernel".to_owned(), vec![offsets, 1, DOWN[0]]);
    normalization(&mut layout, "norm1", DOWN[0]);
    block(&mut layout, "block1", DOWN[0]);
    for (level, (inputs, outputs)) in DOWN.into_iter().zip(DOWN.into_iter().skip(1)).enumerate() {
        stage(&mut layout, level + 2, "", [inputs, outputs]);
    }
    stage(&mut layout, 4, "_tr", [DOWN[3], UP[2]]);
    stage(&mut layout, 3, "_tr", [UP[2] + DOWN[2], UP[1]]);
    stage(&mut layout, 2, "_tr", [UP[1] + DOWN[1], UP[0]]);
    layout.insert("conv1_tr.kernel".to_owned(), vec![UP[0] + DOWN[0], LAST]);
    layout.insert("final.kernel".to_owned(), vec![LAST, config.features]);
    layout.insert("final.bias".to_owned(), vec![1, config.features]);
    layout
}

/// The same with kernels of one offset as the weights have them.
#[must_use]
pub fn layout_as_stored(config: &FcgfConfig, parameters: &Parameters) -> Layout {
    let mut layout = layout(config);
    for name in POINTWISE {
        if let (Some([1, rest @ ..]), Some(shape)) = (parameters.shape(name), layout.get_mut(name))
            && rest == shape.as_slice()
        {
            shape.insert(0, 1);
        }
    }
    layout
}

/// A convolution between strides, its normalisation and the block behind it.
fn stage(layout: &mut Layout, number: usize, suffix: &str, [inputs, outputs]: [usize; 2]) {
    layout.insert(format!("conv{number}{suffix}.kernel"), vec![27, inputs, outputs]);
    normalization(layout, &format!("norm{number}{suffix}"), outputs);
    block(layout, &format!("block{number}{suffix}"), outputs);
}

fn block(layout: &mut Layout, name: &str, channels: usize) {
    for part in 1..=2 {
        layout.insert(format!("{name}.conv{part}.kernel"), vec![27, channels, channels]);
        normalization(layout, &format!("{name}.norm{part}"), channels);
    }
}

fn normalization(layout: &mut Layout, name: &str, channels: usize) {
    for part in ["weight", "bias", "running_mean", "running_var"] {
        layout.insert(format!("{name}.bn.{part}"), vec![channels]);
    }
    layout.insert(format!("{name}.bn.num_batches_tracked"), Vec::new());
}
