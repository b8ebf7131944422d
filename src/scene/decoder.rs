//! Decodes scenes, whole or in part (`docs/format.md`, clause 18.3).

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use rayon::prelude::*;

use super::halo::{Near, Neighbourhood, around};
use super::neighbours::Bounds;
use super::reader::SceneReader;
use super::source::Source;
#[cfg(feature = "ply")]
use crate::cloud::ColouredVoxels;
use crate::container::Header;
use crate::container::scene::Cube;
use crate::decoder::{Decoder, LevelVoxels, Part};
use crate::error::{Error, Result};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::{SiblingMap, Voxels};
#[cfg(doc)]
use crate::limits::Limits;
use crate::placement::Placement;

/// Bytes of memory for each byte of a stream that is decoded: the stream, and its slices.
const CODED_BYTES: u64 = 5;
/// Bytes of a decoded voxel that is kept: its key, two colours, and how it is drawn.
pub(super) const VOXEL_BYTES: u64 = 8 + 3 + 3 + 1;
/// Bytes of a voxel of a block, or around it, while it is drawn: its key, links and neighbours at two levels, a kernel
/// map that these are made from, colours, and choices.
const PART_BYTES: u64 = 2 * (8 + 5 + SiblingMap::BYTES_PER_VOXEL + SiblingMap::BYTES_PER_PARENT) + 27 * 4 + 3 + 3 + 3;

/// Decodes scenes of blocks. Blocks are decoded in parallel; the result does not depend on the number of threads.
#[derive(Debug, Clone, Default)]
pub struct SceneDecoder {
    decoder: Decoder,
}

/// Which part of a scene is wanted.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub enum Wanted {
    /// All of it.
    #[default]
    All,
    /// What has its voxels' centres in a box in world coordinates: the lowest and the highest corner.
    Box([f64; 3], [f64; 3]),
    /// These blocks.
    Blocks(Vec<usize>),
}

/// A part of a scene that was decoded.
#[derive(Debug)]
pub struct DecodedScene<T> {
    /// What could be decoded.
    pub content: T,
    /// Blocks that were decoded.
    pub blocks: usize,
    /// Why other blocks could not be decoded: [`Error::Block`]. Their neighbours are drawn as if they were empty.
    pub lost: Vec<Error>,
}

impl<T> DecodedScene<T> {
    /// What was decoded, if no block is lost.
    ///
    /// # Errors
    /// Why the first of them is.
    pub fn whole(self) -> Result<T> {
        match self.lost.into_iter().next() {
            Some(error) => Err(error),
            None => Ok(self.content),
        }
    }
}

/// The voxels of a level that are wanted, and the blocks that they are in.
struct Selection {
    level: u8,
    blocks: Vec<usize>,
    /// All of these blocks, if there are none.
    bounds: Option<Bounds>,
}

/// What is known of the blocks of a scene at a level.
#[derive(Debug, Default)]
pub(super) struct Decoded {
    /// Blocks that were decoded, by their numbers; `None` for those that could not be.
    pub blocks: Blocks,
    /// Keys of the coarsest level, of blocks that were decoded no further.
    coarse: BTreeMap<usize, Vec<u64>>,
}

/// Decoded blocks by their numbers; `None` for those that could not be decoded.
pub(super) type Blocks = BTreeMap<usize, Option<LevelVoxels>>;

impl SceneDecoder {
    /// A decoder of scenes, which decodes and draws as `decoder` does: its level, heads, limits and instructions count.
    /// Limits on points hold for each block.
    pub fn new(decoder: Decoder) -> Self {
        SceneDecoder { decoder }
    }

    /// The Gaussians of a part, block by block.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], [`Error::Usage`] for a level or a part that the scene has not, [`Error::Unsupported`]
    /// for heads that there are not, [`Error::Cancelled`]; what is wrong with all blocks, if none can be decoded. Of
    /// damage in some of them [`DecodedScene::lost`] tells.
    pub fn gaussians<S: Source>(&self, scene: &SceneReader<S>, wanted: &Wanted) -> Result<DecodedScene<Gaussians>> {
        let selection = self.select(scene, wanted)?;
        let (mut decoded, mut lost) = (Decoded::default(), Vec::new());
        let mut parts: Vec<Gaussians> = Vec::new();
        let mut take = |_, drawn| parts.push(drawn);
        let Selection { level, bounds, .. } = &selection;
        let wanted = (*level, &selection.blocks[..], bounds.as_ref());
        self.draw_blocks(scene, wanted, 0, &mut decoded, &mut lost, &mut take)?;
        drop(decoded);
        let blocks = parts.len();
        finish(joined(parts, frame_of(scene.header())), lost, blocks)
    }

