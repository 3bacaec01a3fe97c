//! Convolution with 3 x 3 kernels in fewer products: F(2 x 2, 3 x 3) of Lavin and Gray, Fast Algorithms for
//! Convolutional Neural Networks (CVPR 2016).
//!
//! The image is cut into tiles of 2 x 2 outputs. A tile needs a window of 4 x 4 pixels; transformed, window and kernel
//! have 16 frequencies, and each frequency of the tile is the product of the two, summed over the inputs. These are 16
//! matrix products whose rows are tiles, with 16 products per tile, input and output where the definition has 36.
//!
//! The windows are transformed once, before the products. The kernels stay in memory as their file has them: a piece of
//! work, a chunk of tiles times a panel of columns, transforms its kernels into the cache, block by block of the
//! inputs, adds up the products of all frequencies, then transforms these sums back and finishes the pixels as the
//! direct way does. Everything is in single precision.

mod transforms;

use std::ops::Range;

use rayon::prelude::*;

use super::backend::Shape;
use super::convolution::Context;
use super::cpu::Precision;
use super::epilogue::Epilogue;
use super::operand::Layout;
use super::pack::{PANEL, PackedWeight};
use super::shared_output::SharedOutput;
use super::simd::{LANES, Simd, Vectorized};
use super::tile::{Segment, Tile};

use transforms::{Windows, transform_kernels, transform_sums};

/// Frequencies of a window and of a kernel.
const FREQUENCIES: usize = 16;

/// All frequencies, in the order of their rows.
const ALL: [usize; FREQUENCIES] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// The frequencies of doubled images that are not zero: the two pixels in the middle of a window come from the same
/// one, so that their difference vanishes in both directions.
const DOUBLED: [usize; 9] = [0, 1, 3, 4, 5, 7, 12, 13, 15];

/// Tiles of a chunk, at most: a multiple of the rows of the register tiles (14, 6, 2). The sums of a chunk fill 336 KiB,
/// a part of the second-level cache.
const CHUNK_TILES: usize = 168;

/// Inputs of a block, at most: their transformed kernels fill 192 KiB, and those of one frequency the first-level cache.
const BLOCK_INPUTS: usize = 96;

/// Bytes of transformed windows at a time (of one chunk at least), so that large batches need no more memory.
const WAVE_BYTES: usize = 32 << 20;

/// Whether this way is the faster one. It depends on the sizes of one image alone, so that the result of an image does
/// not depend on those beside it.
pub(super) fn pays(weight: &PackedWeight, stride: usize, result: Shape, upsampled: bool) -> bool {
    let fits = weight.precision() == Precision::F32 && weight.side == 3 && stride == 1;
    let size = [result.height, result.width];
    fits && costs_less(weight.inputs, weight.panels * PANEL, size, upsampled)
}

/// Compares the time per input and output, in products. What the transforms take was fitted to measurements: windows
/// are transformed once for all outputs, sums once for all inputs, kernels for each chunk of tiles.
fn costs_less(inputs: usize, outputs: usize, [height, width]: [usize; 2], upsampled: bool) -> bool {
    const WINDOW: f64 = 640.0;
    const SUMS: f64 = 300.0;
    const KERNEL: f64 = 96.0;
    let tiles = (height.div_ceil(2) * width.div_ceil(2)) as f64;
    let products = if upsampled { DOUBLED.len() } else { ALL.len() } as f64;
    let tile = products + WINDOW / outputs as f64 + SUMS / inputs as f64;
    tiles * tile + KERNEL < (9 * height * width) as f64
}

/// A convolution.
pub(super) struct Winograd<'a> {
    pub(super) context: Context<'a>,
    /// The padded images.
    pub(super) operand: &'a [f32],
    pub(super) layout: Layout,
    pub(super) weight: &'a PackedWeight,
    /// Of the result.
    pub(super) shape: Shape,
    /// Whether the images are doubled ones.
    pub(super) upsampled: bool,
}

/// How a convolution is cut. Transformed windows lie by chunk, block of inputs, frequency, tile, input.
#[derive(Debug, Clone, Copy)]
struct Plan {
    /// Tiles in each direction of an image.
    down: usize,
    across: usize,
    /// All tiles of all images, in order, cut into chunks.
    chunks: Cut,
    /// Inputs of a block, in whole vectors; the last block may have fewer.
    block: usize,
    blocks: usize,
    inputs: usize,
    frequencies: &'static [usize],
}

/// Equally long parts.
#[derive(Debug, Clone, Copy)]
struct Cut {
    length: usize,
    parts: usize,
}

impl Cut {
    fn new(length: usize, longest: usize) -> Cut {
        Cut { length, parts: length.div_ceil(longest) }
    }

    fn part(self, index: usize) -> Range<usize> {
        self.length * index / self.parts..self.length * (index + 1) / self.parts
    }

    fn longest(self) -> usize {
        self.length.div_ceil(self.parts)
    }
}

impl Plan {
    fn new(shape: Shape, inputs: usize, upsampled: bool) -> Plan {
        let (down, across) = (shape.height.div_ceil(2), shape.width.div_ceil(2));
        let block = inputs.div_ceil(inputs.div_ceil(BLOCK_INPUTS)).next_multiple_of(LANES);
        Plan {
            down,
            across,
            chunks: Cut::new(shape.batch * down * across, CHUNK_TILES),
            block,
            blocks: inputs.div_ceil(block),
            inputs,
            frequencies: if upsampled { &DOUBLED } else { &ALL },
        }
    }

    /// The inputs of a block.
    fn inputs(&self, block: usize) -> Range<usize> {
        block * self.block..self.inputs.min((block + 1) * self.block)
    }

