//! `--report`: a page of all pairs, and one of each pair that was refined.
//!
//! Pages are made after the results, by refining once more: whether they are asked for changes no result, and an
//! evaluation that is finished gets its pages later. A page that is there is not made again.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use rare::eval::dataset::DatasetPair;
use rare::io as files;
use rare::{Refiner, RefinerConfig, RigidTransform};

use super::Plan;
use super::method::refine;
use super::work::Loaded;
use crate::args::Direction;
use crate::options::Settings;
use crate::progress::Pairs;
use crate::report::{self, Pages};
use crate::run::{Inputs, Registration, Start};

/// Makes the pages that are missing; gives where all of them lie.
///
/// # Errors
/// If a cloud cannot be read or a page cannot be written. A pair that cannot be refined has no page.
pub(super) fn write_all(plan: &Plan, folder: &Path) -> Result<Pages> {
    let refiners: Vec<(&str, &RefinerConfig)> = plan
        .methods
        .iter()
        .filter_map(|method| Some((method.name.as_str(), method.refiner()?)))
        .collect();
    let progress = Pairs::start(plan.settings.quiet, refiners.len() * plan.pairs.len());
    let mut pages = Pages::new();
    for (method, config) in refiners {
        let within = format!("pages/{method}");
        let place = folder.join("pages").join(method);
        fs::create_dir_all(&place).with_context(|| place.display().to_string())?;
        for &index in &plan.pairs {
            let Some(pair) = plan.dataset.pairs.get(index) else { continue };
            let page = Page { index, pair, place: &place };
            if page.is_made_if_possible(plan, config)? {
                pages.insert((method.to_owned(), index), format!("{within}/{}.html", page.name()));
            }
            progress.advance();
        }
    }
    Ok(pages)
}

/// The page of a pair and a method.
struct Page<'a> {
    index: usize,
    pair: &'a DatasetPair,
    place: &'a Path,
}

impl Page<'_> {
    /// Named by the pair; scenes may have any name.
    fn name(&self) -> String {
        let truth = &self.pair.truth;
        let plain = |character: char| {
            if character.is_ascii_alphanumeric() || character == '-' { character } else { '_' }
        };
        let scene: String = truth.scene.chars().map(plain).take(60).collect();
        format!("{:05}_{scene}_{}_{}", self.index, truth.source, truth.reference)
    }

    /// Makes the page unless it is there; false if the pair cannot be refined.
    fn is_made_if_possible(&self, plan: &Plan, config: &RefinerConfig) -> Result<bool> {
        let file = self.place.join(self.name() + ".html");
        if file.is_file() {
            return Ok(true);
        }
        let clock = Instant::now();
        let Loaded { source, reference } = Loaded::read(self.pair)?;
        let read_seconds = clock.elapsed().as_secs_f64();
        let refiner = Refiner::new(config.clone());
        let mut scans = Loaded { source, reference };
        let start = scans.start(self.index, plan);
        let refined = start.and_then(|start| {
            let initial = RigidTransform::from_matrix(&start.pose()?)?;
            let refinement = refine(&refiner, &scans.source, &scans.reference, &start)?;
            let total_seconds = clock.elapsed().as_secs_f64();
            let pair = [&scans.source, &scans.reference];
            let illustration = report::illustrate(&refiner, pair, Some(&initial), &refinement)?;
            Ok((initial, refinement, illustration, total_seconds))
        });
        // Why there is none stands in the results.
        let Ok((initial, refinement, illustration, total_seconds)) = refined else {
            return Ok(false);
        };
        // So that the command on the page can be repeated.
        let init = self.place.join(self.name() + ".txt");
        files::write_pose(&init, &initial)?;
        let registration = Registration {
            settings: Settings { refiner: config.clone(), ..plan.settings.clone() },
            inputs: self.inputs(&init),
            source: scans.source,
            reference: scans.reference,
            initial: Some(initial),
            refinement,
            illustration: None,
            network: None,
            backbone: None,
            filter: None,
            read_seconds,
            total_seconds,
        };
        report::write(&file, &registration, &illustration)?;
        Ok(true)
    }

    fn inputs(&self, init: &Path) -> Inputs {
        let name = |file: &PathBuf| file.display().to_string();
        Inputs {
            source: name(&self.pair.source),
            reference: name(&self.pair.reference),
            start: Start::Given {
                init: init.display().to_string(),
                init_direction: Direction::SourceToTarget,
                source_features: None,
                reference_features: None,
                correspondences: None,
            },
        }
    }
}