    /// Draws blocks at a level, or what of them lies in a box, and gives each to `take` with its number. What is
    /// decoded for it is kept in `decoded`; `held` bytes of memory are taken already, what is in `decoded` included.
    pub(super) fn draw_blocks<S: Source>(
        &self,
        scene: &SceneReader<S>,
        (level, blocks, bounds): (u8, &[usize], Option<&Bounds>),
        held: u64,
        decoded: &mut Decoded,
        lost: &mut Vec<Error>,
        take: &mut dyn FnMut(usize, Gaussians),
    ) -> Result<()> {
        let header = scene.header();
        self.decoder.check_drawable(header, level)?;
        let reach = self.decoder.reach(header, level)?;
        let kept = self.gaussian_bytes(scene, blocks, level)?.saturating_add(held);
        let needed = self.near(scene, (level, blocks), kept, decoded)?;
        let decoded = &mut decoded.blocks;
        let missing = needed.iter().copied().filter(|block| !decoded.contains_key(block));
        let missing: Vec<usize> = missing.collect();
        let kept = kept.saturating_add(self.check_memory(scene, &missing, level, kept)?);
        self.decode(scene, &needed, level, decoded, lost)?;
        for &block in blocks {
            self.decoder.cancel().check()?;
            let Some(Some(own)) = decoded.get(&block) else { continue };
            let near = Near::of(scene.blocks(), decoded, block, level, reach);
            self.check_drawing(header, level, near.voxels(), kept)?;
            take(block, self.draw(header, own, &near.collect()?, bounds)?);
        }
        Ok(())
    }

    /// Some blocks and those around them that have voxels so near that drawing depends on them. The coarsest level of a
    /// block tells that, for a fraction of what it takes to decode.
    pub(super) fn near<S: Source>(
        &self,
        scene: &SceneReader<S>,
        (level, blocks): (u8, &[usize]),
        held: u64,
        decoded: &mut Decoded,
    ) -> Result<Vec<usize>> {
        let (all, base) = (scene.blocks(), scene.header().base);
        let reach = self.decoder.reach(scene.header(), level)?;
        let around = around(all, blocks, level, reach);
        if around.len() == blocks.len() || base >= level {
            return Ok(around);
        }
        let own: BTreeSet<usize> = blocks.iter().copied().collect();
        let is_needed = |block: &usize| own.contains(block) || decoded.blocks.contains_key(block);
        let unknown = |block: &&usize| !is_needed(block) && !decoded.coarse.contains_key(block);
        let unknown: Vec<usize> = around.iter().filter(unknown).copied().collect();
        self.check_memory(scene, &unknown, base, held)?;
        let mut found = Blocks::new();
        // What is wrong with a block is said when it is decoded.
        self.decode(scene, &unknown, base, &mut found, &mut Vec::new())?;
        for (block, voxels) in found {
            decoded.coarse.extend(voxels.map(|voxels| (block, voxels.keys)));
        }
        let reached = own.iter().map(|&block| Bounds::around(all[block].cube, level, reach));
        let reached: Vec<Bounds> = reached.collect();
        let has_near = |block: &usize, keys: &[u64]| {
            let cube = Bounds::of(all[*block].cube, level);
            let close: Vec<&Bounds> = reached.iter().filter(|bounds| bounds.meets(&cube)).collect();
            keys.iter().any(|&key| {
                let voxel = Bounds::of(Cube { level: base, key }, level);
                close.iter().any(|bounds| bounds.meets(&voxel))
            })
        };
        let near = around.into_iter().filter(|block| match decoded.coarse.get(block) {
            Some(keys) if !own.contains(block) && !decoded.blocks.contains_key(block) => has_near(block, keys),
            _ => true,
        });
        Ok(near.collect())
    }

    /// What decodes blocks.
    #[cfg(feature = "render")]
    pub(super) fn decoder(&self) -> &Decoder {
        &self.decoder
    }

