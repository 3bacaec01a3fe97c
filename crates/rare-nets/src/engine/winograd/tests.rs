//! Whole numbers, so that every order of the sums gives the same and every result is exact.

use std::sync::Arc;

use half::{bf16, f16};

use super::super::arena::Arena;
use super::super::backend::{Arrangement, Backend, Convolution, Kernel, Prologue, Shape};
use super::super::convolution::Context;
use super::super::cpu::{CpuBackend, Precision};
use super::super::epilogue::Epilogue;
use super::super::operand::Preparation;
use super::super::pack::{PackedWeight, Storage, pack};
use super::super::simd::Processor;
use super::{CHUNK_TILES, Plan, Winograd, costs_less, pays};
use crate::{Parameter, Values};

fn number(index: usize) -> f32 {
    (index * 7 % 11) as f32 - 5.0
}

fn packed(
    processor: Processor,
    [outputs, inputs, side]: [usize; 3],
    storage: Storage,
) -> PackedWeight {
    // Multiples of 4: their quarters, the kernels' frequencies, are whole.
    let values = (0..outputs * inputs * side * side).map(|index| 4.0 * number(index));
    let values = match storage {
        Storage::F16 => Values::F16(values.map(f16::from_f32).collect()),
        Storage::Bf16 => Values::Bf16(values.map(bf16::from_f32).collect()),
        Storage::F32 | Storage::Pairs => Values::F32(values.collect()),
    };
    let parts = [Parameter { shape: vec![outputs, inputs, side, side], values }];
    let kernel = Kernel { parts: &parts, bias: None, arrangement: Arrangement::Plain };
    let precision = match storage {
        Storage::Pairs => Precision::Bf16,
        _ => Precision::F32,
    };
    let weight = pack(processor, &kernel, precision).unwrap();
    assert_eq!(weight.storage, storage);
    weight
}

/// The convolution of the numbers in their order, whether it pays or not.
fn convolved(
    processor: Processor,
    input: Shape,
    upsample: bool,
    weight: &PackedWeight,
) -> Vec<f32> {
    let arena = &Arc::<Arena>::default();
    let context = Context { processor, precision: Precision::F32, arena };
    let values: Vec<f32> = (0..input.values()).map(number).collect();
    let input = CpuBackend::on(processor, Precision::F32).upload(input, &values).unwrap();
    let (prologue, precision) = (Prologue::None, Precision::F32);
    let preparation = Preparation { processor, arena, precision, prologue, upsample, border: 1 };
    let (layout, operand) = (preparation.layout(&input), preparation.prepare(&input));
    let (height, width) = (layout.height - 2, layout.width - 2);
    let shape = Shape { height, width, channels: weight.outputs, ..input.shape };
    let epilogue = Epilogue::new(weight, &Convolution::default(), shape).unwrap();
    let mut output = vec![f32::NAN; shape.values()];
    let operand = operand.units();
    let winograd = Winograd { context, operand, layout, weight, shape, upsampled: upsample };
    winograd.compute(&epilogue, &mut output);
    output
}

/// By the definition.
fn expected(input: Shape, upsample: bool, outputs: usize) -> Vec<f32> {
    let factor = 1 + usize::from(upsample);
    let (height, width) = (input.height * factor, input.width * factor);
    let value = |image: usize, y: usize, x: usize, channel: usize| {
        // Counted from the border of zeros.
        if (1..=height).contains(&y) && (1..=width).contains(&x) {
            let (y, x) = ((y - 1) / factor, (x - 1) / factor);
            number(((image * input.height + y) * input.width + x) * input.channels + channel)
        } else {
            0.0
        }
    };
    let one = |index: usize| {
        let (output, pixel) = (index % outputs, index / outputs);
        let (image, y, x) = (pixel / (height * width), pixel / width % height, pixel % width);
        let products = (0..input.channels * 9).map(|at| {
            let (channel, tap) = (at / 9, at % 9);
            let kernel = 4.0 * number(output * input.channels * 9 + at);
            kernel * value(image, y + tap / 3, x + tap % 3, channel)
        });
        products.sum::<f32>()
    };
    (0..input.batch * height * width * outputs).map(one).collect()
}

