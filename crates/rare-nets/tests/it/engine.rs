//! The engine on the CPU, operation by operation: against the definitions in `reference_backend`, with all instructions
//! that this machine has and in both precisions.

mod attention;
mod convolution;
mod repetition;
mod shapes;
mod winograd;

use std::fmt::Debug;

use rare::Result;
use rare::random::Random;
use rare_nets::engine::{Backend, CpuBackend, Precision, Processor, Shape};

use crate::reference_backend::ReferenceBackend;

/// Something that every backend computes from the same numbers.
trait Operation: Debug + Sync {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>>;
}

/// The backends of one precision, with memory that earlier operations have used.
struct Candidates {
    backends: Vec<CpuBackend>,
    /// Relative to the largest number of a result.
    tolerance: f64,
}

impl Candidates {
    fn new(precision: Precision, tolerance: f64) -> Candidates {
        Candidates { backends: on_every_processor(precision), tolerance }
    }

    /// Compares all backends with the definition.
    fn follow(&self, operation: &impl Operation) {
        let expected = operation.run(&ReferenceBackend::default()).unwrap();
        for backend in &self.backends {
            let error = relative_error(&expected, &operation.run(backend).unwrap());
            let name = backend.processor().name();
            assert!(error < self.tolerance, "error {error:e} of {operation:?} on {name}");
        }
    }
}

fn on_every_processor(precision: Precision) -> Vec<CpuBackend> {
    let processors = Processor::available().into_iter();
    processors.map(|processor| CpuBackend::on(processor, precision)).collect()
}

/// The largest error relative to the largest number.
fn relative_error(expected: &[f32], found: &[f32]) -> f64 {
    assert_eq!(expected.len(), found.len());
    assert!(found.iter().all(|value| value.is_finite()));
    let errors = expected.iter().zip(found).map(|(&a, &b)| (f64::from(a) - f64::from(b)).abs());
    let largest = expected.iter().map(|&value| f64::from(value).abs()).fold(0.0, f64::max);
    assert!(largest > 0.0, "a test of zeros proves nothing");
    errors.fold(0.0, f64::max) / largest
}

/// Numbers between -1 and 1 with all bits of single precision, the same on every machine.
fn numbers(seed: u64, count: usize) -> Vec<f32> {
    let mut random = Random::new(seed, 0);
    (0..count).map(|_| (2.0 * random.uniform() - 1.0) as f32).collect()
}

fn uploaded<B: Backend>(backend: &B, seed: u64, shape: Shape) -> Result<B::Tensor> {
    backend.upload(shape, &numbers(seed, shape.values()))
}

/// Joins the channels of two tensors with these many channels each.
#[derive(Debug)]
struct Concatenation([usize; 2]);

impl Operation for Concatenation {
    fn run<B: Backend>(&self, backend: &B) -> Result<Vec<f32>> {
        let shape = |channels| Shape { batch: 2, height: 3, width: 1, channels };
        let first = uploaded(backend, 1, shape(self.0[0]))?;
        let second = uploaded(backend, 2, shape(self.0[1]))?;
        let joined = backend.concatenate(&first, &second)?;
        assert_eq!(backend.shape(&joined), shape(self.0[0] + self.0[1]));
        backend.download(&joined)
    }
}

#[test]
fn channels_are_joined() {
    for precision in [Precision::F32, Precision::Bf16] {
        // Nothing is computed: not a bit may change.
        let candidates = Candidates::new(precision, f64::MIN_POSITIVE);
        for channels in [[1, 1], [3, 17], [320, 5], [16, 33]] {
            candidates.follow(&Concatenation(channels));
        }
    }
}
