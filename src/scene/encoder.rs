//! Clouds of any size to scenes.

use std::ops::RangeInclusive;

use rayon::prelude::*;

use super::partition::{BLOCK_VOXELS, Cutter};
use crate::axes::Axes;
use crate::cancel::Cancel;
use crate::cloud::ColouredVoxels;
use crate::container::scene::{BlockEntry, Cube, most_level, write_index};
use crate::container::{Format, Header, MAX_COLOUR_SLICE, with_axes};
use crate::encoder::transform::{self, Options, QualityTarget};
use crate::error::{Error, Result};
use crate::geometry::{Voxels, morton};
use crate::log::Log;
use crate::placement::Placement;

/// Codes clouds as scenes.
#[derive(Debug, Clone)]
pub struct SceneEncoder {
    pub(super) options: Options,
    pub(super) block_voxels: usize,
    memory: u64,
    axes: Axes,
    cancel: Cancel,
}

/// The grid that a scene's voxels lie in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// N.
    pub bits: u8,
    /// Where the cube lies.
    pub placement: Placement,
}

/// A voxel of level N: its Morton key and its colour.
pub type Voxel = (u64, [u8; 3]);

/// Takes each block of a scene, in order.
pub type Sink<'a> = dyn FnMut(&BlockEntry, &[u8]) -> Result<()> + 'a;

/// Voxels of a block.
pub(super) type Cut = (Cube, Vec<Voxel>);

/// Copies of a block's voxels while it is coded: as they came, and as a cloud.
const COPIES: usize = 2;

impl Default for SceneEncoder {
    fn default() -> Self {
        SceneEncoder {
            options: scene_options(Options::default()),
            block_voxels: BLOCK_VOXELS,
            memory: u64::MAX,
            axes: Axes::default(),
            cancel: Cancel::default(),
        }
    }
}

impl SceneEncoder {
    /// An encoder of blocks of at most [`BLOCK_VOXELS`] voxels, with the quality and the levels of
    /// [`Encoder::new`](crate::Encoder::new).
    pub fn new() -> Self {
        Self::default()
    }

    /// The same encoder with these options of each block, but for slices of colours. Levels are those of the scene.
    #[doc(hidden)]
    pub fn with_options(mut self, options: Options) -> Self {
        self.options = scene_options(options);
        self
    }

    /// The same encoder for these levels, which a scene may be cut after. Blocks are not smaller than voxels of the
    /// first.
    pub fn with_levels(mut self, levels: RangeInclusive<u8>) -> Self {
        self.options.levels = Some(levels);
        self
    }

    /// The same encoder with another quality of colours.
    pub fn with_quality(mut self, quality: QualityTarget) -> Self {
        self.options.fineness = quality;
        self
    }

    /// The same encoder, whose blocks have at most so many voxels of level N.
    pub fn with_block_voxels(mut self, voxels: usize) -> Self {
        self.block_voxels = voxels;
        self
    }

    /// The same encoder, which codes as many blocks at a time as take so many bytes of memory, and at least one: smaller
    /// blocks take less. Default: one for each thread.
    pub fn with_memory(mut self, bytes: u64) -> Self {
        self.memory = bytes;
        self
    }

    /// The same encoder, whose scenes state these axes.
    pub fn with_axes(mut self, axes: Axes) -> Self {
        self.axes = axes;
        self
    }

    /// The same encoder, stopped before its next block when `cancel` is thrown.
    pub fn with_cancel(mut self, cancel: Cancel) -> Self {
        self.cancel = cancel;
        self
    }

    /// Codes a cloud. The scene does not depend on the number of threads.
    ///
    /// # Errors
    /// Those of [`Encoder::encode`](crate::Encoder::encode), of a block as [`Error::Block`]; [`Error::Cancelled`].
    pub fn encode(&self, cloud: &ColouredVoxels) -> Result<Vec<u8>> {
        let mut blocks = Vec::new();
        let mut take = |_: &BlockEntry, bytes: &[u8]| {
            blocks.extend_from_slice(bytes);
            Ok(())
        };
        let mut scene = self.encode_voxels(Grid::of(cloud), voxels_of(cloud), &mut take)?;
        scene.append(&mut blocks);
        Ok(scene)
    }

