//! The sizes and lengths of a network from its weights: sizes by the shapes of tensors, lengths by the kernel points,
//! which are stored in metres. So any network of the same topology runs, whatever its widths and its spacing; numbers of
//! groups and heads, which weights do not say, are those of the released networks.

use rare::pose::Ransac;
use rare::{Error, Result};

use super::cofinet::CoFiNetConfig;
use super::geotransformer::{FineMatchingConfig, GeoTransformerConfig, TransformerConfig};
use super::kpconv::PyramidConfig;
use super::predator::PredatorConfig;
use crate::checkpoint::Parameters;

/// How far the outermost kernel point of the released networks lies from the middle, in radii of the convolution.
const KERNEL_REACH: f64 = 0.66;
/// Networks with a larger first radius, metres, were trained on streets: 6 cm in rooms, 1.3 m in streets.
const STREETS: f64 = 0.5;
/// A spacing that is this near to that of a released network (natural logarithm of the ratio) is that: kernel points
/// were laid out with some noise.
const SNAP: f64 = 0.15;
/// The widest layer that is believed.
const WIDEST: usize = 1 << 14;

/// The `GeoTransformer` that the weights are of.
///
/// # Errors
/// `InvalidInput` if tensors that say so are missing or damaged.
pub(crate) fn geotransformer(parameters: &Parameters) -> Result<GeoTransformerConfig> {
    let released = if parameters.contains("backbone.encoder5_1.KPConv.weights") {
        GeoTransformerConfig::kitti()
    } else {
        GeoTransformerConfig::three_d_match()
    };
    let radius = first_radius(parameters, "backbone.encoder1_1.KPConv.kernel_points")?;
    let pyramid = spaced(released.pyramid, radius);
    let scale = pyramid.voxel / released.pyramid.voxel;
    let width = size(parameters, "backbone.encoder1_1.KPConv.weights", 2)?;
    Ok(GeoTransformerConfig {
        pyramid,
        width,
        groups: groups(width, released.groups),
        features: size(parameters, "backbone.decoder2.mlp.weight", 0)?,
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

/// How many groups channels are normalised in, which weights do not say: as many as in the released networks where they
/// divide the narrowest layer, half the first width, or else one for each of its channels.
fn groups(width: usize, released: usize) -> usize {
    let narrowest = (width / 2).max(1);
    if narrowest.is_multiple_of(released) { released } else { narrowest }
}

/// The Predator that the weights are of.
///
/// # Errors
/// `InvalidInput` if tensors that say so are missing or damaged.
pub(crate) fn predator(parameters: &Parameters) -> Result<PredatorConfig> {
    let radius = first_radius(parameters, "encoder_blocks.0.KPConv.kernel_points")?;
    let released =
        if radius > STREETS { PredatorConfig::kitti() } else { PredatorConfig::three_d_match() };
    let pyramid = spaced(released.pyramid, radius);
    Ok(PredatorConfig {
        ransac: scaled(&released.ransac, pyramid.voxel / released.pyramid.voxel),
        pyramid,
        width: 2 * size(parameters, "encoder_blocks.0.KPConv.weights", 2)?,
        coarse_channels: size(parameters, "bottle.weight", 0)?,
        features: size(parameters, "decoder_blocks.5.mlp.weight", 0)?.saturating_sub(2).max(1),
        ..released
    })
}

/// The CoFiNet that the weights are of.
///
/// # Errors
/// `InvalidInput` if tensors that say so are missing or damaged.
pub(crate) fn cofinet(parameters: &Parameters) -> Result<CoFiNetConfig> {
    let radius = first_radius(parameters, "encoder.encoder_blocks.0.KPConv.kernel_points")?;
    let released =
        if radius > STREETS { CoFiNetConfig::kitti() } else { CoFiNetConfig::three_d_match() };
    let pyramid = spaced(released.pyramid, radius);
    Ok(CoFiNetConfig {
        ransac: scaled(&released.ransac, pyramid.voxel / released.pyramid.voxel),
        pyramid,
        width: 2 * size(parameters, "encoder.encoder_blocks.0.KPConv.weights", 2)?,
        coarse_channels: size(parameters, "encoder.bottle.weight", 0)?,
        features: size(parameters, "decoder.decoder_blocks.5.mlp.weight", 0)?,
        ..released
    })
}

/// The radius of the first convolution, metres, for which the kernel points `name` were laid out.
fn first_radius(parameters: &Parameters, name: &str) -> Result<f64> {
    let points = parameters.read(name, &[15, 3])?.to_f32();
    let reach = points.chunks_exact(3).fold(0.0, |reach: f64, point| {
        let squared: f64 = point.iter().map(|&value| f64::from(value).powi(2)).sum();
        reach.max(squared.sqrt())
    });
    let radius = reach / KERNEL_REACH;
    if (1e-6..1e6).contains(&radius) {
        return Ok(radius);
    }
    Err(Error::invalid(format!(
        "the kernel points {name} reach {reach} m: the weights are damaged"
    )))
}

/// The released pyramid for convolutions of this radius.
fn spaced(released: PyramidConfig, radius: f64) -> PyramidConfig {
    let voxel = radius / released.radius;
    let is_released = (voxel / released.voxel).ln().abs() < SNAP;
    // Two digits: what the noise of the kernel points leaves.
    let rounded = format!("{voxel:.1e}").parse().unwrap_or(voxel);
    PyramidConfig { voxel: if is_released { released.voxel } else { rounded }, ..released }
}

fn scaled(released: &Ransac, scale: f64) -> Ransac {
    Ransac { inlier_threshold: released.inlier_threshold * scale, ..released.clone() }
}

/// One of the sizes of a tensor.
fn size(parameters: &Parameters, name: &str, axis: usize) -> Result<usize> {
    match parameters.shape(name).map(|shape| (shape, shape.get(axis))) {
        Some((_, Some(&size @ 1..=WIDEST))) => Ok(size),
        Some((shape, _)) => {
            Err(Error::invalid(format!("tensor {name} has the impossible shape {shape:?}")))
        }
        None => Err(Error::invalid(format!("there is no tensor {name}"))),
    }
}
