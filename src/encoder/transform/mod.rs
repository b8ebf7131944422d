//! Streams of version 3: colours as transform coefficients.

mod candidates;
mod checking;
mod choice;
mod descent;
mod field;
mod head_maps;
mod knobs;
mod memory;
mod motion;
mod noise;
mod options;
mod predicted;
mod quality;
mod rate_control;
mod reference;
mod refine;
mod shape;
mod surfel_size;
mod thickness;
mod votes;
mod warp;
mod writing;

use std::ops::RangeInclusive;
use std::sync::{Arc, OnceLock};

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::Encoded;
use crate::cloud::ColouredVoxels;
use crate::colour::{self, Filter, LevelColours, Steps, Truth};
use crate::container::{Format, Header, Writer};
use crate::decoder::{Decoder, colour_hash};
use crate::error::{Error, Result};
use crate::geometry::{Octree, SiblingMap, Voxels, codec};
use crate::log::Log;
use crate::motion::{ColourGuide, GeometryGuide};
use descent::Pictures;
pub(crate) use memory::memory_of;
pub use memory::{encode_memory, surface_within};
pub use options::{Motion, Options, Outline, Tune};
pub use predicted::{PredictedFrame, encode_predicted};
pub use quality::QualityTarget;
pub(crate) use thickness::of_stream as thickness_of;

pub use rate_control::encode_to_rate;
pub use shape::GeometryTarget;
use shape::Shape;
use writing::{Coded, Layer, counted};

/// Filters of levels that are not the finest may take one part in so many of a stream that ends there.
const FILTER_SHARE: usize = 100;

/// Codes a cloud, then decodes the stream and compares before giving it out.
///
/// # Errors
/// [`Error::Usage`] for levels that the cloud does not have and steps that the format does not have,
/// [`Error::Malformed`] for slices that the format does not have; and, if encoder and decoder disagreed on this
/// machine, whatever the decoder found.
pub fn encode(cloud: &ColouredVoxels, options: &Options, log: &Log) -> Result<Encoded> {
    let steps = options.fineness.steps()?;
    let levels = choose_levels(cloud.voxels.depth(), options.levels.clone())?;
    let mut subject = EncoderInput::new(cloud, levels, options, log)?;
    let top = *subject.levels.end();
    let shape = subject.shape(top, subject.lambda(top, steps), log)?;
    if shape.is_some() {
        // A shape has a map of its own.
        subject.maps.truncate(top.into());
    }
    let coded = subject.code(top, steps, shape, log)?;
    // They are needed no more, and are the largest part.
    subject.maps = Vec::new();
    subject.pictures.take();
    subject.checked(coded, options.has_head_maps(), usize::MAX, log)
}

/// The levels to code, for a cloud of bit depth `bits`.
fn choose_levels(bits: u8, wanted: Option<RangeInclusive<u8>>) -> Result<RangeInclusive<u8>> {
    let levels = wanted.unwrap_or(bits.saturating_sub(3)..=bits.saturating_sub(1));
    let (first, last) = (*levels.start(), *levels.end());
    if first > last || last > bits {
        return Err(Error::Usage(format!(
            "levels {first}..{last} cannot be coded: a cloud of {bits} bits has levels up to {bits}"
        )));
    }
    Ok(levels)
}

/// A cloud and what all its streams share, however exactly colours are coded.
struct EncoderInput<'a> {
    cloud: &'a ColouredVoxels,
    options: &'a Options,
    isa: Isa,
    levels: RangeInclusive<u8>,
    octree: Octree,
    /// The maps of the levels from 0 on.
    maps: Vec<SiblingMap>,
    /// The code of the levels from 1 on: of each slice the children, and its bytes.
    geometry: Vec<Vec<(u32, Vec<u8>)>>,
    grey: bool,
    /// Whether the cloud is a capture that is sparse at its own level.
    sparse: bool,
    /// Points that the header states.
    points: u64,
    /// What descent compares with.
    pictures: OnceLock<Pictures>,
    /// What the previous frame tells of the levels from 1 on, for a predicted frame of a sequence.
    guides: Option<Guides>,
}

/// What a previous frame tells of the levels from 1 on.
#[derive(Debug, Default)]
struct Guides {
    geometry: Vec<GeometryGuide>,
    colours: Vec<ColourGuide>,
}

