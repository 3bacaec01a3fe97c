//! The names and shapes of the tensors.

use super::GeoTransformerConfig;
use crate::checkpoint::Layout;

/// Kernel points of a convolution.
const KERNEL_POINTS: usize = 15;

/// The tensors of a `GeoTransformer` as its released checkpoints name them.
#[must_use]
pub fn layout(config: &GeoTransformerConfig) -> Layout {
    let mut tensors = Tensors(Layout::new());
    tensors.backbone(config);
    tensors.transformer(config);
    tensors.add("optimal_transport.alpha", &[]);
    tensors.0
}

struct Tensors(Layout);

impl Tensors {
    fn add(&mut self, name: &str, shape: &[usize]) {
        self.0.insert(name.to_owned(), shape.to_vec());
    }

    fn backbone(&mut self, config: &GeoTransformerConfig) {
        self.convolution("backbone.encoder1_1.KPConv", 1, config.width);
        self.affine("backbone.encoder1_1.norm.norm", config.width);
        self.residual("backbone.encoder1_2", config.width, config.channels(0));
        let stages = config.pyramid.stages;
        for stage in 1..stages {
            let (finer, channels) = (config.channels(stage - 1), config.channels(stage));
            let name = |block: usize| format!("backbone.encoder{}_{block}", stage + 1);
            self.residual(&name(1), finer, finer);
            self.residual(&name(2), finer, channels);
            self.residual(&name(3), channels, channels);
        }
        for stage in (1..stages.saturating_sub(1)).rev() {
            let inputs = config.channels(stage + 1) + config.channels(stage);
            let name = format!("backbone.decoder{}", stage + 1);
            if stage == 1 {
                self.linear(&format!("{name}.mlp"), inputs, config.features);
            } else {
                self.unary(&name, inputs, config.channels(stage));
            }
        }
    }

    fn residual(&mut self, name: &str, inputs: usize, outputs: usize) {
        let middle = outputs / 4;
        if inputs != middle {
            self.unary(&format!("{name}.unary1"), inputs, middle);
        }
        self.convolution(&format!("{name}.KPConv"), middle, middle);
        self.affine(&format!("{name}.norm_conv.norm"), middle);
        self.unary(&format!("{name}.unary2"), middle, outputs);
        if inputs != outputs {
            self.unary(&format!("{name}.unary_shortcut"), inputs, outputs);
        }
    }

    fn convolution(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.add(&format!("{name}.weights"), &[KERNEL_POINTS, inputs, outputs]);
        self.add(&format!("{name}.kernel_points"), &[KERNEL_POINTS, 3]);
        self.add(&format!("{name}.bias"), &[outputs]);
    }

    fn unary(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.linear(&format!("{name}.mlp"), inputs, outputs);
        self.affine(&format!("{name}.norm.norm"), outputs);
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.add(&format!("{name}.weight"), &[outputs, inputs]);
        self.add(&format!("{name}.bias"), &[outputs]);
    }

    fn affine(&mut self, name: &str, channels: usize) {
        self.add(&format!("{name}.weight"), &[channels]);
        self.add(&format!("{name}.bias"), &[channels]);
    }

    fn transformer(&mut self, config: &GeoTransformerConfig) {
        let sizes = &config.transformer;
        let hidden = sizes.hidden;
        self.add("transformer.embedding.embedding.div_term", &[hidden / 2]);
        self.linear("transformer.embedding.proj_d", hidden, hidden);
        self.linear("transformer.embedding.proj_a", hidden, hidden);
        let superpoints = config.channels(config.pyramid.stages.saturating_sub(1));
        self.linear("transformer.in_proj", superpoints, hidden);
        self.linear("transformer.out_proj", hidden, sizes.output);
        for layer in 0..2 * sizes.blocks {
            let name = format!("transformer.transformer.layers.{layer}");
            let projections: &[&str] =
                if layer % 2 == 0 { &["q", "k", "v", "p"] } else { &["q", "k", "v"] };
            for projection in projections {
                self.linear(
                    &format!("{name}.attention.attention.proj_{projection}"),
                    hidden,
                    hidden,
                );
            }
            self.linear(&format!("{name}.attention.linear"), hidden, hidden);
            self.affine(&format!("{name}.attention.norm"), hidden);
            self.linear(&format!("{name}.output.expand"), hidden, 2 * hidden);
            self.linear(&format!("{name}.output.squeeze"), 2 * hidden, hidden);
            self.affine(&format!("{name}.output.norm"), hidden);
        }
    }
}
