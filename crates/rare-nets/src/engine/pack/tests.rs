use half::{bf16, f16};

use super::super::backend::{Arrangement, Kernel};
use super::super::cpu::Precision;
use super::super::simd::{Processor, Simd, Vectorized};
use super::{PANEL, PackedWeight, Storage, pack};
use crate::{Parameter, Values};

/// Element `100 * output + 10 * input + tap`; the outputs of a part go on from those of the one before.
fn part(outputs: std::ops::Range<usize>, inputs: usize, side: usize) -> Parameter {
    let shape = vec![outputs.len(), inputs, side, side];
    let taps = side * side;
    let values = outputs.flat_map(|output| {
        (0..inputs * taps).map(move |at| (100 * output + 10 * (at / taps) + at % taps) as f32)
    });
    Parameter { shape, values: Values::F32(values.collect()) }
}

fn packed(parts: &[Parameter], arrangement: Arrangement, precision: Precision) -> PackedWeight {
    let rows = parts.iter().map(|part| part.shape[0]).sum();
    let bias: Vec<f32> = (0..rows).map(|row| 1.0 + row as f32).collect();
    let kernel = Kernel { parts, bias: Some(&bias), arrangement };
    pack(Processor::available()[0], &kernel, precision).unwrap()
}

#[test]
fn columns_are_outputs_and_rows_are_inputs_tap_by_tap() {
    let parts = [part(0..2, 2, 3), part(2..3, 2, 3)];
    let packed = packed(&parts, Arrangement::Plain, Precision::F32);
    assert_eq!((packed.panels, packed.outputs, packed.inputs, packed.side), (1, 3, 2, 3));
    let elements = &packed.elements.slice::<f32>()[..9 * 2 * PANEL];
    let rows: Vec<&[f32]> = elements.chunks_exact(PANEL).collect();
    assert_eq!(rows[0][..4], [0.0, 100.0, 200.0, 0.0]);
    assert_eq!(rows[1][..4], [10.0, 110.0, 210.0, 0.0]);
    assert_eq!(rows[2][..4], [1.0, 101.0, 201.0, 0.0]);
    assert_eq!(rows[17][..4], [18.0, 118.0, 218.0, 0.0]);
    assert!(rows.iter().all(|row| row[3..].iter().all(|&value| value == 0.0)));
    assert_eq!(packed.bias[..4], [1.0, 2.0, 3.0, 0.0]);
    assert_eq!(packed.bias.len(), PANEL);
}

#[test]
fn outputs_beyond_a_panel_go_to_the_next() {
    let packed = packed(&[part(0..34, 3, 1)], Arrangement::Plain, Precision::F32);
    assert_eq!(packed.panels, 2);
    let elements = packed.elements.slice::<f32>();
    assert_eq!(elements[PANEL + 31], 3110.0);
    assert_eq!(elements[3 * PANEL..][..3], [3200.0, 3300.0, 0.0]);
    assert_eq!(packed.bias[32..35], [33.0, 34.0, 0.0]);
}

#[test]
fn gates_stand_beside_their_values() {
    let packed = packed(&[part(0..36, 1, 1)], Arrangement::Gated, Precision::F32);
    assert_eq!((packed.panels, packed.outputs), (2, 18));
    let elements = packed.elements.slice::<f32>();
    assert_eq!(elements[..2], [0.0, 100.0]);
    assert_eq!(elements[16..18], [1800.0, 1900.0]);
    assert_eq!(elements[PANEL..][..3], [1600.0, 1700.0, 0.0]);
    assert_eq!(elements[PANEL + 16..][..3], [3400.0, 3500.0, 0.0]);
    assert_eq!(packed.bias[PANEL + 16..][..3], [35.0, 36.0, 0.0]);
}

#[test]
fn two_inputs_are_a_pair_and_the_last_may_be_alone() {
    let packed = packed(&[part(0..2, 3, 1)], Arrangement::Plain, Precision::Bf16);
    assert_eq!((packed.storage, packed.steps()), (Storage::Pairs, 2));
    let elements: Vec<f32> =
        packed.elements.slice::<bf16>()[..4 * PANEL].iter().map(|value| value.to_f32()).collect();
    assert_eq!(elements[..5], [0.0, 10.0, 100.0, 110.0, 0.0]);
    assert_eq!(elements[2 * PANEL..][..5], [20.0, 0.0, 120.0, 0.0, 0.0]);
}

/// Widens some steps of the first panel.
struct Block<'a>(&'a PackedWeight, std::ops::Range<usize>);

impl Vectorized for Block<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<f32> {
        let mut scratch = vec![f32::NAN; (self.1.len() + 1) * PANEL];
        self.0.block(simd, 0, self.1, &mut scratch).to_vec()
    }
}

#[test]
fn narrow_elements_stay_narrow_and_are_widened_block_by_block() {
    let wide = part(0..3, 5, 1);
    let narrow = |values| Parameter { values, ..wide.clone() };
    let halves = wide.to_f32().into_iter().map(f16::from_f32).collect();
    let uppers = wide.to_f32().into_iter().map(bf16::from_f32).collect();
    for (values, storage) in
        [(Values::F16(halves), Storage::F16), (Values::Bf16(uppers), Storage::Bf16)]
    {
        let packed = packed(&[narrow(values)], Arrangement::Plain, Precision::F32);
        assert_eq!(packed.storage, storage);
        for processor in Processor::available() {
            let block = processor.run(Block(&packed, 1..4));
            assert_eq!(block.len(), 3 * PANEL);
            assert_eq!(block[..4], [10.0, 110.0, 210.0, 0.0]);
            assert_eq!(block[2 * PANEL..][..4], [30.0, 130.0, 230.0, 0.0]);
        }
    }
}
