//! The deepest level of a stream of version 3 that was decoded, as it is drawn.

use std::sync::OnceLock;

use b2p_kernels::Isa;

use crate::colour::{Filter, LevelColours, Steps};
use crate::gaussians::HeadMap;
use crate::gaussians::learned::LevelInput;
use crate::gaussians::surfels::is_for_surfels;
use crate::geometry::{Octree, SiblingMap};

/// The deepest level so far.
#[derive(Debug, Clone)]
pub(super) struct Reached {
    pub level: u8,
    pub octree: Octree,
    /// Its voxels' neighbours.
    pub map: SiblingMap,
    /// Level 0 has none.
    pub above: Option<Above>,
    /// Decoded, before the filter: what the next level is coded from.
    pub coloured: LevelColours,
    pub filter: Option<Filter>,
    /// Quantisation steps that the filter and learned heads go by: those of the frame that the filter is from.
    pub steps: Steps,
    /// Where the encoder advises surfels in place of learned Gaussians.
    pub head_map: Option<HeadMap>,
    /// Filtered, as they are drawn, once they are asked for.
    pub filtered: OnceLock<Vec<[u8; 3]>>,
}

/// The level above.
#[derive(Debug, Clone)]
pub(super) struct Above {
    pub map: SiblingMap,
    /// Before the filter; not known of the last level but one of a trunk.
    pub coloured: Option<LevelColours>,
}

impl Reached {
    /// The colours of the level as they are drawn.
    pub fn colours(&self, isa: Isa) -> &[[u8; 3]] {
        self.filtered.get_or_init(|| match &self.filter {
            None => self.coloured.rgb(),
            Some(filter) => filter.rgb(isa, &self.coloured, &self.map, self.steps),
        })
    }

    /// The size of luma's quantisation step that heads go by, in 255ths.
    pub fn luma_step(&self) -> f32 {
        self.steps.luma_step()
    }

    /// The colours of the level above before its filter: where they are not known, the means of this level's, which
    /// come to the same but for rounding.
    pub fn colours_above(&self, above: &Above) -> Vec<[u8; 3]> {
        match &above.coloured {
            Some(coloured) => coloured.rgb(),
            None => means(&self.octree, self.level, &self.coloured.rgb()),
        }
    }

    /// What learned heads read, for all voxels but those `without` Gaussians.
    pub fn heads_input<'a>(
        &'a self,
        isa: Isa,
        above: &'a Above,
        colours_above: &'a [[u8; 3]],
        without: Option<&'a [bool]>,
    ) -> LevelInput<'a> {
        LevelInput {
            octree: &self.octree,
            level: self.level,
            map: &self.map,
            above: &above.map,
            colours: self.colours(isa),
            colours_above,
            luma_step: self.luma_step(),
            without,
            range: None,
        }
    }

    /// Whether surfels draw all of the level, whatever heads are asked for.
    pub fn is_all_surfels(&self) -> bool {
        self.advises_surfels() || is_for_surfels(&self.map, 0..self.map.len())
    }

    /// Whether the encoder advises surfels for all of the level.
    pub fn advises_surfels(&self) -> bool {
        self.head_map.as_ref().is_some_and(HeadMap::is_all_surfels)
    }

    /// Calls `with` with what learned heads read, of the voxels that they draw; none at level 0, or if surfels draw
    /// all.
    pub fn with_heads_input<T>(&self, isa: Isa, with: impl FnOnce(LevelInput<'_>) -> T) -> Option<T> {
        let above = self.above.as_ref()?;
        if self.is_all_surfels() {
            return None;
        }
        let heads = self.head_map.as_ref();
        let without = heads.and_then(|heads| heads.surfels(&self.octree, self.level));
        let colours_above = self.colours_above(above);
        Some(with(self.heads_input(isa, above, &colours_above, without.as_deref())))
    }
}

/// The mean colours of the children of every voxel above `level`, rounded to the nearest, halves up.
pub(super) fn means(octree: &Octree, level: u8, colours: &[[u8; 3]]) -> Vec<[u8; 3]> {
    let parents = octree.occupancy(level - 1).iter();
    let parents = parents.zip(octree.first_child(level - 1));
    let mean = |(mask, &first): (&u8, &u32)| {
        let (first, count) = (first as usize, mask.count_ones());
        let children = &colours[first..first + count as usize];
        [0, 1, 2].map(|c| {
            let sum: u32 = children.iter().map(|colour| u32::from(colour[c])).sum();
            ((2 * sum + count) / (2 * count)) as u8
        })
    };
    parents.map(mean).collect()
}
