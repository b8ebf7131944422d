//! The network that predicts occupancy: its weights and initial state (`docs/format.md`, clauses 4.4 and 4.5).
//!
//! One hidden layer of [`WIDTH`] units. Its input are binary *features* of the neighbourhood, each with a row of
//! weights. The input of the hidden layer is the sum of the rows of the features that are set:
//!
//! - *presence* `k`: the neighbour at offset `k` (3³ order, not 13) is occupied, and its children are unknown;
//! - *known* `k`: it is occupied, and its children are known;
//! - *child* `k, o`: its children are known, and the one in octant `o` is occupied.
//!
//! The children of a neighbour are known if it precedes this voxel in the same slice. That requires a negative
//! component of its offset. So there are 26 presence rows, 19 known rows and 19·8 child rows.
//!
//! One more row is added for the child to be coded. It is selected by the child's octant `c` and the occupancy of the
//! octants below: `1 << c | occupancy of those` (1..=255).
//!
//! # `weights.bin`
//! Little-endian. Each row has [`WIDTH`] values, unit 0 first. The order is: presence rows (`i8`) for `k` ascending;
//! for each of the 19 `k`, ascending, the known row (`i8`), then the child rows (`i8`), octant 0 first; the 255 rows of
//! the children (`i8`); one output row (`i16`) for each octant; eight output biases (`i32`).

use super::neighbourhood::{BEFORE_OFFSETS, Neighbourhood};
use crate::geometry::{KernelMap, ones};
pub use b2p_kernels::hidden::WIDTH;
use b2p_kernels::hidden::{Narrow, Row};
use std::ops::Range;
use std::sync::OnceLock;

/// Number of features.
pub const FEATURES: usize = PRESENCES + 9 * BEFORE_COUNT;

/// Number of rows that are selected by the child to be coded.
pub const NODES: usize = 255;

/// Size of `weights.bin` in bytes.
pub const SIZE: usize = (FEATURES + NODES) * WIDTH + 8 * (2 * WIDTH + 4);

/// Number of offsets but the centre.
const PRESENCES: usize = 26;
/// Number of [`BEFORE_OFFSETS`].
const BEFORE_COUNT: usize = 19;

static WEIGHTS: &[u8; SIZE] = include_bytes!("weights.bin");

/// For each of [`BEFORE_OFFSETS`] its index among them.
const BEFORE_INDEX: [u8; 27] = {
    let mut slots = [0; 27];
    let (mut k, mut slot) = (0, 0);
    while k < 27 {
        slots[k] = slot;
        slot += (BEFORE_OFFSETS >> k & 1) as u8;
        k += 1;
    }
    slots
};

/// Passes to `emit` the index of the weight row of each feature that is set for the voxel `voxel` of the slice `slice`.
/// `map` is their 3³ kernel map, `occupancy` that of the slice, at least up to `voxel`.
pub fn features(map: &KernelMap, slice: &Range<usize>, voxel: usize, occupancy: &[u8], mut emit: impl FnMut(usize)) {
    let neighbourhood = Neighbourhood::at(map, slice, voxel);
    for k in ones(neighbourhood.there & !neighbourhood.known) {
        emit(k - usize::from(k > KernelMap::CENTRE));
    }
    for k in ones(neighbourhood.known) {
        let known = PRESENCES + 9 * usize::from(BEFORE_INDEX[k]);
        emit(known);
        let mask = occupancy[map.row(voxel)[k] as usize - slice.start];
        ones(mask).for_each(|octant| emit(known + 1 + octant));
    }
}

/// The weights in the layout of the predictor.
#[derive(Debug)]
pub(super) struct Network {
    presence: [Narrow; 27],
    /// For each of [`BEFORE_OFFSETS`] the sums of the rows of its children, by half of the occupancy and the four bits
    /// of that half. The known row is split between both halves so that sums fit in `i8`.
    halves: Vec<[[Narrow; 16]; 2]>,
    /// What exceeds `i8` in these sums.
    pub remainders: Vec<Remainder>,
    nodes: [Narrow; NODES + 1],
    /// Initial rows and biases of the output layer, by octant.
    pub output: [Row; 8],
    pub bias: [i32; 8],
}

/// What exceeds `i8` in the sums of one offset and one half of its occupancy.
#[derive(Debug)]
pub(super) struct Remainder {
    /// Offset of the neighbour.
    pub k: usize,
    shift: usize,
    rows: [Narrow; 16],
}

impl Remainder {
    /// The row to add for a neighbour of occupancy `mask`.
    #[inline(always)]
    pub fn row(&self, mask: u8) -> &Narrow {
        &self.rows[usize::from(mask >> self.shift & 15)]
    }
}

