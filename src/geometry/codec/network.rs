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

use crate::geometry::KernelMap;
use std::ops::Range;
use std::sync::OnceLock;

/// Hidden units.
pub const WIDTH: usize = 128;

/// How many facts there are.
pub const FACTS: usize = PRESENCES + 9 * EARLIER;

/// How many rows there are for children.
pub const NODES: usize = 255;

/// Bytes of `weights.bin`.
pub const SIZE: usize = (FACTS + NODES) * WIDTH + 8 * (2 * WIDTH + 4);

const PRESENCES: usize = 26;
const EARLIER: usize = 19;

/// One number per hidden unit.
pub(super) type Row = [i16; WIDTH];

static WEIGHTS: &[u8; SIZE] = include_bytes!("weights.bin");

/// For every offset its place among those that may come earlier.
const EARLIER_SLOT: [Option<u8>; 27] = {
    let mut slots = [None; 27];
    let (mut k, mut slot) = (0, 0);
    while k < 27 {
        if k % 3 == 0 || k / 3 % 3 == 0 || k < 9 {
            slots[k] = Some(slot);
            slot += 1;
        }
        k += 1;
    }
    slots
};

/// Tells the facts that hold for the voxel `here`, each by the number of its row: its 3³ neighbours are `row`, and `occupancy` is
/// that of the voxels `slice`, up to `here` at least.
pub fn facts(
    row: &[u32],
    slice: &Range<usize>,
    here: usize,
    occupancy: &[u8],
    mut tell: impl FnMut(usize),
) {
    visit(row, slice, here, occupancy, |k, children| match children {
        None => tell(k - usize::from(k > KernelMap::CENTRE)),
        Some((slot, mask)) => {
            let known = PRESENCES + 9 * slot;
            tell(known);
            (0..8)
                .filter(|octant| mask >> octant & 1 == 1)
                .for_each(|octant| tell(known + 1 + octant));
        }
    });
}

/// Visits the occupied neighbours of the voxel `here`: for each its offset and, if its children are known, the offset's place among
/// those that may come earlier, and its occupancy.
#[inline(always)]
pub(super) fn visit(
    row: &[u32],
    slice: &Range<usize>,
    here: usize,
    occupancy: &[u8],
    mut neighbour: impl FnMut(usize, Option<(usize, u8)>),
) {
    // Which are there is a guess for each, so that is told first, without branches.
    let there = |(k, &index)| u32::from(index != KernelMap::ABSENT) << k;
    let mut left: u32 = row.iter().enumerate().map(there).sum();
    left &= !(1 << KernelMap::CENTRE);
    while left != 0 {
        let k = left.trailing_zeros() as usize;
        left &= left - 1;
        let index = row[k] as usize;
        let children = match EARLIER_SLOT[k] {
            Some(slot) if slice.start <= index && index < here => {
                Some((usize::from(slot), occupancy[index - slice.start]))
            }
            _ => None,
        };
        neighbour(k, children);
    }
}

/// The weights, laid out for use.
#[derive(Debug)]
pub(super) struct Network {
    presence: [Row; 27],
    /// For every earlier neighbour the sum of the rows of any low half of its occupancy, the known row among them…
    low: Vec<[Row; 16]>,
    /// …and of any high half.
    high: Vec<[Row; 16]>,
    tree: Vec<Row>,
    /// What the output layer starts from.
    pub output: [Row; 8],
    pub bias: [i32; 8],
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
        let mut row = || -> Row {
            let bytes = bytes(WIDTH);
            std::array::from_fn(|unit| i16::from(bytes[unit] as i8))
        };
        let mut presence = [[0; WIDTH]; 27];
        for k in (0..27).filter(|&k| k != KernelMap::CENTRE) {
            presence[k] = row();
        }
        let (mut low, mut high) = (Vec::new(), Vec::new());
        for _ in 0..EARLIER {
            let known = row();
            let children: [Row; 8] = std::array::from_fn(|_| row());
            low.push(sums(known, &children[..4]));
            high.push(sums([0; WIDTH], &children[4..]));
        }
        let mut tree = vec![[0; WIDTH]];
        tree.extend((0..NODES).map(|_| row()));
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
            low,
            high,
            tree,
            output,
            bias,
        }
    }

    /// Adds to `sum` the rows of the neighbour at offset `k`: of its children, if they are known, by its place among those that may come earlier.
    #[inline(always)]
    pub fn add(&self, sum: &mut Row, k: usize, children: Option<(usize, u8)>) {
        match children {
            None => add(sum, &self.presence[k]),
            Some((slot, mask)) => {
                add(sum, &self.low[slot][usize::from(mask & 15)]);
                add(sum, &self.high[slot][usize::from(mask >> 4)]);
            }
        }
    }

    /// The hidden layer for the child `node` (`1 << octant | occupancy of the octants below it`): of the sum of all rows what is
    /// positive.
    #[inline(always)]
    pub fn hidden(&self, facts: &Row, node: usize) -> Row {
        let tree = &self.tree[node];
        std::array::from_fn(|unit| facts[unit].wrapping_add(tree[unit]).max(0))
    }
}

/// At most 26 + 19·8 + 1 rows of `i8` meet, so a sum stays within ±22 733.
#[inline(always)]
fn add(sum: &mut Row, row: &Row) {
    for (sum, weight) in sum.iter_mut().zip(row) {
        *sum = sum.wrapping_add(*weight);
    }
}

/// `base` plus any subset of four rows.
fn sums(base: Row, rows: &[Row]) -> [Row; 16] {
    std::array::from_fn(|mask| {
        let mut sum = base;
        for (bit, row) in rows.iter().enumerate() {
            if mask >> bit & 1 == 1 {
                add(&mut sum, row);
            }
        }
        sum
    })
}
