//! The nearest points within a radius.

use rare::Result;
use rayon::prelude::*;

use super::Point;
use super::grid_subsampling::bounds;

/// Queries that a thread takes at once.
const BLOCK: usize = 256;

/// For each query the indices of the points near it, the nearest first: a matrix with as many columns as the longest
/// row needs. Shorter rows end with the number of points that were searched, which stands for no point.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Neighbours {
    width: usize,
    support: usize,
    indices: Vec<u32>,
}

impl Neighbours {
    /// Columns.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of queries.
    #[must_use]
    pub fn len(&self) -> usize {
        self.indices.len().checked_div(self.width).unwrap_or(0)
    }

    /// Whether there is no query.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.indices.is_empty()
    }

    /// Number of points that were searched: the index that stands for no point.
    #[must_use]
    pub fn support(&self) -> usize {
        self.support
    }

    /// The indices of all rows, one after the other.
    #[must_use]
    pub fn indices(&self) -> &[u32] {
        &self.indices
    }

    /// The row of a query, with what fills it up; empty if there is no such query.
    #[must_use]
    pub fn row(&self, query: usize) -> &[u32] {
        self.indices.get(query * self.width..(query + 1) * self.width).unwrap_or(&[])
    }
}

/// The points of `support` closer than `radius` (metres) to each of `queries`, the nearest first, of equally near ones
/// the first, at most `limit` of them. `queries` and `support` stack two clouds, whose sizes are `lengths`; a point has
/// neighbours in its own cloud only.
///
/// Squared distances are those of single precision, as in the released code (nanoflann).
///
/// # Errors
/// `InvalidInput` if a support point is not finite or the support spans too much for the radius.
pub fn neighbours(
    [queries, support]: [&[Point]; 2],
    lengths: [[usize; 2]; 2],
    radius: f32,
    limit: usize,
) -> Result<Neighbours> {
    let [query_lengths, support_lengths] = lengths;
    let (first_queries, second_queries) = queries.split_at(query_lengths[0].min(queries.len()));
    let (first, second) = support.split_at(support_lengths[0].min(support.len()));
    let limit = limit.max(1);
    let mut rows = search(&Cells::new(first, radius, 0)?, first_queries, limit);
    rows.extend(search(&Cells::new(second, radius, first.len())?, second_queries, limit));
    let width = rows.iter().map(|row| row.widest).max().unwrap_or(0).max(1);
    let mut indices = vec![support.len() as u32; queries.len() * width];
    let mut rest = indices.as_mut_slice();
    for block in &rows {
        let mut found = block.indices.as_slice();
        for &count in &block.counts {
            let (row, after) = std::mem::take(&mut rest).split_at_mut(width);
            let (indices, others) = found.split_at(count as usize);
            row[..indices.len()].copy_from_slice(indices);
            (rest, found) = (after, others);
        }
    }
    Ok(Neighbours { width, support: support.len(), indices })
}

/// The neighbours of a block of queries, one after the other.
#[derive(Default)]
struct Block {
    indices: Vec<u32>,
    counts: Vec<u32>,
    widest: usize,
}

fn search(cells: &Cells, queries: &[Point], limit: usize) -> Vec<Block> {
    let block = |queries: &[Point]| {
        let mut block = Block::default();
        let mut found = Vec::new();
        for query in queries {
            cells.within(query, &mut found);
            if found.len() > limit {
                found.select_nth_unstable(limit - 1);
                found.truncate(limit);
            }
            found.sort_unstable();
            block.indices.extend(found.iter().map(|&entry| entry as u32));
            block.counts.push(found.len() as u32);
            block.widest = block.widest.max(found.len());
        }
        block
    };
    queries.par_chunks(BLOCK).map(block).collect()
}

/// Points sorted by the cubes in which they lie; the cubes are a little larger than the radius.
pub(super) struct Cells {
    origin: [f64; 3],
    edge: f64,
    squared_radius: f32,
    /// The cube of each point, ascending.
    keys: Vec<u64>,
    /// The points in the same order, and their indices.
    points: Vec<(Point, u32)>,
}

impl Cells {
    /// `first` is the index of the first point.
    ///
    /// # Errors
    /// Those of [`neighbours`].
    pub(super) fn new(points: &[Point], radius: f32, first: usize) -> Result<Cells> {
        let (low, _) = bounds(points, radius)?;
        // Larger than the radius by more than single precision can round, so that the next cube is far enough.
        let edge = f64::from(radius) * 1.001;
        let mut cells = Cells {
            // One cube below, so that no query near the cloud has a negative cube next to it.
            origin: low.map(|coordinate| f64::from(coordinate) - 2.0 * edge),
            edge,
            squared_radius: radius * radius,
            keys: Vec::new(),
            points: Vec::new(),
        };
        let mut entries: Vec<(u64, u32)> =
            points.iter().zip(0..).map(|(point, index)| (cells.key(point), index)).collect();
        entries.sort_unstable();
        cells.keys = entries.iter().map(|entry| entry.0).collect();
        cells.points = entries
            .iter()
            .filter_map(|&(_, index)| Some((*points.get(index as usize)?, index + first as u32)))
            .collect();
        Ok(cells)
    }

