//! Streams of version 3: colours as transform coefficients.

mod choice;
mod descent;
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

use std::ops::RangeInclusive;
use std::sync::{Arc, OnceLock};

use b2p_kernels::Isa;
use rayon::prelude::*;

use super::{Encoded, rates};
use crate::cloud::ColouredVoxels;
use crate::colour::{self, Filter, Steps, Truth};
use crate::container::{Format, Header, Writer};
use crate::decoder::{Decoder, colour_hash};
use crate::error::{Error, Result};
use crate::geometry::{Octree, SiblingMap, Voxels, codec};
use crate::limits::Limits;
use crate::log::Log;
use crate::motion::{ColourGuide, GeometryGuide};
use descent::Pictures;
pub(crate) use memory::memory_of;
pub use memory::{encode_memory, surface_within};
pub use options::{Options, Tune};
pub use predicted::{PredictedFrame, encode_predicted};
pub use quality::QualityTarget;

pub use rate_control::encode_to_rate;
use reference::Reference;
pub use shape::GeometryTarget;
use shape::Shape;

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

/// A stream that has not been checked yet.
struct Coded {
    bytes: Vec<u8>,
    top: u8,
    /// Its geometry, unless that is exact.
    shape: Option<Arc<Shape>>,
    /// The colours of the finest level, filtered.
    colours: Vec<[u8; 3]>,
    /// Those of the level above before its filter, as heads read them.
    colours_above: Vec<[u8; 3]>,
    /// The step of luma that heads go by, in 255ths.
    luma_step: f32,
    /// Last level and payload of the colour trunk.
    trunk: (u8, Vec<u8>),
    layers: Vec<Layer>,
}

