//! The command that does the same again.

use rare::scale::Profile;
use rare::viewpoints::CameraChoice;
use rare_nets::backbones::SelectionRule;

use crate::args::Direction;
use crate::options::{Encoder, Preset};
use crate::run::{Registration, Start};

/// The command line, quoted for a POSIX shell.
pub(super) fn line(registration: &Registration) -> String {
    let inputs = &registration.inputs;
    let mut words = vec!["rare".to_owned()];
    let (command, start) = match &inputs.start {
        Start::Estimated { init_method } => {
            let method = init_method.iter();
            (
                "register",
                method.flat_map(|method| option("--init-method", name_of(method))).collect(),
            )
        }
        Start::Given {
            init,
            init_direction,
            source_features,
            reference_features,
            correspondences,
        } => {
            let mut start = option("--init", init.clone());
            if *init_direction == Direction::TargetToSource {
                start.extend(option("--init-direction", name_of(init_direction)));
            }
            for (name, file) in [
                ("--source-features", source_features),
                ("--reference-features", reference_features),
                ("--correspondences", correspondences),
            ] {
                start.extend(file.iter().flat_map(|file| option(name, file.clone())));
            }
            ("refine", start)
        }
    };
    words.extend([command.to_owned(), inputs.source.clone(), inputs.reference.clone()]);
    words.extend(start);
    words.extend(settings(registration));
    words.iter().map(|word| quoted(word)).collect::<Vec<_>>().join(" ")
}

/// The settings that are not those of every registration.
fn settings(registration: &Registration) -> Vec<String> {
    let settings = &registration.settings;
    let (refiner, recipe) = (&settings.refiner, &settings.refiner.recipe);
    let flag = |given: bool, name: &str| given.then(|| name.to_owned());
    let mut words = Vec::new();
    if settings.preset == Preset::Paper {
        words.extend(option("--preset", "paper".to_owned()));
    }
    if refiner.profile != Profile::Auto {
        words.extend(option("--profile", name_of(&refiner.profile)));
    }
    if refiner.camera != CameraChoice::Auto {
        words.extend(option("--camera", name_of(&refiner.camera)));
    }
    words.extend(refiner.voxel.iter().flat_map(|voxel| option("--voxel", voxel.to_string())));
    if refiner.seed != 0 {
        words.extend(option("--seed", refiner.seed.to_string()));
    }
    if settings.encoder == Encoder::Diffusion {
        words.extend(option("--encoder", settings.encoder.name().to_owned()));
    }
    if let Some(backbone) = &settings.backbone {
        words.extend(option("--backbone", backbone.network.name().to_owned()));
        if backbone.rule != SelectionRule::default() {
            words.extend(option("--keypoint-rule", name_of(&backbone.rule)));
        }
        let limits = backbone.neighbour_limits.iter();
        words.extend(limits.flat_map(|limits| option("--neighbor-limits", joined(limits))));
    }
    words.extend(flag(settings.vbreg_noise, "--vbreg-noise"));
    let weights = settings.weights.iter();
    words.extend(weights.flat_map(|path| option("--weights", path.display().to_string())));
    let keypoints = recipe.keypoints.iter();
    words.extend(keypoints.flat_map(|count| option("--keypoints", count.to_string())));
    let recorded = settings.depth_features.iter();
    words.extend(recorded.flat_map(|file| option("--depth-features", file.display().to_string())));
    if settings.preset == Preset::Default && settings.encoder == Encoder::Builtin {
        let usual = rare::Recipe::default();
        if recipe.rounds != usual.rounds {
            words.extend(option("--rounds", recipe.rounds.to_string()));
        }
        words.extend(flag(!recipe.verify, "--no-verify"));
        words.extend(flag(recipe.verify && !recipe.search, "--no-search"));
        words.extend(flag(!recipe.polish, "--no-polish"));
    }
    words
}

fn joined(numbers: &[usize]) -> String {
    numbers.iter().map(usize::to_string).collect::<Vec<_>>().join(",")
}

fn option(name: &str, value: String) -> Vec<String> {
    vec![name.to_owned(), value]
}

/// The name by which options and files know a choice.
fn name_of(choice: &impl serde::Serialize) -> String {
    let value = serde_json::to_value(choice).unwrap_or_default();
    value.as_str().unwrap_or_default().to_owned()
}

/// A word that a shell takes as one.
fn quoted(word: &str) -> String {
    let plain =
        |character: char| character.is_ascii_alphanumeric() || "-_./:+=,@".contains(character);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_word_stays_one_word() {
        assert_eq!(quoted("scans/a-1.ply"), "scans/a-1.ply");
        assert_eq!(quoted("two words"), "'two words'");
        assert_eq!(quoted("it's $(here)"), "'it'\\''s $(here)'");
        assert_eq!(quoted(""), "''");
    }
}
