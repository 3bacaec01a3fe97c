//! An exact kd-tree over 3-D points: nearest, k nearest within a radius, all within a radius.
//!
//! Points are copied once, reordered so that a leaf is one run of memory. Nodes are split at the median position (not
//! at a value), so that the depth is logarithmic whatever the points are, millions of copies of one point included.
//! One traversal serves all queries: it offers every point that precedes a shrinking bound in the order (distance,
//! index), which makes ties, and with them every result, independent of the shape of the tree.

mod build;

use nalgebra::Point3;

use self::build::{Entry, Node};

/// A point found by a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Position of the point in the slice that the tree was built from.
    pub index: usize,
    /// Squared distance to the query, square metres.
    pub squared_distance: f64,
}

impl Neighbour {
    /// Point `index` of the indexed `points` as a query at `point` finds it, distance to the last bit.
    pub(crate) fn of(
        points: &[Point3<f64>],
        index: usize,
        point: &Point3<f64>,
    ) -> Option<Neighbour> {
        let offset = points.get(index)? - point;
        let squared_distance = squared_length(&[offset.x, offset.y, offset.z]);
        Some(Neighbour { index, squared_distance })
    }

    /// The order of all results: by distance, ties by the lowest index. Nothing precedes or follows a NaN.
    fn precedes(&self, other: &Neighbour) -> bool {
        self.squared_distance < other.squared_distance
            || (self.squared_distance == other.squared_distance && self.index < other.index)
    }

    /// The bound that is preceded by everything closer than `radius`.
    fn closer_than(radius: f64) -> Neighbour {
        Neighbour { index: 0, squared_distance: radius * radius }
    }
}

/// An exact nearest-neighbour index over at most `2^32 - 1` points (further ones are not indexed).
#[derive(Debug, Clone)]
pub struct KdTree {
    entries: Vec<Entry>,
    nodes: Vec<Node>,
    /// The lowest point index below each node: tells whether a subtree at exactly the bound's distance can matter.
    lowest: Vec<u32>,
}

impl KdTree {
    /// Indexes `points`; `O(n log n)`.
    #[must_use]
    pub fn new(points: &[Point3<f64>]) -> KdTree {
        let mut entries: Vec<Entry> = (0..u32::MAX)
            .zip(points)
            .map(|(index, point)| Entry { position: [point.x, point.y, point.z], index })
            .collect();
        let mut tree = KdTree { entries: Vec::new(), nodes: Vec::new(), lowest: Vec::new() };
        if !entries.is_empty() {
            tree.split(&mut entries, 0);
        }
        tree.entries = entries;
        tree
    }

    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is no point.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The indices of all points in the order of the leaves: neighbours in space are close in this order.
    pub fn leaf_order(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.entries.iter().map(|entry| entry.index as usize)
    }

    /// The point closest to `point`; `None` only if the tree is empty or `point` is not finite.
    #[must_use]
    pub fn nearest(&self, point: &Point3<f64>) -> Option<Neighbour> {
        self.nearest_within(point, f64::INFINITY)
    }

    /// The point closest to `point` among those closer than `radius` (metres).
    #[must_use]
    pub fn nearest_within(&self, point: &Point3<f64>, radius: f64) -> Option<Neighbour> {
        self.first_before(point, Neighbour::closer_than(radius))
    }

    /// As [`KdTree::nearest_within`], where a good guess is known: `guess` (its true distance to `point`) is returned
    /// unless another point precedes it. The same result, found sooner.
    #[must_use]
    pub fn nearest_from(&self, point: &Point3<f64>, guess: Neighbour) -> Neighbour {
        self.first_before(point, guess).unwrap_or(guess)
    }

    /// The point closest to `point` among those closer than `radius` (metres), as [`KdTree::nearest_within`], and its
    /// clearance: no other point is closer than that, metres. The clearance ends `margin` beyond the point found, or at
    /// `radius`. `guess` (its true distance to `point`) shortens the search.
    pub(crate) fn nearest_with_clearance(
        &self,
        point: &Point3<f64>,
        guess: Option<Neighbour>,
        radius: f64,
        margin: f64,
    ) -> (Option<Neighbour>, f64) {
        let capped = |nearest: &Neighbour| (nearest.squared_distance.sqrt() + margin).powi(2);
        let squared_radius = radius * radius;
        let mut nearest = guess.filter(|guess| guess.squared_distance < squared_radius);
        let mut clearance = nearest.as_ref().map_or(squared_radius, capped).min(squared_radius);
        let bound = Neighbour { index: 0, squared_distance: clearance };
        self.search(point, bound, |candidate, bound| {
            match nearest {
                Some(known) if known.index == candidate.index => return,
                Some(known) if known.precedes(&candidate) => {
                    clearance = clearance.min(candidate.squared_distance);
                }
                _ => {
                    let other = nearest.map_or(f64::INFINITY, |known| known.squared_distance);
                    clearance = clearance.min(other).min(capped(&candidate));
                    nearest = Some(candidate);
                }
            }
            // At exactly the same distance a lower index would still win.
            let tied = nearest.filter(|nearest| nearest.squared_distance == clearance);
            let index = tied.map_or(0, |nearest| nearest.index);
            *bound = Neighbour { index, squared_distance: clearance };
        });
        (nearest, clearance.sqrt())
    }

