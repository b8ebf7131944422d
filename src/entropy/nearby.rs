//! Which voxels of a slice lie near each other, one or two away along any of the axes.

use std::sync::LazyLock;

use crate::geometry::morton;

/// The voxels of a slice, by their parents.
#[derive(Debug)]
pub(super) struct Nearby {
    parents: Vec<Parent>,
    /// Each voxel's octant, and the number of its parent.
    voxels: Vec<(u8, u32)>,
}

#[derive(Debug)]
struct Parent {
    /// The number of its first voxel.
    first: u32,
    /// Which of its octants are voxels of the slice.
    mask: u8,
    /// The numbers of the parents around it, in the order of a 3³ kernel, or [`ABSENT`].
    around: [u32; 27],
}

const ABSENT: u32 = u32::MAX;
/// The place of a parent itself in a 3³ kernel.
const CENTRE: usize = 13;

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

/// Where a near voxel may lie, seen from one of an octant.
#[derive(Debug, Clone, Copy)]
struct Place {
    /// Which of the parents around.
    tap: usize,
    octant: u8,
    two: bool,
    axes: u32,
}

/// For every octant the places of voxels that come before: one away, those of lower octants; two away, those of the same one, of which the ones
/// with parents that come before.
static PLACES: LazyLock<[Vec<Place>; 8]> = LazyLock::new(|| std::array::from_fn(places));

fn places(octant: usize) -> Vec<Place> {
    let mut places = Vec::new();
    for tap in (0..27).filter(|&tap| tap != CENTRE) {
        let steps = [tap % 3, tap / 3 % 3, tap / 9].map(|step| step as i32 - 1);
        let axes = steps.iter().filter(|&&step| step != 0).count() as u32;
        let (mut parent, mut other) = (CENTRE as i32, 0);
        for (axis, step) in steps.into_iter().enumerate() {
            let at = (octant >> axis & 1) as i32 + step;
            parent += at.div_euclid(2) * 3i32.pow(axis as u32);
            other |= at.rem_euclid(2) << axis;
        }
        if other < octant as i32 {
            places.push(Place {
                tap: parent as usize,
                octant: other as u8,
                two: false,
                axes,
            });
        }
        places.push(Place {
            tap,
            octant: octant as u8,
            two: true,
            axes,
        });
    }
    places
}

impl Nearby {
    /// Of voxels with these Morton keys, ascending.
    pub fn new(keys: &[u64]) -> Self {
        let (mut above, mut parents, mut voxels) = (Vec::new(), Vec::<Parent>::new(), Vec::new());
        for (v, key) in keys.iter().enumerate() {
            if above.last() != Some(&(key >> 3)) {
                above.push(key >> 3);
                parents.push(Parent {
                    first: v as u32,
                    mask: 0,
                    around: [ABSENT; 27],
                });
            }
            let octant = (key & 7) as u8;
            voxels.push((octant, parents.len() as u32 - 1));
            let parent = parents.last_mut().expect("there is one by now");
            parent.mask |= 1 << octant;
        }
        for p in 0..above.len() {
            let here = morton::decode(above[p]);
            parents[p].around[CENTRE] = p as u32;
            // What lies on one side of this one has it on its other side.
            for tap in CENTRE + 1..27 {
                let steps = [tap % 3, tap / 3 % 3, tap / 9];
                let there: [u32; 3] =
                    std::array::from_fn(|a| (here[a] + steps[a] as u32).wrapping_sub(1));
                // Parents lie one level above the finest that there is.
                let inside = there.iter().all(|&x| x >> (morton::MAX_DEPTH - 1) == 0);
                if inside && let Some(q) = find(&above, p, morton::encode(there)) {
                    parents[p].around[tap] = q as u32;
                    parents[q].around[26 - tap] = p as u32;
                }
            }
        }
        Nearby { parents, voxels }
    }

    /// The voxels near one that come before it, octant by octant, and in Morton order within an octant.
    pub fn before(&self, voxel: usize) -> impl Iterator<Item = Near> {
        let (octant, own) = self.voxels[voxel];
        let around = &self.parents[own as usize].around;
        PLACES[usize::from(octant)].iter().filter_map(move |place| {
            let q = around[place.tap];
            if q == ABSENT || place.two && q > own {
                return None;
            }
            let parent = &self.parents[q as usize];
            let below = (1u8 << place.octant) - 1;
            (parent.mask >> place.octant & 1 == 1).then(|| Near {
                voxel: (parent.first + (parent.mask & below).count_ones()) as usize,
                two: place.two,
                axes: place.axes,
            })
        })
    }
}

/// Where a key is among ascending ones, most likely not far from `from`.
fn find(keys: &[u64], from: usize, key: u64) -> Option<usize> {
    let mut step = 1;
    let among = if key > keys[from] {
        while keys.get(from + step).is_some_and(|&k| k < key) {
            step *= 2;
        }
        from + step / 2..keys.len().min(from + step + 1)
    } else {
        while step <= from && keys[from - step] > key {
            step *= 2;
        }
        from.saturating_sub(step)..from
    };
    let start = among.start;
    let found = keys[among].binary_search(&key).ok();
    found.map(|i| start + i)
}

#[cfg(test)]
mod tests {
    use super::*;
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
            let mut found: Vec<Near> = nearby.before(voxel).collect();
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
        let mut keys: Vec<u64> = [
            [0, 0, 0],
            [last, 0, 0],
            [0, last, 1],
            [1, 2, last],
            [last; 3],
        ]
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
