//! What can be compared: the names of `--methods` and what they do to a pair.

use anyhow::{Result, bail};
use rare::nalgebra::Matrix4;
use rare::verify::Verdict;
use rare::{Recipe, Refiner, RefinerConfig, RigidTransform, Scan};

use crate::options::Settings;

/// A method by its name.
pub(super) struct Method {
    pub(super) name: String,
    kind: Kind,
}

enum Kind {
    /// The initial transform as it is.
    Init,
    Refine(RefinerConfig),
}

/// What a method made of a pair.
pub(super) struct Found {
    pub(super) target_from_source: Matrix4<f64>,
    pub(super) confidence: Option<f64>,
    pub(super) verdict: Option<String>,
}

/// All names, for help and errors.
const NAMES: &str = "init, refine, refine-paper, refine-one-round, refine-no-polish, refine-no-consensus, refine-no-fallback";

impl Method {
    /// Reads a list of names.
    ///
    /// # Errors
    /// If one is unknown or comes twice.
    pub(super) fn parse_all(names: &[String], settings: &Settings) -> Result<Vec<Method>> {
        let mut methods: Vec<Method> = Vec::new();
        for name in names {
            if methods.iter().any(|method| method.name == *name) {
                bail!("--methods names {name} twice");
            }
            methods.push(Method { name: name.clone(), kind: Kind::parse(name, settings)? });
        }
        Ok(methods)
    }

    /// Applies the method.
    ///
    /// # Errors
    /// What the method has: then the pair counts as not solved by it.
    pub(super) fn apply(
        &self,
        source: &Scan,
        reference: &Scan,
        initial: &Matrix4<f64>,
    ) -> rare::Result<Found> {
        match &self.kind {
            Kind::Init => {
                Ok(Found { target_from_source: *initial, confidence: None, verdict: None })
            }
            Kind::Refine(config) => {
                let initial = RigidTransform::from_matrix(initial)?;
                let refinement =
                    Refiner::new(config.clone()).refine(source, reference, &initial)?;
                Ok(Found {
                    target_from_source: refinement.target_from_source.to_matrix(),
                    confidence: Some(refinement.confidence),
                    verdict: Some(verdict_name(refinement.verdict).to_owned()),
                })
            }
        }
    }
}

impl Kind {
    fn parse(name: &str, settings: &Settings) -> Result<Kind> {
        let given = &settings.refiner;
        let with = |recipe: Recipe| Kind::Refine(RefinerConfig { recipe, ..given.clone() });
        let recipe = given.recipe.clone();
        Ok(match name {
            "init" => Kind::Init,
            "refine" => with(recipe),
            "refine-paper" => with(Recipe::paper()),
            "refine-one-round" => with(Recipe { rounds: 1, ..recipe }),
            "refine-no-polish" => with(Recipe { polish: false, ..recipe }),
            "refine-no-consensus" => with(Recipe { consensus: false, ..recipe }),
            "refine-no-fallback" => with(Recipe { keep_initial: false, ..recipe }),
            _ => bail!("--methods {name}: unknown, choose from {NAMES}"),
        })
    }
}

/// The verdict as records name it.
fn verdict_name(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Refined => "refined",
        Verdict::KeptInitial => "kept-initial",
        Verdict::Rejected => "rejected",
    }
}
