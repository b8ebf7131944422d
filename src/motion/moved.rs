//! The moved previous frame (`docs/format.md`, clause 17.8).

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::previous::PreviousLevel;
use crate::colour::Ycc;
use crate::error::{Error, Result, Stage};
use crate::geometry::{Voxels, morton};

/// How many levels a reference level may be below the blocks.
pub const REACH: u8 = 5;

/// The clause of more voxels than a moved frame may have.
pub const TOO_MANY: &str = "17.8.2";

/// Levels of the moved previous frame that are coarser than the reference level.
#[derive(Debug, Clone)]
pub(super) struct Moved {
    /// The first of them.
    first: u8,
    levels: Vec<PreviousLevel>,
}

impl Moved {
    /// Moves the voxels of `previous`, of level `reference`, into the blocks `keys` of level `block`, each by its shift,
    /// and averages them up to the level after `block`: colours of children count alike. If `coarse`, up to level 1, and
    /// all voxels of level `reference` count alike.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the blocks take more than twice the previous frame's voxels.
    pub fn new(
        previous: &PreviousLevel,
        [block, reference]: [u8; 2],
        keys: &[u64],
        shift: impl Fn(usize) -> [i32; 3] + Sync,
        coarse: bool,
    ) -> Result<Self> {
        assert!(reference > block, "moved voxels are averaged");
        let side = 1i32 << (reference - block);
        let most = 2 * previous.values.len() + 64;
        let count = AtomicUsize::new(0);
        let down = u32::from(reference - block - 1);
        // Sums of the block's nodes of the level above, by Morton key.
        let nodes = || vec![Sum::default(); 1 << (3 * down)];
        let parents_of = |nodes: &mut Vec<Sum>, (i, key): (usize, &u64)| {
            // No more is kept than may be.
            if count.load(Ordering::Relaxed) > most {
                return Vec::new();
            }
            let corner = corner(*key, side, shift(i));
            let mut found = 0;
            previous.in_box(corner, side, |from, index| {
                let at = [0, 1, 2].map(|axis| (from[axis] - corner[axis]) as u32 >> 1);
                nodes[morton::encode(at) as usize].add(Sum::of(previous.values[index]));
                found += 1;
            });
            count.fetch_add(found, Ordering::Relaxed);
            let keys = (*key << (3 * down)..).zip(nodes);
            let there = keys.filter(|(_, sum)| sum.count > 0);
            there.map(|(key, sum)| (key, std::mem::take(sum))).collect()
        };
        let parts: Vec<Vec<_>> = keys.par_iter().enumerate().map_init(nodes, parents_of).collect();
        if count.into_inner() > most {
            return Err(Error::malformed(
                Stage::Bitstream,
                "motion of the frame",
                "voxels of the moved previous frame",
                "more",
                format!("at most {most}"),
            )
            .breaks(TOO_MANY));
        }
        // Blocks are in the order of keys, and each has keys of its own.
        let mut sums = parts.concat();
        let first = if coarse { 1 } else { block + 1 };
        let mut levels = Vec::new();
        for level in (first..reference).rev() {
            let keys = sums.iter().map(|sum| sum.0).collect();
            let values = sums.iter().map(|sum| sum.1.mean()).collect();
            levels.push(PreviousLevel::new(&Voxels::from_sorted(level, keys), values));
            if !coarse {
                sums.iter_mut().for_each(|(_, sum)| *sum = Sum::of(sum.mean()));
            }
            sums = parents(&sums);
        }
        levels.reverse();
        Ok(Moved { first, levels })
    }

    /// The same without the levels after the first.
    pub fn coarsest(mut self) -> Self {
        self.levels.truncate(1);
        self
    }

    /// A level. `None` if it was not made.
    pub fn level(&self, level: u8) -> Option<&PreviousLevel> {
        self.levels.get(usize::from(level.checked_sub(self.first)?))
    }
}

/// Where the first voxel of a block of `side` voxels was.
fn corner(key: u64, side: i32, shift: [i32; 3]) -> [i32; 3] {
    let at = morton::decode(key);
    [0, 1, 2].map(|axis| at[axis] as i32 * side - shift[axis])
}

/// Colours of voxels, summed.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    colours: [i64; 3],
    count: i64,
}

impl Sum {
    fn of(colour: Ycc) -> Self {
        Sum {
            colours: colour.map(i64::from),
            count: 1,
        }
    }

    fn add(&mut self, other: Sum) {
        (0..3).for_each(|t| self.colours[t] += other.colours[t]);
        self.count += other.count;
    }

