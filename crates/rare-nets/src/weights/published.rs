//! Where the authors of the networks on points publish their weights.
//!
//! None of these files was at hand when this was written: names and places are those that the authors' pages and
//! scripts give; lengths and hashes stand here only where somebody has stated them.

use crate::networks::{Network, TrainedOn};

/// A file of weights that its authors publish.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Published {
    /// The network.
    pub network: Network,
    /// What it was trained on.
    pub trained_on: TrainedOn,
    /// The file's name.
    pub file: &'static str,
    /// The page or archive where a person finds it.
    pub place: &'static str,
    /// What else is to be known of it.
    pub remark: &'static str,
    /// Its length, if somebody has stated it.
    pub bytes: Option<u64>,
    /// Its SHA-256, if somebody has stated it.
    pub sha256: Option<&'static str>,
}

const GEOTRANSFORMER: &str = "https://github.com/qinzheng93/GeoTransformer/releases/tag/1.0.0";
const PREDATOR: &str = "https://share.phys.ethz.ch/~gsg/Predator/weights.zip";
const COFINET: &str = "https://github.com/haoyu94/Coarse-to-fine-correspondences, folder weights";
const FCGF: &str = "https://huggingface.co/chrischoy/FCGF";
const POINTDSC: &str = "https://github.com/XuyangBai/PointDSC, folder snapshot";
const VBREG: &str = "https://github.com/Jiang-HB/VBReg, folder snapshot";

/// All files.
pub const PUBLISHED: [Published; 16] = [
    published(
        Network::GeoTransformer,
        ROOMS,
        "geotransformer-3dmatch.pth.tar",
        GEOTRANSFORMER,
        "MIT licence",
    ),
    Published {
        // As a public evaluation of the released file states it.
        sha256: Some("39cd6a01de6430c656eb8c9d67997f334f0a38c446dd8884b16a654e2b233237"),
        ..published(
            Network::GeoTransformer,
            STREETS,
            "geotransformer-kitti.pth.tar",
            GEOTRANSFORMER,
            "MIT licence",
        )
    },
    published(
        Network::Predator,
        ROOMS,
        "weights/indoor.pth",
        PREDATOR,
        "MIT licence; users say that the link is dead",
    ),
    published(
        Network::Predator,
        STREETS,
        "weights/kitti.pth",
        PREDATOR,
        "MIT licence; users say that the link is dead",
    ),
    published(Network::CoFiNet, ROOMS, "best_3dmatch.pth", COFINET, "no licence is stated"),
    published(Network::CoFiNet, STREETS, "best_kitti.pth", COFINET, "no licence is stated"),
    published(
        Network::Fcgf,
        ROOMS,
        "2019-08-19_06-17-41.pth",
        FCGF,
        "MIT licence; voxels of 2.5 cm, 32 numbers",
    ),
    published(
        Network::Fcgf,
        ROOMS,
        "2019-09-18_14-15-59.pth",
        FCGF,
        "MIT licence; voxels of 2.5 cm, 16 numbers",
    ),
    published(
        Network::Fcgf,
        ROOMS,
        "2019-08-16_19-21-47.pth",
        FCGF,
        "MIT licence; voxels of 5 cm, 32 numbers",
    ),
    published(
        Network::Fcgf,
        STREETS,
        "KITTI-v0.3-ResUNetBN2C-conv1-5-nout32.pth",
        FCGF,
        "MIT licence; voxels of 30 cm, 32 numbers",
    ),
    published(
        Network::Fcgf,
        STREETS,
        "2019-07-31_19-37-00.pth",
        FCGF,
        "MIT licence; voxels of 30 cm, features not of unit length",
    ),
    published(
        Network::Fcgf,
        STREETS,
        "2019-07-31_19-30-19.pth",
        FCGF,
        "MIT licence; voxels of 20 cm, features not of unit length",
    ),
    published(
        Network::PointDsc,
        ROOMS,
        "PointDSC_3DMatch_release/models/model_best.pkl",
        POINTDSC,
        "see the repository for its licence",
    ),
    published(
        Network::PointDsc,
        STREETS,
        "PointDSC_KITTI_release/models/model_best.pkl",
        POINTDSC,
        "see the repository for its licence",
    ),
    published(
        Network::Vbreg,
        ROOMS,
        "VBReg_3DMatch_release/models/model_best.pkl",
        VBREG,
        "see the repository for its licence",
    ),
    published(
        Network::Vbreg,
        STREETS,
        "VBReg_KITTI_release/models/model_best.pkl",
        VBREG,
        "see the repository for its licence",
    ),
];

const ROOMS: TrainedOn = TrainedOn::ThreeDMatch;
const STREETS: TrainedOn = TrainedOn::Kitti;

const fn published(
    network: Network,
    trained_on: TrainedOn,
    file: &'static str,
    place: &'static str,
    remark: &'static str,
) -> Published {
    Published { network, trained_on, file, place, remark, bytes: None, sha256: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_network_has_weights_for_rooms_and_for_streets() {
        for network in Network::ALL {
            for trained_on in [ROOMS, STREETS] {
                let fits =
                    |one: &&Published| (one.network, one.trained_on) == (network, trained_on);
                assert!(PUBLISHED.iter().any(|one| fits(&one)), "{network} {trained_on}");
            }
        }
    }
}
