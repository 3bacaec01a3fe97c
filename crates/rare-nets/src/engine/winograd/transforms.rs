//! The three transforms of F(2 x 2, 3 x 3), in the letters of the paper: windows `B^T d B`, kernels `G g G^T`, sums
//! `A^T m A`. Each is done in one direction, then in the other.

use std::ops::Range;

use half::{bf16, f16};

use super::super::operand::Layout;
use super::super::pack::{PANEL, PackedWeight, Storage};
use super::super::simd::{LANES, Simd, Vectorized};
use super::super::vectors::{Stored, load, store};
use super::{FREQUENCIES, Plan};

/// Transforms the windows of some tiles.
pub(super) struct Windows<'a> {
    /// The padded images.
    pub(super) operand: &'a [f32],
    pub(super) layout: Layout,
    pub(super) plan: &'a Plan,
    pub(super) tiles: Range<usize>,
    /// Of one block.
    pub(super) inputs: Range<usize>,
    /// By frequency, tile and input; what fills the last vector of inputs becomes zero.
    pub(super) target: &'a mut [f32],
}

impl Vectorized for Windows<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Windows { operand, layout, plan, tiles, inputs, target } = self;
        let (target, _) = target.as_chunks_mut::<LANES>();
        let stride = plan.frequency_size() / LANES;
        for (index, tile) in tiles.enumerate() {
            let pixels = pixels(operand, layout, plan.position(tile));
            for input in inputs.clone().step_by(LANES) {
                let start = (index * plan.block + input - inputs.start) / LANES;
                transform_window(simd, &pixels, input, &mut target[start..], stride);
            }
        }
    }
}

/// The 16 pixels of a window, row by row. Those that a tile at the edge has beyond the border are empty.
#[inline(always)]
fn pixels(
    operand: &[f32],
    layout: Layout,
    [image, top, left]: [usize; 3],
) -> [&[f32]; FREQUENCIES] {
    let Layout { height, width, units } = layout;
    let mut pixels: [&[f32]; FREQUENCIES] = [&[]; FREQUENCIES];
    for (index, pixel) in pixels.iter_mut().enumerate() {
        let (y, x) = (top + index / 4, left + index % 4);
        if y < height && x < width {
            let start = ((image * height + y) * width + x) * units;
            *pixel = &operand[start..start + units];
        }
    }
    pixels
}

/// `B^T d B` of a vector of inputs; frequencies are `stride` vectors apart.
#[inline(always)]
fn transform_window<S: Simd>(
    simd: S,
    pixels: &[&[f32]; FREQUENCIES],
    input: usize,
    target: &mut [[f32; LANES]],
    stride: usize,
) {
    let a = window_column(simd, pixels, 0, input);
    let b = window_column(simd, pixels, 1, input);
    let c = window_column(simd, pixels, 2, input);
    let d = window_column(simd, pixels, 3, input);
    store_four(simd, differences(simd, [a[0], b[0], c[0], d[0]]), target, 0, stride);
    store_four(simd, differences(simd, [a[1], b[1], c[1], d[1]]), target, 4, stride);
    store_four(simd, differences(simd, [a[2], b[2], c[2], d[2]]), target, 8, stride);
    store_four(simd, differences(simd, [a[3], b[3], c[3], d[3]]), target, 12, stride);
}

/// `B^T d` for one column of a window.
#[inline(always)]
fn window_column<S: Simd>(
    simd: S,
    pixels: &[&[f32]; FREQUENCIES],
    x: usize,
    input: usize,
) -> [S::Floats; 4] {
    let upper = [load(simd, pixels[x], input), load(simd, pixels[4 + x], input)];
    let lower = [load(simd, pixels[8 + x], input), load(simd, pixels[12 + x], input)];
    differences(simd, [upper[0], upper[1], lower[0], lower[1]])
}

/// `B^T` times four numbers.
#[inline(always)]
fn differences<S: Simd>(simd: S, [d0, d1, d2, d3]: [S::Floats; 4]) -> [S::Floats; 4] {
    [simd.sub(d0, d2), simd.add(d1, d2), simd.sub(d2, d1), simd.sub(d1, d3)]
}

/// Stores four frequencies from number `first` on.
#[inline(always)]
fn store_four<S: Simd>(
    simd: S,
    values: [S::Floats; 4],
    target: &mut [[f32; LANES]],
    first: usize,
    stride: usize,
) {
    simd.store(values[0], &mut target[first * stride]);
    simd.store(values[1], &mut target[(first + 1) * stride]);
    simd.store(values[2], &mut target[(first + 2) * stride]);
    simd.store(values[3], &mut target[(first + 3) * stride]);
}

