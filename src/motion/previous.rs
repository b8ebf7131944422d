//! The previous frame as it was decoded.

use super::bricks::{Bricks, Near};
use crate::colour::{Filter, Steps, Ycc};
use crate::error::{Error, Result};
use crate::geometry::{Octree, Voxels};
#[cfg(feature = "encoder")]
use crate::geometry::{morton, ones};
use rayon::prelude::*;

/// The levels of a decoded frame, from level 0 on, that the next frame is predicted from.
#[derive(Debug)]
pub struct Previous {
    levels: Vec<PreviousLevel>,
}

/// A level of a decoded frame.
#[derive(Debug, Clone)]
pub struct PreviousLevel {
    pub(super) bricks: Bricks,
    /// Y, Co and Cg of every voxel before the filter.
    pub values: Vec<Ycc>,
    /// The filter of the level, which the next frame inherits.
    pub filter: Option<Filter>,
    /// The quantisation steps that filter and heads go by, which it inherits, too.
    pub steps: Option<Steps>,
}

/// Y, Co and Cg of a level's voxels, its filter, and the steps that it is drawn with.
pub type Coloured = (Vec<Ycc>, Option<Filter>, Option<Steps>);

impl Previous {
    /// The levels of `octree` with their colours and filters, from level 0 on.
    ///
    /// # Panics
    /// If there are more colours than levels, or other than one per voxel.
    pub fn new(octree: &Octree, colours: Vec<Coloured>) -> Self {
        let level = |(level, (values, filter, steps)): (usize, Coloured)| {
            let voxels = octree.level(level as u8);
            PreviousLevel {
                filter,
                steps,
                ..PreviousLevel::new(voxels, values)
            }
        };
        Previous {
            levels: colours.into_par_iter().enumerate().map(level).collect(),
        }
    }

    /// A frame of its finest level alone.
    #[cfg(feature = "encoder")]
    pub fn of_finest(voxels: Voxels, values: Vec<Ycc>) -> Self {
        let nothing = |level| PreviousLevel::new(&Voxels::from_sorted(level, Vec::new()), Vec::new());
        let mut levels: Vec<_> = (0..voxels.depth()).map(nothing).collect();
        levels.push(PreviousLevel::new(&voxels, values));
        Previous { levels }
    }

    /// A level. `None` if it was not decoded.
    pub fn level(&self, level: u8) -> Option<&PreviousLevel> {
        self.levels.get(usize::from(level))
    }

    /// A level.
    ///
    /// # Errors
    /// [`Error::Usage`] if it was not decoded.
    pub fn at(&self, level: u8) -> Result<&PreviousLevel> {
        self.level(level)
            .ok_or_else(|| Error::Usage(format!("level {level} of the previous frame was not decoded")))
    }

    /// How many voxels the finest level has.
    pub fn voxels(&self) -> usize {
        self.levels.last().map_or(0, |level| level.values.len())
    }

    /// Bytes of memory per voxel at most.
    pub const fn bytes_per_voxel() -> usize {
        Bricks::bytes_per_voxel() + size_of::<Ycc>()
    }
}

impl PreviousLevel {
    pub(super) fn new(voxels: &Voxels, values: Vec<Ycc>) -> Self {
        assert_eq!(voxels.len(), values.len(), "one colour per voxel");
        Self::of_bricks(Bricks::new(voxels), values)
    }

    pub(super) fn of_bricks(bricks: Bricks, values: Vec<Ycc>) -> Self {
        PreviousLevel {
            bricks,
            values,
            filter: None,
            steps: None,
        }
    }

    /// Keys of the nodes of level `block` with voxels; the level itself is `level`, at least two
    /// deeper.
    pub fn nodes(&self, level: u8, block: u8) -> Vec<u64> {
        self.bricks.nodes(3 * u32::from(level.saturating_sub(2 + block)))
    }

    /// Keys of the voxels of the level.
    #[cfg(feature = "encoder")]
    pub fn keys(&self) -> Vec<u64> {
        let keys = |(place, mask, _): ([u32; 3], u64, usize)| {
            let brick = morton::encode(place) << 6;
            ones(mask).map(move |key| brick | key as u64)
        };
        self.bricks.each().flat_map(keys).collect()
    }

    /// Calls `each` with the place and number of all voxels in a box of `side`³ cells from the place `first` on.
    pub fn in_box(&self, first: [i32; 3], side: i32, each: impl FnMut([i32; 3], usize)) {
        self.bricks.in_box(first, side, each);
    }

    /// For queries of which each is near the one before.
    pub fn near(&self) -> Near<'_> {
        self.bricks.near()
    }

    /// The number of the voxel at this place, if there is one.
    pub fn index(&self, at: [i32; 3]) -> Option<usize> {
        self.bricks.index(at)
    }

    /// The 4³ cells from this place on, as a mask by `x + 4y + 16z`.
    pub fn window(&self, at: [i32; 3]) -> u64 {
        self.bricks.window(at)
    }
}