    /// The mean, rounded to the nearest, halves up.
    fn mean(&self) -> Ycc {
        self.colours
            .map(|sum| (2 * sum + self.count).div_euclid(2 * self.count) as i16)
    }
}

/// The parents of nodes, each with the sum of its children.
fn parents(nodes: &[(u64, Sum)]) -> Vec<(u64, Sum)> {
    let sum = |children: &[(u64, Sum)]| {
        let mut total = Sum::default();
        children.iter().for_each(|child| total.add(child.1));
        (children[0].0 >> 3, total)
    };
    nodes.chunk_by(|a, b| a.0 >> 3 == b.0 >> 3).map(sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn level(depth: u8, keys: Vec<u64>) -> (PreviousLevel, Vec<(u64, Ycc)>) {
        let voxels = Voxels::new(depth, keys);
        let values: Vec<Ycc> = (0..voxels.len() as i16).map(|i| [i * 7 % 100, -i, i]).collect();
        let all = voxels.keys().iter().copied().zip(values.iter().copied()).collect();
        (PreviousLevel::new(&voxels, values), all)
    }

    proptest! {
        #[test]
        fn voxels_move_with_the_blocks_that_they_come_to(
            keys in prop::collection::vec(0u64..1 << 12, 1..200),
            shift in prop::array::uniform3(-9i32..10),
        ) {
            let (previous, voxels) = level(4, keys);
            // The blocks of the lower half along z stay, the others move.
            let blocks: Vec<u64> = (0..64).collect();
            let shift_of = |block: u64| if morton::decode(block)[2] < 2 { [0; 3] } else { shift };
            let moved = Moved::new(&previous, [2, 4], &blocks, |i| shift_of(blocks[i]), false).unwrap();
            let mut expected = BTreeMap::<u64, Vec<Ycc>>::new();
            for block in &blocks {
                for &(key, colour) in &voxels {
                    let (at, shift) = (morton::decode(key), shift_of(*block));
                    let at = [0, 1, 2].map(|axis| at[axis] as i32 + shift[axis]);
                    if at.iter().all(|x| (0..16).contains(x)) {
                        let key = morton::encode(at.map(|x| x as u32));
                        if key >> 6 == *block {
                            expected.entry(key >> 3).or_default().push(colour);
                        }
                    }
                }
            }
            let found = moved.level(3).unwrap();
            prop_assert!(moved.level(2).is_none() && moved.level(4).is_none());
            prop_assert_eq!(found.values.len(), expected.len());
            for (key, colours) in expected {
                let at = morton::decode(key).map(|x| x as i32);
                let mean = [0, 1, 2].map(|t| {
                    let sum: f64 = colours.iter().map(|colour| f64::from(colour[t])).sum();
                    (sum / colours.len() as f64 + 0.5).floor() as i16
                });
                prop_assert_eq!(found.index(at).map(|index| found.values[index]), Some(mean));
            }
        }
    }

    #[test]
    fn every_voxel_counts_alike_in_the_means_of_coarse_levels() {
        // One voxel alone in a node of level 3, and eight in another; all in one node of level 2.
        let keys: Vec<u64> = std::iter::once(0).chain(8..16).collect();
        let previous = PreviousLevel::new(
            &Voxels::new(4, keys),
            std::iter::once([900, 9, 0]).chain([[0; 3]; 8]).collect(),
        );
        let moved = |coarse| Moved::new(&previous, [1, 4], &[0], |_| [0; 3], coarse).unwrap();
        let colour = |moved: &Moved, level| Some(moved.level(level)?.values[0]);
        let [alike, coarse] = [false, true].map(moved);
        assert_eq!(colour(&alike, 2), Some([450, 5, 0]));
        assert_eq!(colour(&coarse, 2), Some([100, 1, 0]));
        assert_eq!(colour(&coarse, 3), Some([900, 9, 0]));
        assert_eq!(colour(&coarse, 1), Some([100, 1, 0]));
        assert!(colour(&alike, 1).is_none() && colour(&coarse, 0).is_none());
    }

    #[test]
    fn blocks_that_all_come_from_one_crowded_place_are_refused() {
        let (previous, _) = level(4, (0..64).collect());
        let blocks: Vec<u64> = (0..64).collect();
        let from_the_corner = |i: usize| morton::decode(blocks[i]).map(|x| 4 * x as i32);
        let refused =
            Moved::new(&previous, [2, 4], &blocks, from_the_corner, false).expect_err("64 times as many voxels");
        assert_eq!(refused.clause(), Some(TOO_MANY));
    }
}
