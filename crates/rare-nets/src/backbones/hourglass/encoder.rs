//! Kernel point convolutions from the finest stage to the coarsest (Thomas et al., ICCV 2019).

use rare::{Error, Result};

use crate::Matrix;
use crate::backbones::kpconv::{
    ConvolutionBlock, NormalizationKind, Pyramid, PyramidConfig, ResidualBlock,
};
use crate::checkpoint::Layout;
use crate::engine::CpuBackend;
use crate::layers::Weights;

/// Points of a kernel.
const KERNEL_POINTS: usize = 15;
/// The width of a block over that of its convolution.
const BOTTLENECK: usize = 4;

/// The sizes of an encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::backbones) struct EncoderSizes {
    /// Channels of the finest stage; each coarser one has twice as many.
    pub(in crate::backbones) width: usize,
    /// Number of stages.
    pub(in crate::backbones) stages: usize,
    /// Residual blocks of each stage but the finest, which has one, beside the strided block that leads there.
    pub(in crate::backbones) blocks: usize,
}

/// A residual block: its place in the network and its channels.
struct Block {
    number: usize,
    /// The stage whose features it takes.
    level: usize,
    strided: bool,
    inputs: usize,
    outputs: usize,
}

impl EncoderSizes {
    /// Channels of the coarsest stage.
    pub(in crate::backbones) fn coarsest(&self) -> usize {
        self.width << self.stages.saturating_sub(1)
    }

    /// All residual blocks in order; block 0 is a plain convolution before them.
    fn blocks(&self) -> Vec<Block> {
        let mut blocks = Vec::new();
        let mut inputs = self.width / 2;
        let mut add = |level: usize, strided: bool, outputs: usize| {
            blocks.push(Block { number: blocks.len() + 1, level, strided, inputs, outputs });
            inputs = outputs;
        };
        add(0, false, self.width);
        for level in 1..self.stages {
            add(level - 1, true, self.width << (level - 1));
            (0..self.blocks).for_each(|_| add(level, false, self.width << level));
        }
        blocks
    }

    /// Adds the tensors of an encoder whose names begin with `prefix`.
    pub(in crate::backbones) fn add_to(&self, layout: &mut Layout, prefix: &str) {
        convolution(layout, &format!("{prefix}.0"), 1, self.width / 2);
        for block in self.blocks() {
            let Block { number, inputs, outputs, .. } = block;
            let name = format!("{prefix}.{number}");
            let narrow = outputs / BOTTLENECK;
            if inputs != narrow {
                layout.insert(format!("{name}.unary1.mlp.weight"), vec![narrow, inputs]);
            }
            convolution(layout, &name, narrow, narrow);
            layout.insert(format!("{name}.unary2.mlp.weight"), vec![outputs, narrow]);
            if inputs != outputs {
                layout.insert(format!("{name}.unary_shortcut.mlp.weight"), vec![outputs, inputs]);
            }
        }
    }
}

fn convolution(layout: &mut Layout, name: &str, inputs: usize, outputs: usize) {
    layout.insert(format!("{name}.KPConv.weights"), vec![KERNEL_POINTS, inputs, outputs]);
    layout.insert(format!("{name}.KPConv.kernel_points"), vec![KERNEL_POINTS, 3]);
}

/// Convolutions of all stages, each with the normalisation over both clouds.
pub(in crate::backbones) struct Encoder {
    first: ConvolutionBlock,
    blocks: Vec<(Block, ResidualBlock)>,
}

/// What an encoder makes of two clouds; rows are the points of a stage, both clouds stacked.
pub(in crate::backbones) struct Encoded {
    /// Features of every stage but the coarsest, the finest first.
    pub(in crate::backbones) skipped: Vec<Matrix>,
    /// Features of the coarsest stage.
    pub(in crate::backbones) coarsest: Matrix,
}

impl Encoder {
    /// Reads the tensors whose names begin with `prefix`.
    ///
    /// # Errors
    /// Those of [`Weights::values`].
    pub(in crate::backbones) fn read(
        cpu: &CpuBackend,
        weights: &Weights<'_>,
        prefix: &str,
        sizes: &EncoderSizes,
        pyramid: &PyramidConfig,
    ) -> Result<Encoder> {
        let kind = NormalizationKind::Instance;
        let block = |block: Block| {
            let name = format!("{prefix}.{}", block.number);
            let sigma = pyramid.sigma(block.level);
            let loaded = ResidualBlock::load(cpu, weights, &name, kind, sigma, block.strided)?;
            Ok((block, loaded))
        };
        let (name, sigma) = (format!("{prefix}.0"), pyramid.sigma(0));
        Ok(Encoder {
            first: ConvolutionBlock::load(cpu, weights, &name, kind, sigma)?,
            blocks: sizes.blocks().into_iter().map(block).collect::<Result<_>>()?,
        })
    }

    /// Features of the points, from nothing but where they are.
    ///
    /// # Errors
    /// `Internal` if the pyramid has too few stages.
    pub(in crate::backbones) fn apply(
        &self,
        cpu: &CpuBackend,
        pyramid: &Pyramid,
    ) -> Result<Encoded> {
        let Some(finest) = pyramid.stages.first() else {
            return Err(Error::Internal("a pyramid without stages".to_owned()));
        };
        let ones = Matrix::filled(finest.points.len(), 1, 1.0);
        let mut features = self.first.apply(cpu, pyramid, 0, &ones)?;
        let mut skipped = Vec::new();
        for (block, residual) in &self.blocks {
            let next = residual.apply(cpu, pyramid, block.level, &features)?;
            let before = std::mem::replace(&mut features, next);
            if block.strided {
                skipped.push(before);
            }
        }
        Ok(Encoded { skipped, coarsest: features })
    }
}
