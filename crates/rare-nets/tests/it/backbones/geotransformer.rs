//! `GeoTransformer` against what its released code computes.

use rare_nets::backbones::geotransformer::{
    FineMatchingConfig, GeoTransformer, GeoTransformerConfig, TransformerConfig, layout,
};
use rare_nets::backbones::kpconv::{NeighbourLimits, PyramidConfig};
use rare_nets::checkpoint::Parameters;

use super::kpconv::golden_pyramid;
use crate::shared::{GoldenTensors, path, relative_difference};

/// The largest relative difference that a stage may have.
const TOLERANCE: f64 = 1e-4;

/// The network of the golden files `tiny` and `small`.
fn reduced(voxel: f64, superpoint_matches: usize) -> GeoTransformerConfig {
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
struct Case {
    golden: GoldenTensors,
    network: GeoTransformer,
    config: GeoTransformerConfig,
    limits: NeighbourLimits,
}

impl Case {
    fn reduced(name: &str) -> Option<Case> {
        let (voxel, matches) = if name == "tiny" { (0.1, 32) } else { (0.05, 128) };
        let file = format!("backbones/geotransformer_{name}");
        let golden = GoldenTensors::open(&format!("{file}.safetensors"))?;
        let weights = path(&format!("golden/{file}.weights.safetensors"))?;
        let parameters = Parameters::open(&weights)
            .and_then(|all| all.renamed(|name| name.strip_prefix("w.").map(str::to_owned)))
            .unwrap();
        let config = reduced(voxel, matches);
        let network = GeoTransformer::load(&parameters, config.clone()).unwrap();
        Some(Case { golden, network, config, limits: NeighbourLimits(vec![24; 4]) })
    }
}

/// The names and shapes of an official checkpoint.
fn official_layout(name: &str) -> Option<Vec<(String, Vec<usize>)>> {
    let file = path(&format!("golden/backbones/geotransformer_{name}.state_dict.txt"))?;
    let text = std::fs::read_to_string(file).unwrap();
    let tensor = |line: &str| {
        let fields: Vec<&str> = line.split('\t').collect();
        let sizes = fields[1].trim_matches(['(', ')']).split(',').map(str::trim);
        let sizes = sizes.filter(|size| !size.is_empty()).map(|size| size.parse().unwrap());
        (fields[0].to_owned(), sizes.collect())
    };
    let mut tensors: Vec<(String, Vec<usize>)> = text.lines().map(tensor).collect();
    tensors.sort();
    Some(tensors)
}

#[test]
fn tensors_are_those_of_the_official_checkpoints() {
    let cases = [
        ("full3dmatch", GeoTransformerConfig::three_d_match(), 9_829_377),
        ("kitti", GeoTransformerConfig::kitti(), 25_499_137),
        ("tiny", reduced(0.1, 32), 440_769),
    ];
    for (name, config, parameters) in cases {
        let Some(official) = official_layout(name) else { return };
        let ours: Vec<(String, Vec<usize>)> = layout(&config).into_iter().collect();
        assert_eq!(ours, official, "{name}");
        // Kernel points and wave numbers are not learnt.
        let learnt = ours
            .iter()
            .filter(|(name, _)| !name.ends_with("kernel_points") && !name.ends_with("div_term"));
        assert_eq!(
            learnt.map(|(_, shape)| shape.iter().product::<usize>()).sum::<usize>(),
            parameters
        );
    }
}

#[test]
fn encoder_and_decoder_meet_the_golden_values() {
    for name in ["tiny", "small"] {
        let Some(case) = Case::reduced(name) else { return };
        let pyramid = golden_pyramid(&case.golden, &case.config.pyramid, &case.limits);
        let mut compared = 0;
        case.network
            .run(&pyramid, &mut |part, values| {
                if !case.golden.contains(part) {
                    return;
                }
                let difference =
                    relative_difference(values.values(), &case.golden.array(part).values);
                println!("{name} {part}: {difference:.1e}");
                assert!(difference < TOLERANCE, "{name} {part}: {difference}");
                compared += 1;
            })
            .unwrap();
        assert!(compared >= 13, "{compared}");
    }
}