    fn cube(&self, point: &Point) -> [i64; 3] {
        [0, 1, 2]
            .map(|axis| ((f64::from(point[axis]) - self.origin[axis]) / self.edge).floor() as i64)
    }

    fn key(&self, point: &Point) -> u64 {
        packed(self.cube(point))
    }

    /// The points closer than the radius, in no order: each the bits of its squared distance, then its index, so that
    /// they compare by distance, then index.
    pub(super) fn within(&self, query: &Point, found: &mut Vec<u64>) {
        found.clear();
        let [x, y, z] = self.cube(query);
        // No point of the cloud is near a query so far outside its cubes.
        if [x, y, z].iter().any(|&cell| !(1..1 << 22).contains(&cell)) {
            return;
        }
        for (dz, dy) in (-1..=1).flat_map(|dz| (-1..=1).map(move |dy| (dz, dy))) {
            // Cubes that follow each other along x do so in the order of the keys.
            let (low, high) = (packed([x - 1, y + dy, z + dz]), packed([x + 1, y + dy, z + dz]));
            let start = self.keys.partition_point(|&key| key < low);
            let candidates = self.keys.iter().zip(&self.points).skip(start);
            for (_, (point, index)) in candidates.take_while(|&(&key, _)| key <= high) {
                let squared = squared_distance(query, point);
                if squared < self.squared_radius {
                    found.push(u64::from(squared.to_bits()) << 32 | u64::from(*index));
                }
            }
        }
    }
}

/// Cubes along x follow each other; 21 bits for an axis.
fn packed([x, y, z]: [i64; 3]) -> u64 {
    const LARGEST: i64 = (1 << 21) - 1;
    let [x, y, z] = [x, y, z].map(|cell| cell.clamp(0, LARGEST) as u64);
    z << 42 | y << 21 | x
}

fn squared_distance(a: &Point, b: &Point) -> f32 {
    let [x, y, z] = [0, 1, 2].map(|axis| a[axis] - b[axis]);
    x * x + y * y + z * z
}

#[cfg(test)]
mod tests {
    use super::*;
    use rare::random::Random;

    fn cloud(count: usize, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed, 0);
        // Steps of a sixteenth: many equal distances.
        let mut coordinate = || (random.below(32) as f32 - 16.0) / 16.0;
        (0..count).map(|_| [coordinate(), coordinate(), coordinate() / 4.0]).collect()
    }

    /// All distances, sorted.
    fn reference(query: &Point, support: &[Point], first: usize, radius: f32) -> Vec<u32> {
        let squared = |index: &usize| squared_distance(query, &support[*index]);
        let mut near: Vec<usize> =
            (0..support.len()).filter(|index| squared(index) < radius * radius).collect();
        near.sort_by(|a, b| squared(a).total_cmp(&squared(b)));
        near.iter().map(|&index| (index + first) as u32).collect()
    }

    #[test]
    fn the_nearest_of_the_own_cloud_are_found_in_order() {
        let (queries, support) = (cloud(300, 1), cloud(700, 2));
        for (radius, limit) in [(0.2, 1000), (0.3, 7), (0.04, 3)] {
            let lengths = [[100, 200], [300, 400]];
            let found = neighbours([&queries, &support], lengths, radius, limit).unwrap();
            assert_eq!((found.len(), found.support()), (300, 700));
            let mut widest = 1;
            for (index, query) in queries.iter().enumerate() {
                let (part, first) =
                    if index < 100 { (&support[..300], 0) } else { (&support[300..], 300) };
                let mut expected = reference(query, part, first, radius);
                expected.truncate(limit);
                widest = widest.max(expected.len());
                let (row, rest) = found.row(index).split_at(expected.len());
                assert_eq!(row, expected);
                assert!(rest.iter().all(|&index| index == 700));
            }
            assert_eq!(found.width(), widest);
        }
    }

    #[test]
    fn nothing_is_near_what_is_far() {
        let far = [[1e30, 0.0, 0.0], [-1e30, 0.0, 0.0], [f32::NAN; 3]];
        let found = neighbours([&far, &cloud(50, 3)], [[2, 1], [25, 25]], 0.5, 4).unwrap();
        assert!(found.indices().iter().all(|&index| index == 50));
        assert!(neighbours([&far, &[]], [[2, 1], [0, 0]], 0.5, 4).unwrap().width() == 1);
        assert!(neighbours([&far, &far], [[3, 0], [3, 0]], 0.5, 4).is_err());
    }
}