    /// Numbers of the transformed windows of one frequency of a chunk and block.
    fn frequency_size(&self) -> usize {
        self.chunks.longest() * self.block
    }

    /// Numbers of all transformed windows of a chunk and block.
    fn block_size(&self) -> usize {
        FREQUENCIES * self.frequency_size()
    }

    /// Image, row and column of the first output of a tile.
    fn position(&self, tile: usize) -> [usize; 3] {
        let (image, y, x) =
            (tile / (self.down * self.across), tile / self.across % self.down, tile % self.across);
        [image, 2 * y, 2 * x]
    }
}

impl Winograd<'_> {
    /// Writes all outputs.
    pub(super) fn compute(&self, epilogue: &Epilogue<'_>, output: &mut [f32]) {
        let plan = Plan::new(self.shape, self.weight.inputs, self.upsampled);
        let chunk_size = plan.blocks * plan.block_size();
        let waves = Cut::new(plan.chunks.parts, (WAVE_BYTES / 4 / chunk_size).max(1));
        let rows: Vec<u32> =
            (0..plan.chunks.longest()).map(|tile| (tile * plan.block) as u32).collect();
        let output = SharedOutput::new(&mut output[..self.shape.values()]);
        let mut windows = self.context.arena.lend(waves.longest() * chunk_size * 4);
        for wave in 0..waves.parts {
            let chunks = waves.part(wave);
            let windows = &mut windows.slice_mut::<f32>()[..chunks.len() * chunk_size];
            self.transform_windows(&plan, chunks.start, windows);
            let panels = self.weight.panels;
            (0..chunks.len() * panels).into_par_iter().with_max_len(1).for_each(|item| {
                let (chunk, panel) = (item / panels, item % panels);
                self.context.processor.run(Chunk {
                    winograd: self,
                    plan: &plan,
                    epilogue,
                    panel,
                    tiles: plan.chunks.part(chunks.start + chunk),
                    rows: &rows,
                    windows: &windows[chunk * chunk_size..(chunk + 1) * chunk_size],
                    output: &output,
                });
            });
        }
    }

    /// Transforms the windows of some chunks, from number `first` on.
    fn transform_windows(&self, plan: &Plan, first: usize, target: &mut [f32]) {
        let parts = target.par_chunks_exact_mut(plan.block_size());
        parts.enumerate().for_each(|(index, target)| {
            self.context.processor.run(Windows {
                operand: self.operand,
                layout: self.layout,
                plan,
                tiles: plan.chunks.part(first + index / plan.blocks),
                inputs: plan.inputs(index % plan.blocks),
                target,
            });
        });
    }
}

/// Some tiles of one panel.
struct Chunk<'a> {
    winograd: &'a Winograd<'a>,
    plan: &'a Plan,
    epilogue: &'a Epilogue<'a>,
    panel: usize,
    tiles: Range<usize>,
    /// Where the tiles begin in the windows of a frequency.
    rows: &'a [u32],
    windows: &'a [f32],
    output: &'a SharedOutput<'a, f32>,
}

impl Vectorized for Chunk<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Chunk { winograd, plan, panel, .. } = self;
        let arena = winograd.context.arena;
        let mut sums = arena.lend(FREQUENCIES * self.tiles.len() * PANEL * 4);
        let mut kernels = arena.lend(FREQUENCIES * plan.block * PANEL * 4);
        let (sums, kernels) = (sums.slice_mut::<f32>(), kernels.slice_mut::<f32>());
        for block in 0..plan.blocks {
            let inputs = plan.inputs(block);
            transform_kernels(simd, winograd.weight, panel, inputs, plan.block, kernels);
            self.multiply(block, kernels, sums);
        }
        self.finish(simd, sums);
    }
}

impl Chunk<'_> {
    /// Adds the products of a block.
    fn multiply(&self, block: usize, kernels: &[f32], sums: &mut [f32]) {
        let plan = self.plan;
        let windows = &self.windows[block * plan.block_size()..];
        let segment = Segment { offset: 0, steps: plan.inputs(block).len() as u32 };
        for &frequency in plan.frequencies {
            let tile = Tile {
                a: &windows[frequency * plan.frequency_size()..],
                rows: &self.rows[..self.tiles.len()],
                segments: &[segment],
                b: &kernels[frequency * plan.block * PANEL..],
                b_stride: PANEL,
                c_stride: PANEL,
                groups: PANEL / LANES,
                accumulate: block > 0,
            };
            let sums = &mut sums[frequency * self.tiles.len() * PANEL..];
            tile.multiply(self.winograd.context.processor, Precision::F32, sums);
        }
    }

    /// Transforms the sums back and finishes the pixels that exist.
    #[inline(always)]
    fn finish<S: Simd>(&self, simd: S, sums: &mut [f32]) {
        let size = self.tiles.len() * PANEL;
        for frequency in (0..FREQUENCIES).filter(|one| !self.plan.frequencies.contains(one)) {
            sums[frequency * size..(frequency + 1) * size].fill(0.0);
        }
        let Shape { height, width, .. } = self.winograd.shape;
        for (index, tile) in self.tiles.clone().enumerate() {
            let mut outputs = [0.0; 4 * PANEL];
            transform_sums(simd, &sums[index * PANEL..], size, &mut outputs);
            let [image, top, left] = self.plan.position(tile);
            for (corner, outputs) in outputs.chunks_exact(PANEL).enumerate() {
                let (y, x) = (top + corner / 2, left + corner % 2);
                if y < height && x < width {
                    let pixel = (image * height + y) * width + x;
                    self.epilogue.apply(simd, pixel, self.panel, outputs, self.output);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
