//! Building the tree: median splits along the widest axis.

use super::KdTree;

/// Points per leaf. Measured on real scans: nearest-neighbour and radius queries are fastest with 12 to 16.
const LEAF_SIZE: usize = 12;

/// A point as the leaves keep it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Entry {
    pub(super) position: [f64; 3],
    pub(super) index: u32,
}

#[derive(Debug, Clone, Copy)]
pub(super) enum Node {
    /// The entries `begin..end`.
    Leaf { begin: u32, end: u32 },
    /// The left child follows at once, the right one stands at `right`. Along `axis` the left points end at
    /// `left_max` and the right ones begin at `right_min`.
    Split { axis: u8, right: u32, left_max: f64, right_min: f64 },
}

impl KdTree {
    /// Appends the subtree over `entries`, which will stand at `begin`; returns their lowest index.
    pub(super) fn split(&mut self, entries: &mut [Entry], begin: u32) -> u32 {
        let node = self.nodes.len();
        let end = begin + entries.len() as u32;
        self.nodes.push(Node::Leaf { begin, end });
        self.lowest.push(0);
        let lowest = if entries.len() <= LEAF_SIZE {
            entries.iter().map(|entry| entry.index).min().unwrap_or(0)
        } else {
            let axis = widest_axis(entries);
            let middle = entries.len() / 2;
            entries.select_nth_unstable_by(middle, |a, b| {
                a.position[axis].total_cmp(&b.position[axis]).then(a.index.cmp(&b.index))
            });
            let (left, right) = entries.split_at_mut(middle);
            let left_max = fold_axis(left, axis, f64::max);
            let right_min = fold_axis(right, axis, f64::min);
            let lowest_left = self.split(left, begin);
            let right_node = self.nodes.len() as u32;
            let lowest_right = self.split(right, begin + middle as u32);
            self.nodes[node] =
                Node::Split { axis: axis as u8, right: right_node, left_max, right_min };
            lowest_left.min(lowest_right)
        };
        self.lowest[node] = lowest;
        lowest
    }
}

fn fold_axis(entries: &[Entry], axis: usize, choose: fn(f64, f64) -> f64) -> f64 {
    entries.iter().map(|entry| entry.position[axis]).fold(f64::NAN, choose)
}

/// The axis along which the points spread most.
fn widest_axis(entries: &[Entry]) -> usize {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    for entry in entries {
        for axis in 0..3 {
            low[axis] = low[axis].min(entry.position[axis]);
            high[axis] = high[axis].max(entry.position[axis]);
        }
    }
    let spread = |axis: usize| high[axis] - low[axis];
    let first = if spread(1) > spread(0) { 1 } else { 0 };
    if spread(2) > spread(first) { 2 } else { first }
}
