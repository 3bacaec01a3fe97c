//! Convolution as an implicit matrix product: the rows are output pixels, the sum runs over taps and inputs, and the
//! operand is read through offsets instead of being unrolled in memory.
//!
//! The work is cut into chunks of rows times panels of columns. A thread computes a chunk of a panel in blocks of the
//! sum that fit its cache, then applies everything that follows the product while the result is still there.

use std::sync::Arc;

use half::bf16;
use rare::{Error, Result};
use rayon::prelude::*;

use super::arena::Arena;
use super::backend::{Convolution, Prologue, Shape};
use super::cpu::Precision;
use super::epilogue::Epilogue;
use super::operand::{Layout, Preparation};
use super::pack::{PANEL, PackedWeight};
use super::shared_output::SharedOutput;
use super::simd::{LANES, Processor, Simd, Vectorized};
use super::tensor::{Elements, Tensor};
use super::tile::{Segment, Tile};
use super::vectors::Element;
use super::winograd::{self, Winograd};

/// Rows of a chunk: a multiple of the rows of the register tiles (14, 6, 2), small enough to keep all threads busy.
const CHUNK_ROWS: usize = 336;

/// Units of the sum in a block: with a panel's columns 192 KiB, a part of the second-level cache.
const BLOCK_STEPS: usize = 1536;

/// Where and how everything is computed.
#[derive(Clone, Copy)]
pub(super) struct Context<'a> {
    pub(super) processor: Processor,
    pub(super) precision: Precision,
    pub(super) arena: &'a Arc<Arena>,
}

/// [`super::Backend::convolve`] on the CPU.
pub(super) fn convolve(
    context: Context<'_>,
    input: &Tensor,
    weight: &PackedWeight,
    fused: &Convolution<'_, Tensor>,
) -> Result<Tensor> {
    let Context { processor, precision, arena } = context;
    check(input, weight, fused, precision)?;
    let preparation = Preparation {
        processor,
        arena,
        precision,
        prologue: fused.prologue,
        upsample: fused.upsample,
        border: weight.side / 2,
    };
    let layout = addressable(&preparation, input)?;
    let operand = preparation.prepare(input);
    let shape = result(input, weight, fused, layout);
    let elements = match (precision, fused.intermediate) {
        (Precision::Bf16, true) => Elements::Bf16,
        _ => Elements::F32,
    };
    let mut buffer = arena.lend(shape.values() * elements.bytes());
    let epilogue = Epilogue::new(weight, fused, shape)?;
    let operand = operand.units();
    let upsampled = fused.upsample;
    if winograd::pays(weight, fused.stride, shape, upsampled) {
        let winograd = Winograd { context, operand, layout, weight, shape, upsampled };
        winograd.compute(&epilogue, buffer.slice_mut());
        return Ok(Tensor { shape, elements, buffer });
    }
    let geometry = Geometry::new(weight, fused.stride, layout, shape);
    let product = Product { context, operand, weight, geometry: &geometry };
    match elements {
        Elements::F32 => product.compute::<f32>(&epilogue, buffer.slice_mut()),
        Elements::Bf16 => product.compute::<bf16>(&epilogue, buffer.slice_mut()),
    }
    Ok(Tensor { shape, elements, buffer })
}

/// The layout of the operand, if its offsets fit.
fn addressable(preparation: &Preparation<'_>, input: &Tensor) -> Result<Layout> {
    let layout = preparation.layout(input);
    if layout.is_addressable(input.shape.batch) {
        return Ok(layout);
    }
    Err(Error::Unsupported(format!(
        "the images {:?} are too large for one convolution: use fewer or smaller ones",
        input.shape
    )))
}

/// The shape of the result.
fn result(
    input: &Tensor,
    weight: &PackedWeight,
    fused: &Convolution<'_, Tensor>,
    layout: Layout,
) -> Shape {
    let border = weight.side / 2;
    let size = |padded: usize| (padded - 2 * border).div_ceil(fused.stride);
    let (height, width) = (size(layout.height), size(layout.width));
    Shape { batch: input.shape.batch, height, width, channels: weight.outputs }
}

fn check(
    input: &Tensor,
    weight: &PackedWeight,
    fused: &Convolution<'_, Tensor>,
    precision: Precision,
) -> Result<()> {
    let channels = input.shape.channels;
    let normalized = match fused.prologue {
        Prologue::None | Prologue::Silu => true,
        Prologue::GroupNormalization { groups, scale, shift, .. } => {
            groups > 0
                && channels.is_multiple_of(groups)
                && scale.len() == channels
                && shift.len() == channels
        }
        Prologue::LayerNormalization { scale, shift, .. } => {
            scale.len() == channels && shift.len() == channels
        }
    };
    let fits = channels == weight.inputs && weight.precision() == precision;
    if fits && normalized && matches!(fused.stride, 1 | 2) {
        return Ok(());
    }
    Err(Error::Internal(format!(
        "a convolution of {} inputs (stride {}, {:?}) and its normalisation do not fit {:?} in {precision:?}",
        weight.inputs,
        fused.stride,
        weight.precision(),
        input.shape
    )))
}

