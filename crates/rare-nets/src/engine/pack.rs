//! Weights in the order in which the matrix product reads them.
//!
//! The outputs of a convolution are cut into panels of [`PANEL`] columns; within a panel, the weights of one input
//! follow those of the other, tap by tap of the kernel. Numbers stay in the precision of the file (half the memory
//! and half the traffic of single precision) and are widened, block by block, into the cache when they are used.
//! In the precision bf16 two inputs share 32 bits, as the processor's instruction for pairs wants them.

use std::borrow::Cow;

use bytemuck::Pod;
use half::{bf16, f16};
use rare::{Error, Result};
use rayon::prelude::*;

use super::arena::Buffer;
use super::backend::{Arrangement, Kernel};
use super::cpu::Precision;
use super::simd::{LANES, Processor, Simd, Vectorized};
use super::vectors::Stored;
use crate::{Parameter, Values};

/// Columns of a panel: two groups.
pub(super) const PANEL: usize = 2 * LANES;

/// The packed weights of a convolution.
#[derive(Debug)]
pub struct PackedWeight {
    /// Channels that go in.
    pub(super) inputs: usize,
    /// Channels that come out; of gated outputs, half.
    pub(super) outputs: usize,
    /// 1 or 3.
    pub(super) side: usize,
    pub(super) arrangement: Arrangement,
    /// One number per column of all panels, zero where there is no output.
    pub(super) bias: Vec<f32>,
    pub(super) panels: usize,
    pub(super) storage: Storage,
    elements: Buffer,
}

/// What the elements of a panel are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Storage {
    F32,
    F16,
    Bf16,
    /// Pairs of consecutive inputs of one column.
    Pairs,
}

impl Storage {
    /// Bytes of one unit (32 bits of the product's operand) as stored.
    fn bytes(self) -> usize {
        match self {
            Storage::F32 | Storage::Pairs => 4,
            Storage::F16 | Storage::Bf16 => 2,
        }
    }
}

impl PackedWeight {
    /// The products that the weights were packed for.
    pub(super) fn precision(&self) -> Precision {
        match self.storage {
            Storage::F32 | Storage::F16 | Storage::Bf16 => Precision::F32,
            Storage::Pairs => Precision::Bf16,
        }
    }

    /// Units of one tap: inputs, or pairs of them.
    pub(super) fn steps(&self) -> usize {
        if self.storage == Storage::Pairs { self.inputs.div_ceil(2) } else { self.inputs }
    }

    /// Number of taps of the kernel.
    pub(super) fn taps(&self) -> usize {
        self.side * self.side
    }

    /// The columns of one panel for some steps (counted over all taps), widened into `scratch` if they are stored
    /// narrower.
    #[inline(always)]
    pub(super) fn block<'a, S: Simd>(
        &'a self,
        simd: S,
        panel: usize,
        steps: std::ops::Range<usize>,
        scratch: &'a mut [f32],
    ) -> &'a [f32] {
        let first = panel * self.taps() * self.steps() * PANEL;
        let range = first + steps.start * PANEL..first + steps.end * PANEL;
        match self.storage {
            Storage::F32 | Storage::Pairs => &self.elements.slice::<f32>()[range],
            Storage::F16 => widen(simd, &self.elements.slice::<f16>()[range], scratch),
            Storage::Bf16 => widen(simd, &self.elements.slice::<bf16>()[range], scratch),
        }
    }

    /// One panel as it is stored (as `T`, which is for the caller to know), vector by vector: tap, step, group.
    #[inline(always)]
    pub(super) fn panel<T: Stored>(&self, panel: usize) -> &[[T; LANES]] {
        let length = self.taps() * self.steps() * (PANEL / LANES);
        let (vectors, _) = self.elements.slice::<T>().as_chunks::<LANES>();
        &vectors[panel * length..(panel + 1) * length]
    }
}

/// Fills the begin of `scratch`.
#[inline(always)]
fn widen<'a, S: Simd, T: Stored>(simd: S, narrow: &[T], scratch: &'a mut [f32]) -> &'a [f32] {
    let (narrow, _) = narrow.as_chunks::<LANES>();
    let (wide, _) = scratch.as_chunks_mut::<LANES>();
    for (narrow, wide) in narrow.iter().zip(wide) {
        simd.store(T::load(simd, narrow), wide);
    }
    &scratch[..narrow.len() * LANES]
}

/// The sizes of a kernel.
#[derive(Debug, Clone, Copy)]
struct Sizes {
    inputs: usize,
    side: usize,
    /// Outputs of all parts.
    rows: usize,
}

