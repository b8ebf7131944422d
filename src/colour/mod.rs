//! Colours of voxels as integer transform coefficients over the octree (`docs/format.md`, clause 5).
//!
//! A level's colours are coded given the octree and the colours of the level above. The colour of a node is the mean of
//! its children's colours, by their `weights`. The differences between the children are
//!
//! 1. transformed by two-point butterflies (`transform`),
//! 2. predicted from neighbouring colours (`prediction`),
//! 3. quantised with a step per channel (`space`), and
//! 4. coded with a binary range coder, whose probabilities mix several adaptive contexts (`model`, `node`, `block`).
//!
//! No model file is needed. All arithmetic is on integers, so decoded colours are bit-exact on every machine.
//!
//! # Structure
//! The levels 1 to K are the *trunk* and share one entropy stream. K is the deepest level of at most
//! [`TRUNK_VOXELS`] voxels ([`trunk_depth`]), and at most the base level of the stream. Every deeper level is cut into
//! slices of nodes of the level above, each with an entropy stream of its own. All slices of a level start from the
//! adaptive model with which the first slice of the level above (or the trunk) ended. Their predictions use only those
//! coded children that belong to the same slice. So the slices of a level are coded in parallel.

mod block;
#[cfg(feature = "encoder")]
mod encode;
mod energy;
mod filter;
#[cfg(feature = "encoder")]
mod importance;
mod model;
mod node;
mod prediction;
mod space;
mod transform;
mod weights;

pub use block::Guide;
#[cfg(feature = "encoder")]
pub use encode::{Options, Truth, encode_level, encode_trunk};
pub use filter::Filter;
#[cfg(feature = "encoder")]
pub use importance::Importance;
#[cfg(feature = "encoder")]
pub(crate) use space::from_rgb;
pub use space::{Steps, Ycc};

use std::ops::Range;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use crate::cancel::Cancel;
use crate::coding::binary::Decoder;
use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use crate::geometry::{Octree, SiblingMap};
use block::{Coding, Nodes};
use energy::spread_energies;
use model::{CoefficientContext, Model};
use node::{CoefficientCoder, Quantiser};
use weights::Weights;

/// Maximum number of voxels of the trunk's deepest level.
pub const TRUNK_VOXELS: usize = 16_384;
/// Bytes of a slice before its entropy stream: step indices of luma and chroma, gain.
const SLICE_HEADER: usize = 3;
/// Bytes of the trunk before its entropy stream: those of a slice, then the root's colour and the last level.
const TRUNK_HEADER: usize = SLICE_HEADER + 6;

/// Decoded colours of a level, with the coder state that the next level needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LevelColours {
    steps: Steps,
    /// The last level of the stream, as it was coded: that of a cut one may be coarser.
    last: u8,
    values: Vec<Ycc>,
    /// Of each voxel and channel, the local coefficient energy around its parent: 16 times the mean magnitude.
    energies: Vec<[u8; 3]>,
    /// The adaptive model at the end of the first slice.
    model: Model,
}

impl LevelColours {
    /// Y, Co and Cg of every voxel in Morton order, in units of 1/64 of a 255th, or of one 255th if the steps are
    /// lossless.
    pub fn values(&self) -> &[Ycc] {
        &self.values
    }

    /// The quantisation steps of the level: those of its first slice.
    pub fn steps(&self) -> Steps {
        self.steps
    }

    /// Red, green and blue of every voxel, rounded to the nearest integer.
    pub fn rgb(&self) -> Vec<[u8; 3]> {
        let fraction = self.steps.fraction();
        self.values
            .par_iter()
            .map(|ycc| space::display(*ycc, fraction))
            .collect()
    }

    /// Bytes of memory per voxel, without the adaptive model.
    pub const fn bytes_per_voxel() -> usize {
        size_of::<Ycc>() + size_of::<[u8; 3]>()
    }

    /// Bytes of memory of the adaptive model.
    pub const fn model_bytes() -> usize {
        Model::BYTES
    }
}

