//! The network that predicts occupancy: its weights, and what it starts from.
//!
//! One hidden layer of [`WIDTH`] units. What is known before a voxel's children are coded is a list of *facts*, yes or no, each with
//! a row of weights; the hidden layer's input is the sum of the rows of the facts that hold:
//!
//! - *presence* `k`: the neighbour at offset `k` (3³ order, not 13) is occupied, but its own children are not known;
//! - *known* `k`: it is occupied, and its children are known;
//! - *child* `k, o`: and its child in octant `o` is occupied.
//!
//! The children of a neighbour are known if it comes before this voxel in the same slice. It cannot if none of its offsets is
//! negative, so there are 26 presence rows, 19 known rows and 19·8 child rows.
//!
//! Then one row more is added for the child to be coded: there is one for every octant `c` and every way in which the octants below
//! it may be occupied, numbered `1 << c | occupancy of those` (1..=255).
//!
//! # `weights.bin`
//! Little-endian, each row [`WIDTH`] values, unit 0 first: presence rows (`i8`) for `k` ascending; for each of the 19 `k`, ascending,
//! the known row (`i8`), then the child rows (`i8`), octant 0 first; the 255 rows of the children (`i8`); one output row (`i16`) for
//! each octant; eight output biases (`i32`).

use super::neighbourhood::{MAY_BE_EARLIER, Neighbourhood};
use crate::geometry::{KernelMap, ones};
pub use b2p_kernels::hidden::WIDTH;
use b2p_kernels::hidden::{Narrow, Row};
use std::ops::Range;
use std::sync::OnceLock;

/// How many facts there are.
pub const FACTS: usize = PRESENCES + 9 * EARLIER;

/// How many rows there are for children.
pub const NODES: usize = 255;

/// Bytes of `weights.bin`.
pub const SIZE: usize = (FACTS + NODES) * WIDTH + 8 * (2 * WIDTH + 4);

const PRESENCES: usize = 26;
const EARLIER: usize = 19;

static WEIGHTS: &[u8; SIZE] = include_bytes!("weights.bin");

/// For every offset that may come earlier its place among those.
const EARLIER_SLOT: [u8; 27] = {
    let mut slots = [0; 27];
    let (mut k, mut slot) = (0, 0);
    while k < 27 {
        slots[k] = slot;
        slot += (MAY_BE_EARLIER >> k & 1) as u8;
        k += 1;
    }
    slots
};

/// Tells the facts that hold for the voxel `here` of the voxels `slice`, whose 3³ kernel map is `map`, each by the number of its row: `occupancy` is
/// that of the slice, up to `here` at least.
pub fn facts(map: &KernelMap, slice: &Range<usize>, here: usize, occupancy: &[u8], mut tell: impl FnMut(usize)) {
    let around = Neighbourhood::at(map, slice, here);
    for k in ones(around.there & !around.earlier) {
        tell(k - usize::from(k > KernelMap::CENTRE));
    }
    for k in ones(around.earlier) {
        let known = PRESENCES + 9 * usize::from(EARLIER_SLOT[k]);
        tell(known);
        let mask = occupancy[map.row(here)[k] as usize - slice.start];
        ones(mask.into()).for_each(|octant| tell(known + 1 + octant));
    }
}

/// The weights, laid out for use.
#[derive(Debug)]
pub(super) struct Network {
    presence: [Narrow; 27],
    /// For every offset that may come earlier the sums of the rows of any low half of an occupancy and of any high half, the known row split between
    /// them so that they fit…
    halves: Vec<[[Narrow; 16]; 2]>,
    /// …and where they cannot, what is left to be added.
    pub rest: Vec<Rest>,
    nodes: [Narrow; NODES + 1],
    /// What the output layer starts from.
    pub output: [Row; 8],
    pub bias: [i32; 8],
}

/// What is left of the sums of one offset and one half of its occupancy.
#[derive(Debug)]
pub(super) struct Rest {
    /// The offset.
    pub k: usize,
    shift: usize,
    rows: [Narrow; 16],
}