/// The colours of a level in a stream.
struct Layer {
    level: u8,
    hash: u64,
    filter: Option<Vec<u8>>,
    head_map: Option<Vec<u8>>,
    slices: Vec<(u32, Vec<u8>)>,
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
            true => self.refined(coded, steps, log),
            false => Ok(coded),
        }
    }

    /// The same again, nearer to the cloud as it is drawn.
    fn refined(&self, coded: Coded, steps: Steps, log: &Log) -> Result<Coded> {
        let (top, voxels) = (coded.top, coded.colours.len());
        let moves = log.step("compare what is drawn", voxels, "voxels", || self.moves(&coded))?;
        let shape = coded.shape;
        let truth = log.step("colours to draw", voxels, "voxels", || {
            Ok(self.moved_truth(top, shape.as_deref(), &moves))
        })?;
        let coded = self.code_towards(&truth, top, steps, shape, log)?;
        drop(truth);
        self.descended(coded, moves, steps, log)
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
        let mut colours = Vec::new();
        let mut colours_above = Vec::new();
        for level in trunk..=top {
            let count = octree.level(level).len();
            let mut slices = Vec::new();
            if level == top && level > trunk {
                colours_above = coloured.rgb();
            } else if level == top && level > 0 {
                colours_above = Decoder::colours_above(octree, level, &coloured.rgb());
            }
            if level > trunk {
                let (above, map) = (map_of(level - 1), map_of(level));
                let coding = self.coding(steps, top, level);
                let guide = self
                    .guides
                    .as_ref()
                    .map(|guides| guides.colours[usize::from(level) - 1].guide());
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
            let mut filter = None;
            // Predicted frames inherit the filters of the frame before.
            if level >= base && self.options.filter && self.guides.is_none() {
                let name = format!("filter of level {level}");
                let most = match level == top {
                    true => usize::MAX,
                    false => (bytes + self.geometry_bytes(level, None)) / FILTER_SHARE,
                };
                filter = log.step(name, count, "voxels", || {
                    let map = map_of(level);
                    let filter = Filter::fit(isa, &coloured, map, truth.level(level));
                    Ok(filter.filter(|filter| filter.to_bytes().len() <= most))
                })?;
            }
            if level == top {
                colours = match &filter {
                    Some(filter) => filter.rgb(isa, &coloured, map_of(level), coloured.steps()),
                    None => coloured.rgb(),
                };
            }
            layers.push(Layer {
                level,
                hash: colour_hash(&coloured),
                filter: filter.map(|filter| filter.to_bytes()),
                head_map: self.closing_map(octree, level, map_of(level)),
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

    /// Bytes of the geometry of the levels 1 to `level`, which may have a shape.
    fn geometry_bytes(&self, level: u8, shape: Option<&Shape>) -> usize {
        let exact = usize::from(level) - usize::from(shape.is_some());
        let last = shape.into_iter().flat_map(|shape| &shape.geometry);
        let levels = self.geometry[..exact].iter().flatten();
        levels.chain(last).map(|(_, bytes)| bytes.len()).sum()
    }

    /// The stream of what was coded.
    fn written(&self, coded: &Coded) -> Result<Vec<u8>> {
        let header = self.header(coded.top, |level| {
            self.octree(coded.shape.as_deref()).level(level).len()
        });
        let base = header.base;
        let mut writer = Writer::new(header)?;
        self.write(&mut writer, base, coded)?;
        writer.finish()
    }

    /// Writes the sections of all levels.
    fn write(&self, writer: &mut Writer, base: u8, coded: &Coded) -> Result<()> {
        let Coded {
            trunk, layers, shape, ..
        } = coded;
        let (trunk, payload) = (trunk.0, &trunk.1);
        let slice = self.options.slice_voxels as usize;
        let voxels = |level: usize| self.octree.level(level as u8).len();
        // Levels of one slice each.
        let small = (1..=usize::from(base)).take_while(|level| voxels(level - 1) <= slice);
        let small = small.count();
        let geometry = |level: u8| match shape {
            Some(shape) if level == coded.top => &shape.geometry,
            _ => &self.geometry[usize::from(level) - 1],
        };
        let levels = (1..=small).flat_map(|level| geometry(level as u8));
        let levels: Vec<_> = levels.map(|(count, bytes)| (*count, bytes)).collect();
        writer.geometry_trunk(&levels)?;
        let rest = small + 1..=usize::from(base);
        for level in rest {
            writer.geometry(level as u8, geometry(level as u8))?;
        }
        for layer in layers {
            let level = layer.level;
            if level > base {
                writer.geometry(level, geometry(level))?;
            }
            if level == trunk {
                let hash = layers[usize::from(base - trunk)].hash;
                writer.colour_trunk(level, voxels(level.into()) as u32, hash, payload)?;
            } else {
                let hash = (level > base).then_some(layer.hash);
                writer.colours(level, hash, &layer.slices)?;
            }
            if let Some(filter) = &layer.filter {
                writer.post_filter(level, filter)?;
            }
            if let Some(map) = &layer.head_map {
                writer.head_map(level, map)?;
            }
        }
        Ok(())
    }

    /// The stream, once it has been decoded to what was encoded; if asked for with head maps, if the stream has
    /// at most `most` bytes with them.
    fn checked(&self, mut coded: Coded, head_maps: bool, most: usize, log: &Log) -> Result<Encoded> {
        let top = coded.top;
        let shape = coded.shape.clone();
        let octree = self.octree(shape.as_deref());
        let voxels = octree.level(top);
        let decoder = Decoder::new().with_isa(self.isa).with_limits(Limits::unlimited());
        let mut decoding = decoder.with_level(top).start();
        decoding.push(&coded.bytes);
        let wanted = head_maps && self.has_head_maps(top);
        let (mut reference, mut finest) = (None, None);
        if let Some(heads) = self.options.heads.as_ref().filter(|_| wanted) {
            decoding.set_heads_model(heads.clone());
            let levels = *self.levels.start().min(&top)..=top;
            let (count, depth) = (self.cloud.voxels.len(), self.cloud.voxels.depth());
            reference = Some(log.step("draw the cloud", count, "voxels", || {
                let levels = levels.filter(|level| self.has_head_map(*level) && *level < depth);
                Reference::new(self.isa, self.cloud, self.sparse, levels)
            })?);
            if top == depth && !self.sparse {
                finest = log.step("draw the cloud with heads", count, "voxels", || {
                    surfel_size::pictures(self.isa, self.cloud, heads)
                })?;
            }
        }
        let mut maps = Vec::new();
        let same = log.step("decode again", voxels.len(), "voxels", || {
            while let Some(level) = decoding.advance()? {
                let Some(reference) = reference.as_ref().filter(|_| self.has_head_map(level)) else {
                    continue;
                };
                let pictures = match level == self.cloud.voxels.depth() {
                    true => finest.as_deref().unwrap_or_default(),
                    false => reference.pictures(level),
                };
                if pictures.is_empty() {
                    continue;
                }
                let map = match self.maps_blocks(level) {
                    true => head_maps::of_level(octree, reference, &mut decoding, level)?,
                    false => surfel_size::of_level(self.isa, octree, pictures, &mut decoding, level)?,
                };
                maps.push((level, map));
            }
            let points = decoding.points();
            Ok(points.is_some_and(|points| points.voxels == voxels && points.colours == coded.colours))
        })?;
        if !same {
            return Err(Error::Usage(
                "the stream does not decode to what was encoded: this machine computes wrongly".into(),
            ));
        }
        for (level, map) in maps {
            let layer = coded.layers.iter_mut().find(|layer| layer.level == level);
            layer
                .into_iter()
                .for_each(|layer| layer.head_map = Some(map.to_bytes()));
        }
        let mapped = self.written(&coded)?;
        if mapped.len() <= most {
            coded.bytes = mapped;
        }
        let bytes = coded.bytes;
        let rates = rates(&Header::parse(&bytes, &Limits::unlimited())?);
        Ok(Encoded { bytes, rates })
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

/// Payloads with the numbers of their parents.
fn counted(parents: usize, slice: usize, payloads: Vec<Vec<u8>>) -> Vec<(u32, Vec<u8>)> {
    let count = |i: usize| (parents - i * slice).min(slice) as u32;
    let payloads = payloads.into_iter().enumerate();
    payloads.map(|(i, bytes)| (count(i), bytes)).collect()
}