    /// The voxels of a part with their colours, in the order of space.
    ///
    /// # Errors
    /// Those of [`SceneDecoder::gaussians`], but for heads.
    pub fn voxels<S: Source>(
        &self,
        scene: &SceneReader<S>,
        wanted: &Wanted,
    ) -> Result<DecodedScene<(Voxels, Vec<[u8; 3]>)>> {
        let selection = self.select(scene, wanted)?;
        self.check_memory(scene, &selection.blocks, selection.level, 0)?;
        let (mut decoded, mut lost) = (Blocks::new(), Vec::new());
        self.decode(scene, &selection.blocks, selection.level, &mut decoded, &mut lost)?;
        let (mut keys, mut colours) = (Vec::new(), Vec::new());
        let mut blocks = 0;
        for (&block, voxels) in &decoded {
            let Some(voxels) = voxels else { continue };
            blocks += 1;
            for range in selection.ranges(&voxels.keys, scene.blocks()[block].cube) {
                keys.extend(&voxels.keys[range.clone()]);
                colours.extend(&voxels.colours[range]);
            }
        }
        let voxels = Voxels::from_sorted(selection.level, keys);
        finish((voxels, colours), lost, blocks)
    }

    /// The same on a grid of their own: that of the scene, with as many bits as the level has.
    ///
    /// # Errors
    /// Those of [`SceneDecoder::voxels`].
    #[cfg(feature = "ply")]
    pub fn points<S: Source>(&self, scene: &SceneReader<S>, wanted: &Wanted) -> Result<DecodedScene<ColouredVoxels>> {
        let DecodedScene { content, blocks, lost } = self.voxels(scene, wanted)?;
        let (voxels, colours) = content;
        let Placement { origin, voxel_size } = scene.header().placement;
        let coarser = f64::from(1u32 << (scene.header().bits - voxels.depth()));
        let content = ColouredVoxels {
            voxels,
            colours,
            placement: Placement {
                origin,
                voxel_size: voxel_size * coarser,
            },
        };
        Ok(DecodedScene { content, blocks, lost })
    }

    /// The levels of a scene that can be drawn, the coarsest first, down to the decoder's level if it has one.
    ///
    /// # Errors
    /// [`Error::Usage`] for a level that the scene has not.
    pub fn levels<S: Source>(&self, scene: &SceneReader<S>) -> Result<Vec<u8>> {
        let header = scene.header();
        let levels = header.base..=self.level(header)?;
        let drawable = |level: &u8| self.decoder.check_drawable(header, *level).is_ok();
        Ok(levels.filter(drawable).collect())
    }

    /// Bytes of memory that decoding a part and its Gaussians takes, beyond [`Limits::OVERHEAD`] and models. Around a
    /// block there are taken to be as many voxels as in it.
    ///
    /// # Errors
    /// [`Error::Usage`] for a level or a part that the scene has not, [`Error::Unsupported`] for heads that there are
    /// not.
    pub fn memory<S: Source>(&self, scene: &SceneReader<S>, wanted: &Wanted) -> Result<u64> {
        let Selection { level, blocks, .. } = self.select(scene, wanted)?;
        let reach = self.decoder.reach(scene.header(), level)?;
        let needed = around(scene.blocks(), &blocks, level, reach);
        let (decoded, working) = self.decoding_bytes(scene, &needed, level)?;
        let made = self.gaussian_bytes(scene, &blocks, level)?;
        let own = |block: &usize| -> Result<u64> {
            let entry = &scene.blocks()[*block];
            let voxels = entry.header(scene.header()).voxels(level - entry.cube.level)?;
            Ok(2 * u64::from(voxels))
        };
        let most = blocks
            .iter()
            .map(own)
            .try_fold(0, |most, voxels| voxels.map(|voxels| most.max(voxels)))?;
        let drawing = self.decoder.drawing_bytes_of(scene.header(), level, [most; 2], false)?;
        let drawing = drawing.saturating_add(most.saturating_mul(PART_BYTES));
        Ok(made.saturating_add(decoded).saturating_add(working.max(drawing)))
    }

    /// The blocks in which a part lies.
    ///
    /// # Errors
    /// [`Error::Usage`] for a level or a part that the scene has not.
    pub fn blocks<S: Source>(&self, scene: &SceneReader<S>, wanted: &Wanted) -> Result<Vec<usize>> {
        Ok(self.select(scene, wanted)?.blocks)
    }

    /// The level that is decoded.
    pub(super) fn level(&self, header: &Header) -> Result<u8> {
        let level = self.decoder.level().unwrap_or(header.top);
        header.voxels(level)?;
        Ok(level)
    }

    fn select<S: Source>(&self, scene: &SceneReader<S>, wanted: &Wanted) -> Result<Selection> {
        let level = self.level(scene.header())?;
        let all = 0..scene.blocks().len();
        let (blocks, bounds) = match wanted {
            Wanted::All => (all.collect(), None),
            Wanted::Box(low, high) => {
                let bounds = bounds_of(scene.header(), level, *low, *high)?;
                let meets = |block: &usize| bounds.meets(&Bounds::of(scene.blocks()[*block].cube, level));
                (all.filter(meets).collect(), Some(bounds))
            }
            Wanted::Blocks(blocks) => {
                if let Some(block) = blocks.iter().find(|block| !all.contains(block)) {
                    let last = all.end - 1;
                    return Err(Error::Usage(format!(
                        "the scene has the blocks 0 to {last}, not {block}"
                    )));
                }
                let mut blocks = blocks.clone();
                blocks.sort_unstable();
                blocks.dedup();
                (blocks, None)
            }
        };
        Ok(Selection { level, blocks, bounds })
    }