impl<'a> EncoderInput<'a> {
    fn new(cloud: &'a ColouredVoxels, levels: RangeInclusive<u8>, options: &'a Options, log: &Log) -> Result<Self> {
        let (isa, top) = (options.isa.unwrap_or_else(Isa::detect), *levels.end());
        let may_move = options.geometry == GeometryTarget::Visual && top == cloud.voxels.depth();
        let subject = EncoderInput {
            cloud,
            options,
            isa,
            levels,
            octree: Octree::root(),
            maps: Vec::new(),
            geometry: Vec::new(),
            sparse: (may_move || options.has_head_maps()) && head_maps::is_sparse(cloud)?,
            grey: cloud.colours.par_iter().all(|[r, g, b]| r == g && g == b),
            points: cloud.voxels.len() as u64,
            pictures: OnceLock::new(),
            guides: None,
        };
        // What the format forbids is refused before anything is computed, as if of one voxel.
        Writer::new(Header {
            points: 1,
            ..subject.header(top, |_| 1)
        })?;
        let octree = octree_of(cloud, top, log)?;
        subject.with_octree(octree, top, log)
    }

    /// Codes the octree down to level `top`.
    fn with_octree(self, octree: Octree, top: u8, log: &Log) -> Result<Self> {
        let (isa, count) = (self.isa, octree.level(top).len());
        let maps = log.step("neighbours", count, "voxels", || Ok(sibling_maps(&octree)))?;
        let slice = self.options.slice_voxels as usize;
        let geometry = log.step("geometry", count, "voxels", || {
            let code = |level: u8| {
                let map = &maps[usize::from(level) - 1];
                let guide = self
                    .guides
                    .as_ref()
                    .map(|guides| guides.geometry[usize::from(level) - 1].guide());
                codec::encode_guided(isa, &octree, &map.table(), level, slice, guide)
            };
            Ok((1..=top).into_par_iter().map(code).collect())
        })?;
        Ok(EncoderInput {
            octree,
            maps,
            geometry,
            ..self
        })
    }

    /// The header of a stream whose last level is `top`.
    fn header(&self, top: u8, voxels: impl Fn(u8) -> usize) -> Header {
        let levels = *self.levels.start().min(&top)..=top;
        Header {
            optional_flags: 0,
            bits: self.cloud.voxels.depth(),
            base: *levels.start(),
            top,
            // At level N the points are its voxels, of which a shape may have others than the cloud.
            points: match top == self.cloud.voxels.depth() {
                true => voxels(top) as u64,
                false => self.points,
            },
            placement: self.cloud.placement,
            format: Format::Transform {
                colour_slice: self.options.colour_slice,
            },
            slice_voxels: self.options.slice_voxels,
            voxels: levels.map(|level| voxels(level) as u32).collect(),
            sections: Vec::new(),
        }
    }

    /// The colours that a stream whose last level is `top` approaches.
    fn truth(&self, top: u8, shape: Option<&Shape>, lossless: bool) -> Truth {
        let ColouredVoxels { voxels, colours, .. } = self.cloud;
        let octree = self.octree(shape);
        Truth::new(voxels, colours, octree, self.trunk_depth(top), top, lossless)
    }

    /// The octree of streams of this shape.
    fn octree<'b>(&'b self, shape: Option<&'b Shape>) -> &'b Octree {
        shape.map_or(&self.octree, |shape| &shape.octree)
    }

    /// The last level of the colour trunk of a stream whose last level is `top`.
    fn trunk_depth(&self, top: u8) -> u8 {
        let base = *self.levels.start().min(&top);
        colour::trunk_depth(base, |level| self.octree.level(level).len())
    }

    /// Codes the colours of the levels down to `top`.
    fn code(&self, top: u8, steps: Steps, shape: Option<Arc<Shape>>, log: &Log) -> Result<Coded> {
        let truth = log.step("mean colours", self.cloud.voxels.len(), "voxels", || {
            Ok(self.truth(top, shape.as_deref(), steps.is_lossless()))
        })?;
        let coded = self.code_towards(&truth, top, steps, shape, log)?;
        drop(truth);
        match self.is_refined(steps) {
            true => self.refined(coded, steps, self.options.rounds, log),
            false => Ok(coded),
        }
    }

    /// The same again, nearer to the cloud as it is drawn, with so many `rounds` of descent through pictures.
    fn refined(&self, coded: Coded, steps: Steps, rounds: usize, log: &Log) -> Result<Coded> {
        let (top, voxels) = (coded.top, coded.colours.len());
        let moves = log.step("compare what is drawn", voxels, "voxels", || self.moves(&coded))?;
        let shape = coded.shape;
        let truth = log.step("colours to draw", voxels, "voxels", || {
            Ok(self.moved_truth(top, shape.as_deref(), &moves))
        })?;
        let coded = self.code_towards(&truth, top, steps, shape, log)?;
        drop(truth);
        self.descended(coded, moves, steps, rounds, log)
    }

