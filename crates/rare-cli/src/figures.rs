//! The figures of a paper for one's own scans: images at the density of print, drawn without a browser.
//!
//! `canvas` is the surface, `text` and `layout` what is written where, `clouds` draws points; every other file is a figure.

mod alignment;
mod canvas;
mod clouds;
mod layout;
mod maps;
mod matches;
mod overlap;
mod residuals;
mod scales;
mod text;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use rare::io::write_whole;
use rare::refine::{IllustratedView, Illustration};
use rare::scale::SceneKind;
use rare::viewpoints::Frame;
use rare::{PointCloud, RigidTransform};
use rayon::prelude::*;

use crate::figures::canvas::Canvas;
use crate::run::Registration;

/// The colours of the clouds, from the palette of Okabe and Ito.
const SOURCE: [u8; 3] = [230, 159, 0];
const REFERENCE: [u8; 3] = [0, 114, 178];

/// Draws one figure.
type Draw = fn(&Subject<'_>) -> Result<Canvas>;

/// What the figures are drawn of.
struct Subject<'a> {
    source: &'a PointCloud,
    reference: &'a PointCloud,
    kind: SceneKind,
    poses: Vec<Pose>,
    illustration: &'a Illustration,
}

/// A transform that is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    name: &'static str,
    /// Its place in the illustration.
    index: usize,
    /// Moves points of the source into the frame of the reference, both as the clouds keep them.
    local: RigidTransform,
}

/// Draws the figures of a registration into `folder`, which is made if it does not exist.
///
/// # Errors
/// If a file cannot be written.
pub(crate) fn write_all(
    folder: &Path,
    registration: &Registration,
    illustration: &Illustration,
) -> Result<Vec<PathBuf>> {
    let (source, reference) = (&registration.source.cloud, &registration.reference.cloud);
    let found = &registration.refinement.target_from_source;
    let subject = Subject {
        source,
        reference,
        kind: registration.refinement.scale.kind,
        poses: poses(source, reference, registration.initial.as_ref(), found),
        illustration,
    };
    subject.write(folder)
}

/// The transforms in the order of the illustration; the last one is the result.
fn poses(
    source: &PointCloud,
    reference: &PointCloud,
    initial: Option<&RigidTransform>,
    found: &RigidTransform,
) -> Vec<Pose> {
    let given = RigidTransform::identity();
    let named = [("as given", Some(&given)), ("initial", initial), ("result", Some(found))];
    let known = named.into_iter().filter_map(|(name, pose)| Some((name, pose?)));
    let local = |pose| PointCloud::to_local(reference, source, pose);
    let indexed = known.enumerate();
    indexed.map(|(index, (name, pose))| Pose { name, index, local: local(pose) }).collect()
}

impl Subject<'_> {
    fn write(&self, folder: &Path) -> Result<Vec<PathBuf>> {
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        let figures: [(&str, Draw); 7] = [
            ("alignment.png", alignment::draw),
            ("depth_maps.png", maps::draw_depths),
            ("features.png", maps::draw_features),
            ("matches.png", matches::draw),
            ("masks.png", maps::draw_masks),
            ("residuals.png", residuals::draw),
            ("overlap.png", overlap::draw),
        ];
        let write = |(name, draw): &(&str, Draw)| {
            let path = folder.join(name);
            let png = draw(self)?.to_png()?;
            write_whole(&path, |writer| writer.write_all(&png))?;
            Ok(path)
        };
        figures.par_iter().map(write).collect()
    }

    /// The view of each frame in which most features match, the reference's first: a sensor is seen by its own camera
    /// alone, a ring and an object by many.
    fn views(&self) -> Vec<(&'static str, &IllustratedView)> {
        let frames = [(Frame::Reference, "reference view"), (Frame::Source, "source view")];
        let best = |(frame, name)| {
            let views = self.illustration.views.iter().rev();
            let of_frame = views.filter(|view| view.frame == frame);
            // Of equals `max_by_key` takes the last, which reversed is the first.
            Some((name, of_frame.max_by_key(|view| view.matches.len())?))
        };
        frames.into_iter().filter_map(best).collect()
    }

    /// Where the source is compared from, and the result; only the result if there is no other transform.
    fn before_and_after(&self) -> Vec<Pose> {
        let first = self.poses.len().saturating_sub(2);
        self.poses.iter().skip(first).copied().collect()
    }
}

#[cfg(test)]
mod tests;