impl Network {
    /// The network that the format defines.
    pub fn get() -> &'static Network {
        static NETWORK: OnceLock<Network> = OnceLock::new();
        NETWORK.get_or_init(|| Network::parse(WEIGHTS))
    }

    fn parse(weights: &[u8; SIZE]) -> Network {
        let mut rest = weights.as_slice();
        let mut bytes = |count: usize| {
            let (taken, after) = rest.split_at(count);
            rest = after;
            taken
        };
        let mut row = || -> Narrow {
            let bytes = bytes(WIDTH);
            std::array::from_fn(|unit| bytes[unit] as i8)
        };
        let mut presence = [[0; WIDTH]; 27];
        for k in (0..27).filter(|&k| k != KernelMap::CENTRE) {
            presence[k] = row();
        }
        let (mut halves, mut remainders) = (Vec::new(), Vec::new());
        for k in ones(BEFORE_OFFSETS) {
            let known = row();
            let children: [Narrow; 8] = std::array::from_fn(|_| row());
            let parts = split(&known, &children);
            for (half, (_, remainder)) in parts.iter().enumerate() {
                if *remainder != [[0; WIDTH]; 16] {
                    let (shift, rows) = (4 * half, *remainder);
                    remainders.push(Remainder { k, shift, rows });
                }
            }
            halves.push(parts.map(|(sums, _)| sums));
        }
        let mut nodes = [[0; WIDTH]; NODES + 1];
        nodes[1..].fill_with(row);
        let output = std::array::from_fn(|_| {
            let bytes = bytes(2 * WIDTH);
            std::array::from_fn(|unit| i16::from_le_bytes([bytes[2 * unit], bytes[2 * unit + 1]]))
        });
        let bias = std::array::from_fn(|_| {
            let bytes = bytes(4);
            i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
        });
        Network {
            presence,
            halves,
            remainders,
            nodes,
            output,
            bias,
        }
    }

    /// Row of an occupied neighbour at offset `k` with unknown children.
    #[inline(always)]
    pub fn presence(&self, k: usize) -> &Narrow {
        &self.presence[k]
    }

    /// Rows to add for a neighbour of occupancy `mask` at offset `k`, one of [`BEFORE_OFFSETS`]. The [`Remainder`]s
    /// must be added, too.
    #[inline(always)]
    pub fn children(&self, k: usize, mask: u8) -> [&Narrow; 2] {
        let [low, high] = &self.halves[usize::from(BEFORE_INDEX[k])];
        [&low[usize::from(mask & 15)], &high[usize::from(mask >> 4)]]
    }

    /// Row of the child `node` (`1 << octant | occupancy of the octants below`).
    #[inline(always)]
    pub fn node(&self, node: usize) -> &Narrow {
        &self.nodes[node & 255]
    }
}

/// Sums of the rows `children`, by half and by the four bits of that half, with `known` split between the halves.
/// Returns for each half the sums clamped to `i8`, and their remainders. At most 26 + 19·8 + 1 rows are added for a
/// child, so all totals stay within ±22,733.
fn split(known: &Narrow, children: &[Narrow; 8]) -> [([Narrow; 16], [Narrow; 16]); 2] {
    let mut halves = [([[0; WIDTH]; 16], [[0; WIDTH]; 16]); 2];
    for unit in 0..WIDTH {
        let sums = [0, 1].map(|half| {
            let mut sums = [0i32; 16];
            for mask in 1..16usize {
                let octant = 4 * half + mask.trailing_zeros() as usize;
                sums[mask] = sums[mask & (mask - 1)] + i32::from(children[octant][unit]);
            }
            sums
        });
        // Range of the part of `known` with which all sums of a half fit in `i8`.
        let [(a, b), (c, d)] = sums.map(|sums| {
            let (least, most) = sums.iter().fold((0, 0), |(a, b), &sum| (sum.min(a), sum.max(b)));
            (i32::from(i8::MIN) - least, i32::from(i8::MAX) - most)
        });
        let known = i32::from(known[unit]);
        let low = known.max(a.max(known - d)).min(b.min(known - c));
        for ((clamped, remainder), (base, sums)) in halves.iter_mut().zip([low, known - low].into_iter().zip(sums)) {
            for mask in 0..16 {
                let exact = base + sums[mask];
                let fits = exact.clamp(i8::MIN.into(), i8::MAX.into());
                clamped[mask][unit] = fits as i8;
                remainder[mask][unit] = i8::try_from(exact - fits).expect("the remainder fits in i8");
            }
        }
    }
    halves
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rows_of_an_occupancy_sum_to_the_rows_of_its_children() {
        let network = Network::get();
        for (slot, k) in ones(BEFORE_OFFSETS).enumerate() {
            for mask in 0..=255u8 {
                for unit in 0..WIDTH {
                    let at = |row: usize| i32::from(WEIGHTS[(PRESENCES + 9 * slot + row) * WIDTH + unit] as i8);
                    let expected = at(0) + ones(mask).map(|octant| at(1 + octant)).sum::<i32>();
                    let mut sum: i32 = network.children(k, mask).map(|row| row[unit].into()).iter().sum();
                    for remainder in network.remainders.iter().filter(|remainder| remainder.k == k) {
                        sum += i32::from(remainder.row(mask)[unit]);
                    }
                    assert_eq!(sum, expected);
                }
            }
        }
    }
}
