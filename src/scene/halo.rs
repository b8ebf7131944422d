//! The voxels around a block that drawing it depends on.

use std::ops::Range;

use rayon::prelude::*;

use super::decoder::Blocks;
use super::neighbours::Bounds;
use crate::container::scene::BlockEntry;
use crate::decoder::LevelVoxels;
use crate::error::Result;
use crate::geometry::{Octree, Voxels};

/// Where the voxels lie that drawing a block depends on: its own and those around.
pub(super) struct Near<'a> {
    level: u8,
    /// Voxels of the blocks that have some, in the order of space.
    parts: Vec<(&'a LevelVoxels, Vec<Range<usize>>)>,
    /// Which of them the block is.
    own: usize,
}

/// A block's voxels among those that drawing it depends on.
pub(super) struct Neighbourhood {
    pub octree: Octree,
    pub colours: Vec<[u8; 3]>,
    pub unfiltered: Vec<[u8; 3]>,
    /// Voxels of the block.
    pub own: Range<usize>,
}

impl<'a> Near<'a> {
    pub fn of(blocks: &[BlockEntry], decoded: &'a Blocks, block: usize, level: u8, reach: u32) -> Self {
        let bounds = Bounds::around(blocks[block].cube, level, reach);
        let (mut parts, mut own) = (Vec::new(), 0);
        for (&other, voxels) in decoded {
            if other == block {
                own = parts.len();
            } else if !bounds.meets(&Bounds::of(blocks[other].cube, level)) {
                continue;
            }
            if let Some(voxels) = voxels {
                parts.push((voxels, bounds.ranges(&voxels.keys, blocks[other].cube, level)));
            }
        }
        Near { level, parts, own }
    }

    /// How many there are.
    pub fn voxels(&self) -> u64 {
        let ranges = self.parts.iter().flat_map(|(_, ranges)| ranges);
        ranges.map(|range| range.len() as u64).sum()
    }

    pub fn collect(self) -> Result<Neighbourhood> {
        let count = self.voxels() as usize;
        let mut keys = Vec::with_capacity(count);
        let (mut colours, mut unfiltered) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut own = 0..0;
        for (i, (voxels, ranges)) in self.parts.into_iter().enumerate() {
            let start = keys.len();
            for range in ranges {
                keys.extend(&voxels.keys[range.clone()]);
                colours.extend(&voxels.colours[range.clone()]);
                unfiltered.extend(&voxels.unfiltered[range]);
            }
            if i == self.own {
                own = start..keys.len();
            }
        }
        Ok(Neighbourhood {
            octree: Octree::new(Voxels::from_sorted(self.level, keys))?,
            colours,
            unfiltered,
            own,
        })
    }
}

/// Some blocks and those that drawing them depends on, ascending.
pub(super) fn around(all: &[BlockEntry], blocks: &[usize], level: u8, reach: u32) -> Vec<usize> {
    if blocks.len() == all.len() {
        return blocks.to_vec();
    }
    let own = blocks
        .iter()
        .map(|&block| Bounds::around(all[block].cube, level, reach));
    let own: Vec<Bounds> = own.collect();
    let is_near = |block: &usize| {
        let bounds = Bounds::of(all[*block].cube, level);
        own.iter().any(|own| own.meets(&bounds))
    };
    (0..all.len()).into_par_iter().filter(is_near).collect()
}
