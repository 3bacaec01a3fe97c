//! Convolutions with everything around them.

use half::{bf16, f16};
use rare::Result;
use rare_nets::engine::{
    Activation, Arrangement, Backend, Convolution, Kernel, Precision, Prologue, Shape,
};
use rare_nets::{Parameter, Values};

use super::{Candidates, Operation, numbers, uploaded};

/// A convolution of numbers that follow from their count.
#[derive(Debug, Clone)]
pub(super) struct Case {
    pub(super) input: Shape,
    /// Outputs of each part of the kernel, and how its file holds them.
    pub(super) parts: Vec<(usize, Format)>,
    pub(super) side: usize,
    pub(super) bias: bool,
    pub(super) arrangement: Arrangement,
    pub(super) before: Before,
    pub(super) upsample: bool,
    pub(super) stride: usize,
    pub(super) offset: bool,
    pub(super) activation: Activation,
    /// Images of the residual.
    pub(super) residual: Option<usize>,
    pub(super) intermediate: bool,
}

/// The precision of a file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Format {
    F32,
    F16,
    Bf16,
}

/// The prologue.
#[derive(Debug, Clone, Copy)]
pub(super) enum Before {
    Nothing,
    Silu,
    Groups { groups: usize, silu: bool },
    Layer,
}

impl Case {
    /// Nothing but the product.
    pub(super) fn plain(input: Shape, outputs: usize, side: usize) -> Case {
        Case {
            input,
            parts: vec![(outputs, Format::F32)],
            side,
            bias: true,
            arrangement: Arrangement::Plain,
            before: Before::Nothing,
            upsample: false,
            stride: 1,
            offset: false,
            activation: Activation::None,
            residual: None,
            intermediate: false,
        }
    }

    fn result(&self) -> Shape {
        let outputs: usize = self.parts.iter().map(|part| part.0).sum();
        let size = |size: usize| (size * (1 + usize::from(self.upsample))).div_ceil(self.stride);
        Shape {
            batch: self.input.batch,
            height: size(self.input.height),
            width: size(self.input.width),
            channels: if self.arrangement == Arrangement::Gated { outputs / 2 } else { outputs },
        }
    }

    fn pack<B: Backend>(&self, backend: &B) -> Result<B::Weight> {
        let (inputs, side) = (self.input.channels, self.side);
        // So that results have about the size of inputs.
        let scale = 3.0 / ((inputs * side * side) as f32).sqrt();
        let part = |&(outputs, format): &(usize, Format)| {
            let values = numbers(outputs as u64, outputs * inputs * side * side).into_iter();
            Parameter {
                shape: match side {
                    1 if format == Format::F16 => vec![outputs, inputs],
                    _ => vec![outputs, inputs, side, side],
                },
                values: in_format(values.map(|value| value * scale), format),
            }
        };
        let parts: Vec<Parameter> = self.parts.iter().map(part).collect();
        let outputs = parts.iter().map(|part| part.shape[0]).sum();
        let bias = numbers(2, outputs);
        let bias = self.bias.then_some(&bias[..]);
        backend.pack(&Kernel { parts: &parts, bias, arrangement: self.arrangement })
    }

    /// Of any input of the right shape.
    pub(super) fn convolve<B: Backend>(&self, backend: &B, input: &B::Tensor) -> Result<B::Tensor> {
        let channels = self.input.channels;
        let (scale, shift) = (numbers(3, channels), numbers(4, channels));
        let result = self.result();
        let one = Shape { batch: 1, height: 1, width: 1, ..result };
        let offset = self.offset.then(|| uploaded(backend, 5, one)).transpose()?;
        let images = |batch| uploaded(backend, 6, Shape { batch, ..result });
        let residual = self.residual.map(images).transpose()?;
        let fused = Convolution {
            prologue: self.before.prologue(&scale, &shift),
            upsample: self.upsample,
            stride: self.stride,
            offset: offset.as_ref(),
            activation: self.activation,
            residual: residual.as_ref(),
            intermediate: self.intermediate,
        };
        let convolved = backend.convolve(input, &self.pack(backend)?, &fused)?;
        assert_eq!(backend.shape(&convolved), result);
        Ok(convolved)
    }
}

