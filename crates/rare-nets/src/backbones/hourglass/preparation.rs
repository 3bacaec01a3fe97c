//! Clouds made ready for a network that was trained on points of one density.

use rare::data::{resolution, voxel_downsample};
use rare::nalgebra::Point3;
use rare::{Error, Result};

use crate::backbones::kpconv::{NeighbourLimits, Point, Pyramid, PyramidConfig};

/// Points that are closer to each other than this share of a voxel are thinned. In clouds with a point in each voxel the
/// median distance to the nearest other point is 0.6 to 0.9 voxels.
const DENSE: f64 = 0.5;
/// Points that are further apart than so many voxels are not what a network knows.
const SPARSE: f64 = 2.0;

/// Two clouds at the density of a network.
pub(in crate::backbones) struct Prepared {
    /// The stages of both clouds, the source first.
    pub(in crate::backbones) pyramid: Pyramid,
    /// What the caller should know.
    pub(in crate::backbones) warnings: Vec<String>,
}

impl Prepared {
    /// Thins clouds (metres, local frames) that are denser than the voxels of the first stage, and finds all neighbours.
    ///
    /// # Errors
    /// `InvalidInput` if a cloud is empty or too large for the voxels, or the limits do not fit.
    pub(in crate::backbones) fn new(
        clouds: [&[Point3<f64>]; 2],
        config: &PyramidConfig,
        limits: &NeighbourLimits,
        network: &str,
    ) -> Result<Prepared> {
        let [source, target] = clouds;
        let (source, of_source) = thinned(source, "source", config.voxel, network)?;
        let (target, of_target) = thinned(target, "target", config.voxel, network)?;
        let pyramid = Pyramid::new([&source, &target], config, limits)?;
        Ok(Prepared { pyramid, warnings: of_source.into_iter().chain(of_target).collect() })
    }

    /// The points of the first stage of either cloud, metres, local frames.
    pub(in crate::backbones) fn points(&self) -> [Vec<Point3<f64>>; 2] {
        let Some(finest) = self.pyramid.stages.first() else { return [Vec::new(), Vec::new()] };
        let wide = |point: &Point| Point3::from(point.map(f64::from));
        let (source, target) = finest.points.split_at(finest.lengths[0].min(finest.points.len()));
        [source, target].map(|points| points.iter().map(wide).collect())
    }
}

/// A cloud with no more points than the network knows, and a remark if it has far fewer.
fn thinned(
    cloud: &[Point3<f64>],
    name: &str,
    voxel: f64,
    network: &str,
) -> Result<(Vec<Point>, Option<String>)> {
    if let Some(bad) = cloud.iter().find(|point| !point.iter().all(|value| value.is_finite())) {
        return Err(Error::invalid(format!(
            "the {name} has the point ({}, {}, {}), and no network takes what is not finite: leave such points out",
            bad.x, bad.y, bad.z
        )));
    }
    let distance = resolution(cloud);
    let warning = (distance > SPARSE * voxel).then(|| {
        format!(
            "{network} was trained on points about {voxel} m apart, those of the {name} are {distance:.3} m apart: \
             check the unit of the cloud (metres), or take a network for such clouds"
        )
    });
    let narrow = |points: &[Point3<f64>]| -> Vec<Point> {
        points.iter().map(|point| [point.x as f32, point.y as f32, point.z as f32]).collect()
    };
    let dense = distance < DENSE * voxel;
    Ok((if dense { narrow(&voxel_downsample(cloud, voxel)?) } else { narrow(cloud) }, warning))
}