/// Which elements of the operand make which output.
struct Geometry {
    shape: Shape,
    /// Where the window of each output pixel begins, in units.
    rows: Vec<u32>,
    /// The parts of the sum, cut so that none is longer than a block.
    blocks: Vec<Block>,
}

/// A part of the sum that is done for all rows of a chunk before the next.
struct Block {
    segments: Vec<Segment>,
    /// Steps of the sum, counted over all taps.
    steps: std::ops::Range<usize>,
}

impl Geometry {
    fn new(weight: &PackedWeight, stride: usize, layout: Layout, shape: Shape) -> Geometry {
        let (height, width) = (shape.height, shape.width);
        let pixel = |image: usize, y: usize, x: usize| {
            (((image * layout.height + y) * layout.width + x) * layout.units) as u32
        };
        let row = |index: usize| {
            let (image, y, x) = (index / (height * width), index / width % height, index % width);
            pixel(image, y * stride, x * stride)
        };
        let tap = |tap: usize| pixel(0, tap / weight.side, tap % weight.side);
        Geometry {
            shape,
            rows: (0..shape.pixels()).map(row).collect(),
            blocks: blocks(weight, tap),
        }
    }
}

/// Cuts the sum over taps and inputs into blocks of at most [`BLOCK_STEPS`] steps.
fn blocks(weight: &PackedWeight, tap_offset: impl Fn(usize) -> u32) -> Vec<Block> {
    let steps = weight.steps();
    let parts = steps.div_ceil(BLOCK_STEPS);
    let mut blocks: Vec<Block> = Vec::new();
    for tap in 0..weight.taps() {
        for part in 0..parts {
            let (first, end) = (steps * part / parts, steps * (part + 1) / parts);
            let segment =
                Segment { offset: tap_offset(tap) + first as u32, steps: (end - first) as u32 };
            let range = tap * steps + first..tap * steps + end;
            match blocks.last_mut() {
                Some(block) if range.end - block.steps.start <= BLOCK_STEPS => {
                    block.segments.push(segment);
                    block.steps.end = range.end;
                }
                _ => blocks.push(Block { segments: vec![segment], steps: range }),
            }
        }
    }
    blocks
}

/// The product and what it needs.
struct Product<'a> {
    context: Context<'a>,
    operand: &'a [f32],
    weight: &'a PackedWeight,
    geometry: &'a Geometry,
}

impl Product<'_> {
    /// Writes all outputs.
    fn compute<T: Element>(&self, epilogue: &Epilogue<'_>, output: &mut [T]) {
        let rows = &self.geometry.rows;
        // Equally large chunks, so that no thread is left alone with a large last one.
        let chunks = rows.len().div_ceil(CHUNK_ROWS);
        let panels = self.weight.panels;
        let output = SharedOutput::new(&mut output[..self.geometry.shape.values()]);
        (0..chunks * panels).into_par_iter().with_max_len(1).for_each(|item| {
            let (chunk, panel) = (item / panels, item % panels);
            let first = rows.len() * chunk / chunks;
            let rows = &rows[first..rows.len() * (chunk + 1) / chunks];
            self.context.processor.run(Chunk {
                product: self,
                epilogue,
                panel,
                first,
                rows,
                output: &output,
            });
        });
    }
}

/// Some rows of one panel.
struct Chunk<'a, T> {
    product: &'a Product<'a>,
    epilogue: &'a Epilogue<'a>,
    panel: usize,
    /// The output pixel of the first row.
    first: usize,
    rows: &'a [u32],
    output: &'a SharedOutput<'a, T>,
}

impl<T: Element> Vectorized for Chunk<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let arena = self.product.context.arena;
        let mut sums = arena.lend(self.rows.len() * PANEL * 4);
        let mut widened = arena.lend((BLOCK_STEPS + 1) * PANEL * 4);
        let (sums, widened) = (sums.slice_mut::<f32>(), widened.slice_mut::<f32>());
        for block in &self.product.geometry.blocks {
            let weight = self.product.weight;
            let columns = weight.block(simd, self.panel, block.steps.clone(), widened);
            let tile = Tile {
                a: self.product.operand,
                rows: self.rows,
                segments: &block.segments,
                b: columns,
                b_stride: PANEL,
                c_stride: PANEL,
                groups: PANEL / LANES,
                accumulate: block.steps.start > 0,
            };
            let Context { processor, precision, .. } = self.product.context;
            tile.multiply(processor, precision, sums);
        }
        for (row, sums) in sums.chunks_exact(PANEL).take(self.rows.len()).enumerate() {
            self.epilogue.apply(simd, self.first + row, self.panel, sums, self.output);
        }
    }
}
