//! Convolutions in fewer products, at sizes where the engine chooses this way in single precision (a test beside it
//! says so); smaller ones are among the tests inside the engine.

use rare_nets::engine::{Activation, Backend, CpuBackend, Precision, Shape};

use super::convolution::{Before, Case, Format};
use super::{Candidates, Operation, numbers, on_every_processor};
use crate::reference_backend::ReferenceBackend;

/// Measured 4.4e-7.
fn single() -> Candidates {
    Candidates::new(Precision::F32, 1e-6)
}

const fn shape(batch: usize, height: usize, width: usize, channels: usize) -> Shape {
    Shape { batch, height, width, channels }
}

/// Odd images, the last vector of inputs and the last panel not full, everything before and after.
pub(super) fn odd(format: Format) -> Case {
    Case {
        parts: vec![(100, format), (50, format)],
        before: Before::Groups { groups: 10, silu: true },
        offset: true,
        residual: Some(1),
        activation: Activation::Silu,
        ..Case::plain(shape(2, 9, 7, 130), 150, 3)
    }
}

/// Chunks that end within rows and images.
pub(super) fn large() -> Case {
    Case { residual: Some(3), ..Case::plain(shape(3, 23, 31, 50), 130, 3) }
}

/// A doubled image, of which only some frequencies are computed.
pub(super) fn doubled() -> Case {
    Case { upsample: true, ..Case::plain(shape(2, 5, 3, 130), 100, 3) }
}

#[test]
fn every_format_of_a_file_is_convolved() {
    for format in [Format::F32, Format::F16, Format::Bf16] {
        single().follow(&odd(format));
    }
}

#[test]
fn large_images_are_cut_and_put_together() {
    single().follow(&large());
}

#[test]
fn doubled_images_are_convolved() {
    single().follow(&doubled());
    single().follow(&Case { bias: false, ..doubled() });
}

#[test]
fn long_sums_are_as_exact_as_single_precision_allows() {
    let case = Case::plain(shape(1, 8, 11, 1280), 128, 3);
    let expected = case.run(&ReferenceBackend::default()).unwrap();
    let square = |value: f64| value * value;
    let norm: f64 = expected.iter().map(|&value| square(f64::from(value))).sum();
    for backend in on_every_processor(Precision::F32) {
        let found = case.run(&backend).unwrap();
        let differences = expected.iter().zip(&found).map(|(&a, &b)| f64::from(a) - f64::from(b));
        let error = (differences.map(square).sum::<f64>() / norm).sqrt();
        let name = backend.processor().name();
        // Measured 9.4e-7 with all instructions.
        assert!(error < 2e-6, "relative error {error:e} on {name}");
    }
}

/// The convolution of an image alone.
fn alone(backend: &CpuBackend, case: &Case, values: &[f32]) -> Vec<f32> {
    let input = Shape { batch: 1, ..case.input };
    let case = Case { input, ..case.clone() };
    let input = backend.upload(input, values).unwrap();
    backend.download(&case.convolve(backend, &input).unwrap()).unwrap()
}

#[test]
fn an_image_becomes_the_same_alone_and_in_a_batch() {
    for case in [odd(Format::F16), Case { residual: None, ..large() }, doubled()] {
        let values = numbers(7, case.input.values());
        for backend in on_every_processor(Precision::F32) {
            let input = backend.upload(case.input, &values).unwrap();
            let together = case.convolve(&backend, &input).unwrap();
            let images = values.chunks_exact(values.len() / case.input.batch);
            let single: Vec<f32> =
                images.flat_map(|values| alone(&backend, &case, values)).collect();
            assert!(backend.download(&together).unwrap() == single, "{case:?}");
        }
    }
}