    /// Decodes those of some blocks that have not been decoded yet, as many at a time as there are threads.
    pub(super) fn decode<S: Source>(
        &self,
        scene: &SceneReader<S>,
        blocks: &[usize],
        level: u8,
        decoded: &mut Blocks,
        lost: &mut Vec<Error>,
    ) -> Result<()> {
        let decode = |&block: &usize| -> Result<LevelVoxels> {
            let cube = scene.blocks()[block].cube;
            let bytes = scene.block(block)?;
            let decoded = || {
                let decoding = self.decoder.exact(bytes, level - cube.level)?;
                let voxels = decoding.level_voxels();
                voxels.ok_or_else(|| Error::Usage("nothing was decoded".into()))
            };
            let mut voxels = decoded().map_err(|error| match error {
                Error::Cancelled => Error::Cancelled,
                source => Error::Block {
                    block,
                    source: Box::new(source.moved(|byte| scene.blocks()[block].offset + byte)),
                },
            })?;
            let first = cube.keys(level).start;
            voxels.keys.iter_mut().for_each(|key| *key |= first);
            Ok(voxels)
        };
        let missing: Vec<usize> = blocks
            .iter()
            .copied()
            .filter(|block| !decoded.contains_key(block))
            .collect();
        for group in missing.chunks(rayon::current_num_threads().max(1)) {
            self.decoder.cancel().check()?;
            let found: Vec<Result<LevelVoxels>> = group.par_iter().map(decode).collect();
            for (&block, found) in group.iter().zip(found) {
                let voxels = match found {
                    Ok(voxels) => Some(voxels),
                    Err(error @ Error::Cancelled) => return Err(error),
                    Err(error) => {
                        lost.push(error);
                        None
                    }
                };
                decoded.insert(block, voxels);
            }
        }
        Ok(())
    }

    /// Draws a block among the voxels around it.
    fn draw(
        &self,
        header: &Header,
        own: &LevelVoxels,
        around: &Neighbourhood,
        bounds: Option<&Bounds>,
    ) -> Result<Gaussians> {
        let (octree, level) = (&around.octree, around.octree.depth());
        let (above, map) = octree.last_sibling_maps(level);
        let range = around.own.clone();
        let voxels = octree.level(level);
        let chosen = bounds.map(|bounds| {
            let is_in = |voxel| bounds.has(voxels.coordinate(voxel));
            (0..voxels.len()).map(is_in).collect::<Vec<bool>>()
        });
        let surfels = own.surfels.as_ref().map(|own| {
            let mut all = vec![false; voxels.len()];
            all[range.clone()].copy_from_slice(own);
            all
        });
        let part = Part {
            octree,
            level,
            map: &map,
            above: above.as_ref(),
            colours: &around.colours,
            range,
            chosen: chosen.as_deref(),
            surfels: surfels.as_deref(),
            advice: own.advice,
        };
        self.decoder.draw(header, &part, || {
            Decoder::colours_above(octree, level, &around.unfiltered)
        })
    }

    /// Bytes that the Gaussians of some blocks take at most.
    pub(super) fn gaussian_bytes<S: Source>(&self, scene: &SceneReader<S>, blocks: &[usize], level: u8) -> Result<u64> {
        let mut voxels = 0;
        for &block in blocks {
            let entry = &scene.blocks()[block];
            voxels += u64::from(entry.header(scene.header()).voxels(level - entry.cube.level)?);
        }
        self.decoder.gaussian_bytes(scene.header(), level, voxels)
    }

    /// Checks that decoding these blocks keeps to the limits, beside `kept` bytes, and returns what they take when they
    /// are decoded.
    fn check_memory<S: Source>(&self, scene: &SceneReader<S>, blocks: &[usize], level: u8, kept: u64) -> Result<u64> {
        let (decoded, working) = self.decoding_bytes(scene, blocks, level)?;
        let all = kept.saturating_add(decoded).saturating_add(working);
        self.decoder.limits().check_bytes("memory to decode this scene", all)?;
        Ok(decoded)
    }

