//! The networks of the golden files.

use rare_nets::backbones::geotransformer::{
    FineMatchingConfig, GeoTransformer, GeoTransformerConfig, TransformerConfig, layout,
};
use rare_nets::backbones::kpconv::{NeighbourLimits, PyramidConfig};
use rare_nets::checkpoint::Parameters;

use super::formula;
use crate::shared::{GoldenTensors, path, relative_difference};

/// The largest relative difference that a stage may have.
pub(super) const TOLERANCE: f64 = 1e-4;

/// The network of the golden files `tiny` and `small`.
pub(super) fn reduced(voxel: f64, superpoint_matches: usize) -> GeoTransformerConfig {
    let official = GeoTransformerConfig::three_d_match();
    GeoTransformerConfig {
        name: "the test",
        pyramid: PyramidConfig { voxel, ..official.pyramid },
        groups: 8,
        width: 16,
        features: 32,
        patch_points: 32,
        transformer: TransformerConfig {
            hidden: 32,
            output: 32,
            sigma_distance: 8.0 * voxel,
            ..official.transformer
        },
        superpoint_matches,
        fine: FineMatchingConfig { acceptance_radius: 4.0 * voxel, ..official.fine },
        ..official
    }
}

/// A golden file and its network.
pub(super) struct Case {
    pub(super) golden: GoldenTensors,
    pub(super) network: GeoTransformer,
    pub(super) config: GeoTransformerConfig,
    pub(super) limits: NeighbourLimits,
}

impl Case {
    pub(super) fn reduced(name: &str) -> Option<Case> {
        let (voxel, matches) = if name == "tiny" { (0.1, 32) } else { (0.05, 128) };
        let file = format!("backbones/geotransformer_{name}");
        let golden = GoldenTensors::open(&format!("{file}.safetensors"))?;
        let parameters = reduced_parameters(name)?;
        let config = reduced(voxel, matches);
        let network = GeoTransformer::load(&parameters, config.clone()).unwrap();
        Some(Case { golden, network, config, limits: NeighbourLimits(vec![24; 4]) })
    }

    /// The official sizes with weights by formula. Kernel points are those of the tiny network, whose voxel is 0.1 m.
    pub(super) fn full() -> Option<Case> {
        let golden = GoldenTensors::open("backbones/geotransformer_full3dmatch.safetensors")?;
        let tiny = reduced_parameters("tiny")?;
        let config = GeoTransformerConfig::three_d_match();
        let ratio = (config.pyramid.voxel / 0.1) as f32;
        let kernel_points = |name: &str| {
            let points = tiny.read(name, &[15, 3]).unwrap().to_f32();
            points.iter().map(|coordinate| coordinate * ratio).collect()
        };
        let folder = tempfile::tempdir().unwrap();
        let parameters = formula::parameters(folder.path(), &layout(&config), kernel_points);
        let network = GeoTransformer::load(&parameters, config.clone()).unwrap();
        Some(Case { golden, network, config, limits: NeighbourLimits::three_d_match() })
    }
}

pub(super) fn reduced_parameters(name: &str) -> Option<Parameters> {
    let weights = path(&format!("golden/backbones/geotransformer_{name}.weights.safetensors"))?;
    let renamed = Parameters::open(&weights)
        .and_then(|all| all.renamed(|name| name.strip_prefix("w.").map(str::to_owned)));
    Some(renamed.unwrap())
}

/// Golden names of what is compared for target and source.
pub(super) fn both(pattern: &str) -> [String; 2] {
    ["ref", "src"].map(|side| pattern.replace('*', side))
}

pub(super) fn close(name: &str, part: &str, found: &[f32], golden: &[f64]) {
    let difference = relative_difference(found, golden);
    println!("{name} {part}: {difference:.1e}");
    assert!(difference < TOLERANCE, "{name} {part}: {difference}");
}
