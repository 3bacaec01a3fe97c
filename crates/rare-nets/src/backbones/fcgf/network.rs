//! `ResUNetBN2C`: the network, and what it computes on the way.

use rare::nalgebra::Point3;
use rare::{Error, Result};

use super::FcgfConfig;
use super::convolution::{FirstConvolution, SparseConvolution};
use super::coordinates::{Coordinate, CoordinateMap};
use super::kernel_map::KernelMap;
use super::layout::layout_as_stored;
use super::voxels::voxelise;
use crate::Matrix;
use crate::checkpoint::Parameters;
use crate::engine::{CpuBackend, Precision};
use crate::layers::{Activation, Linear, Weights, unit_rows};

/// The network with its weights (Choy, Park, Koltun: Fully Convolutional Geometric Features, ICCV 2019).
pub struct Fcgf {
    pub(super) config: FcgfConfig,
    cpu: CpuBackend,
    first: FirstConvolution,
    first_block: Block,
    down: [Stage; 3],
    up: [Stage; 3],
    before_last: Linear,
    last: Linear,
}

/// What the network computes of one cloud. The index of arrays is that of the stride: 1, 2, 4, 8.
#[derive(Debug, Clone, PartialEq)]
pub struct Output {
    /// The point that stands for each voxel of the finest stride: indices into the cloud, ascending.
    pub kept: Vec<usize>,
    /// The voxels of each stride, in voxels of the finest one.
    pub coordinates: [Vec<Coordinate>; 4],
    /// Features of the voxels of each stride on the way down.
    pub down: [Matrix; 4],
    /// Features of the voxels of the strides 1, 2 and 4 on the way up.
    pub up: [Matrix; 3],
    /// The last layer's output: a row for each voxel of the finest stride.
    pub raw: Matrix,
    /// The features: `raw`, divided by the norm of each row if the model wants it.
    pub features: Matrix,
}

/// The voxels of a cloud at four strides, and which of them meet under the kernels.
struct Maps {
    voxels: [CoordinateMap; 4],
    within: [KernelMap; 4],
    down: [KernelMap; 3],
    up: [KernelMap; 3],
}

/// Side of all kernels but the first.
const SIDE: usize = 3;

impl Fcgf {
    /// Takes the weights of `ResUNetBN2C` under their official names. The size of the first kernel and the length of
    /// features are those of the weights, whatever `config` says.
    ///
    /// # Errors
    /// `InvalidInput` if they are not the weights of this network or are damaged; `Io`, `Unsupported` as the file has it.
    pub fn load(parameters: &Parameters, config: FcgfConfig) -> Result<Fcgf> {
        let config = config.fitted(parameters);
        let layout = layout_as_stored(&config, parameters);
        let weights = Weights::new(parameters, &layout, "FCGF")?;
        let cpu = CpuBackend::new(Precision::F32)?;
        Ok(Fcgf {
            first: FirstConvolution::read(&weights, "conv1", "norm1", config.first_kernel)?,
            first_block: Block::read(&cpu, &weights, "block1")?,
            down: [
                Stage::read(&cpu, &weights, "2")?,
                Stage::read(&cpu, &weights, "3")?,
                Stage::read(&cpu, &weights, "4")?,
            ],
            up: [
                Stage::read(&cpu, &weights, "2_tr")?,
                Stage::read(&cpu, &weights, "3_tr")?,
                Stage::read(&cpu, &weights, "4_tr")?,
            ],
            before_last: pointwise(&cpu, &weights, "conv1_tr.kernel", None)?,
            last: pointwise(&cpu, &weights, "final.kernel", Some("final.bias"))?,
            config,
            cpu,
        })
    }

    /// Its settings.
    #[must_use]
    pub fn config(&self) -> &FcgfConfig {
        &self.config
    }

