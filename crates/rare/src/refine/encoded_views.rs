//! Steps 1 to 3 by themselves: what the refiner sees and what its encoder makes of it, for those who keep features.

use crate::data::{DepthMap, LayeredFeatures, PointFeatures, RigidTransform, Scan};
use crate::densify::Densifier;
use crate::depth_features::DepthFeatures;
use crate::encode::{DepthEncoder, MapSummary, Recorded, Recording};
use crate::error::Result;
use crate::reduce::merge;
use crate::refine::stopwatch::Stopwatch;
use crate::refine::working_pair::WorkingPair;
use crate::refine::{Refiner, views};
use crate::scale::SceneKind;
use crate::viewpoints::{self, CameraChoice, Frame, Viewpoint};

/// The depth maps of a pair under one initial transform, and their features.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodedViews {
    /// The initial transform, target from source, as the caller gave it.
    pub initial: RigidTransform,
    /// The densified maps in the order of [`DepthEncoder::encode`]; their lengths are in the refiner's working units (a
    /// voxel is 5 cm), or metres with the paper's recipe.
    pub maps: Vec<DepthMap>,
    /// The features of each map.
    pub features: Vec<LayeredFeatures>,
}

/// What the virtual cameras see under a pose, densified.
pub(super) struct DenseViews {
    pub(super) viewpoints: Vec<Viewpoint>,
    /// For each view the reference's map, then the source's: what the points themselves show ...
    pub(super) sparse: Vec<DepthMap>,
    /// ... and densified.
    pub(super) maps: Vec<DepthMap>,
}

impl Refiner {
    /// Steps 1 to 3 of the first round of [`Refiner::refine`]: what it would encode under `initial`, which moves the
    /// source into the target's frame, and the features that its encoder makes.
    ///
    /// # Errors
    /// As [`Refiner::refine`].
    pub fn encode_views(
        &self,
        source: &Scan,
        target: &Scan,
        initial: &RigidTransform,
    ) -> Result<EncodedViews> {
        let mut clock = self.stopwatch();
        let pair = clock.time("prepare", || WorkingPair::new(source, target, &self.config))?;
        let DenseViews { maps, .. } =
            self.dense_views(&pair, &pair.to_working(initial), &mut clock);
        let features = clock.time("encode", || self.encode(&pair, &maps))?;
        Ok(EncodedViews { initial: *initial, maps, features })
    }

    /// The features of one cloud's own depth maps at the points that they show: a pixel of each cell of the feature map,
    /// lifted by the densified depth, in the frame of the cloud, metres. Views follow each other.
    ///
    /// Layers are normalised, brought to one size and joined, but not reduced: principal components of one cloud would
    /// not be those of another, and features of two clouds are to be compared.
    ///
    /// # Errors
    /// As [`Refiner::refine`].
    pub fn point_features(&self, scan: &Scan) -> Result<PointFeatures> {
        let mut clock = self.stopwatch();
        let pair = clock.time("prepare", || WorkingPair::new(scan, scan, &self.config))?;
        let own = self.own_views(&pair, &mut clock);
        let layers = clock.time("encode", || self.encode_own(&pair, &own.maps))?;
        let maps = clock.time("reduce", || layers.iter().map(merge).collect::<Result<Vec<_>>>())?;
        let lifted = clock.time("transfer", || {
            views::lift_own(&pair, &own.viewpoints, &own.maps, &maps, self.sampling())
        })?;
        Ok(lifted.map_points(|point| point * pair.unit + scan.cloud.shift()))
    }

    /// Steps 1 and 2: the densified maps of all views under a pose.
    pub(super) fn dense_views(
        &self,
        pair: &WorkingPair<'_>,
        pose: &RigidTransform,
        clock: &mut Stopwatch<'_>,
    ) -> DenseViews {
        let viewpoints = self.viewpoints(pair, pose);
        let sparse = clock.time("project", || views::project_all(pair, &viewpoints, pose));
        let maps = clock.time("densify", || views::densify_all(&sparse, self.densifier(pair)));
        DenseViews { viewpoints, sparse, maps }
    }

    /// Steps 1 and 2 of a cloud alone, which stands on both sides of the pair: the reference's maps of its own views.
    fn own_views(&self, pair: &WorkingPair<'_>, clock: &mut Stopwatch<'_>) -> DenseViews {
        let pose = RigidTransform::identity();
        let mut viewpoints = self.viewpoints(pair, &pose);
        viewpoints.retain(|view| view.frame == Frame::Reference);
        let sparse = clock.time("project", || views::project_all(pair, &viewpoints, &pose));
        let sparse: Vec<DepthMap> = sparse.into_iter().step_by(2).collect();
        let maps = clock.time("densify", || views::densify_all(&sparse, self.densifier(pair)));
        DenseViews { viewpoints, sparse, maps }
    }

    /// Step 3.
    pub(super) fn encode(
        &self,
        pair: &WorkingPair<'_>,
        maps: &[DepthMap],
    ) -> Result<Vec<LayeredFeatures>> {
        match &self.encoder {
            Some(encoder) => encoder.encode(maps),
            None => DepthFeatures::for_voxel(pair.scale.voxel).encode(maps),
        }
    }

    /// Step 3 of a cloud alone: its maps stand where those of a reference stand.
    fn encode_own(
        &self,
        pair: &WorkingPair<'_>,
        maps: &[DepthMap],
    ) -> Result<Vec<LayeredFeatures>> {
        let placed: Vec<(usize, &DepthMap)> =
            maps.iter().enumerate().map(|(view, map)| (2 * view, map)).collect();
        match &self.encoder {
            Some(encoder) => encoder.encode_at(&placed),
            None => DepthFeatures::for_voxel(pair.scale.voxel).encode_at(&placed),
        }
    }

    /// The paper sees a street through KITTI's colour camera; everything else chooses by the kind of scene.
    pub(super) fn viewpoints(
        &self,
        pair: &WorkingPair<'_>,
        pose: &RigidTransform,
    ) -> Vec<Viewpoint> {
        let camera = match self.config.camera {
            CameraChoice::Auto if self.is_street_in_metres(pair) => CameraChoice::Kitti,
            chosen => chosen,
        };
        viewpoints::choose(camera, &pair.scale, &pair.target.coarse, &pair.source.coarse, pose)
    }

    fn is_street_in_metres(&self, pair: &WorkingPair<'_>) -> bool {
        self.config.recipe.metric && pair.scale.kind == SceneKind::Lidar
    }

    /// The recipe's filters: `fast` indoors and in working units, `multiscale` for streets in metres.
    fn densifier(&self, pair: &WorkingPair<'_>) -> Densifier {
        if self.is_street_in_metres(pair) { Densifier::Multiscale } else { Densifier::Fast }
    }
}

impl EncodedViews {
    /// The features for another run, with what it needs to know: the reduction and interpolation of the recipe of
    /// `refiner`, which made them, and the encoder's settings in words.
    #[must_use]
    pub fn into_recorded(self, refiner: &Refiner, settings: String) -> Recorded {
        let recipe = &refiner.config.recipe;
        let recording = Recording {
            maps: self.maps.iter().map(MapSummary::of).collect(),
            components: recipe.components,
            aligned_corners: recipe.aligned_corners,
            settings,
        };
        Recorded::new(self.initial, self.features).with_recording(recording)
    }
}