impl Before {
    fn prologue<'a>(self, scale: &'a [f32], shift: &'a [f32]) -> Prologue<'a> {
        let epsilon = 1e-5;
        match self {
            Before::Nothing => Prologue::None,
            Before::Silu => Prologue::Silu,
            Before::Groups { groups, silu } => {
                Prologue::GroupNormalization { groups, epsilon, scale, shift, silu }
            }
            Before::Layer => Prologue::LayerNormalization { epsilon, scale, shift },
        }
    }
}

fn in_format(values: impl Iterator<Item = f32>, format: Format) -> Values {
    match format {
        Format::F32 => Values::F32(values.collect()),
        Format::F16 => Values::F16(values.map(f16::from_f32).collect()),
        Format::Bf16 => Values::Bf16(values.map(bf16::from_f32).collect()),
    }
}

impl Operation for Case {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        // Not around zero, so that a normalisation has a mean to take away.
        let values = numbers(1, self.input.values()).into_iter().map(|value| 2.0 * value + 1.0);
        let input = backend.upload(self.input, &values.collect::<Vec<f32>>())?;
        backend.download(&self.convolve(backend, &input)?)
    }
}

/// The second convolution takes what the first has left as an intermediate result.
#[derive(Debug)]
struct Chain([Case; 2]);

impl Operation for Chain {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let input = uploaded(backend, 1, self.0[0].input)?;
        let between = self.0[0].convolve(backend, &input)?;
        backend.download(&self.0[1].convolve(backend, &between)?)
    }
}

/// Single precision: measured 2.5e-6 in sums of 5120, and 1.6e-6 else.
fn single() -> Candidates {
    Candidates::new(Precision::F32, 5e-6)
}

/// Factors of 8 bits: measured 7.1e-3.
fn half() -> Candidates {
    Candidates::new(Precision::Bf16, 1e-2)
}

const fn shape(batch: usize, height: usize, width: usize, channels: usize) -> Shape {
    Shape { batch, height, width, channels }
}

const PROLOGUES: [Before; 5] = [
    Before::Nothing,
    Before::Silu,
    Before::Groups { groups: 3, silu: false },
    Before::Groups { groups: 2, silu: true },
    Before::Layer,
];

/// Number `index` of all combinations of what a convolution can do. Two panels of outputs, neither full.
fn combination(mut index: usize) -> Option<Case> {
    let mut choose = |count: usize| {
        let chosen = index % count;
        index /= count;
        chosen
    };
    let case = Case {
        side: [1, 3][choose(2)],
        before: PROLOGUES[choose(5)],
        upsample: choose(2) == 1,
        stride: 1 + choose(2),
        offset: choose(2) == 1,
        activation: [Activation::None, Activation::Silu, Activation::QuickGelu][choose(3)],
        residual: [None, Some(3), Some(1)][choose(3)],
        intermediate: choose(2) == 1,
        arrangement: [Arrangement::Plain, Arrangement::Gated][choose(2)],
        ..Case::plain(shape(3, 3, 4, 6), 34, 1)
    };
    (index == 0).then_some(case)
}

fn all_combinations_follow(candidates: &Candidates) {
    // No network adds an offset to gates, and the engine refuses it.
    let refused = |case: &Case| case.offset && case.arrangement == Arrangement::Gated;
    let cases = (0..).map_while(combination).filter(|case| !refused(case));
    assert_eq!(cases.map(|case| candidates.follow(&case)).count(), 2160);
}

#[test]
fn all_combinations_follow_the_definition_in_single_precision() {
    all_combinations_follow(&single());
}

#[test]
fn all_combinations_follow_the_definition_in_half_precision() {
    all_combinations_follow(&half());
}

