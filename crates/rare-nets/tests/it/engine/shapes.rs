//! Shapes that do not fit are errors, and nothing panics.

use rare::{Error, Result};
use rare_nets::engine::{
    Arrangement, Backend, Convolution, CpuBackend, Kernel, PackedWeight, Precision, Prologue,
    Shape, Tensor,
};
use rare_nets::{Parameter, Values};

use super::{on_every_processor, uploaded};

fn on_all(test: impl Fn(&CpuBackend)) {
    for precision in [Precision::F32, Precision::Bf16] {
        on_every_processor(precision).iter().for_each(&test);
    }
}

fn tensor(backend: &CpuBackend, sizes: [usize; 4]) -> Tensor {
    uploaded(backend, 1, shape(sizes)).unwrap()
}

fn shape([batch, height, width, channels]: [usize; 4]) -> Shape {
    Shape { batch, height, width, channels }
}

fn part(shape: &[usize]) -> Parameter {
    Parameter { shape: shape.to_vec(), values: Values::F32(vec![0.5; shape.iter().product()]) }
}

fn packed(backend: &CpuBackend, shape: &[usize], arrangement: Arrangement) -> PackedWeight {
    backend.pack(&Kernel { parts: &[part(shape)], bias: None, arrangement }).unwrap()
}

#[track_caller]
fn refused<T>(result: Result<T>, what: &str) {
    match result {
        Err(Error::Internal(_)) => {}
        Err(error) => panic!("another error for {what}: {error}"),
        Ok(_) => panic!("no error for {what}"),
    }
}

#[test]
fn values_that_do_not_fill_a_shape_are_refused() {
    on_all(|backend| {
        let sizes = [
            ([1, 1, 2, 3], 5),
            ([1, 1, 2, 3], 7),
            ([0, 2, 2, 3], 0),
            ([2, 0, 2, 3], 0),
            ([2, 2, 0, 3], 0),
            ([2, 2, 2, 0], 0),
            ([usize::MAX, 2, 1, 1], 4),
            ([1 << 32, 1 << 32, 1, 1], 0),
        ];
        for (sizes, count) in sizes {
            refused(backend.upload(shape(sizes), &vec![0.0; count]), &format!("{sizes:?}"));
        }
    });
}

#[test]
fn kernels_that_do_not_fit_are_refused() {
    on_all(|backend| {
        let pack = |parts: &[Parameter], bias: Option<&[f32]>, arrangement| {
            backend.pack(&Kernel { parts, bias, arrangement })
        };
        let plain = |parts: &[Parameter]| pack(parts, None, Arrangement::Plain);
        refused(plain(&[]), "no part");
        for shape in [
            &[4][..],
            &[4, 3, 1],
            &[4, 3, 3, 1],
            &[4, 3, 2, 2],
            &[4, 3, 5, 5],
            &[4, 0],
            &[0, 3],
            &[0, 3, 3, 3],
        ] {
            refused(plain(&[part(shape)]), &format!("{shape:?}"));
        }
        refused(plain(&[part(&[4, 3]), part(&[4, 2])]), "other inputs");
        refused(plain(&[part(&[4, 3]), part(&[4, 3, 3, 3])]), "another side");
        refused(plain(&[part(&[4, 3]), part(&[0, 3])]), "an empty part");
        let lacking = Parameter { shape: vec![5, 3], ..part(&[4, 3]) };
        refused(plain(&[lacking]), "too few values");
        let endless = Parameter { shape: vec![usize::MAX, 3], ..part(&[4, 3]) };
        refused(plain(&[part(&[4, 3]), endless]), "an endless shape");
        let plain = Arrangement::Plain;
        refused(pack(&[part(&[4, 3])], Some(&[0.0; 3]), plain), "too few biases");
        refused(pack(&[part(&[4, 3])], Some(&[0.0; 5]), plain), "too many biases");
        refused(pack(&[part(&[5, 3])], None, Arrangement::Gated), "gates without values");
    });
}

#[test]
fn convolutions_that_do_not_fit_are_refused() {
    on_all(|backend| {
        let weight = packed(backend, &[4, 6, 3, 3], Arrangement::Plain);
        let input = tensor(backend, [2, 3, 3, 6]);
        assert!(backend.convolve(&input, &weight, &Convolution::default()).is_ok());
        for channels in [1, 5, 7, 12] {
            let input = tensor(backend, [2, 3, 3, channels]);
            let result = backend.convolve(&input, &weight, &Convolution::default());
            refused(result, &format!("{channels} channels"));
        }
        for stride in [0, 3] {
            let fused = Convolution { stride, ..Convolution::default() };
            refused(backend.convolve(&input, &weight, &fused), &format!("stride {stride}"));
        }
        for (groups, scale, shift) in [(0, 6, 6), (4, 6, 6), (7, 6, 6), (2, 5, 6), (2, 6, 7)] {
            let (scale, shift) = (&vec![1.0; scale][..], &vec![1.0; shift][..]);
            let groups =
                Prologue::GroupNormalization { groups, epsilon: 1e-5, scale, shift, silu: false };
            let fused = Convolution { prologue: groups, ..Convolution::default() };
            refused(backend.convolve(&input, &weight, &fused), &format!("{groups:?}"));
        }
        for (scale, shift) in [(5, 6), (6, 7), (0, 0)] {
            let (scale, shift) = (&vec![1.0; scale][..], &vec![1.0; shift][..]);
            let layer = Prologue::LayerNormalization { epsilon: 1e-5, scale, shift };
            let fused = Convolution { prologue: layer, ..Convolution::default() };
            refused(backend.convolve(&input, &weight, &fused), &format!("{layer:?}"));
        }
    });
}

