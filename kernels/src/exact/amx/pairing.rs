//! Which taps share a tile row, and where their tiles are.

use crate::sparse::rows::{Extents, Words};

/// Panels whose sums of three products fit the tiles, beside one of rows and one of weights.
pub(super) const WIDTH: usize = 2;
/// Products of digits: high, low, and of their sums.
pub(super) const PRODUCTS: usize = 3;
/// The taps of a 3³ kernel in pairs that few groups need: on surfaces a voxel has both neighbours or none more often
/// than not.
const OF_27: [&[u8]; 14] = [
    &[0, 1],
    &[2],
    &[3, 6],
    &[4, 7],
    &[5, 8],
    &[9, 18],
    &[10, 13],
    &[11, 14],
    &[12, 15],
    &[16, 17],
    &[19, 20],
    &[21, 24],
    &[22, 25],
    &[23, 26],
];

/// The pair of each tap, and its half.
pub(super) fn homes(volume: usize) -> Vec<[usize; 2]> {
    let mut homes: Vec<_> = (0..volume).map(|tap| [tap / 2, tap % 2]).collect();
    if volume == 27 {
        for (pair, taps) in OF_27.iter().enumerate() {
            for (half, &tap) in taps.iter().enumerate() {
                homes[usize::from(tap)] = [pair, half];
            }
        }
    }
    homes
}

/// The tile of a pair's product of one panel: those of a block of panels follow each other for each pair.
pub(super) fn tile(extents: Extents, pair: usize, product: usize, panel: usize) -> usize {
    let (pairs, block) = (extents.volume.div_ceil(2), panel / WIDTH);
    let width = WIDTH.min(extents.panels() - block * WIDTH);
    let before = block * WIDTH * PRODUCTS * pairs;
    before + (pair * PRODUCTS + product) * width + panel % WIDTH
}

/// The rows of two taps, and the weights that they meet.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Step {
    /// For each tap, which sixteen of the rows.
    pub(super) places: [*const u16; 2],
    pub(super) weights: *const Words,
}

/// Memory that a thread reuses.
#[derive(Default)]
pub(super) struct Steps {
    /// Of all groups, one after the other.
    pub(super) all: Vec<Step>,
    /// How many each group has.
    pub(super) counts: Vec<usize>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tap_has_a_half_of_a_pair_of_its_own() {
        for volume in [1, 2, 8, 27, 54] {
            let mut homes = homes(volume);
            assert!(homes.iter().all(|[pair, _]| *pair < volume.div_ceil(2)));
            homes.sort_unstable();
            homes.dedup();
            assert_eq!(homes.len(), volume);
        }
    }

    #[test]
    fn every_product_has_a_tile_of_its_own() {
        for panels in 1..6 {
            let extents = Extents {
                volume: 27,
                cin: 32,
                cout: 16 * panels,
            };
            let all = (0..14).flat_map(|pair| (0..3).map(move |product| (pair, product)));
            let tiles =
                all.flat_map(|(pair, product)| (0..panels).map(move |panel| tile(extents, pair, product, panel)));
            let mut tiles: Vec<_> = tiles.collect();
            tiles.sort_unstable();
            assert!(tiles.into_iter().eq(0..14 * 3 * panels));
        }
    }
}
