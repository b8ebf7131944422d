//! Which voxels of a slice lie near each other, one or two away along any of the axes.

use crate::geometry::ones;

/// The voxels of a slice, by their parents.
#[derive(Debug)]
pub(super) struct Nearby {
    parents: Vec<Parent>,
    around: Vec<Around>,
    /// Each voxel's octant, and the number of its parent.
    voxels: Vec<(u8, u32)>,
}

#[derive(Debug, Clone, Copy)]
struct Parent {
    /// The number of its first voxel.
    first: u32,
    /// Which of its octants are voxels of the slice.
    mask: u8,
}

/// What lies around a parent, in the order of a 3³ kernel.
#[derive(Debug)]
struct Around {
    /// Where there are parents, itself among them; and where those that come before it.
    present: u32,
    earlier: u32,
    numbers: [u32; 27],
}

/// The place of a parent itself in a 3³ kernel.
const CENTRE: usize = 13;
/// Every third bit of a key belongs to an axis, those of x from the lowest on.
const X: u64 = 0x1249_2492_4924_9249;

/// A voxel near another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Near {
    /// Its number in the slice.
    pub voxel: usize,
    /// Whether it is two away, along each of the axes along which it differs.
    pub two: bool,
    /// Along how many axes it differs.
    pub axes: u32,
}

/// For an octant, and a place around its parent, the lower octants there that are one away.
static ONE_AWAY: [[u8; 27]; 8] = {
    let mut table = [[0; 27]; 8];
    let mut i = 0;
    while i < 8 * 27 * 8 {
        let (octant, tap, other) = (i / (27 * 8), i / 8 % 27, i % 8);
        let steps = [tap % 3, tap / 3 % 3, tap / 9];
        let mut one = other < octant;
        let mut axis = 0;
        while axis < 3 {
            // Three more than it is away along this axis.
            let away = 2 * steps[axis] + (other >> axis & 1) + 1 - (octant >> axis & 1);
            one = one && 2 <= away && away <= 4;
            axis += 1;
        }
        table[octant][tap] |= (one as u8) << other;
        i += 1;
    }
    table
};

/// For an octant, the places around its parent where there are any.
static WITH_ONE_AWAY: [u32; 8] = {
    let mut table = [0; 8];
    let mut i = 0;
    while i < 8 * 27 {
        table[i / 27] |= ((ONE_AWAY[i / 27][i % 27] != 0) as u32) << (i % 27);
        i += 1;
    }
    table
};

/// Along how many axes a place around a parent differs.
static AXES: [u8; 27] = {
    let mut table = [0; 27];
    let mut tap = 0;
    while tap < 27 {
        table[tap] = (tap % 3 != 1) as u8 + (tap / 3 % 3 != 1) as u8 + (tap / 9 != 1) as u8;
        tap += 1;
    }
    table
};

/// Along how many axes two octants differ, by the bits that do.
static ONES: [u8; 8] = [0, 1, 1, 2, 1, 2, 2, 3];

/// For a mask of octants and an octant, how many lie below it, four bits each.
static BELOW: [u32; 256] = {
    let mut table = [0; 256];
    let mut i = 0;
    while i < 256 * 8 {
        let (mask, octant) = (i / 8, i % 8);
        table[mask] |= (mask & ((1 << octant) - 1)).count_ones() << (4 * octant);
        i += 1;
    }
    table
};

impl Nearby {
    /// Of voxels with these Morton keys, ascending.
    pub fn new(keys: &[u64]) -> Self {
        let families = || keys.chunk_by(|a, b| a >> 3 == b >> 3);
        let count = families().count();
        let (mut above, mut parents) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut around: Vec<Around> = Vec::with_capacity(count);
        let mut voxels = Vec::with_capacity(keys.len());
        for (p, family) in families().enumerate() {
            above.push(family[0] >> 3);
            let first = voxels.len() as u32;
            let octants = family.iter().map(|key| (key & 7) as u8);
            voxels.extend(octants.clone().map(|octant| (octant, p as u32)));
            let mask = octants.fold(0, |mask, octant| mask | 1 << octant);
            parents.push(Parent { first, mask });
            let (present, mut numbers) = (1 << CENTRE, [0; 27]);
            numbers[CENTRE] = p as u32;
            around.push(Around {
                present,
                earlier: 0,
                numbers,
            });
        }
        // Neighbours of neighbours are neighbours: each is looked for where the last one in its place was.
        let mut last = [0; 27];
        for (p, &key) in above.iter().enumerate() {
            let moved = [0, 1, 2].map(|axis| [0, 1, 2].map(|step| moved(key, axis, step)));
            // What lies on one side of this one has it on its other side.
            for tap in CENTRE + 1..27 {
                let there = moved[0][tap % 3] | moved[1][tap / 3 % 3] | moved[2][tap / 9];
                let q = first_from(&above, last[tap], there);
                last[tap] = q;
                if above.get(q) == Some(&there) {
                    for (p, tap, q) in [(p, tap, q), (q, 26 - tap, p)] {
                        around[p].present |= 1 << tap;
                        around[p].earlier |= u32::from(q < p) << tap;
                        around[p].numbers[tap] = q as u32;
                    }
                }
            }
        }
        Nearby {
            parents,
            around,
            voxels,
        }
    }

