//! What is known around a child when its occupancy is coded.

use std::sync::LazyLock;

use super::mixer::MODELS;
use crate::geometry::KernelMap;

/// Cells `x + 4y + 16z` of the 4³ cells around a parent's children that each neighbour's octants fill: `[neighbour][mask]`.
static CELLS: LazyLock<Vec<[u64; 256]>> = LazyLock::new(|| {
    (0..27usize)
        .map(|k| {
            std::array::from_fn(|mask| {
                let mut cells = 0;
                for octant in 0..8usize {
                    let place = |axis: u32| 2 * (k / 3usize.pow(axis) % 3) + (octant >> axis & 1);
                    let [x, y, z] = [0, 1, 2].map(place);
                    let inside = [x, y, z].iter().all(|v| (1..=4).contains(v));
                    if mask >> octant & 1 == 1 && inside {
                        cells |= 1 << (x - 1 + 4 * (y - 1) + 16 * (z - 1));
                    }
                }
                cells
            })
        })
        .collect()
});

/// What surrounds one parent.
pub(super) struct Window {
    /// Which of the 27 voxels around the parent, itself included, are occupied.
    parents: u32,
    /// Which of the 4³ cells around its children are known to be occupied.
    occupied: u64,
    /// Which of them are known to be one or the other.
    known: u64,
}

impl Window {
    /// `done` are the masks of the slice's voxels so far, the first of them being voxel `first`.
    pub fn around(row: &[u32], first: usize, done: &[u8]) -> Window {
        let cells = &*CELLS;
        let mut window = Window {
            parents: 0,
            occupied: 0,
            known: 0,
        };
        for (k, &voxel) in row.iter().enumerate() {
            if voxel == KernelMap::ABSENT {
                window.known |= cells[k][255];
                continue;
            }
            window.parents |= 1 << k;
            if let Some(&mask) = (voxel as usize)
                .checked_sub(first)
                .and_then(|i| done.get(i))
            {
                window.known |= cells[k][255];
                window.occupied |= cells[k][usize::from(mask)];
            }
        }
        window
    }
}

/// The contexts of one child.
pub(super) struct Contexts {
    /// One counter per model.
    pub slots: [usize; MODELS],
    /// The set of mixing weights.
    pub set: usize,
}

const SIZES: [usize; MODELS] = [
    1 << 11,
    1 << 14,
    1 << 13,
    1 << 12,
    1 << 13,
    1 << 16,
    1 << 16,
];

const STARTS: [usize; MODELS] = {
    let mut starts = [0; MODELS];
    let mut m = 1;
    while m < MODELS {
        starts[m] = starts[m - 1] + SIZES[m - 1];
        m += 1;
    }
    starts
};

impl Contexts {
    /// Counters in all.
    pub const COUNT: usize = STARTS[MODELS - 1] + SIZES[MODELS - 1];
    /// Sets of weights.
    pub const SETS: usize = 8 * 8;

    /// Those of the child in `octant`, after the children `mask` of the octants before it.
    #[inline]
    pub fn of(window: &Window, octant: usize, mask: u8) -> Contexts {
        let siblings = u64::from(mask);
        // The parent's own children so far, at the window's middle.
        let own = (siblings & 3) << 21
            | (siblings >> 2 & 3) << 25
            | (siblings >> 4 & 3) << 37
            | (siblings >> 6 & 3) << 41;
        let own_known = u64::from((1u32 << octant) - 1);
        let own_known = (own_known & 3) << 21
            | (own_known >> 2 & 3) << 25
            | (own_known >> 4 & 3) << 37
            | (own_known >> 6 & 3) << 41;
        let [ox, oy, oz] = [octant & 1, octant >> 1 & 1, octant >> 2 & 1];
        let base = ox + 4 * oy + 16 * oz;
        let occupied = cube(window.occupied | own, base);
        let known = cube(window.known | own_known, base);
        let parents = window.parents;

        // Steps along each axis away from the parent's centre, as distances in a 3³ mask.
        let out = [
            if ox == 1 { 1 } else { -1 },
            if oy == 1 { 3 } else { -3 },
            if oz == 1 { 9 } else { -9 },
        ];
        let at = |mask: u32, step: i32| (mask >> (13 + step) & 1) as usize;
        // 0 known empty, 1 known occupied, 2 not known.
        let state = |step: i32| {
            if at(known, step) == 1 {
                at(occupied, step)
            } else {
                2
            }
        };
        let [x, y, z] = out;
        let outward = state(x) + 3 * state(y) + 9 * state(z);
        let inward = at(occupied, -x) | at(occupied, -y) << 1 | at(occupied, -z) << 2;
        let edges = state(x + y) + 3 * state(x + z) + 9 * state(y + z);
        let touching = at(parents, x)
            | at(parents, y) << 1
            | at(parents, z) << 2
            | at(parents, x + y) << 3
            | at(parents, x + z) << 4
            | at(parents, y + z) << 5
            | at(parents, x + y + z) << 6;
        let opposite = at(parents, -x) | at(parents, -y) << 1 | at(parents, -z) << 2;
        let faces = (parents >> 4 & 1
            | parents >> 9 & 2
            | parents >> 10 & 4
            | parents >> 11 & 8
            | parents >> 12 & 16
            | parents >> 17 & 32) as usize;
        let node = 1 << octant | usize::from(mask);
        let around = (occupied & !(1 << 13)).count_ones() as usize;
        let unknown = (!known & 0x7ff_ffff & !(1 << 13)).count_ones() as usize;

        let slots = [
            octant * 216 + outward * 8 + inward,
            node * 64 + faces,
            (octant * 32 + around) * 32 + unknown,
            touching * 27 + edges,
            (touching * 8 + opposite) * 8 + octant,
            hash(u64::from(parents) << 3 | octant as u64, 16),
            hash(
                u64::from(occupied) << 3 | octant as u64 | u64::from(known & 0x10_5410) << 32,
                16,
            ),
        ];
        Contexts {
            slots: std::array::from_fn(|m| STARTS[m] + slots[m]),
            set: octant * 8 + (touching & 7),
        }
    }
}

/// The 27 cells from `base` on as bits x + 3y + 9z.
fn cube(cells: u64, base: usize) -> u32 {
    let w = cells >> base;
    let slab = |w: u64| (w & 7 | w >> 1 & 0o70 | w >> 2 & 0o700) as u32;
    slab(w) | slab(w >> 16) << 9 | slab(w >> 32) << 18
}

fn hash(value: u64, bits: u32) -> usize {
    (value.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (64 - bits)) as usize
}
