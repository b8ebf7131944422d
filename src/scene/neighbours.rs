//! The voxels around a block, and which of its voxels lie in a box.

use std::ops::Range;

use crate::container::scene::Cube;
use crate::geometry::morton;

/// Voxels of a level from `low` to `high` on each axis, both included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounds {
    pub low: [u32; 3],
    pub high: [u32; 3],
}

impl Bounds {
    /// The voxels of `level` in a cube; if the cube is smaller than a voxel, the one that it lies in.
    pub fn of(cube: Cube, level: u8) -> Self {
        let at = morton::decode(cube.key);
        match level.checked_sub(cube.level) {
            Some(below) => Bounds {
                low: at.map(|x| x << below),
                high: at.map(|x| (x << below) + ((1u32 << below) - 1)),
            },
            None => {
                let at = at.map(|x| x >> (cube.level - level));
                Bounds { low: at, high: at }
            }
        }
    }

    /// The voxels of `level`, 1 or more, that drawing a cube may depend on: all children of the voxels of the level
    /// above that are at most `reach` away.
    pub fn around(cube: Cube, level: u8, reach: u32) -> Self {
        let Some(above) = level.checked_sub(1) else {
            return Bounds::of(cube, level);
        };
        let Bounds { low, high } = Bounds::of(cube, above);
        let last = (1u32 << above) - 1;
        Bounds {
            low: low.map(|x| 2 * x.saturating_sub(reach)),
            high: high.map(|x| 2 * x.saturating_add(reach).min(last) + 1),
        }
    }

    /// Whether the two have a voxel in common.
    pub fn meets(&self, other: &Bounds) -> bool {
        (0..3).all(|axis| self.low[axis] <= other.high[axis] && other.low[axis] <= self.high[axis])
    }

    /// Whether all of the other are among these.
    fn holds(&self, other: &Bounds) -> bool {
        (0..3).all(|axis| self.low[axis] <= other.low[axis] && other.high[axis] <= self.high[axis])
    }

    /// Whether a voxel is among these.
    pub fn has(&self, at: [u32; 3]) -> bool {
        self.holds(&Bounds { low: at, high: at })
    }

    /// Those of voxels in Morton order that are among these: ranges of their indices, ascending. `keys` are keys of
    /// `level` that lie in `cube`.
    pub fn ranges(&self, keys: &[u64], cube: Cube, level: u8) -> Vec<Range<usize>> {
        let mut ranges = Vec::new();
        if cube.level <= level {
            self.add_ranges(keys, 0, cube, level, &mut ranges);
        }
        ranges
    }

    fn add_ranges(&self, keys: &[u64], first: usize, cube: Cube, level: u8, ranges: &mut Vec<Range<usize>>) {
        let own = Bounds::of(cube, level);
        if keys.is_empty() || !self.meets(&own) {
            return;
        }
        if self.holds(&own) {
            match ranges.last_mut() {
                Some(last) if last.end == first => last.end += keys.len(),
                _ => ranges.push(first..first + keys.len()),
            }
            return;
        }
        let (mut rest, mut first) = (keys, first);
        for octant in 0..8 {
            let child = Cube {
                level: cube.level + 1,
                key: cube.key << 3 | octant,
            };
            let end = child.keys(level).end;
            let (inside, after) = rest.split_at(rest.partition_point(|key| *key < end));
            self.add_ranges(inside, first, child, level, ranges);
            first += inside.len();
            rest = after;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn ranges_are_the_voxels_in_the_box(
            keys in prop::collection::btree_set(0u64..1 << 12, 1..300),
            low in prop::array::uniform3(0u32..16),
            size in prop::array::uniform3(0u32..9),
        ) {
            let keys: Vec<u64> = keys.into_iter().collect();
            let bounds = Bounds { low, high: [0, 1, 2].map(|axis| low[axis] + size[axis]) };
            let ranges = bounds.ranges(&keys, Cube { level: 0, key: 0 }, 4);
            prop_assert!(ranges.windows(2).all(|pair| pair[0].end < pair[1].start));
            let found: Vec<usize> = ranges.into_iter().flatten().collect();
            let is_inside = |key: u64| {
                let at = morton::decode(key);
                (0..3).all(|axis| (bounds.low[axis]..=bounds.high[axis]).contains(&at[axis]))
            };
            let expected: Vec<usize> = (0..keys.len()).filter(|i| is_inside(keys[*i])).collect();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn what_a_cube_depends_on_has_all_children_of_its_parents() {
        let cube = Cube {
            level: 2,
            key: morton::encode([1, 2, 3]),
        };
        let around = Bounds::around(cube, 5, 3);
        // At level 4 the cube has the voxels 4..8, 8..12 and 12..16, the last of that level.
        assert_eq!(
            around,
            Bounds {
                low: [2, 10, 18],
                high: [21, 29, 31]
            }
        );
        let voxel = Cube {
            level: 5,
            key: morton::encode([9, 9, 31]),
        };
        assert_eq!(
            Bounds::around(voxel, 5, 1),
            Bounds {
                low: [6, 6, 28],
                high: [11, 11, 31]
            }
        );
    }
}
