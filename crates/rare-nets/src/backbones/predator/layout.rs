//! The tensors of Predator.

use super::PredatorConfig;
use crate::backbones::hourglass::{MessagePassing, pointwise};
use crate::checkpoint::Layout;

/// The layers between coarse points: of each cloud, of both, of each.
pub(super) const GRAPHS: [&str; 3] = ["gnn.layers.0", "gnn.layers.1", "gnn.layers.2"];

/// The shape of every tensor of a model.
#[must_use]
pub fn layout(config: &PredatorConfig) -> Layout {
    let channels = config.coarse_channels;
    let [first, between, second] = GRAPHS;
    let mut layout = Layout::from([("epsilon".to_owned(), Vec::new())]);
    config.encoder().add_to(&mut layout, "encoder_blocks");
    pointwise(&mut layout, "bottle", [config.encoder().coarsest(), channels]);
    for name in [first, second] {
        let sizes = [[1, 2], [2, 2], [1, 4]].map(|sizes| sizes.map(|size| size * channels));
        for (part, [outputs, inputs]) in (1..).zip(sizes) {
            layout.insert(format!("{name}.conv{part}.weight"), vec![outputs, inputs, 1, 1]);
        }
    }
    MessagePassing::add_to(&mut layout, between, channels);
    pointwise(&mut layout, "proj_gnn", [channels, channels]);
    pointwise(&mut layout, "proj_score", [channels, 1]);
    config.decoder().add_to(&mut layout, "decoder_blocks");
    layout
}