/// Packs a kernel.
///
/// # Errors
/// `Internal` if parts, bias and arrangement do not fit.
pub(super) fn pack(
    processor: Processor,
    kernel: &Kernel<'_>,
    precision: Precision,
) -> Result<PackedWeight> {
    let sizes = sizes(kernel)?;
    let order = columns(kernel.arrangement, sizes.rows);
    let storage = storage(kernel.parts, precision);
    let units = if storage == Storage::Pairs { sizes.inputs.div_ceil(2) } else { sizes.inputs };
    let mut elements =
        Buffer::zeroed(order.len() * sizes.side * sizes.side * units * storage.bytes());
    let parts = kernel.parts;
    match storage {
        Storage::F32 => permute(&as_f32(parts), sizes, &order, 1, elements.slice_mut()),
        Storage::F16 => permute(&as_f16(parts), sizes, &order, 1, elements.slice_mut()),
        Storage::Bf16 => {
            permute(&as_bf16(processor, parts), sizes, &order, 1, elements.slice_mut());
        }
        Storage::Pairs => {
            permute(&as_bf16(processor, parts), sizes, &order, 2, elements.slice_mut());
        }
    }
    let bias_of = |row: &Option<usize>| kernel.bias.and_then(|bias| bias.get((*row)?));
    Ok(PackedWeight {
        inputs: sizes.inputs,
        outputs: outputs(kernel.arrangement, sizes.rows),
        side: sizes.side,
        arrangement: kernel.arrangement,
        bias: order.iter().map(|row| bias_of(row).copied().unwrap_or(0.0)).collect(),
        panels: order.len() / PANEL,
        storage,
        elements,
    })
}

fn outputs(arrangement: Arrangement, rows: usize) -> usize {
    match arrangement {
        Arrangement::Plain => rows,
        Arrangement::Gated => rows / 2,
    }
}

/// Checks that everything fits.
fn sizes(kernel: &Kernel<'_>) -> Result<Sizes> {
    let shape_of = |part: &Parameter| match part.shape[..] {
        [rows, inputs] => Some((rows, inputs, 1)),
        [rows, inputs, height, width] if height == width => Some((rows, inputs, height)),
        _ => None,
    };
    let shapes: Option<Vec<_>> = kernel.parts.iter().map(shape_of).collect();
    let shapes = shapes.unwrap_or_default();
    let fits = |&(_, inputs, side): &(usize, usize, usize), part: &Parameter| {
        let count = part.shape.iter().copied().try_fold(1, usize::checked_mul);
        (inputs, side) == (shapes[0].1, shapes[0].2)
            && !part.values.is_empty()
            && count == Some(part.values.len())
    };
    let rows = shapes.iter().map(|shape| shape.0).fold(0, usize::saturating_add);
    let all_fit = shapes.iter().zip(kernel.parts).all(|(shape, part)| fits(shape, part))
        && kernel.bias.is_none_or(|bias| bias.len() == rows)
        && (kernel.arrangement == Arrangement::Plain || rows % 2 == 0);
    match shapes.first() {
        Some(&(_, inputs, side)) if all_fit && (side == 1 || side == 3) => {
            Ok(Sizes { inputs, side, rows })
        }
        _ => Err(Error::Internal(format!(
            "weights of shapes {:?} with {:?} biases make no convolution",
            kernel.parts.iter().map(|part| &part.shape).collect::<Vec<_>>(),
            kernel.bias.map(<[f32]>::len)
        ))),
    }
}

/// Which output stands in which column: panels are filled up with nothing, and of gated outputs a panel has a group of
/// values and the group of their gates.
fn columns(arrangement: Arrangement, rows: usize) -> Vec<Option<usize>> {
    match arrangement {
        Arrangement::Plain => {
            let padded = rows.next_multiple_of(PANEL);
            (0..padded).map(|column| (column < rows).then_some(column)).collect()
        }
        Arrangement::Gated => {
            let half = rows / 2;
            let panels = half.div_ceil(LANES);
            let column = |panel: usize, lane: usize, gate: usize| {
                let row = panel * LANES + lane;
                (row < half).then_some(row + gate * half)
            };
            let panel =
                |panel| (0..PANEL).map(move |index| column(panel, index % LANES, index / LANES));
            (0..panels).flat_map(panel).collect()
        }
    }
}

/// Files in half precision stay so; what is mixed becomes single precision.
fn storage(parts: &[Parameter], precision: Precision) -> Storage {
    let all = |wanted: fn(&Values) -> bool| parts.iter().all(|part| wanted(&part.values));
    match precision {
        Precision::Bf16 => Storage::Pairs,
        Precision::F32 if all(|values| matches!(values, Values::F16(_))) => Storage::F16,
        Precision::F32 if all(|values| matches!(values, Values::Bf16(_))) => Storage::Bf16,
        Precision::F32 => Storage::F32,
    }
}