    /// The same, of colours that have been computed, without looking at what is drawn.
    fn code_towards(
        &self,
        truth: &Truth,
        top: u8,
        steps: Steps,
        shape: Option<Arc<Shape>>,
        log: &Log,
    ) -> Result<Coded> {
        let (octree, isa) = (self.octree(shape.as_deref()), self.isa);
        let finest_map = self.finest_map(top, shape.as_deref());
        let map_of = |level: u8| match level == top {
            true => finest_map.as_ref(),
            false => &self.maps[usize::from(level)],
        };
        let slice = self.options.colour_slice as usize;
        let base = *self.levels.start().min(&top);
        let trunk = self.trunk_depth(top);
        let count = octree.level(trunk).len();
        let name = format!("colours of levels 0 to {trunk}");
        let (payload, mut coloured) = log.step(name, count, "voxels", || {
            let maps = &self.maps[..=usize::from(trunk)];
            let coding = self.coding(steps, top, trunk);
            let guides = self.guides.iter().flat_map(|guides| &guides.colours);
            let guides: Vec<_> = guides.map(ColourGuide::guide).collect();
            Ok(colour::encode_trunk(isa, octree, maps, top, truth, coding, &guides))
        })?;
        let mut layers = Vec::new();
        let mut bytes = payload.len();
        let (mut colours, mut colours_above) = (Vec::new(), Vec::new());
        for level in trunk..=top {
            if level == top && level > trunk {
                colours_above = coloured.rgb();
            } else if level == top && level > 0 {
                colours_above = Decoder::colours_above(octree, level, &coloured.rgb());
            }
            let (map, mut slices) = (map_of(level), Vec::new());
            if level > trunk {
                let (above, count) = (map_of(level - 1), octree.level(level).len());
                let coding = self.coding(steps, top, level);
                let guides = self.guides.as_ref();
                let guide = guides.map(|guides| guides.colours[usize::from(level) - 1].guide());
                let name = format!("colours of level {level}");
                let (payloads, next) = log.step(name, count, "voxels", || {
                    Ok(colour::encode_level(
                        isa, octree, level, above, map, &coloured, truth, slice, coding, guide,
                    ))
                })?;
                coloured = next;
                slices = counted(above.len(), slice, payloads);
                bytes += slices.iter().map(|slice| slice.1.len()).sum::<usize>();
            }
            let most = match level == top {
                true => usize::MAX,
                false => (bytes + self.geometry_bytes(level, None)) / FILTER_SHARE,
            };
            let filter = match level >= base {
                true => self.filter(&coloured, map, level, truth, most, log)?,
                false => None,
            };
            if level == top {
                colours = match &filter {
                    Some(filter) => filter.rgb(isa, &coloured, map, coloured.steps()),
                    None => coloured.rgb(),
                };
            }
            layers.push(Layer {
                level,
                hash: colour_hash(&coloured),
                filter: filter.map(|filter| filter.to_bytes()),
                head_map: self.unseen_map(octree, level, map),
                slices,
            });
        }
        let mut coded = Coded {
            bytes: Vec::new(),
            top,
            shape,
            colours,
            colours_above,
            luma_step: coloured.steps().luma_step(),
            trunk: (trunk, payload),
            layers,
        };
        coded.bytes = self.written(&coded)?;
        Ok(coded)
    }

    /// The colour filter of a level, if there is one of at most `most` bytes that pays.
    fn filter(
        &self,
        coloured: &LevelColours,
        map: &SiblingMap,
        level: u8,
        truth: &Truth,
        most: usize,
        log: &Log,
    ) -> Result<Option<Filter>> {
        // Predicted frames inherit the filters of the frame before.
        if !self.options.filter || self.guides.is_some() {
            return Ok(None);
        }
        log.step(format!("filter of level {level}"), map.len(), "voxels", || {
            let filter = Filter::fit(self.isa, coloured, map, truth.level(level));
            Ok(filter.filter(|filter| filter.to_bytes().len() <= most))
        })
    }
}

/// The maps of all levels.
fn sibling_maps(octree: &Octree) -> Vec<SiblingMap> {
    let mut maps = vec![SiblingMap::root()];
    for level in 0..octree.depth() {
        let next = octree.child_siblings(level, &maps[maps.len() - 1]);
        maps.push(next);
    }
    maps
}

/// The octree of a cloud down to level `top`.
fn octree_of(cloud: &ColouredVoxels, top: u8, log: &Log) -> Result<Octree> {
    let shift = 3 * (cloud.voxels.depth() - top);
    let mut keys: Vec<u64> = cloud.voxels.keys().iter().map(|key| key >> shift).collect();
    keys.dedup();
    let count = keys.len();
    log.step("octree", count, "voxels", || {
        Octree::new(Voxels::from_sorted(top, keys))
    })
}
