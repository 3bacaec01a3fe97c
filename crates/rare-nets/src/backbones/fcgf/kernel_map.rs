//! Which voxels meet under a kernel.

use rayon::prelude::*;

use super::coordinates::{Coordinate, CoordinateMap};

/// The voxels that meet under each offset of a kernel.
pub(super) struct KernelMap {
    /// For every offset, in the order of the kernel's tensor, the places of an input and of an output voxel, outputs
    /// ascending. No output has two inputs under one offset.
    pub(super) pairs: Vec<Vec<[u32; 2]>>,
    /// Number of output voxels.
    pub(super) outputs: usize,
}

impl KernelMap {
    /// The voxels of `input` around those of `output`: `u + offset * stride of the input` meets `u`.
    pub(super) fn new(input: &CoordinateMap, output: &CoordinateMap, side: usize) -> KernelMap {
        let pairs = offsets(side, input.stride()).into_par_iter();
        let pairs = pairs.map(|offset| meeting(input, output, offset)).collect();
        KernelMap { pairs, outputs: output.len() }
    }

    /// The map of the transposed convolution: inputs and outputs exchanged, every pair under the offset that it has.
    pub(super) fn transposed(&self, outputs: usize) -> KernelMap {
        let exchanged = |pairs: &Vec<[u32; 2]>| {
            let mut pairs: Vec<[u32; 2]> = pairs.iter().map(|&[from, to]| [to, from]).collect();
            pairs.sort_unstable_by_key(|&[_, to]| to);
            pairs
        };
        KernelMap { pairs: self.pairs.par_iter().map(exchanged).collect(), outputs }
    }
}

/// The offsets of a cubic kernel in voxels of the finest level, x fastest, centred on 0.
pub(super) fn offsets(side: usize, stride: i32) -> Vec<Coordinate> {
    let reach = side as i32 / 2;
    let along = || (0..side as i32).map(move |step| (step - reach) * stride);
    let layer = |z| along().flat_map(move |y| along().map(move |x| [x, y, z]));
    along().flat_map(layer).collect()
}

/// The sum of two coordinates.
pub(super) fn shifted([x, y, z]: Coordinate, [dx, dy, dz]: Coordinate) -> Coordinate {
    [x + dx, y + dy, z + dz]
}

fn meeting(input: &CoordinateMap, output: &CoordinateMap, offset: Coordinate) -> Vec<[u32; 2]> {
    let outputs = output.coordinates().iter().zip(0..);
    let found = outputs.filter_map(|(&at, place)| Some([input.find(shifted(at, offset))?, place]));
    found.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_run_along_x_first() {
        let offsets = offsets(3, 2);
        assert_eq!(offsets.len(), 27);
        assert_eq!(offsets[..4], [[-2, -2, -2], [0, -2, -2], [2, -2, -2], [-2, 0, -2]]);
        assert_eq!(offsets[13], [0, 0, 0]);
        assert_eq!(offsets[26], [2, 2, 2]);
    }

    #[test]
    fn a_transposed_map_exchanges_input_and_output() {
        let mut fine = CoordinateMap::new(1);
        for coordinate in [[3, 0, 0], [0, 0, 0], [1, 0, 0]] {
            fine.insert(coordinate);
        }
        let coarse = fine.coarser();
        assert_eq!(coarse.coordinates(), [[2, 0, 0], [0, 0, 0]]);
        let map = KernelMap::new(&fine, &coarse, 3);
        assert_eq!(map.pairs[14], [[0, 0], [2, 1]]);
        assert_eq!(map.pairs[12], [[2, 0]]);
        let transposed = map.transposed(fine.len());
        assert_eq!(transposed.pairs[14], [[0, 0], [1, 2]]);
        assert_eq!((map.outputs, transposed.outputs), (2, 3));
    }
}
