//! Where a cloud is cut into blocks.

use crate::container::scene::Cube;

/// Voxels of a block at most, by default: of blocks of a surface the mean is about 2²⁰.
pub const BLOCK_VOXELS: usize = 1 << 21;
/// Voxels up to which a cloud is better coded in one piece: two blocks. Cut in small blocks it takes about 5 % more bits.
pub const ONE_PIECE: usize = 2 * BLOCK_VOXELS;

/// Cuts voxels in Morton order into the largest cubes with at most so many voxels. Only the deepest cubes may have
/// more.
#[derive(Debug, Clone)]
pub struct Cutter {
    /// N.
    depth: u8,
    /// The deepest level whose voxels may be blocks.
    deepest: u8,
    most: usize,
    /// The first key that no block has yet.
    next: u64,
}

impl Cutter {
    /// A cutter of voxels of level `depth` into cubes of levels 0 to `deepest`, with at most `most` voxels, 1 or more.
    pub fn new(depth: u8, deepest: u8, most: usize) -> Self {
        Cutter {
            depth,
            deepest: deepest.min(depth),
            most: most.max(1),
            next: 0,
        }
    }

    /// The next block: its cube and how many of the voxels `keys`, which are those after the last block, it has. `None`
    /// if more voxels must be known: `all` tells that no more follow. With [`Cutter::lookahead`] voxels there is one,
    /// unless only a deepest cube has more.
    pub fn next(&mut self, keys: &[u64], all: bool) -> Option<(Cube, usize)> {
        let first = *keys.first()?;
        for level in 0..=self.deepest {
            let below = 3 * (self.depth - level);
            let cube = Cube {
                level,
                key: first >> below,
            };
            let own = cube.keys(self.depth);
            if own.start < self.next {
                continue;
            }
            let count = keys.partition_point(|key| *key < own.end);
            let known = all || count < keys.len();
            if known && (count <= self.most || level == self.deepest) {
                self.next = own.end;
                return Some((cube, count));
            }
            if !known && count <= self.most {
                // It may be a block, or not.
                return None;
            }
        }
        None
    }

    /// Voxels that decide on the next block.
    pub fn lookahead(&self) -> usize {
        self.most + 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The cubes by definition: a cube that has too many voxels is cut in eight.
    fn by_definition(keys: &[u64], cube: Cube, depth: u8, deepest: u8, most: usize, blocks: &mut Vec<(Cube, usize)>) {
        let own = cube.keys(depth);
        let count = keys.iter().filter(|key| own.contains(key)).count();
        match count {
            0 => {}
            _ if count <= most || cube.level == deepest => blocks.push((cube, count)),
            _ => {
                for octant in 0..8 {
                    let (level, key) = (cube.level + 1, cube.key << 3 | octant);
                    by_definition(keys, Cube { level, key }, depth, deepest, most, blocks);
                }
            }
        }
    }

    proptest! {
        #[test]
        fn blocks_are_the_largest_cubes_with_few_enough_voxels(
            keys in prop::collection::btree_set(0u64..1 << 15, 1..400),
            most in 1usize..60,
            deepest in 0u8..6,
            more in 0usize..50,
        ) {
            let keys: Vec<u64> = keys.into_iter().collect();
            let mut expected = Vec::new();
            by_definition(&keys, Cube { level: 0, key: 0 }, 5, deepest, most, &mut expected);
            let mut cutter = Cutter::new(5, deepest, most);
            let (mut found, mut at, mut known) = (Vec::new(), 0, 0);
            while at < keys.len() {
                known = keys.len().min(known.max(at + cutter.lookahead() + more));
                match cutter.next(&keys[at..known], known == keys.len()) {
                    Some((cube, count)) => {
                        found.push((cube, count));
                        at += count;
                    }
                    None => {
                        prop_assert!(known < keys.len(), "all are known");
                        known += 1;
                    }
                }
            }
            prop_assert_eq!(found, expected);
        }
    }
}
