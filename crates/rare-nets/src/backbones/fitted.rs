//! The sizes and lengths of a network from its weights: sizes by the shapes of tensors, lengths by the kernel points,
//! which are stored in metres.

use rare::{Error, Result};

use super::geotransformer::{FineMatchingConfig, GeoTransformerConfig, TransformerConfig};
use super::kpconv::PyramidConfig;
use crate::checkpoint::Parameters;

/// How far the outermost kernel point of the released networks lies from the middle, in radii of the convolution.
const KERNEL_REACH: f64 = 0.66;
/// A spacing that is this near to that of a released network is that: kernel points were laid out with some noise.
const SNAP: f64 = 0.15;
/// The widest layer that is believed.
const WIDEST: usize = 1 << 14;

/// The `GeoTransformer` that the weights are of.
///
/// # Errors
/// `InvalidInput` if its first tensors are missing or damaged.
pub(crate) fn geotransformer(parameters: &Parameters) -> Result<GeoTransformerConfig> {
    let has_fifth_stage = parameters.contains("backbone.encoder5_1.KPConv.weights");
    let released = if has_fifth_stage {
        GeoTransformerConfig::kitti()
    } else {
        GeoTransformerConfig::three_d_match()
    };
    let width = size(parameters, "backbone.encoder1_1.KPConv.weights", 2)?;
    let pyramid = pyramid(parameters, "backbone.encoder1_1.KPConv.kernel_points", released.pyramid)?;
    let scale = pyramid.voxel / released.pyramid.voxel;
    let features = format!("backbone.decoder{}.mlp.weight", 2);
    Ok(GeoTransformerConfig {
        pyramid,
        width,
        groups: (width / 2).max(1),
        features: size(parameters, &features, 0)?,
        transformer: TransformerConfig {
            hidden: size(parameters, "transformer.in_proj.weight", 0)?,
            output: size(parameters, "transformer.out_proj.weight", 0)?,
            sigma_distance: released.transformer.sigma_distance * scale,
            ..released.transformer
        },
        fine: FineMatchingConfig {
            acceptance_radius: released.fine.acceptance_radius * scale,
            ..released.fine
        },
        ..released
    })
}

/// The released pyramid with the spacing for which the kernel points `name` of its finest stage were laid out.
fn pyramid(parameters: &Parameters, name: &str, released: PyramidConfig) -> Result<PyramidConfig> {
    let points = parameters.read(name, &[15, 3])?.to_f32();
    let reach = points.chunks_exact(3).fold(0.0, |reach: f64, point| {
        let squared: f64 = point.iter().map(|&value| f64::from(value).powi(2)).sum();
        reach.max(squared.sqrt())
    });
    let voxel = reach / KERNEL_REACH / released.radius;
    let near = (voxel / released.voxel).ln().abs() < SNAP;
    if !near && !(voxel.is_finite() && voxel > 0.0) {
        return Err(Error::invalid(format!(
            "the kernel points {name} all lie in the middle: the weights are damaged"
        )));
    }
    Ok(PyramidConfig { voxel: if near { released.voxel } else { voxel }, ..released })
}

/// One of the sizes of a tensor.
fn size(parameters: &Parameters, name: &str, axis: usize) -> Result<usize> {
    let size = parameters.shape(name).and_then(|shape| shape.get(axis)).copied();
    match size {
        Some(size @ 1..=WIDEST) => Ok(size),
        Some(size) => Err(Error::invalid(format!("tensor {name} has {size} numbers along axis {axis}"))),
        None => Err(Error::invalid(format!("there is no tensor {name} as it is expected"))),
    }
}
