//! The octree of a cloud: its voxels at every level, and the links between levels (`docs/format.md`, clause 2.3).

use super::{KernelMap, SiblingMap, Voxels, morton, neighbours};
use crate::error::{Error, Result, Stage};

/// Maximum number of voxels of a level: indices are `u32`, without [`KernelMap::ABSENT`].
pub const MAX_VOXELS: usize = (u32::MAX - 1) as usize;

/// The voxels of all levels from the root, level 0, to the deepest, with the links from each level to the next.
///
/// The children of a voxel are consecutive in the next level, in the order of their octants. So its links are one byte,
/// the *occupancy* (bit `x + 2y + 4z` is the child in that octant), and the index of its first child.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Octree {
    levels: Vec<Voxels>,
    links: Vec<Links>,
}

/// Links from the voxels of one level to those of the next.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Links {
    occupancy: Vec<u8>,
    first_child: Vec<u32>,
}

impl Octree {
    /// The octree of the root voxel alone.
    pub fn root() -> Self {
        Octree {
            levels: vec![Voxels::from_sorted(0, vec![0])],
            links: Vec::new(),
        }
    }

    /// Builds the octree whose deepest level is `deepest`.
    ///
    /// # Errors
    /// [`Error::Usage`] if there are no voxels or more than [`MAX_VOXELS`].
    pub fn new(deepest: Voxels) -> Result<Self> {
        if deepest.is_empty() {
            return Err(Error::Usage("an octree needs at least one voxel".into()));
        }
        if deepest.len() > MAX_VOXELS {
            return Err(Error::Usage(format!(
                "an octree level holds at most {MAX_VOXELS} voxels, not {}",
                deepest.len()
            )));
        }
        let mut levels = vec![deepest];
        let mut links = Vec::new();
        while let Some(children) = levels.last()
            && children.depth() > 0
        {
            let (parents, link) = gather(children);
            links.push(link);
            levels.push(parents);
        }
        levels.reverse();
        links.reverse();
        Ok(Octree { levels, links })
    }

    /// The deepest level.
    pub fn depth(&self) -> u8 {
        self.links.len() as u8
    }

    /// The voxels of a level.
    ///
    /// # Panics
    /// If the octree is not that deep.
    pub fn level(&self, level: u8) -> &Voxels {
        &self.levels[usize::from(level)]
    }

    /// Occupancy of every voxel of `level`: an 8-bit mask of its children, never 0.
    ///
    /// # Panics
    /// If there is no deeper level.
    pub fn occupancy(&self, level: u8) -> &[u8] {
        &self.links[usize::from(level)].occupancy
    }

    /// Index of the first child of every voxel of `level`, in the next level.
    ///
    /// # Panics
    /// If there is no deeper level.
    pub fn first_child(&self, level: u8) -> &[u32] {
        &self.links[usize::from(level)].first_child
    }

    /// A copy of the octree without the levels below `level`.
    pub fn truncated(&self, level: u8) -> Octree {
        let level = usize::from(level);
        Octree {
            levels: self.levels[..=level].to_vec(),
            links: self.links[..level].to_vec(),
        }
    }

    /// Removes the levels below `level`.
    pub fn truncate(&mut self, level: u8) {
        self.levels.truncate(usize::from(level) + 1);
        self.links.truncate(usize::from(level));
    }

    /// Adds a level. `occupancy` has one mask for every voxel of the deepest level.
    ///
    /// # Errors
    /// [`Error::Malformed`] if the number of occupancies is not the number of voxels, if one of them is zero, if the
    /// level would be deeper than [`morton::MAX_DEPTH`] or have more than [`MAX_VOXELS`] voxels. The octree is then
    /// unchanged.
    pub fn grow(&mut self, occupancy: Vec<u8>) -> Result<()> {
        let parents = &self.levels[self.links.len()];
        let depth = parents.depth() + 1;
        let fault = |field: &str, value: usize, expected: String| {
            Error::malformed(Stage::Geometry, format!("level {depth}"), field, value, expected)
        };
        if depth > morton::MAX_DEPTH {
            return Err(fault(
                "octree level",
                depth.into(),
                format!("at most {}", morton::MAX_DEPTH),
            ));
        }
        if occupancy.len() != parents.len() {
            return Err(fault(
                "number of occupancies",
                occupancy.len(),
                format!("{}, one per parent", parents.len()),
            ));
        }
        if let Some(parent) = occupancy.iter().position(|&mask| mask == 0) {
            return Err(fault(
                "parent without children",
                parent,
                "at least one child of every parent".into(),
            ));
        }
        let count: usize = occupancy.iter().map(|m| m.count_ones() as usize).sum();
        if count > MAX_VOXELS {
            return Err(fault("voxel count", count, format!("at most {MAX_VOXELS}")));
        }
        let mut keys = Vec::with_capacity(count);
        let mut first_child = Vec::with_capacity(occupancy.len());
        for (&parent, &mask) in parents.keys().iter().zip(&occupancy) {
            first_child.push(keys.len() as u32);
            let mut left = mask;
            while left != 0 {
                keys.push(parent << 3 | u64::from(left.trailing_zeros()));
                left &= left - 1;
            }
        }
        self.levels.push(Voxels::from_sorted(depth, keys));
        self.links.push(Links { occupancy, first_child });
        Ok(())
    }