    /// Bytes of these blocks when they are decoded, and while they are.
    fn decoding_bytes<S: Source>(&self, scene: &SceneReader<S>, blocks: &[usize], level: u8) -> Result<(u64, u64)> {
        let mut working: Vec<u64> = Vec::new();
        let mut decoded: u64 = 0;
        for &block in blocks {
            let entry = &scene.blocks()[block];
            let (own, local) = (entry.header(scene.header()), level - entry.cube.level);
            let coded = u64::from(entry.bytes).saturating_mul(CODED_BYTES);
            working.push(self.decoder.memory(&own, local)?.saturating_add(coded));
            decoded = decoded.saturating_add(u64::from(own.voxels(local)?) * VOXEL_BYTES);
        }
        working.sort_unstable();
        let largest = working.iter().rev().take(rayon::current_num_threads());
        let working = largest.fold(0, |sum: u64, bytes| sum.saturating_add(*bytes));
        Ok((decoded, working))
    }

    /// Checks that drawing a block among so many voxels keeps to the limits, beside `kept` bytes.
    fn check_drawing(&self, header: &Header, level: u8, voxels: u64, kept: u64) -> Result<()> {
        let drawing = self.decoder.drawing_bytes_of(header, level, [voxels; 2], false)?;
        let all = kept
            .saturating_add(drawing)
            .saturating_add(voxels.saturating_mul(PART_BYTES));
        self.decoder.limits().check_bytes("memory to draw this scene", all)
    }
}

impl Selection {
    /// Those of a block's voxels that are wanted.
    fn ranges(&self, keys: &[u64], cube: Cube) -> Vec<Range<usize>> {
        match &self.bounds {
            Some(bounds) => bounds.ranges(keys, cube, self.level),
            None => std::iter::once(0..keys.len()).collect(),
        }
    }
}

/// What was decoded, unless all is lost.
fn finish<T>(content: T, mut lost: Vec<Error>, blocks: usize) -> Result<DecodedScene<T>> {
    match blocks == 0 && !lost.is_empty() {
        true => Err(lost.swap_remove(0)),
        false => Ok(DecodedScene { content, blocks, lost }),
    }
}

/// Gaussians of blocks at one level, as one. Array by array, so that no more than one of them is in memory twice.
pub(super) fn joined(mut parts: Vec<Gaussians>, frame: Frame) -> Gaussians {
    fn taken<T: Copy>(parts: &mut [Gaussians], array: impl Fn(&mut Gaussians) -> &mut Vec<T>) -> Vec<T> {
        let count = parts.iter_mut().map(|part| array(part).len()).sum();
        let mut all = Vec::with_capacity(count);
        for part in parts {
            all.append(&mut std::mem::take(array(part)));
        }
        all
    }
    let blur = parts.first().map_or(0.0, |part| part.blur);
    Gaussians {
        position: taken(&mut parts, |part| &mut part.position),
        scale: taken(&mut parts, |part| &mut part.scale),
        rotation: taken(&mut parts, |part| &mut part.rotation),
        opacity: taken(&mut parts, |part| &mut part.opacity),
        colour: taken(&mut parts, |part| &mut part.colour),
        blur,
        frame,
        ..Gaussians::default()
    }
}

/// The cube that a scene's Gaussians refer to.
pub(super) fn frame_of(header: &Header) -> Frame {
    Frame {
        bits: header.bits,
        placement: header.placement,
    }
}

/// The voxels of a level whose centres lie in a box of the world.
fn bounds_of(header: &Header, level: u8, low: [f64; 3], high: [f64; 3]) -> Result<Bounds> {
    if low
        .iter()
        .zip(&high)
        .any(|(low, high)| low.is_nan() || high.is_nan() || low > high)
    {
        let what = "a box has a lowest and a highest corner";
        return Err(Error::Usage(format!("{what}, not {low:?} and {high:?}")));
    }
    let Placement { origin, voxel_size } = header.placement;
    let edge = voxel_size * f64::from(1u32 << (header.bits - level));
    let last = f64::from((1u32 << level) - 1);
    let axis = |axis: usize| {
        let [first, end] = [low, high].map(|corner| (corner[axis] - origin[axis]) / edge - 0.5);
        (first.ceil().max(0.0), end.floor().min(last))
    };
    let axes = [axis(0), axis(1), axis(2)];
    if axes.iter().any(|(first, end)| first > end) {
        return Err(Error::Usage(format!(
            "no voxel of the scene has its centre between {low:?} and {high:?}"
        )));
    }
    Ok(Bounds {
        low: axes.map(|(first, _)| first as u32),
        high: axes.map(|(_, end)| end as u32),
    })
}