/// Transforms the kernels of some inputs of a panel: by frequency, input (`block` of them) and column.
#[inline(always)]
pub(super) fn transform_kernels<S: Simd>(
    simd: S,
    weight: &PackedWeight,
    panel: usize,
    inputs: Range<usize>,
    block: usize,
    target: &mut [f32],
) {
    let count = weight.inputs;
    match weight.storage {
        Storage::F16 => {
            transform_panel::<S, f16>(simd, weight.panel(panel), count, inputs, block, target);
        }
        Storage::Bf16 => {
            transform_panel::<S, bf16>(simd, weight.panel(panel), count, inputs, block, target);
        }
        Storage::F32 | Storage::Pairs => {
            transform_panel::<S, f32>(simd, weight.panel(panel), count, inputs, block, target);
        }
    }
}

/// `G g G^T` of the kernels of a panel of `count` inputs.
#[inline(always)]
fn transform_panel<S: Simd, T: Stored>(
    simd: S,
    panel: &[[T; LANES]],
    count: usize,
    inputs: Range<usize>,
    block: usize,
    target: &mut [f32],
) {
    const GROUPS: usize = PANEL / LANES;
    let (target, _) = target.as_chunks_mut::<LANES>();
    let (tap, stride) = (count * GROUPS, block * GROUPS);
    for (index, vector) in (inputs.start * GROUPS..inputs.end * GROUPS).enumerate() {
        let target = &mut target[index..];
        let a = kernel_column(simd, panel, vector, tap);
        let b = kernel_column(simd, panel, vector + tap, tap);
        let c = kernel_column(simd, panel, vector + 2 * tap, tap);
        store_four(simd, halves(simd, [a[0], b[0], c[0]]), target, 0, stride);
        store_four(simd, halves(simd, [a[1], b[1], c[1]]), target, 4, stride);
        store_four(simd, halves(simd, [a[2], b[2], c[2]]), target, 8, stride);
        store_four(simd, halves(simd, [a[3], b[3], c[3]]), target, 12, stride);
    }
}

/// `G g` for the column of a kernel that begins with this vector; taps are `tap` vectors apart.
#[inline(always)]
fn kernel_column<S: Simd, T: Stored>(
    simd: S,
    panel: &[[T; LANES]],
    first: usize,
    tap: usize,
) -> [S::Floats; 4] {
    let upper = T::load(simd, &panel[first]);
    let middle = T::load(simd, &panel[first + 3 * tap]);
    let lower = T::load(simd, &panel[first + 6 * tap]);
    halves(simd, [upper, middle, lower])
}

/// `G` times three numbers.
#[inline(always)]
fn halves<S: Simd>(simd: S, [g0, g1, g2]: [S::Floats; 3]) -> [S::Floats; 4] {
    let half = simd.splat(0.5);
    let (outer, inner) = (simd.mul(simd.add(g0, g2), half), simd.mul(g1, half));
    [g0, simd.add(outer, inner), simd.sub(outer, inner), g2]
}

/// `A^T m A` of the sums of one tile, whose frequencies are `stride` apart: 2 x 2 outputs of a panel.
#[inline(always)]
pub(super) fn transform_sums<S: Simd>(
    simd: S,
    sums: &[f32],
    stride: usize,
    outputs: &mut [f32; 4 * PANEL],
) {
    for group in (0..PANEL).step_by(LANES) {
        let sums = &sums[group..];
        let a = sums_column(simd, sums, 0, stride);
        let b = sums_column(simd, sums, 1, stride);
        let c = sums_column(simd, sums, 2, stride);
        let d = sums_column(simd, sums, 3, stride);
        let upper = totals(simd, [a[0], b[0], c[0], d[0]]);
        let lower = totals(simd, [a[1], b[1], c[1], d[1]]);
        store(simd, upper[0], outputs, group);
        store(simd, upper[1], outputs, PANEL + group);
        store(simd, lower[0], outputs, 2 * PANEL + group);
        store(simd, lower[1], outputs, 3 * PANEL + group);
    }
}

/// `A^T m` for one column of the sums.
#[inline(always)]
fn sums_column<S: Simd>(simd: S, sums: &[f32], x: usize, stride: usize) -> [S::Floats; 2] {
    let upper = [load(simd, sums, x * stride), load(simd, sums, (4 + x) * stride)];
    let lower = [load(simd, sums, (8 + x) * stride), load(simd, sums, (12 + x) * stride)];
    totals(simd, [upper[0], upper[1], lower[0], lower[1]])
}

/// `A^T` times four numbers.
#[inline(always)]
fn totals<S: Simd>(simd: S, [m0, m1, m2, m3]: [S::Floats; 4]) -> [S::Floats; 2] {
    [simd.add(simd.add(m0, m1), m2), simd.sub(simd.sub(m1, m2), m3)]
}
