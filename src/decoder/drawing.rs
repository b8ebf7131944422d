//! Gaussians of decoded voxels: of a stream's level, or of a part of one among its neighbours.

use std::ops::Range;

use super::reached::{Reached, means};
use super::stream::Decoder;
use crate::container::Header;
use crate::error::Result;
use crate::gaussians::learned::LevelInput;
use crate::gaussians::surfels::{SurfelSelection, Surfels, is_for_surfels};
use crate::gaussians::{Frame, Gaussians, HeadMap};
use crate::geometry::{Octree, SiblingMap};

/// How far surfels depend on other voxels: the widest window, in voxels of the level above.
const SURFEL_REACH: u32 = 4;

/// The decoded voxels of a level, and how they are to be drawn.
#[derive(Debug)]
pub(crate) struct LevelVoxels {
    /// Morton keys.
    pub keys: Vec<u64>,
    /// Their colours as they are drawn.
    pub colours: Vec<[u8; 3]>,
    /// Their colours before the filter.
    pub unfiltered: Vec<[u8; 3]>,
    /// For every voxel whether it becomes surfels, where heads draw others; `None` for none.
    pub surfels: Option<Vec<bool>>,
    pub advice: Advice,
}

/// What a stream says of how a level is drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Advice {
    /// Quantisation step of luma.
    pub luma_step: f32,
    /// Whether surfels are better for all of it.
    pub all_surfels: bool,
    /// Factors of the surfels' radii: among learned Gaussians, and where all voxels are surfels.
    pub sizes: [f32; 2],
    /// Standard deviations, in the cube frame, by which learned Gaussians and surfels are thicker.
    pub thickness: [f32; 2],
}

/// Called with the Gaussians of one part after the other.
pub(crate) type Each<'a> = dyn FnMut(&Gaussians) -> Result<()> + 'a;

/// Voxels among their neighbours.
pub(crate) struct Part<'a> {
    pub octree: &'a Octree,
    pub level: u8,
    /// Their neighbours.
    pub map: &'a SiblingMap,
    /// Those in the level above; level 0 has none.
    pub above: Option<&'a SiblingMap>,
    pub colours: &'a [[u8; 3]],
    /// The voxels that are drawn, if they are chosen.
    pub range: Range<usize>,
    /// For every voxel whether it is chosen; `None` for all.
    pub chosen: Option<&'a [bool]>,
    /// For every voxel whether it becomes surfels, where heads draw others; `None` for none.
    pub surfels: Option<&'a [bool]>,
    pub advice: Advice,
}

impl Part<'_> {
    /// Of every voxel whether it is chosen and `is` holds for it.
    fn chosen_that(&self, is: impl Fn(usize) -> bool) -> Vec<bool> {
        let chosen = |voxel| self.chosen.is_none_or(|chosen| chosen[voxel]);
        (0..self.map.len()).map(|voxel| chosen(voxel) && is(voxel)).collect()
    }
}

impl LevelVoxels {
    /// Those that a stream was decoded to.
    pub(super) fn of(decoder: &Decoder, reached: &Reached) -> Self {
        let (octree, level) = (&reached.octree, reached.level);
        let heads = reached.head_map.as_ref();
        LevelVoxels {
            keys: octree.level(level).keys().to_vec(),
            colours: reached.colours(decoder.isa()).to_vec(),
            unfiltered: reached.coloured.rgb(),
            surfels: heads.and_then(|heads| heads.surfels(octree, level)),
            advice: Advice::of(reached),
        }
    }
}

impl Advice {
    fn of(reached: &Reached) -> Self {
        let heads = reached.head_map.as_ref();
        Advice {
            luma_step: reached.luma_step(),
            all_surfels: reached.advises_surfels(),
            sizes: heads.map_or([1.0; 2], HeadMap::sizes),
            thickness: heads.map_or([0.0; 2], |heads| heads.thickness_at(reached.level)),
        }
    }
}

impl Decoder {
    /// The Gaussians of a level of a stream of version 3. With `each`, it gets them part by part, and none are left.
    pub(super) fn generate(
        &self,
        header: &Header,
        reached: &Reached,
        each: Option<&mut Each<'_>>,
    ) -> Result<Gaussians> {
        let (octree, level) = (&reached.octree, reached.level);
        let heads = reached.head_map.as_ref();
        let surfels = heads.and_then(|heads| heads.surfels(octree, level));
        let part = Part {
            octree,
            level,
            map: &reached.map,
            above: reached.above.as_ref().map(|above| &above.map),
            colours: reached.colours(self.isa()),
            range: 0..reached.map.len(),
            chosen: None,
            surfels: surfels.as_deref(),
            advice: Advice::of(reached),
        };
        let colours_above = || {
            reached
                .above
                .as_ref()
                .map_or_else(Vec::new, |above| reached.colours_above(above))
        };
        self.draw_to(header, &part, colours_above, each)
    }

