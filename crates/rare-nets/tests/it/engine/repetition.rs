//! The same bits for any number of threads, and whatever the memory held before.

use rare::Result;
use rare_nets::engine::{Activation, Backend, CpuBackend, Precision, Shape};

use super::attention::{CrossAttention, Projected, SelfAttention};
use super::convolution::{Before, Case, Format};
use super::winograd::{doubled, large, odd};
use super::{Concatenation, Operation, on_every_processor};

/// Results of operations that together use every kind of buffer, and of which several threads have their part.
fn results(backend: &CpuBackend) -> Result<Vec<Vec<u32>>> {
    let shape = |channels| Shape { batch: 3, height: 23, width: 15, channels };
    let groups = Before::Groups { groups: 3, silu: true };
    let image =
        Case { before: groups, residual: Some(1), offset: true, ..Case::plain(shape(9), 70, 3) };
    let narrow = Case {
        parts: vec![(40, Format::F16)],
        before: Before::Layer,
        activation: Activation::Silu,
        intermediate: true,
        ..Case::plain(shape(17), 40, 1)
    };
    let long = Case::plain(Shape { batch: 1, height: 2, width: 3, channels: 3500 }, 33, 1);
    let pixels = SelfAttention { batch: 2, tokens: 300, heads: 3, head: 5, causal: true };
    let projected = SelfAttention { batch: 1, tokens: 77, heads: 2, head: 40, causal: false };
    let context = CrossAttention { batch: 4, contexts: 2, tokens: 77, heads: 3, head: 7 };
    [
        image.run(backend),
        narrow.run(backend),
        long.run(backend),
        odd(Format::F16).run(backend),
        large().run(backend),
        doubled().run(backend),
        pixels.run(backend),
        Projected(projected).run(backend),
        context.run(backend),
        Concatenation([17, 3]).run(backend),
    ]
    .into_iter()
    .map(|result| Ok(result?.into_iter().map(f32::to_bits).collect()))
    .collect()
}

fn on_threads(count: usize, backend: &CpuBackend) -> Vec<Vec<u32>> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
    pool.install(|| results(backend)).unwrap()
}

/// Leaves buffers of all sizes that hold nothing but numbers that are none, in either precision.
fn spoil(backend: &CpuBackend) {
    let none = f32::from_bits(0x7fc1_7fc1);
    let buffers = (4..19).flat_map(|power| vec![1_usize << power; 8]).map(|channels| {
        let shape = Shape { batch: 1, height: 1, width: 1, channels };
        backend.upload(shape, &vec![none; channels]).unwrap()
    });
    // Kept until the last is made: what is given back would be used again.
    drop(buffers.collect::<Vec<_>>());
}

#[test]
fn results_are_the_same_for_any_number_of_threads() {
    for precision in [Precision::F32, Precision::Bf16] {
        for backend in on_every_processor(precision) {
            let name = backend.processor().name();
            let expected = on_threads(1, &backend);
            for count in [2, 5] {
                assert!(on_threads(count, &backend) == expected, "{count} threads on {name}");
            }
        }
    }
}

#[test]
fn results_do_not_depend_on_what_the_memory_held() {
    for precision in [Precision::F32, Precision::Bf16] {
        for backend in on_every_processor(precision) {
            let name = backend.processor().name();
            let expected = results(&backend).unwrap();
            let numbers = expected.iter().flatten().map(|&bits| f32::from_bits(bits));
            assert!(numbers.map(f32::abs).all(|number| number < 100.0), "{name}");
            for _ in 0..2 {
                spoil(&backend);
                assert!(results(&backend).unwrap() == expected, "{precision:?} on {name}");
            }
        }
    }
}