    /// Codes voxels that come in Morton order, and returns header and index. `block` gets each block that follows them.
    /// No more voxels are in memory than those of as many blocks as there are threads, and of one more.
    ///
    /// # Errors
    /// Those of [`SceneEncoder::encode`], of `voxels` and of `block`; [`Error::Usage`] if the voxels are not in Morton
    /// order.
    pub fn encode_voxels(
        &self,
        grid: Grid,
        voxels: impl Iterator<Item = Result<Voxel>>,
        block: &mut Sink<'_>,
    ) -> Result<Vec<u8>> {
        let levels = self.levels(grid.bits)?;
        let log = Log::off().with_cancel(self.cancel.clone());
        let mut cuts = Cuts::new(self.cutter(&grid, &levels), voxels);
        let mut entries: Vec<BlockEntry> = Vec::new();
        let mut waiting = None;
        loop {
            self.cancel.check()?;
            let group = self.group(&grid, &mut cuts, &mut waiting)?;
            if group.is_empty() {
                break;
            }
            let first = entries.len();
            let code = |(i, (cube, voxels)): (usize, Cut)| {
                let bytes = self.code(&grid, &levels, cube, &voxels, first + i == 0, &log);
                let bytes = bytes.map_err(|error| in_block(first + i, error))?;
                Ok((BlockEntry::of(cube, &bytes)?, bytes))
            };
            let coded: Vec<Result<_>> = group.into_par_iter().enumerate().map(code).collect();
            for coded in coded {
                let (entry, bytes) = coded?;
                block(&entry, &bytes)?;
                entries.push(entry);
            }
        }
        let common = Header {
            optional_flags: 0,
            bits: grid.bits,
            base: *levels.start(),
            top: *levels.end(),
            points: 0,
            placement: grid.placement,
            format: Format::Transform {
                colour_slice: self.options.colour_slice,
            },
            slice_voxels: self.options.slice_voxels,
            voxels: Vec::new(),
            sections: Vec::new(),
        };
        write_index(&common, &entries)
    }

    /// The next blocks that are coded at a time. What does not fit waits.
    fn group(
        &self,
        grid: &Grid,
        cuts: &mut impl Iterator<Item = Result<Cut>>,
        waiting: &mut Option<Cut>,
    ) -> Result<Vec<Cut>> {
        let (mut group, mut bytes) = (Vec::new(), 0u64);
        while group.len() < rayon::current_num_threads().max(1) {
            let Some((cube, voxels)) = waiting.take().map(Ok).or_else(|| cuts.next()).transpose()? else {
                break;
            };
            let keys = voxels.iter().map(|voxel| voxel.0);
            let coding = transform::memory_of(grid.bits - cube.level, keys, &self.options, false);
            let copies = (COPIES * size_of::<Voxel>() * voxels.len()) as u64;
            bytes = bytes.saturating_add(coding).saturating_add(copies);
            if bytes > self.memory && !group.is_empty() {
                *waiting = Some((cube, voxels));
                break;
            }
            group.push((cube, voxels));
        }
        Ok(group)
    }

    /// The levels of a scene of so many bits.
    pub(super) fn levels(&self, bits: u8) -> Result<RangeInclusive<u8>> {
        let usual = bits.saturating_sub(3)..=bits.saturating_sub(1);
        let levels = self.options.levels.clone().unwrap_or(usual);
        match levels.is_empty() || *levels.end() > bits {
            true => Err(Error::Usage(format!(
                "levels {}..{} cannot be coded: a cloud of {bits} bits has levels up to {bits}",
                levels.start(),
                levels.end()
            ))),
            false => Ok(levels),
        }
    }

    pub(super) fn cutter(&self, grid: &Grid, levels: &RangeInclusive<u8>) -> Cutter {
        Cutter::new(grid.bits, most_level(*levels.start(), grid.bits), self.block_voxels)
    }

    /// The stream of a block.
    pub(super) fn code(
        &self,
        grid: &Grid,
        levels: &RangeInclusive<u8>,
        cube: Cube,
        voxels: &[Voxel],
        is_first: bool,
        log: &Log,
    ) -> Result<Vec<u8>> {
        let first = cube.keys(grid.bits).start;
        let keys = voxels.iter().map(|(key, _)| key - first).collect();
        let Placement { origin, voxel_size } = grid.placement;
        let corner = corner(cube, grid.bits);
        let cloud = ColouredVoxels {
            voxels: Voxels::from_sorted(grid.bits - cube.level, keys),
            colours: voxels.iter().map(|(_, colour)| *colour).collect(),
            placement: Placement {
                origin: [0, 1, 2].map(|axis| origin[axis] + f64::from(corner[axis]) * voxel_size),
                voxel_size,
            },
        };
        let options = Options {
            levels: Some(levels.start() - cube.level..=levels.end() - cube.level),
            ..self.options.clone()
        };
        let bytes = transform::encode(&cloud, &options, log)?.bytes;
        match is_first {
            true => with_axes(&bytes, &self.axes),
            false => Ok(bytes),
        }
    }
}

