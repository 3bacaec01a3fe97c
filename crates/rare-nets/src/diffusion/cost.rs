//! What a run costs, known before it is started: operations and memory, from the shapes of the networks and maps alone.

mod operations;

use std::collections::BTreeMap;
use std::fs;

use rare::data::Intrinsics;
use rare::hint::{Percentiles, hint};
use rare::{DepthMap, Error, Result};

use super::{Extent, Pipeline, Plan, controlnet_layout, unet_layout};
use crate::Values;
use crate::checkpoint::Parameters;
use crate::engine::Precision;

pub use operations::{LatentSize, controlnet_operations, hint_operations, unet_operations};
use operations::{stored_values, working_values};

/// Pixels of a depth image along a side of a pixel of the latent image.
const HINT_SCALE: usize = 8;

/// Memory beside weights and activations: the program, prompts, depth maps, features; bytes.
const PROGRAM: f64 = 200e6;

/// Memory of activations over that of their values. Buffers are kept and used again for tensors of down to half their
/// size; on the CPU 1.6 to 2.1 were measured, for one to five maps of 640 x 480 pixels in a single step.
const KEPT: f64 = 2.0;

/// What a run needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cost {
    /// Floating-point operations of all passes; a multiplication and the addition after it count as two.
    pub operations: f64,
    /// Memory of the packed weights, bytes.
    pub weight_bytes: u64,
    /// Memory of activations and of the program itself, bytes; an estimate.
    pub other_bytes: u64,
}

impl Cost {
    /// The cost of encoding maps with latents of these sizes. Maps of equal size are encoded together and share the
    /// memory's peak.
    ///
    /// # Errors
    /// Those of reading one small tensor of each network, which tells the precision of the weights.
    pub fn estimate(
        pipeline: &Pipeline,
        plan: &Plan,
        precision: Precision,
        maps: &[LatentSize],
    ) -> Result<Cost> {
        let channels = &pipeline.unet_config.block_out_channels;
        let networks = [
            (unet_layout(&pipeline.unet_config), &pipeline.unet),
            (controlnet_layout(&pipeline.controlnet_config), &pipeline.controlnet),
        ];
        let mut weight_bytes = 0.0;
        for (layout, parameters) in networks {
            let width = bytes_per_value(parameters, channels[0], precision)?;
            weight_bytes += width * stored_values(&layout, plan.extent());
        }
        let operations = maps.iter().map(|&size| {
            let pass = |extent| {
                unet_operations(&pipeline.unet_config, size, extent)
                    + controlnet_operations(&pipeline.controlnet_config, size, extent)
            };
            let steps = (plan.passes() - 1) as f64 * pass(plan.extent());
            let last = pass(Extent::UpToLayer(plan.last_layer()));
            hint_operations(&pipeline.controlnet_config, size) + steps + last
        });
        let working = largest_batch(maps).map_or(0.0, |(size, count)| {
            let bytes = size_of::<f32>() as f64;
            KEPT * bytes * working_values(channels, size, count * plan.branches())
        });
        Ok(Cost {
            operations: operations.sum(),
            weight_bytes: weight_bytes as u64,
            other_bytes: (working + PROGRAM) as u64,
        })
    }

    /// Memory of everything, bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.weight_bytes.saturating_add(self.other_bytes)
    }

    /// Makes sure that the memory suffices; where nobody knows what there is, it is believed to.
    ///
    /// # Errors
    /// `InvalidInput` with both numbers if it does not.
    pub fn check_memory(&self, available: Option<u64>) -> Result<()> {
        match available {
            Some(available) if available < self.bytes() => Err(Error::invalid(format!(
                "the networks need about {} of memory, {} are available: close other programs, use weights in half precision or the precision bf16, or take a larger machine",
                gigabytes(self.bytes()),
                gigabytes(available)
            ))),
            _ => Ok(()),
        }
    }
}

/// Memory of one weight: single precision is kept where the file has it, unless products are to be in half precision.
fn bytes_per_value(parameters: &Parameters, channels: usize, precision: Precision) -> Result<f64> {
    let bias = parameters.read("conv_in.bias", &[channels])?;
    Ok(match (precision, bias.values) {
        (Precision::F32, Values::F32(_)) => 4.0,
        _ => 2.0,
    })
}

/// The size of the latents for depth maps of a camera.
///
/// # Errors
/// `InvalidInput` if maps of this size cannot be encoded.
pub fn latent_size(intrinsics: &Intrinsics) -> Result<LatentSize> {
    let image = hint(&DepthMap::empty(*intrinsics), Percentiles::AllPixels)?;
    Ok(LatentSize { height: image.height() / HINT_SCALE, width: image.width() / HINT_SCALE })
}

/// Memory that programs can still have, bytes; `None` where the system has no `/proc/meminfo`. Limits of a container are
/// not seen.
#[must_use]
pub fn available_memory() -> Option<u64> {
    available_in(&fs::read_to_string("/proc/meminfo").ok()?)
}

fn available_in(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    kibibytes.checked_mul(1024)
}

/// The size whose maps together have the most pixels, and their number.
fn largest_batch(maps: &[LatentSize]) -> Option<(LatentSize, usize)> {
    let mut counts: BTreeMap<LatentSize, usize> = BTreeMap::new();
    for &size in maps {
        *counts.entry(size).or_default() += 1;
    }
    counts.into_iter().max_by_key(|&(size, count)| size.pixels().saturating_mul(count))
}

fn gigabytes(bytes: u64) -> String {
    format!("{:.1} GB", bytes as f64 / 1e9)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_read_from_linux() {
        let text = "MemTotal:  100 kB\nMemFree: 5 kB\nMemAvailable:      20 kB\nCached: 1 kB\n";
        assert_eq!(available_in(text), Some(20 * 1024));
        for text in
            ["", "MemAvailable: kB", "MemAvailable: 18446744073709551615 kB", "MemAvailable: 5"]
        {
            assert_eq!(available_in(text), None, "{text}");
        }
    }

    #[test]
    fn a_lack_of_memory_is_refused() {
        let cost =
            Cost { operations: 0.0, weight_bytes: 3_000_000_000, other_bytes: 1_000_000_000 };
        assert!(cost.check_memory(None).is_ok() && cost.check_memory(Some(cost.bytes())).is_ok());
        let message = cost.check_memory(Some(3_500_000_000)).unwrap_err().to_string();
        assert!(message.contains("4.0 GB") && message.contains("3.5 GB"), "{message}");
    }

    #[test]
    fn sizes_follow_the_depth_image() {
        let size = |width, height| {
            latent_size(&Intrinsics { width, height, ..Intrinsics::indoor() }).unwrap()
        };
        assert_eq!(size(640, 480), LatentSize { height: 64, width: 88 });
        assert_eq!(size(1242, 225), LatentSize { height: 64, width: 160 });
    }

    #[test]
    fn the_largest_batch_counts_all_maps_of_a_size() {
        let [small, large] = [8, 12].map(|height| LatentSize { height, width: 8 });
        assert_eq!(largest_batch(&[small, large, small]), Some((small, 2)));
        assert_eq!(largest_batch(&[small, large]), Some((large, 1)));
        assert_eq!(largest_batch(&[]), None);
    }
}
