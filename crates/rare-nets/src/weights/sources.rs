//! The table of what can be used.

use serde::{Deserialize, Serialize};

/// The terms under which all of these weights are published.
const LICENCE: &str = "CreativeML OpenRAIL-M";
/// Where these terms can be read.
const LICENCE_URL: &str = "https://huggingface.co/spaces/CompVis/stable-diffusion-license";

/// How the repositories name a file in half precision.
const HALF: &str = ".fp16.";

/// Which release of the depth `ControlNet`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum ControlNetVersion {
    /// The first release (`sd-controlnet-depth`).
    #[serde(rename = "v1.0")]
    V1_0,
    /// The second, trained on depth of several estimators (`control_v11f1p_sd15_depth`).
    #[default]
    #[serde(rename = "v1.1")]
    V1_1,
}

/// In which precision the weights are stored; the networks compute in what their engine wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Half precision: half the bytes.
    #[default]
    F16,
    /// Single precision.
    F32,
}

/// What a pipeline folder holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Choice {
    /// The release of the `ControlNet`.
    pub controlnet: ControlNetVersion,
    /// The precision of the weight files.
    pub precision: Precision,
}

/// A repository of weights.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Source {
    /// `owner/name` on the hub.
    pub repository: &'static str,
    /// What is in it.
    pub title: &'static str,
    /// The release of the `ControlNet` that it holds; `None` for the part that both need.
    pub controlnet: Option<ControlNetVersion>,
    /// The folder of its files in a pipeline folder; empty for the pipeline folder itself.
    pub folder: &'static str,
    /// The commit that was verified; `None`: nobody has, the newest commit of the branch `main` is taken.
    pub revision: Option<&'static str>,
    /// The name of the terms of use.
    pub licence: &'static str,
    /// Where the terms can be read.
    pub licence_url: &'static str,
    /// The files that are needed, and no others.
    pub files: &'static [SourceFile],
}

/// A file of a repository.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SourceFile {
    /// Its path in the repository.
    pub path: &'static str,
    /// The precision of the weights in it; `None` for what belongs to both.
    pub precision: Option<Precision>,
    /// Its length, if somebody has verified it.
    pub bytes: Option<u64>,
    /// Its SHA-256 in hexadecimal digits, if somebody has verified it.
    pub sha256: Option<&'static str>,
}

/// Everything that can be used.
pub const SOURCES: [Source; 3] = [
    Source {
        repository: "stable-diffusion-v1-5/stable-diffusion-v1-5",
        title: "Stable Diffusion 1.5 (U-Net, text encoder, tokenizer, schedule)",
        controlnet: None,
        folder: "",
        revision: None,
        licence: LICENCE,
        licence_url: LICENCE_URL,
        files: &[
            small("model_index.json"),
            small("scheduler/scheduler_config.json"),
            small("tokenizer/merges.txt"),
            small("tokenizer/vocab.json"),
            small("text_encoder/config.json"),
            weights("text_encoder/model.fp16.safetensors", Precision::F16),
            weights("text_encoder/model.safetensors", Precision::F32),
            small("unet/config.json"),
            weights("unet/diffusion_pytorch_model.fp16.safetensors", Precision::F16),
            weights("unet/diffusion_pytorch_model.safetensors", Precision::F32),
        ],
    },
    controlnet(
        "lllyasviel/control_v11f1p_sd15_depth",
        "ControlNet v1.1, depth",
        ControlNetVersion::V1_1,
    ),
    controlnet("lllyasviel/sd-controlnet-depth", "ControlNet v1.0, depth", ControlNetVersion::V1_0),
];

const CONTROLNET_FILES: [SourceFile; 3] = [
    small("config.json"),
    weights("diffusion_pytorch_model.fp16.safetensors", Precision::F16),
    weights("diffusion_pytorch_model.safetensors", Precision::F32),
];

const fn controlnet(
    repository: &'static str,
    title: &'static str,
    version: ControlNetVersion,
) -> Source {
    Source {
        repository,
        title,
        controlnet: Some(version),
        folder: "controlnet",
        revision: None,
        licence: LICENCE,
        licence_url: LICENCE_URL,
        files: &CONTROLNET_FILES,
    }
}

const fn small(path: &'static str) -> SourceFile {
    SourceFile { path, precision: None, bytes: None, sha256: None }
}

const fn weights(path: &'static str, precision: Precision) -> SourceFile {
    SourceFile { path, precision: Some(precision), bytes: None, sha256: None }
}

impl Choice {
    /// The repositories that it takes.
    pub fn sources(self) -> impl Iterator<Item = &'static Source> {
        SOURCES.iter().filter(move |source| {
            source.controlnet.is_none_or(|version| version == self.controlnet)
        })
    }

    /// A name for a folder of these files.
    #[must_use]
    pub fn name(self) -> String {
        format!("stable-diffusion-1.5-depth-{}-{}", self.controlnet, self.precision)
    }
}

impl Source {
    /// The files that a pipeline of this precision takes.
    pub fn files_in(&self, precision: Precision) -> impl Iterator<Item = &'static SourceFile> {
        let files: &'static [SourceFile] = self.files;
        files.iter().filter(move |file| file.precision.is_none_or(|own| own == precision))
    }

    /// Where a file of this repository stands in a pipeline folder, with `/` between the parts.
    #[must_use]
    pub fn place(&self, path: &str) -> String {
        match self.folder {
            "" => path.to_owned(),
            folder => format!("{folder}/{path}"),
        }
    }
}

impl SourceFile {
    /// The paths under which a repository may hold it, the best first: not every repository has its weights in half
    /// precision, and those in single precision do as well.
    #[must_use]
    pub fn candidates(&self) -> Vec<String> {
        let own = self.path.to_owned();
        let single = self.path.replace(HALF, ".");
        if single == own { vec![own] } else { vec![own, single] }
    }

    /// Whether somebody has verified length and content.
    #[must_use]
    pub fn is_verified(&self) -> bool {
        self.bytes.is_some() && self.sha256.is_some()
    }
}

impl std::fmt::Display for ControlNetVersion {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            ControlNetVersion::V1_0 => "v1.0",
            ControlNetVersion::V1_1 => "v1.1",
        })
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Precision::F16 => "f16",
            Precision::F32 => "f32",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_takes_each_part_once_and_in_one_precision() {
        for controlnet in [ControlNetVersion::V1_0, ControlNetVersion::V1_1] {
            for precision in [Precision::F16, Precision::F32] {
                let choice = Choice { controlnet, precision };
                let places: Vec<String> = choice
                    .sources()
                    .flat_map(|source| {
                        source.files_in(precision).map(|file| source.place(file.path))
                    })
                    .collect();
                let half = places.iter().filter(|place| place.contains(HALF)).count();
                assert_eq!(
                    (places.len(), half),
                    (10, if precision == Precision::F16 { 3 } else { 0 })
                );
                for part in ["unet/", "controlnet/", "text_encoder/"] {
                    let of_part = |place: &&String| place.starts_with(part);
                    assert_eq!(places.iter().filter(of_part).count(), 2, "{part} in {places:?}");
                }
            }
        }
    }

    #[test]
    fn half_precision_falls_back_on_single() {
        let file = weights("unet/a.fp16.safetensors", Precision::F16);
        assert_eq!(file.candidates(), ["unet/a.fp16.safetensors", "unet/a.safetensors"]);
        assert_eq!(small("unet/config.json").candidates(), ["unet/config.json"]);
    }
}