    /// The `k` closest points among those closer than `radius` (metres), by distance, then index. Replaces the
    /// content of `found`.
    pub fn k_nearest_within(
        &self,
        point: &Point3<f64>,
        k: usize,
        radius: f64,
        found: &mut Vec<Neighbour>,
    ) {
        self.k_nearest_unordered(point, k, radius, found);
        found.sort_unstable_by(order);
    }

    /// As [`KdTree::k_nearest_within`], in an order that is arbitrary but always the same: a good part faster.
    pub fn k_nearest_unordered(
        &self,
        point: &Point3<f64>,
        k: usize,
        radius: f64,
        found: &mut Vec<Neighbour>,
    ) {
        found.clear();
        if k == 0 {
            return;
        }
        // Collect up to twice as many as wanted, then drop the farther half: constant work per candidate.
        let full = k.saturating_mul(2);
        self.search(point, Neighbour::closer_than(radius), |candidate, bound| {
            found.push(candidate);
            if found.len() >= full {
                *bound = keep_closest(found, k);
            }
        });
        if found.len() > k {
            keep_closest(found, k);
        }
    }

    /// All points closer than `radius` (metres), by distance, then index. Replaces the content of `found`.
    pub fn within(&self, point: &Point3<f64>, radius: f64, found: &mut Vec<Neighbour>) {
        self.k_nearest_within(point, usize::MAX, radius, found);
    }

    fn first_before(&self, point: &Point3<f64>, bound: Neighbour) -> Option<Neighbour> {
        let mut first = None;
        self.search(point, bound, |candidate, bound| {
            first = Some(candidate);
            *bound = candidate;
        });
        first
    }

    /// Offers every point that precedes the bound; `offer` may lower it.
    fn search(
        &self,
        point: &Point3<f64>,
        bound: Neighbour,
        mut offer: impl FnMut(Neighbour, &mut Neighbour),
    ) {
        let mut bound = bound;
        if !self.nodes.is_empty() {
            self.visit(0, &[point.x, point.y, point.z], [0.0; 3], &mut bound, &mut offer);
        }
    }

    /// `offset` is how far the query is from the node's region along each axis.
    fn visit(
        &self,
        node: usize,
        query: &[f64; 3],
        offset: [f64; 3],
        bound: &mut Neighbour,
        offer: &mut impl FnMut(Neighbour, &mut Neighbour),
    ) {
        match self.nodes[node] {
            Node::Leaf { begin, end } => {
                for entry in &self.entries[begin as usize..end as usize] {
                    let candidate = entry.seen_from(query);
                    if candidate.precedes(bound) {
                        offer(candidate, bound);
                    }
                }
            }
            Node::Split { axis, right, left_max, right_min } => {
                let axis = usize::from(axis);
                let (beyond_left, before_right) = (query[axis] - left_max, right_min - query[axis]);
                let left = (node + 1, beyond_left);
                let right = (right as usize, before_right);
                let (near, far) =
                    if beyond_left <= before_right { (left, right) } else { (right, left) };
                self.enter(near.0, axis, near.1, query, offset, bound, offer);
                self.enter(far.0, axis, far.1, query, offset, bound, offer);
            }
        }
    }

    /// Visits a child whose region begins `gap` away along `axis`, unless nothing in it precedes the bound.
    #[inline]
    #[expect(clippy::too_many_arguments, reason = "the state of one recursion")]
    fn enter(
        &self,
        child: usize,
        axis: usize,
        gap: f64,
        query: &[f64; 3],
        mut offset: [f64; 3],
        bound: &mut Neighbour,
        offer: &mut impl FnMut(Neighbour, &mut Neighbour),
    ) {
        if gap > offset[axis] {
            offset[axis] = gap;
        }
        // Summed like the distance of a point, so that rounding can never hide one.
        let squared_distance = squared_length(&offset);
        let may_precede = squared_distance < bound.squared_distance
            || (squared_distance == bound.squared_distance
                && (self.lowest[child] as usize) < bound.index);
        if may_precede {
            self.visit(child, query, offset, bound, offer);
        }
    }
}

impl Entry {
    fn seen_from(&self, query: &[f64; 3]) -> Neighbour {
        let [x, y, z] = self.position;
        let offset = [x - query[0], y - query[1], z - query[2]];
        Neighbour { index: self.index as usize, squared_distance: squared_length(&offset) }
    }
}

fn squared_length([x, y, z]: &[f64; 3]) -> f64 {
    x * x + y * y + z * z
}

fn order(a: &Neighbour, b: &Neighbour) -> std::cmp::Ordering {
    a.squared_distance.total_cmp(&b.squared_distance).then(a.index.cmp(&b.index))
}