    /// The 3³ kernel map of a level, built from the root down.
    ///
    /// # Panics
    /// If the octree is not that deep.
    pub fn kernel_map(&self, level: u8) -> KernelMap {
        (0..level).fold(KernelMap::root(), |map, above| self.child_map(above, &map))
    }

    /// The 3³ kernel map of level `level + 1`. `map` is that of `level`.
    ///
    /// # Panics
    /// If the octree is not that deep, or `map` is not the 3³ kernel map of `level`.
    pub fn child_map(&self, level: u8, map: &KernelMap) -> KernelMap {
        neighbours::of_children(map, self.occupancy(level), self.first_child(level))
    }

    /// The same map as [`Octree::child_map`], in less memory.
    ///
    /// # Panics
    /// As [`Octree::child_map`].
    pub fn child_siblings(&self, level: u8, map: &SiblingMap) -> SiblingMap {
        SiblingMap::of_children(map, self.occupancy(level), self.first_child(level))
    }

    /// The same map as [`Octree::kernel_map`], in less memory.
    ///
    /// # Panics
    /// As [`Octree::kernel_map`].
    pub fn sibling_map(&self, level: u8) -> SiblingMap {
        (0..level).fold(SiblingMap::root(), |map, above| self.child_siblings(above, &map))
    }

    /// The maps of the level above `level`, unless it is the root, and of `level`.
    ///
    /// # Panics
    /// As [`Octree::kernel_map`].
    pub fn last_sibling_maps(&self, level: u8) -> (Option<SiblingMap>, SiblingMap) {
        let above = level.checked_sub(1).map(|above| self.sibling_map(above));
        match above {
            Some(map) => {
                let children = self.child_siblings(level - 1, &map);
                (Some(map), children)
            }
            None => (None, SiblingMap::root()),
        }
    }
}

/// The parents of a level's voxels, and the links to the voxels.
fn gather(children: &Voxels) -> (Voxels, Links) {
    let mut keys: Vec<u64> = Vec::new();
    let mut links = Links {
        occupancy: Vec::new(),
        first_child: Vec::new(),
    };
    for (index, key) in children.keys().iter().enumerate() {
        if keys.last() != Some(&(key >> 3)) {
            keys.push(key >> 3);
            links.occupancy.push(0);
            links.first_child.push(index as u32);
        }
        if let Some(mask) = links.occupancy.last_mut() {
            *mask |= 1 << (key & 7);
        }
    }
    (Voxels::from_sorted(children.depth() - 1, keys), links)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn growing_from_the_root_rebuilds_every_level(
            keys in prop::collection::vec(0u64..1 << 15, 1..200)
        ) {
            let octree = Octree::new(Voxels::new(5, keys)).unwrap();
            let mut grown = Octree::root();
            for level in 0..octree.depth() {
                prop_assert_eq!(&grown, &octree.truncated(level));
                grown.grow(octree.occupancy(level).to_vec()).unwrap();
            }
            prop_assert_eq!(grown, octree);
        }

        #[test]
        fn every_link_leads_to_a_child(keys in prop::collection::vec(0u64..1 << 12, 1..200)) {
            let octree = Octree::new(Voxels::new(4, keys)).unwrap();
            for level in 0..octree.depth() {
                let (parents, children) = (octree.level(level), octree.level(level + 1));
                prop_assert_eq!(parents, &children.parents());
                for (i, &parent) in parents.keys().iter().enumerate() {
                    let octants = (0..8).filter(|o| octree.occupancy(level)[i] >> o & 1 == 1);
                    let first = octree.first_child(level)[i] as usize;
                    for (octant, &child) in octants.zip(&children.keys()[first..]) {
                        prop_assert_eq!(child, parent << 3 | octant);
                    }
                }
            }
        }
    }

    #[test]
    fn an_empty_octree_is_refused() {
        assert!(matches!(Octree::new(Voxels::new(3, vec![])), Err(Error::Usage(_))));
    }

    #[test]
    fn a_parent_without_children_is_refused() {
        let mut octree = Octree::root();
        octree.grow(vec![0b101]).unwrap();
        let before = octree.clone();
        assert!(matches!(
            octree.grow(vec![1, 0]),
            Err(Error::Malformed {
                stage: Stage::Geometry,
                ..
            })
        ));
        assert!(octree.grow(vec![1]).is_err());
        assert_eq!(octree, before);
    }

    #[test]
    fn levels_deeper_than_morton_keys_are_refused() {
        let mut octree = Octree::root();
        for _ in 0..morton::MAX_DEPTH {
            octree.grow(vec![0x80]).unwrap();
        }
        assert_eq!(octree.level(21).keys(), [(1 << 63) - 1]);
        assert!(octree.grow(vec![1]).is_err());
    }
}