#[test]
fn any_number_of_channels_goes_in_and_out() {
    let counts = [1, 3, 5, 17, 33, 320];
    for candidates in [single(), half()] {
        for (inputs, outputs) in counts.iter().flat_map(|&a| counts.map(|b| (a, b))) {
            for side in [1, 3] {
                let case = Case::plain(shape(3, 2, 1, inputs), outputs, side);
                candidates.follow(&case);
                let before = Before::Groups { groups: 5, silu: true };
                let input = shape(1, 1, 2, inputs.next_multiple_of(5));
                candidates.follow(&Case { before, ..Case::plain(input, outputs, side) });
            }
        }
    }
}

#[test]
fn gates_of_any_number_of_channels_are_applied() {
    for candidates in [single(), half()] {
        for half in [1, 3, 16, 17, 33, 160] {
            let case = Case::plain(shape(1, 1, 7, 19), 2 * half, 1);
            candidates.follow(&Case { arrangement: Arrangement::Gated, ..case });
        }
    }
}

#[test]
fn every_format_of_a_file_is_read_and_parts_are_joined() {
    use Format::{Bf16, F16, F32};
    let formats = [[F32, F32, F32], [F16, F16, F16], [Bf16, Bf16, Bf16], [F32, F16, Bf16]];
    for candidates in [single(), half()] {
        for (format, side) in formats.into_iter().flat_map(|one| [(one, 1), (one, 3)]) {
            let parts = [3, 17, 32].into_iter().zip(format).collect();
            let case = Case { parts, ..Case::plain(shape(2, 3, 2, 37), 1, side) };
            candidates.follow(&case);
            candidates.follow(&Case { bias: false, ..case });
        }
    }
}

#[test]
fn long_sums_are_cut_and_put_together() {
    for candidates in [single(), half()] {
        for format in [Format::F32, Format::F16, Format::Bf16] {
            // Blocks end within a tap, and with a tap.
            for (input, side) in
                [(shape(1, 2, 3, 5120), 1), (shape(1, 2, 1, 2560), 3), (shape(1, 2, 2, 700), 3)]
            {
                let parts = vec![(33, format)];
                candidates.follow(&Case { parts, ..Case::plain(input, 33, side) });
            }
        }
    }
}

#[test]
fn large_images_are_cut_and_put_together() {
    for candidates in [single(), half()] {
        for (side, stride) in [(1, 1), (3, 1), (3, 2)] {
            let before = Before::Groups { groups: 2, silu: false };
            let residual = Some(1);
            let case = Case::plain(shape(2, 37, 29, 6), 35, side);
            candidates.follow(&Case { before, residual, stride, ..case });
        }
    }
}

#[test]
fn a_large_mean_does_not_drown_the_deviation() {
    #[derive(Debug)]
    struct Shifted(Case);
    impl Operation for Shifted {
        fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
            let values = numbers(1, self.0.input.values()).into_iter().map(|value| value + 100.0);
            let input = backend.upload(self.0.input, &values.collect::<Vec<f32>>())?;
            backend.download(&self.0.convolve(backend, &input)?)
        }
    }
    // Measured 6.2e-5: a mean of 100 is known to 6e-6, and three channels may deviate from it by a tenth only.
    let candidates = Candidates::new(Precision::F32, 1e-4);
    for before in [Before::Layer, Before::Groups { groups: 1, silu: false }] {
        for channels in [3, 17, 32] {
            let case = Case::plain(shape(2, 3, 50, channels), 5, 1);
            candidates.follow(&Shifted(Case { before, ..case }));
        }
    }
}

#[test]
fn intermediate_results_go_into_further_products() {
    for candidates in [single(), half()] {
        for (channels, before) in [6, 7, 34].into_iter().flat_map(|c| PROLOGUES.map(|b| (c, b))) {
            let first = Case::plain(shape(2, 3, 4, 5), channels, 1);
            let first = Case { intermediate: true, activation: Activation::Silu, ..first };
            let before = match before {
                Before::Groups { silu, .. } => Before::Groups { groups: 1, silu },
                other => other,
            };
            for (side, upsample) in [(1, false), (3, false), (3, true)] {
                let second = Case::plain(shape(2, 3, 4, channels), 9, side);
                let second = Case { before, upsample, ..second };
                candidates.follow(&Chain([first.clone(), second]));
            }
        }
    }
}