/// Drops all but the first `k` (1 to `found.len()`) and returns the last one kept.
fn keep_closest(found: &mut Vec<Neighbour>, k: usize) -> Neighbour {
    let (_, last, _) = found.select_nth_unstable_by(k - 1, order);
    let last = *last;
    found.truncate(k);
    last
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::random::Random;

    fn brute_force(points: &[Point3<f64>], query: &Point3<f64>, radius: f64) -> Vec<Neighbour> {
        let mut all: Vec<Neighbour> = points
            .iter()
            .enumerate()
            .map(|(index, point)| {
                let offset = point - query;
                Neighbour {
                    index,
                    squared_distance: squared_length(&[offset.x, offset.y, offset.z]),
                }
            })
            .filter(|neighbour| neighbour.squared_distance < radius * radius)
            .collect();
        all.sort_by(order);
        all
    }

    /// Points on a coarse lattice, so that equal distances and identical points are common.
    fn lattice(max: usize) -> impl Strategy<Value = Vec<Point3<f64>>> {
        prop::collection::vec(prop::array::uniform3(-4_i32..4), 0..max).prop_map(|cells| {
            cells.iter().map(|c| Point3::from(c.map(|x| f64::from(x) * 0.1))).collect()
        })
    }

    proptest! {
        #[test]
        fn every_query_agrees_with_brute_force(
            points in lattice(300),
            query in prop::array::uniform3(-5_i32..5),
            radius in 0.0..0.9_f64,
            k in 0_usize..40,
        ) {
            let query = Point3::from(query.map(|x| f64::from(x) * 0.1));
            let tree = KdTree::new(&points);
            let all = brute_force(&points, &query, f64::INFINITY);
            let near = brute_force(&points, &query, radius);
            let mut found = Vec::new();
            tree.within(&query, radius, &mut found);
            prop_assert_eq!(&found, &near);
            tree.k_nearest_within(&query, k, radius, &mut found);
            prop_assert_eq!(&found[..], &near[..k.min(near.len())]);
            prop_assert_eq!(tree.nearest(&query), all.first().copied());
            prop_assert_eq!(tree.nearest_within(&query, radius), near.first().copied());
            if let Some(&guess) = all.get(k) {
                prop_assert_eq!(tree.nearest_from(&query, guess), all[0]);
            }
            let margin = 0.07;
            for guess in [None, all.get(k).copied()] {
                let (nearest, clearance) = tree.nearest_with_clearance(&query, guess, radius, margin);
                prop_assert_eq!(nearest, near.first().copied());
                let end = nearest.map_or(radius, |nearest| nearest.squared_distance.sqrt() + margin);
                let other = near.get(1).map_or(radius, |other| other.squared_distance.sqrt());
                prop_assert!((clearance - end.min(other)).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn scattered_points_agree_with_brute_force() {
        let mut random = Random::new(5, 0);
        let mut point = || Point3::from([random.normal(), 3.0 * random.normal(), random.normal()]);
        let points: Vec<_> = (0..3000).map(|_| point()).collect();
        let tree = KdTree::new(&points);
        let mut found = Vec::new();
        for _ in 0..200 {
            let query = point();
            tree.k_nearest_within(&query, 40, 0.8, &mut found);
            let expected = brute_force(&points, &query, 0.8);
            assert_eq!(found[..], expected[..expected.len().min(40)]);
            assert_eq!(
                tree.nearest(&query),
                brute_force(&points, &query, f64::INFINITY).first().copied()
            );
        }
    }

    /// A search that visited all copies for each query would take minutes, not a fraction of a second.
    #[test]
    fn identical_points_stay_cheap() {
        let points = vec![Point3::new(1.0, 2.0, 3.0); 400_000];
        let tree = KdTree::new(&points);
        let mut found = Vec::new();
        let started = std::time::Instant::now();
        for _ in 0..50_000 {
            assert_eq!(tree.nearest(&points[0]).unwrap().index, 0);
            tree.k_nearest_within(&points[0], 30, 1.0, &mut found);
            assert!(found.iter().map(|neighbour| neighbour.index).eq(0..30));
            assert!(started.elapsed().as_secs() < 20);
        }
    }

    #[test]
    fn odd_queries_find_nothing() {
        assert_eq!(KdTree::new(&[]).nearest(&Point3::origin()), None);
        let tree = KdTree::new(&[Point3::origin(), Point3::new(f64::NAN, 0.0, 0.0)]);
        assert_eq!(tree.nearest(&Point3::new(f64::NAN, 0.0, 0.0)), None);
        assert_eq!(tree.nearest_within(&Point3::origin(), 0.0), None);
        assert_eq!(tree.nearest_within(&Point3::origin(), f64::NAN), None);
        assert_eq!(tree.nearest(&Point3::new(9.0, 0.0, 0.0)).unwrap().index, 0);
        assert!(tree.leaf_order().eq(0..2));
    }
}
