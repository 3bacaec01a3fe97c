//! Sets of integer coordinates with the place of each, found by hashing.

/// A voxel: `floor(position / edge)`, on coarser levels a multiple of their stride.
pub(super) type Coordinate = [i32; 3];

/// Coordinates are at most this far from 0, so that three of them fit into a key together with the reach of a kernel.
pub(super) const FURTHEST: i32 = 1_000_000;
/// What is added to a coordinate so that it fills [`BITS`] bits and no more.
const OFFSET: i32 = 1 << 20;
/// Bits of a coordinate in a key.
const BITS: u32 = 21;
/// An empty slot.
const EMPTY: u32 = u32::MAX;
/// Slots of an empty table, a power of two.
const FEWEST_SLOTS: usize = 16;

/// Different coordinates in the order in which they came, and where each stands.
///
/// The table has open addressing and is at most half full. It is only asked, never iterated: its order cannot show.
#[derive(Debug, Clone)]
pub(super) struct CoordinateMap {
    stride: i32,
    coordinates: Vec<Coordinate>,
    slots: Vec<(u64, u32)>,
}

impl CoordinateMap {
    /// No coordinates, of voxels whose edge is `stride` of the finest ones.
    pub(super) fn new(stride: i32) -> CoordinateMap {
        CoordinateMap { stride, coordinates: Vec::new(), slots: vec![(0, EMPTY); FEWEST_SLOTS] }
    }

    /// The voxels of twice the edge that hold these: every coordinate rounded down, in the order of the first one.
    pub(super) fn coarser(&self) -> CoordinateMap {
        let stride = 2 * self.stride;
        let mut coarse = CoordinateMap::new(stride);
        for coordinate in &self.coordinates {
            coarse.insert(coordinate.map(|value| value.div_euclid(stride) * stride));
        }
        coarse
    }

    /// Edge of a voxel, in the finest ones.
    pub(super) fn stride(&self) -> i32 {
        self.stride
    }

    /// All coordinates, in the order in which they came.
    pub(super) fn coordinates(&self) -> &[Coordinate] {
        &self.coordinates
    }

    /// Number of coordinates.
    pub(super) fn len(&self) -> usize {
        self.coordinates.len()
    }

    /// Adds a coordinate; false if it is there already.
    pub(super) fn insert(&mut self, coordinate: Coordinate) -> bool {
        if 2 * (self.coordinates.len() + 1) > self.slots.len() {
            self.grow();
        }
        let key = key(coordinate);
        let slot = self.slot(key);
        let Some((held, place)) = self.slots.get_mut(slot).filter(|(_, place)| *place == EMPTY)
        else {
            return false;
        };
        (*held, *place) = (key, self.coordinates.len() as u32);
        self.coordinates.push(coordinate);
        true
    }

    /// The place of a coordinate.
    pub(super) fn find(&self, coordinate: Coordinate) -> Option<u32> {
        let slot = self.slot(key(coordinate));
        self.slots.get(slot).map(|(_, place)| *place).filter(|place| *place != EMPTY)
    }

    /// The slot that holds `key`, or the empty one where it belongs.
    fn slot(&self, key: u64) -> usize {
        let mask = self.slots.len() - 1;
        let mut slot = hash(key) as usize & mask;
        while let Some(&(held, place)) = self.slots.get(slot)
            && place != EMPTY
            && held != key
        {
            slot = (slot + 1) & mask;
        }
        slot
    }

    fn grow(&mut self) {
        let slots = vec![(0, EMPTY); 2 * self.slots.len()];
        let old = std::mem::replace(&mut self.slots, slots);
        for (key, place) in old.into_iter().filter(|(_, place)| *place != EMPTY) {
            let slot = self.slot(key);
            if let Some(free) = self.slots.get_mut(slot) {
                *free = (key, place);
            }
        }
    }
}

/// Three coordinates as one number; no two coordinates within the reach of a kernel from [`FURTHEST`] share one.
fn key(coordinate: Coordinate) -> u64 {
    coordinate.iter().fold(0, |key, value| key << BITS | value.wrapping_add(OFFSET) as u64)
}

/// Fibonacci hashing: the upper bits of the product are mixed best.
fn hash(key: u64) -> u64 {
    key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_are_found_where_they_were_put() {
        let mut map = CoordinateMap::new(1);
        let all: Vec<Coordinate> = (-500..500).map(|i| [i, i * i % 77, FURTHEST - i]).collect();
        assert!(all.iter().all(|&coordinate| map.insert(coordinate)));
        assert!(all.iter().all(|&coordinate| !map.insert(coordinate)));
        for (place, &[x, y, z]) in all.iter().enumerate() {
            assert_eq!(map.find([x, y, z]), Some(place as u32));
            assert_eq!(map.find([x, y + 100, z]), None);
        }
        assert_eq!(map.coordinates(), all);
    }

    #[test]
    fn coarser_voxels_round_down_below_zero_too() {
        let mut map = CoordinateMap::new(2);
        for x in [-6, -4, -2, 0, 2, 4] {
            map.insert([x, 2, -2]);
        }
        let coarse = map.coarser();
        assert_eq!(coarse.coordinates(), [[-8, 0, -4], [-4, 0, -4], [0, 0, -4], [4, 0, -4]]);
        assert_eq!(coarse.stride(), 4);
    }
}