impl Rest {
    /// The row to be added of a neighbour that has these children.
    #[inline(always)]
    pub fn row(&self, mask: u8) -> &Narrow {
        &self.rows[usize::from(mask >> self.shift & 15)]
    }
}

impl Network {
    /// The network of this format.
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
        let (mut halves, mut rest) = (Vec::new(), Vec::new());
        for k in ones(MAY_BE_EARLIER) {
            let known = row();
            let children: [Narrow; 8] = std::array::from_fn(|_| row());
            let parts = split(&known, &children);
            for (half, (_, left)) in parts.iter().enumerate() {
                if *left != [[0; WIDTH]; 16] {
                    let (shift, rows) = (4 * half, *left);
                    rest.push(Rest { k, shift, rows });
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
            rest,
            nodes,
            output,
            bias,
        }
    }

    /// The row of an occupied neighbour at offset `k` whose children are not known.
    #[inline(always)]
    pub fn presence(&self, k: usize) -> &Narrow {
        &self.presence[k]
    }

    /// The rows, to be added, of a neighbour at offset `k`, one that may come earlier, that has these children; what is left is in `rest`.
    #[inline(always)]
    pub fn children(&self, k: usize, mask: u8) -> [&Narrow; 2] {
        let [low, high] = &self.halves[usize::from(EARLIER_SLOT[k])];
        [&low[usize::from(mask & 15)], &high[usize::from(mask >> 4)]]
    }

    /// The row of the child `node` (`1 << octant | occupancy of the octants below it`).
    #[inline(always)]
    pub fn node(&self, node: usize) -> &Narrow {
        &self.nodes[node & 255]
    }
}

/// The sums of any low four and of any high four of the rows `children`, `known` once among them, as near as they fit, and what is left of them.
/// (At most 26 + 19·8 + 1 rows meet, so all sums stay within ±22 733.)
fn split(known: &Narrow, children: &[Narrow; 8]) -> [([Narrow; 16], [Narrow; 16]); 2] {
    let sum = |half: usize, mask: usize, unit: usize| -> i32 {
        ones(mask as u32)
            .map(|octant| i32::from(children[4 * half + octant][unit]))
            .sum()
    };
    // From what to what a half's base may be.
    let range = |half: usize, unit: usize| {
        let sums = (0..16).map(|mask| sum(half, mask, unit));
        let (least, most) = sums.fold((0, 0), |(a, b), sum| (sum.min(a), sum.max(b)));
        (i32::from(i8::MIN) - least, i32::from(i8::MAX) - most)
    };
    let base = |half: usize, unit: usize| {
        let known = i32::from(known[unit]);
        let ((a, b), (c, d)) = (range(0, unit), range(1, unit));
        let low = known.max(a.max(known - d)).min(b.min(known - c));
        if half == 0 { low } else { known - low }
    };
    [0, 1].map(|half| {
        let (mut sums, mut left) = ([[0; WIDTH]; 16], [[0; WIDTH]; 16]);
        for (unit, mask) in (0..WIDTH).flat_map(|unit| (0..16).map(move |mask| (unit, mask))) {
            let exact = base(half, unit) + sum(half, mask, unit);
            let fits = exact.clamp(i8::MIN.into(), i8::MAX.into());
            sums[mask][unit] = fits as i8;
            left[mask][unit] = i8::try_from(exact - fits).expect("what is left fits");
        }
        (sums, left)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rows_of_an_occupancy_are_those_of_its_children() {
        let network = Network::get();
        for (slot, k) in ones(MAY_BE_EARLIER).enumerate() {
            for mask in 0..=255u8 {
                for unit in 0..WIDTH {
                    let at = |row: usize| i32::from(WEIGHTS[(PRESENCES + 9 * slot + row) * WIDTH + unit] as i8);
                    let expected = at(0) + ones(mask.into()).map(|octant| at(1 + octant)).sum::<i32>();
                    let mut sum: i32 = network.children(k, mask).map(|row| row[unit].into()).iter().sum();
                    for rest in network.rest.iter().filter(|rest| rest.k == k) {
                        sum += i32::from(rest.row(mask)[unit]);
                    }
                    assert_eq!(sum, expected);
                }
            }
        }
    }
}