fn as_f32(parts: &[Parameter]) -> Vec<Cow<'_, [f32]>> {
    fn convert(part: &Parameter) -> Cow<'_, [f32]> {
        match &part.values {
            Values::F32(values) => Cow::Borrowed(values),
            _ => Cow::Owned(part.to_f32()),
        }
    }
    parts.iter().map(convert).collect()
}

/// Parts that are all in half precision.
fn as_f16(parts: &[Parameter]) -> Vec<Cow<'_, [f16]>> {
    fn take(part: &Parameter) -> Option<Cow<'_, [f16]>> {
        match &part.values {
            Values::F16(values) => Some(Cow::Borrowed(values)),
            _ => None,
        }
    }
    parts.iter().filter_map(take).collect()
}

/// Rounds what is not bf16 yet.
fn as_bf16(processor: Processor, parts: &[Parameter]) -> Vec<Cow<'_, [bf16]>> {
    fn convert(processor: Processor, part: &Parameter) -> Cow<'_, [bf16]> {
        match &part.values {
            Values::Bf16(values) => Cow::Borrowed(values),
            Values::F32(values) => Cow::Owned(round(processor, Source::F32(values))),
            Values::F16(values) => Cow::Owned(round(processor, Source::F16(values))),
        }
    }
    parts.iter().map(|part| convert(processor, part)).collect()
}

/// What [`round`] takes.
#[derive(Clone, Copy)]
enum Source<'a> {
    F32(&'a [f32]),
    F16(&'a [f16]),
}

/// Elements that one thread rounds at a time.
const CHUNK: usize = 1 << 16;

fn round(processor: Processor, source: Source<'_>) -> Vec<bf16> {
    let count = match source {
        Source::F32(values) => values.len(),
        Source::F16(values) => values.len(),
    };
    let mut target = vec![bf16::ZERO; count];
    target.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, target)| {
        let range = chunk * CHUNK..chunk * CHUNK + target.len();
        match source {
            Source::F32(values) => processor.run(Rounding { source: &values[range], target }),
            Source::F16(values) => processor.run(Rounding { source: &values[range], target }),
        }
    });
    target
}

/// Rounds elements to bf16.
struct Rounding<'a, T> {
    source: &'a [T],
    target: &'a mut [bf16],
}

impl Vectorized for Rounding<'_, f32> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (source, rest) = self.source.as_chunks::<LANES>();
        let (target, target_rest) = self.target.as_chunks_mut::<LANES>();
        for (source, target) in source.iter().zip(target) {
            simd.store_bf16(simd.load(source), target);
        }
        for (source, target) in rest.iter().zip(target_rest) {
            *target = bf16::from_f32(*source);
        }
    }
}

impl Vectorized for Rounding<'_, f16> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let (source, rest) = self.source.as_chunks::<LANES>();
        let (target, target_rest) = self.target.as_chunks_mut::<LANES>();
        for (source, target) in source.iter().zip(target) {
            simd.store_bf16(simd.load_f16(source), target);
        }
        for (source, target) in rest.iter().zip(target_rest) {
            *target = bf16::from_f32(source.to_f32());
        }
    }
}

/// Inputs that are moved at a time, so that what is written stays in the cache.
const INPUTS: usize = 32;

/// Puts the elements in their order: panel, tap, unit of `together` inputs, column, input within the unit.
fn permute<T: Pod + Send + Sync>(
    parts: &[Cow<'_, [T]>],
    sizes: Sizes,
    order: &[Option<usize>],
    together: usize,
    elements: &mut [T],
) {
    let taps = sizes.side * sizes.side;
    let row_length = sizes.inputs * taps;
    let rows: Vec<&[T]> = parts.iter().flat_map(|part| part.chunks_exact(row_length)).collect();
    let units = sizes.inputs.div_ceil(together);
    let panels = elements.par_chunks_exact_mut(taps * units * PANEL * together);
    panels.zip(order.par_chunks_exact(PANEL)).for_each(|(panel, columns)| {
        for first in (0..sizes.inputs).step_by(INPUTS) {
            let last = (first + INPUTS).min(sizes.inputs);
            for (column, row) in columns.iter().enumerate() {
                let Some(row) = row.and_then(|row| rows.get(row)) else { continue };
                for (input, taps_of_input) in
                    (first..last).zip(row[first * taps..].chunks_exact(taps))
                {
                    for (tap, value) in taps_of_input.iter().enumerate() {
                        let unit = tap * units + input / together;
                        panel[(unit * PANEL + column) * together + input % together] = *value;
                    }
                }
            }
        }
    });
}

#[cfg(test)]
mod tests;
