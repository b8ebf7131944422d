//! The occupied voxels of one octree level (`docs/format.md`, clause 2.3).

#[cfg(feature = "encoder")]
use std::ops::Range;

use super::morton;

/// The occupied voxels of one level, in Morton order.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Voxels {
    depth: u8,
    keys: Vec<u64>,
}

impl Voxels {
    /// Sorts and deduplicates Morton keys of level `depth`.
    ///
    /// # Panics
    /// If a key lies outside the level. Keys from untrusted input must be checked before.
    pub fn new(depth: u8, mut keys: Vec<u64>) -> Self {
        keys.sort_unstable();
        keys.dedup();
        Self::from_sorted(depth, keys)
    }

    /// Voxels from keys that are already strictly ascending.
    ///
    /// # Panics
    /// If the last key lies outside the level, or (debug builds only) the keys are not strictly ascending.
    #[doc(hidden)]
    pub fn from_sorted(depth: u8, keys: Vec<u64>) -> Self {
        assert!(depth <= morton::MAX_DEPTH, "octree level {depth} is deeper than 21");
        assert!(
            keys.last().is_none_or(|&last| last >> (3 * depth) == 0),
            "a key lies outside level {depth}"
        );
        debug_assert!(keys.windows(2).all(|w| w[0] < w[1]));
        Voxels { depth, keys }
    }

    /// Numbers of the voxels in the node `key`, whose level is `shift / 3` above.
    #[cfg(feature = "encoder")]
    pub(crate) fn within(&self, key: u64, shift: u8) -> Range<usize> {
        let first = self.keys.partition_point(|k| k >> shift < key);
        // A node has few of all voxels.
        let inside = self.keys[first..].iter().take_while(|k| *k >> shift == key);
        first..first + inside.count()
    }

    /// The octree level. Coordinates are below `2^depth`.
    pub fn depth(&self) -> u8 {
        self.depth
    }

    /// Morton keys, strictly ascending.
    pub fn keys(&self) -> &[u64] {
        &self.keys
    }

    /// Octant of every voxel in its parent, `x + 2y + 4z`.
    #[doc(hidden)]
    pub fn octants(&self) -> Vec<u8> {
        self.keys.iter().map(|key| (key & 7) as u8).collect()
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Whether there are no voxels.
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Coordinates of voxel `i`.
    #[inline]
    pub fn coordinate(&self, i: usize) -> [u32; 3] {
        morton::decode(self.keys[i])
    }

    /// The occupied voxels one level up. Level 0 has no level above, so `depth` must be at least 1.
    #[doc(hidden)]
    pub fn parents(&self) -> Voxels {
        let mut keys: Vec<u64> = self.keys.iter().map(|k| k >> 3).collect();
        keys.dedup();
        Voxels::from_sorted(self.depth - 1, keys)
    }

    /// Index of every voxel's parent in [`Voxels::parents`].
    #[doc(hidden)]
    pub fn parent_indices(&self) -> Vec<u32> {
        let mut index = 0u32;
        let mut last = self.keys.first().map_or(0, |k| k >> 3);
        self.keys
            .iter()
            .map(|k| {
                if k >> 3 != last {
                    last = k >> 3;
                    index += 1;
                }
                index
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parents_and_indices_agree() {
        let voxels = Voxels::new(2, vec![63, 0, 1, 8, 9, 9]);
        assert_eq!(voxels.keys(), [0, 1, 8, 9, 63]);
        let parents = voxels.parents();
        for (key, &parent) in voxels.keys().iter().zip(&voxels.parent_indices()) {
            assert_eq!(parents.keys()[parent as usize], key >> 3);
        }
    }
}