#[test]
fn offsets_and_residuals_that_do_not_fit_are_refused() {
    on_all(|backend| {
        let weight = packed(backend, &[4, 6, 3, 3], Arrangement::Plain);
        let input = tensor(backend, [4, 3, 5, 6]);
        for sizes in [[1, 1, 1, 3], [1, 1, 1, 5], [1, 1, 2, 2], [2, 1, 1, 4], [1, 1, 4, 1]] {
            let offset = tensor(backend, sizes);
            let fused = Convolution { offset: Some(&offset), ..Convolution::default() };
            refused(backend.convolve(&input, &weight, &fused), &format!("offset {sizes:?}"));
        }
        for sizes in
            [[3, 3, 5, 4], [8, 3, 5, 4], [4, 5, 3, 4], [4, 3, 5, 6], [1, 3, 4, 4], [1, 1, 1, 4]]
        {
            let residual = tensor(backend, sizes);
            let fused = Convolution { residual: Some(&residual), ..Convolution::default() };
            refused(backend.convolve(&input, &weight, &fused), &format!("residual {sizes:?}"));
        }
        let gated = packed(backend, &[4, 6], Arrangement::Gated);
        let offset = tensor(backend, [1, 1, 1, 2]);
        let fused = Convolution { offset: Some(&offset), ..Convolution::default() };
        refused(backend.convolve(&input, &gated, &fused), "an offset to gates");
    });
}

#[test]
fn weights_of_the_other_precision_are_refused() {
    let [single, half] = [Precision::F32, Precision::Bf16].map(on_every_processor);
    for (single, half) in single.iter().zip(&half) {
        for (ours, other) in [(single, half), (half, single)] {
            let weight = packed(other, &[4, 6], Arrangement::Plain);
            let input = tensor(ours, [1, 2, 2, 6]);
            refused(ours.convolve(&input, &weight, &Convolution::default()), "weights");
        }
    }
}

#[test]
fn attention_that_does_not_fit_is_refused() {
    on_all(|backend| {
        for (channels, heads) in [(12, 0), (12, 3), (12, 5), (12, 8), (13, 1), (14, 2), (2, 1)] {
            let input = tensor(backend, [2, 1, 4, channels]);
            let what = format!("{channels} channels, {heads} heads");
            refused(backend.self_attention(&input, heads, false), &what);
        }
        let cross = |contexts: &[[usize; 4]], heads| {
            let contexts: Vec<Tensor> = contexts.iter().map(|&one| tensor(backend, one)).collect();
            let queries = tensor(backend, [4, 2, 3, 6]);
            backend.cross_attention(&queries, &contexts.iter().collect::<Vec<_>>(), heads)
        };
        assert!(cross(&[[1, 1, 7, 12], [1, 1, 7, 12]], 2).is_ok());
        for heads in [0, 4, 5, 7] {
            refused(cross(&[[1, 1, 7, 12]], heads), &format!("{heads} heads"));
        }
        for channels in [6, 11, 13, 18] {
            refused(cross(&[[1, 1, 7, channels]], 2), &format!("{channels} channels"));
        }
        refused(cross(&[], 2), "no context");
        refused(cross(&[[1, 1, 7, 12]; 3], 2), "three contexts for four images");
        refused(cross(&[[1, 1, 7, 12]; 5], 2), "more contexts than images");
        refused(cross(&[[1, 1, 7, 12], [1, 1, 8, 12]], 2), "contexts of other lengths");
        refused(cross(&[[2, 1, 7, 12]], 2), "a context of two images");
    });
}

#[test]
fn tensors_of_other_pixels_are_not_joined() {
    on_all(|backend| {
        let first = tensor(backend, [2, 3, 4, 5]);
        for sizes in [[1, 3, 4, 5], [2, 4, 3, 5], [2, 3, 5, 5], [2, 1, 12, 5]] {
            refused(backend.concatenate(&first, &tensor(backend, sizes)), &format!("{sizes:?}"));
        }
    });
}

#[test]
fn what_is_kept_for_products_is_nothing_to_add_or_join() {
    for backend in on_every_processor(Precision::Bf16) {
        let weight = packed(&backend, &[6, 6], Arrangement::Plain);
        let input = tensor(&backend, [1, 2, 2, 6]);
        let intermediate = Convolution { intermediate: true, ..Convolution::default() };
        let kept = backend.convolve(&input, &weight, &intermediate).unwrap();
        refused(backend.concatenate(&input, &kept), "joining");
        let fused = Convolution { residual: Some(&kept), ..Convolution::default() };
        refused(backend.convolve(&input, &weight, &fused), "adding");
    }
}