#[test]
fn images_of_every_size_are_convolved_exactly() {
    let sizes: &[(usize, usize)] = if cfg!(miri) {
        &[(3, 2)]
    } else {
        &[(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (4, 7), (11, 3)]
    };
    for processor in Processor::available() {
        for &(height, width) in sizes {
            for (inputs, outputs) in [(1, 1), (17, 3), (5, 33)] {
                let weight = packed(processor, [outputs, inputs, 3], Storage::F32);
                let input = Shape { batch: 2, height, width, channels: inputs };
                for upsample in [false, true] {
                    let found = convolved(processor, input, upsample, &weight);
                    let name = processor.name();
                    assert_eq!(found, expected(input, upsample, outputs), "{name} {input:?}");
                }
            }
        }
    }
}

#[test]
fn kernels_of_every_storage_and_many_blocks_are_convolved_exactly() {
    let inputs = if cfg!(miri) { 98 } else { 300 };
    for processor in Processor::available() {
        for storage in [Storage::F32, Storage::F16, Storage::Bf16] {
            let weight = packed(processor, [2, inputs, 3], storage);
            let input = Shape { batch: 1, height: 2, width: 3, channels: inputs };
            let found = convolved(processor, input, false, &weight);
            assert_eq!(found, expected(input, false, 2), "{storage:?} {}", processor.name());
        }
    }
}

#[test]
fn parts_are_all_of_the_whole() {
    for (batch, inputs) in [(1, 1), (1, 320), (3, 96), (2, 97), (5, 2560)] {
        let plan = Plan::new(Shape { batch, height: 63, width: 87, channels: 1 }, inputs, false);
        let chunks = (0..plan.chunks.parts).map(|chunk| plan.chunks.part(chunk));
        assert!(chunks.clone().all(|chunk| chunk.len() <= plan.chunks.longest()));
        assert!(plan.chunks.longest() <= CHUNK_TILES);
        assert!(chunks.flatten().eq(0..batch * 32 * 44));
        assert!((0..plan.blocks).flat_map(|block| plan.inputs(block)).eq(0..inputs));
    }
}

#[test]
fn it_pays_on_all_but_small_images_and_few_channels() {
    let better = |inputs, outputs, size| costs_less(inputs, outputs, size, false);
    // The networks', and those of the tests of whole convolutions.
    for (channels, size) in [(320, [64, 88]), (640, [32, 44]), (1280, [16, 22]), (1280, [8, 11])] {
        assert!(better(channels, channels, size));
    }
    assert!(better(130, 160, [9, 7]) && better(50, 160, [23, 31]) && better(1280, 128, [8, 11]));
    assert!(costs_less(130, 128, [10, 6], true));
    assert!(!better(3, 32, [512, 704]) && !better(320, 32, [64, 88]) && !better(4, 320, [64, 88]));
    assert!(!better(1280, 1280, [3, 3]) && !better(1280, 1280, [1, 100]));
}

#[test]
fn only_square_kernels_in_single_precision_without_stride_are_convolved_this_way() {
    let processor = Processor::available()[0];
    let shape = Shape { batch: 1, height: 64, width: 88, channels: 320 };
    let single = packed(processor, [320, 320, 3], Storage::F16);
    assert!(pays(&single, 1, shape, false) && pays(&single, 1, shape, true));
    assert!(!pays(&single, 2, shape, false));
    assert!(!pays(&packed(processor, [320, 320, 1], Storage::F16), 1, shape, false));
    assert!(!pays(&packed(processor, [320, 320, 3], Storage::Pairs), 1, shape, false));
}