/// K, the depth of the trunk, in a stream with the base level `base`. `voxels` returns the number of voxels of a level.
pub fn trunk_depth(base: u8, voxels: impl Fn(u8) -> usize) -> u8 {
    let fits = |level: &u8| voxels(*level) <= TRUNK_VOXELS;
    (0..=base).rev().find(fits).unwrap_or(0)
}

/// Ranges of nodes that the slices cover, of at most `slice` nodes each.
fn slices(nodes: usize, slice: usize) -> impl ExactSizeIterator<Item = Range<usize>> {
    (0..nodes.div_ceil(slice)).map(move |i| i * slice..nodes.min((i + 1) * slice))
}

/// Decodes the trunk: the root and the levels 1 to K. `maps` are the maps of the levels 0 to K.
///
/// # Errors
/// [`Error::Truncated`] or [`Error::Malformed`] if the payload is invalid.
///
/// # Panics
/// If the octree has fewer than K levels.
pub fn decode_trunk(isa: Isa, octree: &Octree, maps: &[SiblingMap], payload: &Slice) -> Result<LevelColours> {
    decode_guided_trunk(isa, octree, maps, payload, &[], &mut |_, _| {})
}

/// [`decode_trunk`] with what a previous frame tells of the levels from 1 on, if there are guides. `each` gets the
/// levels before K, and their colours.
///
/// # Errors
/// Those of [`decode_trunk`].
///
/// # Panics
/// As [`decode_trunk`]; if there are guides, but not of every level.
pub fn decode_guided_trunk(
    isa: Isa,
    octree: &Octree,
    maps: &[SiblingMap],
    payload: &Slice,
    guides: &[Guide<'_>],
    each: &mut dyn FnMut(u8, &LevelColours),
) -> Result<LevelColours> {
    let depth = maps.len() - 1;
    let (coding, rest) = read_coding(payload, TRUNK_HEADER)?;
    let number = |at: usize| i16::from_le_bytes([payload.bytes[at], payload.bytes[at + 1]]);
    let root = [payload.bytes[3].into(), number(4), number(6)];
    if root[1..].iter().any(|x| !(-255..=255).contains(x)) {
        let at = format!("byte {}", payload.offset + 4);
        return Err(Error::malformed(
            Stage::Colour,
            at,
            "chroma of the root",
            format!("{:?}", &root[1..]),
            "−255 to 255",
        )
        .breaks("5.3.2"));
    }
    let last = payload.bytes[8];
    let mut coder = EntropyDecoder(Decoder::new(rest));
    let colours = trunk(
        isa,
        octree,
        maps,
        last,
        coding,
        root,
        &mut coder,
        |_| None,
        guides,
        each,
    );
    coder
        .0
        .finish(&format!("byte {}, colours of levels 1 to {depth}", payload.offset))?;
    Ok(colours)
}

/// Codes the levels 1 to K in turn, from a root of this colour. `coding` is that of level K, `last` the stream's last
/// level. `truth` returns the original colours of a level to an encoder, and `None` to a decoder. `guides` are those of
/// the levels from 1 on, if there are any; `each` gets the levels before K.
fn trunk<'t, S: CoefficientCoder>(
    isa: Isa,
    octree: &Octree,
    maps: &[SiblingMap],
    last: u8,
    coding: Coding,
    root: [i16; 3],
    coder: &mut S,
    truth: impl Fn(u8) -> Option<&'t [Ycc]>,
    guides: &[Guide<'_>],
    each: &mut dyn FnMut(u8, &LevelColours),
) -> LevelColours {
    let depth = maps.len() - 1;
    let mut colours = root_colours(coding.steps, last, root);
    let weights = weights::of_trunk(octree, maps, last);
    for level in 1..=depth {
        each(level as u8 - 1, &colours);
        let coding = coding_above(coding, depth - level);
        let mut model = std::mem::replace(&mut colours.model, Model::empty());
        let weights = Weights::Given(&weights[level]);
        let mut nodes = nodes(octree, level as u8, &maps[level - 1], &maps[level], weights, &colours);
        nodes.guide = guides.get(level - 1).copied();
        let coded = isa.run(CodeSlice {
            coder,
            model: &mut model,
            nodes,
            range: 0..nodes.masks.len(),
            coding,
            truth: truth(level as u8),
        });
        let energies = spread_energies(isa, nodes, &coded.energies);
        colours = LevelColours {
            steps: coding.steps,
            last,
            values: coded.values,
            energies,
            model,
        };
    }
    colours
}

/// Decodes the colours of `level` from those of the level above and one payload for every `slice` nodes. `above_map` is
/// the 3³ kernel map of the level above, `map` that of `level`, `guide` what a previous frame tells of the level.
///
/// # Errors
/// [`Error::Truncated`] or [`Error::Malformed`] if a payload is invalid, and [`Error::Cancelled`].
///
/// # Panics
/// If the maps or colours belong to another level, or `slice` is 0.
#[allow(clippy::too_many_arguments)]
pub fn decode_level(
    isa: Isa,
    octree: &Octree,
    level: u8,
    above_map: &SiblingMap,
    map: &SiblingMap,
    above: &LevelColours,
    payloads: &[Slice],
    slice: usize,
    guide: Option<Guide<'_>>,
    cancel: &Cancel,
) -> Result<LevelColours> {
    let weights = Weights::below_trunk(level, above.last);
    let mut nodes = nodes(octree, level, above_map, map, weights, above);
    nodes.guide = guide;
    let ranges = slices(nodes.masks.len(), slice);
    if payloads.len() != ranges.len() {
        let at = format!("level {level}");
        return Err(Error::malformed(
            Stage::Colour,
            at,
            "number of colour slices",
            payloads.len(),
            ranges.len(),
        )
        .breaks("3.3.2"));
    }
    let decode = |(range, payload): (Range<usize>, &Slice)| {
        cancel.check()?;
        let first = range.start == 0;
        let (coding, rest) = read_coding(payload, SLICE_HEADER)?;
        if coding.steps.is_lossless() != above.steps.is_lossless() {
            let at = format!("byte {}, level {level}", payload.offset);
            let expected = if above.steps.is_lossless() {
                "lossless, as in the level above"
            } else {
                "lossy, as in the level above"
            };
            return Err(
                Error::malformed(Stage::Colour, at, "steps", format!("{:?}", coding.steps), expected).breaks("5.1.3"),
            );
        }
        let (mut coder, mut model) = (EntropyDecoder(Decoder::new(rest)), above.model.clone());
        let coded = isa.run(CodeSlice {
            coder: &mut coder,
            model: &mut model,
            nodes,
            range,
            coding,
            truth: None,
        });
        coder
            .0
            .finish(&format!("byte {}, colours of level {level}", payload.offset))?;
        // No slice of the next level starts from the models of the other slices.
        let model = if first { model } else { Model::empty() };
        Ok((coding.steps, coded, model))
    };
    let tasks: Vec<_> = ranges.zip(payloads).collect();
    // Collect all results first: the error returned is that of the first faulty slice, with any number of threads.
    let coded: Vec<Result<_>> = tasks.into_par_iter().map(decode).collect();
    Ok(join(isa, nodes, above.last, coded.into_iter().collect::<Result<_>>()?))
}

/// Concatenates the slices of a level, in a stream with this last level.
fn join(isa: Isa, nodes: Nodes<'_>, last: u8, slices: Vec<(Steps, block::CodedSlice, Model)>) -> LevelColours {
    let children = slices.iter().map(|(_, coded, _)| coded.values.len()).sum();
    let mut values = Vec::with_capacity(children);
    let mut energies = Vec::with_capacity(nodes.masks.len());
    let mut first = None;
    for (steps, coded, model) in slices {
        values.extend(coded.values);
        energies.extend(coded.energies);
        first.get_or_insert((steps, model));
    }
    // A level has at least one node, hence at least one slice.
    let (steps, model) = first.unwrap_or_else(|| (Steps::LOSSLESS, Model::empty()));
    let energies = spread_energies(isa, nodes, &energies);
    LevelColours {
        steps,
        last,
        values,
        energies,
        model,
    }
}

/// The colours of level 0, with the initial model.
fn root_colours(steps: Steps, last: u8, root: [i16; 3]) -> LevelColours {
    let fraction = steps.fraction();
    LevelColours {
        steps,
        last,
        values: vec![root.map(|x| space::clamp(i32::from(x) << fraction, fraction))],
        energies: vec![[0; 3]],
        model: Model::new(),
    }
}

/// The coding parameters of the level `up` levels above.
fn coding_above(coding: Coding, up: usize) -> Coding {
    let steps = (0..up).fold(coding.steps, |steps, _| steps.above());
    Coding { steps, ..coding }
}

/// The nodes of level `level − 1`, whose children are coded. `map` is theirs, `children` that of `level`, of
/// which the weights are.
fn nodes<'a>(
    octree: &'a Octree,
    level: u8,
    map: &'a SiblingMap,
    children: &'a SiblingMap,
    weights: Weights<'a>,
    above: &'a LevelColours,
) -> Nodes<'a> {
    let masks = octree.occupancy(level - 1);
    assert_eq!(
        (map.len(), above.values.len()),
        (masks.len(), masks.len()),
        "the map and the colours must be those of the level above"
    );
    assert_eq!(
        children.len(),
        octree.level(level).len(),
        "the map must be that of the level"
    );
    Nodes {
        map,
        children,
        weights,
        height: usize::from(above.last.saturating_sub(level)).min(3),
        masks,
        first_child: octree.first_child(level - 1),
        values: &above.values,
        energies: &above.energies,
        guide: None,
    }
}