    /// Visits the voxels near one that come before it, octant by octant, and in Morton order within an octant.
    #[inline]
    pub fn before(&self, voxel: usize, mut visit: impl FnMut(Near)) {
        let (octant, own) = self.voxels[voxel];
        let octant = usize::from(octant);
        let around = &self.around[own as usize];
        for tap in ones(around.present & WITH_ONE_AWAY[octant]) {
            let parent = self.parents[around.numbers[tap] as usize];
            for other in ones(u32::from(ONE_AWAY[octant][tap] & parent.mask)) {
                visit(Near {
                    voxel: parent.child(other),
                    two: false,
                    axes: u32::from(ONES[octant ^ other]),
                });
            }
        }
        for tap in ones(around.earlier) {
            let parent = self.parents[around.numbers[tap] as usize];
            if parent.mask >> octant & 1 == 1 {
                visit(Near {
                    voxel: parent.child(octant),
                    two: true,
                    axes: u32::from(AXES[tap]),
                });
            }
        }
    }
}

impl Parent {
    /// The number of the voxel in an octant, or of the one after it.
    fn child(self, octant: usize) -> usize {
        (self.first + (BELOW[usize::from(self.mask)] >> (4 * octant) & 7)) as usize
    }
}

/// The bits of an axis of a key, one less, as they are, or one more for a step of 0, 1 or 2. Beyond the cube no key is
/// that of a parent.
fn moved(key: u64, axis: u32, step: u32) -> u64 {
    let (bits, one) = (X << axis, 1 << axis);
    match step {
        0 => (key & bits).wrapping_sub(one) & bits,
        1 => key & bits,
        _ => (key | !bits).wrapping_add(one) & bits,
    }
}

/// The first of ascending keys that is no lower than `key`, most likely not far from `from`.
fn first_from(keys: &[u64], from: usize, key: u64) -> usize {
    let mut step = 1;
    let (low, high) = if keys.get(from).is_some_and(|&k| k < key) {
        while keys.get(from + step).is_some_and(|&k| k < key) {
            step *= 2;
        }
        (from + step / 2, keys.len().min(from + step))
    } else {
        while step <= from && keys[from - step] >= key {
            step *= 2;
        }
        (from.saturating_sub(step), from)
    };
    low + keys[low..high].partition_point(|&k| k < key)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::morton;
    use proptest::prelude::*;

    /// By definition: all voxels, one by one.
    fn searched(keys: &[u64], voxel: usize) -> Vec<Near> {
        let at = morton::decode(keys[voxel]).map(i64::from);
        let mut near = Vec::new();
        for (other, &key) in keys.iter().enumerate() {
            let there = morton::decode(key).map(i64::from);
            let away: [i64; 3] = std::array::from_fn(|i| (there[i] - at[i]).abs());
            let axes = away.iter().filter(|&&d| d > 0).count() as u32;
            let before = (key & 7, key) < (keys[voxel] & 7, keys[voxel]);
            for (two, d) in [(false, 1), (true, 2)] {
                if before && away.iter().all(|&a| a == 0 || a == d) {
                    near.push(Near {
                        voxel: other,
                        two,
                        axes,
                    });
                }
            }
        }
        near
    }

    fn check(keys: &[u64]) {
        let nearby = Nearby::new(keys);
        for voxel in 0..keys.len() {
            let mut found = Vec::new();
            nearby.before(voxel, |near| found.push(near));
            found.sort_by_key(|near| near.voxel);
            assert_eq!(found, searched(keys, voxel), "voxel {voxel}");
        }
    }

    proptest! {
        #[test]
        fn voxels_near_by_are_those_that_searching_finds(
            keys in prop::collection::btree_set(0u64..1 << 12, 0..300),
            far in prop::collection::btree_set(0u64..1 << 63, 0..20),
        ) {
            let keys: Vec<u64> = keys.union(&far).copied().collect();
            check(&keys);
        }
    }

    #[test]
    fn nothing_is_near_across_the_edge_of_the_cube() {
        let last = (1 << 21) - 1;
        let mut keys: Vec<u64> = [[0, 0, 0], [last, 0, 0], [0, last, 1], [1, 2, last], [last; 3]]
            .into_iter()
            .map(morton::encode)
            .collect();
        keys.sort_unstable();
        check(&keys);
    }

    #[test]
    fn a_whole_block_has_all_that_come_before() {
        check(&(0..512).collect::<Vec<u64>>());
    }
}