    /// How many Gaussians a level of a stream of version 3 has, if that is known before they are made: of eight learned
    /// ones of a voxel, faint ones are left out.
    pub(super) fn gaussian_count(&self, header: &Header, reached: &Reached) -> Result<Option<usize>> {
        let (octree, level) = (&reached.octree, reached.level);
        let all = octree.level(level).len();
        let discs = self.surfels_per_voxel(header, level)?.count();
        let each = match self.network(header, level)? {
            Some((_, (_, count))) if !reached.is_all_surfels() => count,
            _ => return Ok(Some(discs * all)),
        };
        let surfels = reached.head_map.as_ref().and_then(|heads| heads.surfels(octree, level));
        let surfels = surfels.map_or(0, |surfels| surfels.iter().filter(|&&is| is).count());
        Ok((each == 1).then(|| all - surfels + discs * surfels))
    }

    /// How many voxels of the level above lie between a voxel's parent and the farthest one that its Gaussians depend
    /// on.
    pub(crate) fn reach(&self, header: &Header, level: u8) -> Result<u32> {
        let network = self.network(header, level)?;
        Ok(SURFEL_REACH.max(network.map_or(0, |(model, set)| model.reach(set))))
    }

    /// The Gaussians of a part of a level of a stream of version 3, first those of the network.
    pub(crate) fn draw(
        &self,
        header: &Header,
        part: &Part<'_>,
        colours_above: impl FnOnce() -> Vec<[u8; 3]>,
    ) -> Result<Gaussians> {
        self.draw_to(header, part, colours_above, None)
    }

    /// As [`Decoder::draw`]. With `each`, it gets the Gaussians part by part, one part at least, and none are left.
    fn draw_to(
        &self,
        header: &Header,
        part: &Part<'_>,
        colours_above: impl FnOnce() -> Vec<[u8; 3]>,
        mut each: Option<&mut Each<'_>>,
    ) -> Result<Gaussians> {
        let frame = Frame {
            bits: header.bits,
            placement: header.placement,
        };
        let level = part.level;
        let [mixed, alone] = part.advice.sizes;
        let [thickness, thickness_of_discs] = part.advice.thickness;
        let discs = |only: Option<&[bool]>, size: f32, blur: Option<f32>, each: Option<&mut Each<'_>>| {
            let range = Some(&part.range);
            let surfels = Surfels {
                isa: self.isa(),
                voxels: part.octree.level(level),
                map: part.map,
                colours: part.colours,
                per_voxel: self.surfels_per_voxel(header, level)?,
                choice: SurfelSelection { only, size, range },
                frame,
            };
            let Some(each) = each else {
                let mut drawn = surfels.all();
                drawn.thicken(thickness_of_discs);
                return Ok(drawn);
            };
            surfels.in_parts(|mut drawn| {
                self.cancel().check()?;
                drawn.thicken(thickness_of_discs);
                drawn.blur = blur.unwrap_or(drawn.blur);
                each(&drawn)
            })?;
            Ok(Gaussians::default())
        };
        let (Some((model, set)), Some(above)) = (self.network(header, level)?, part.above) else {
            return discs(part.chosen, alone, None, each);
        };
        if part.advice.all_surfels || is_for_surfels(part.map, part.range.clone()) {
            return discs(part.chosen, alone, None, each);
        }
        let is_surfels = |voxel: usize| part.surfels.is_some_and(|surfels| surfels[voxel]);
        let without = (part.surfels.is_some() || part.chosen.is_some()).then(|| {
            let learned = part.chosen_that(|voxel| !is_surfels(voxel));
            learned.iter().map(|learned| !learned).collect::<Vec<bool>>()
        });
        let colours_above = colours_above();
        let input = LevelInput {
            octree: part.octree,
            level,
            map: part.map,
            above,
            colours: part.colours,
            colours_above: &colours_above,
            luma_step: part.advice.luma_step,
            without: without.as_deref(),
            range: Some(&part.range),
        };
        let (isa, precision) = (self.isa(), self.precision);
        let rows = (self.span_rows(), each.is_none());
        let mut taken = |drawn: &mut Gaussians| {
            self.cancel().check()?;
            if let Some(each) = &mut each {
                drawn.thicken(thickness);
                each(drawn)?;
                drawn.clear();
            }
            Ok(())
        };
        let mut gaussians = model.generate_in_parts(isa, precision, set, input, frame, rows, &mut taken)?;
        gaussians.thicken(thickness);
        if part.surfels.is_some() {
            let chosen = part.chosen_that(is_surfels);
            gaussians.append(discs(Some(&chosen), mixed, Some(gaussians.blur), each)?);
        }
        Ok(gaussians)
    }

    /// The mean colours of the children of every voxel above `level`.
    pub(crate) fn colours_above(octree: &Octree, level: u8, colours: &[[u8; 3]]) -> Vec<[u8; 3]> {
        means(octree, level, colours)
    }
}