/// Parses the `header` bytes before the entropy stream. Returns the coding parameters and the entropy stream.
fn read_coding<'a>(payload: &Slice<'a>, header: usize) -> Result<(Coding, &'a [u8])> {
    if payload.bytes.len() < header {
        return Err(Error::Truncated {
            stage: Stage::Colour,
            offset: (payload.offset + payload.bytes.len()) as u64,
            field: "steps of colours",
            needed: (header - payload.bytes.len()) as u64,
        });
    }
    let (head, rest) = payload.bytes.split_at(header);
    let steps = Steps {
        luma: head[0],
        chroma: head[1],
    };
    if !steps.is_valid() {
        let at = format!("byte {}", payload.offset);
        let expected = "luma 0 to 87 and chroma 0 to 87 or 254, or both 255";
        return Err(Error::malformed(Stage::Colour, at, "steps", format!("{steps:?}"), expected).breaks("5.2.1"));
    }
    Ok((Coding { steps, gain: head[2] }, rest))
}

/// Decodes coefficients from an entropy stream.
struct EntropyDecoder<'a>(Decoder<'a>);

impl CoefficientCoder for EntropyDecoder<'_> {
    #[inline(always)]
    fn coefficient<I: Instructions>(
        &mut self,
        simd: I,
        model: &mut Model,
        c: &CoefficientContext,
        _: i32,
        _: Quantiser,
    ) -> i32 {
        model.code(simd, &mut self.0, c, 0)
    }
}

/// Encodes or decodes a slice.
struct CodeSlice<'a, S> {
    coder: &'a mut S,
    model: &'a mut Model,
    nodes: Nodes<'a>,
    range: Range<usize>,
    coding: Coding,
    truth: Option<&'a [Ycc]>,
}

impl<S: CoefficientCoder> Work for CodeSlice<'_, S> {
    type Output = block::CodedSlice;

    #[inline(always)]
    fn run<I: Instructions>(self, simd: I) -> block::CodedSlice {
        let CodeSlice {
            coder,
            model,
            nodes,
            range,
            coding,
            truth,
        } = self;
        block::code(simd, coder, model, nodes, range, coding, truth)
    }
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