    /// Features of the voxels of a cloud, metres.
    ///
    /// # Errors
    /// `InvalidInput` if there is no point, or one is not finite or too far from the origin.
    pub fn run(&self, points: &[Point3<f64>]) -> Result<Output> {
        if points.is_empty() {
            return Err(Error::invalid("FCGF needs a cloud with points, and this one has none"));
        }
        let cpu = &self.cpu;
        let voxels = voxelise(points, self.config.voxel)?;
        let maps = Maps::new(voxels.coordinates);

        let first = self.first.apply(&maps.voxels[0])?;
        let down1 = self.first_block.apply(cpu, &first, &maps.within[0])?;
        let down2 = self.down[0].apply(cpu, &down1, &maps.down[0], &maps.within[1])?;
        let down4 = self.down[1].apply(cpu, &down2, &maps.down[1], &maps.within[2])?;
        let down8 = self.down[2].apply(cpu, &down4, &maps.down[2], &maps.within[3])?;

        let up4 = self.up[2].apply(cpu, &down8, &maps.up[2], &maps.within[2])?;
        let up2 = self.up[1].apply(cpu, &up4.beside(&down4)?, &maps.up[1], &maps.within[1])?;
        let up1 = self.up[0].apply(cpu, &up2.beside(&down2)?, &maps.up[0], &maps.within[0])?;
        let mut joined = self.before_last.apply(cpu, &up1.beside(&down1)?)?;
        Activation::Relu.apply_to(joined.values_mut());
        let raw = self.last.apply(cpu, &joined)?;
        let mut features = raw.clone();
        if self.config.unit_features {
            unit_rows(&mut features);
        }
        Ok(Output {
            kept: voxels.kept,
            coordinates: maps.voxels.map(|voxels| voxels.coordinates().to_vec()),
            down: [down1, down2, down4, down8],
            up: [up1, up2, up4],
            raw,
            features,
        })
    }
}

impl Maps {
    fn new(finest: CoordinateMap) -> Maps {
        let second = finest.coarser();
        let third = second.coarser();
        let fourth = third.coarser();
        let voxels = [finest, second, third, fourth];
        let [one, two, four, eight] = &voxels;
        let down = [(one, two), (two, four), (four, eight)]
            .map(|(fine, coarse)| KernelMap::new(fine, coarse, SIDE));
        let [first, second, third] = &down;
        let up = [(first, one), (second, two), (third, four)]
            .map(|(map, fine)| map.transposed(fine.len()));
        let within = [one, two, four, eight].map(|voxels| KernelMap::new(voxels, voxels, SIDE));
        Maps { within, down, up, voxels }
    }
}

/// Two convolutions beside a shortcut (He et al., 2016).
struct Block {
    first: SparseConvolution,
    second: SparseConvolution,
}

impl Block {
    fn read(cpu: &CpuBackend, weights: &Weights<'_>, name: &str) -> Result<Block> {
        let part = |number| {
            let (convolution, norm) =
                (format!("{name}.conv{number}"), format!("{name}.norm{number}"));
            SparseConvolution::read(cpu, weights, &convolution, &norm)
        };
        Ok(Block { first: part(1)?, second: part(2)? })
    }

    fn apply(&self, cpu: &CpuBackend, input: &Matrix, map: &KernelMap) -> Result<Matrix> {
        let mut between = self.first.apply(cpu, input, map)?;
        Activation::Relu.apply_to(between.values_mut());
        let mut output = self.second.apply(cpu, &between, map)?;
        output.add(input)?;
        Activation::Relu.apply_to(output.values_mut());
        Ok(output)
    }
}

/// A convolution from one stride to the next, and the block there.
///
/// There is no activation between the two: the block's own is all that follows.
struct Stage {
    convolution: SparseConvolution,
    block: Block,
}

impl Stage {
    fn read(cpu: &CpuBackend, weights: &Weights<'_>, suffix: &str) -> Result<Stage> {
        let (convolution, norm) = (format!("conv{suffix}"), format!("norm{suffix}"));
        Ok(Stage {
            convolution: SparseConvolution::read(cpu, weights, &convolution, &norm)?,
            block: Block::read(cpu, weights, &format!("block{suffix}"))?,
        })
    }

    fn apply(
        &self,
        cpu: &CpuBackend,
        input: &Matrix,
        between: &KernelMap,
        within: &KernelMap,
    ) -> Result<Matrix> {
        let moved = self.convolution.apply(cpu, input, between)?;
        self.block.apply(cpu, &moved, within)
    }
}

/// The linear layer of a kernel with one offset, `[1 x] inputs x outputs`.
fn pointwise(
    cpu: &CpuBackend,
    weights: &Weights<'_>,
    kernel: &str,
    bias: Option<&str>,
) -> Result<Linear> {
    let [.., inputs, outputs] = *weights.shape(kernel)? else {
        return Err(Error::Internal(format!("{kernel} is no kernel")));
    };
    let matrix = Matrix::new(inputs, outputs, weights.values(kernel)?)?;
    let bias = bias.map(|name| weights.values(name)).transpose()?;
    Linear::new(cpu, matrix.transposed(), bias.as_deref())
}