/// Blocks are decoded beside each other, so that their slices may be as long as they can be: that takes fewer bits.
fn scene_options(options: Options) -> Options {
    Options {
        colour_slice: MAX_COLOUR_SLICE,
        ..options
    }
}

impl Grid {
    /// The grid of a cloud.
    pub fn of(cloud: &ColouredVoxels) -> Self {
        Grid {
            bits: cloud.voxels.depth(),
            placement: cloud.placement,
        }
    }
}

/// The voxels of a cloud, one after the other.
pub(super) fn voxels_of(cloud: &ColouredVoxels) -> impl Iterator<Item = Result<Voxel>> {
    let voxels = cloud.voxels.keys().iter().zip(&cloud.colours);
    voxels.map(|(key, colour)| Ok((*key, *colour)))
}

/// Takes voxels together to blocks.
pub(super) struct Cuts<I> {
    cutter: Cutter,
    voxels: I,
    /// Voxels that are in no block yet: their keys, and colours.
    keys: Vec<u64>,
    colours: Vec<[u8; 3]>,
    ended: bool,
}

impl<I: Iterator<Item = Result<Voxel>>> Cuts<I> {
    pub fn new(cutter: Cutter, voxels: I) -> Self {
        Cuts {
            cutter,
            voxels,
            keys: Vec::new(),
            colours: Vec::new(),
            ended: false,
        }
    }

    /// Takes voxels until there are so many.
    fn fill(&mut self, count: usize) -> Result<()> {
        while self.keys.len() < count && !self.ended {
            let Some(voxel) = self.voxels.next() else {
                self.ended = true;
                break;
            };
            let (key, colour) = voxel?;
            if self.keys.last().is_some_and(|last| *last >= key) {
                return Err(Error::Usage("the voxels of a scene must come in Morton order".into()));
            }
            self.keys.push(key);
            self.colours.push(colour);
        }
        Ok(())
    }
}

impl<I: Iterator<Item = Result<Voxel>>> Iterator for Cuts<I> {
    type Item = Result<Cut>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut wanted = self.cutter.lookahead();
        loop {
            if let Err(error) = self.fill(wanted) {
                (self.ended, self.keys) = (true, Vec::new());
                return Some(Err(error));
            }
            if self.keys.is_empty() {
                return None;
            }
            if let Some((cube, count)) = self.cutter.next(&self.keys, self.ended) {
                let voxels = self.keys.drain(..count).zip(self.colours.drain(..count));
                return Some(Ok((cube, voxels.collect())));
            }
            wanted = 2 * self.keys.len();
        }
    }
}

fn in_block(block: usize, error: Error) -> Error {
    match error {
        Error::Cancelled => Error::Cancelled,
        source => Error::Block {
            block,
            source: Box::new(source),
        },
    }
}

/// The coordinates of a cube's lowest corner in voxels of level N.
fn corner(cube: Cube, depth: u8) -> [u32; 3] {
    morton::decode(cube.key).map(|x| x << (depth - cube.level))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Blocks of one voxel each, in order.
    fn blocks(count: u64) -> impl Iterator<Item = Result<Cut>> {
        (0..count).map(|key| Ok((Cube { level: 4, key }, vec![(key << 6, [7; 3])])))
    }

    #[test]
    fn as_many_blocks_as_fit_are_coded_at_a_time_and_at_least_one() {
        let grid = Grid {
            bits: 6,
            placement: Placement::VOXEL_GRID,
        };
        let sizes = |memory: u64| {
            let encoder = SceneEncoder::new().with_memory(memory);
            let (mut cuts, mut waiting) = (blocks(7), None);
            let mut groups = Vec::new();
            loop {
                let group = encoder.group(&grid, &mut cuts, &mut waiting).unwrap();
                if group.is_empty() {
                    break;
                }
                groups.push(group.iter().map(|(cube, _)| cube.key).collect::<Vec<_>>());
            }
            assert_eq!(groups.concat(), (0..7).collect::<Vec<_>>());
            groups.into_iter().map(|group| group.len()).collect::<Vec<_>>()
        };
        let one =
            transform::memory_of(2, [0].into_iter(), &Options::default(), false) + (COPIES * size_of::<Voxel>()) as u64;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        pool.install(|| {
            assert_eq!(sizes(u64::MAX), [3, 3, 1]);
            assert_eq!(sizes(2 * one), [2, 2, 2, 1]);
            assert_eq!(sizes(0), [1; 7]);
        });
    }
}
