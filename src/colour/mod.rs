//! Colours of voxels as integer transform coefficients over the octree.
//!
//! A level's colours are coded given those of the level above and the octree: every node's colour is the mean of its children's, and what the children
//! differ by is transformed by butterflies (`transform`), less what neighbouring colours predict (`prediction`), quantised to a step (`space`), and coded
//! under probabilities that mix what the slice has shown in several contexts (`model`, `block`). No model file is needed, and all is integer arithmetic: decoded
//! colours are the same on every machine.
//!
//! # Structure
//! The levels 1 to K, the *trunk*, share one entropy stream, in turn; K is the deepest level of at most [`TRUNK_VOXELS`] voxels ([`trunk_depth`]), but at most the
//! stream's first level. Every deeper level is cut into slices of nodes of the level above, each an entropy stream of its own: all slices of a level begin with what the
//! first slice of the level above (or the trunk) had learned in the end, and see only coded children of their own slice. So they are coded in parallel.
//!
//! # Payloads
//! A slice is: u8 index of luma's step, u8 index of chroma's ([`Steps`]), u8 gain of predictions in 256ths, then the range coder's words (`crate::coding`).
//! The trunk's steps are those of level K; the level above has [half of them](Steps), and so on. After its gain follow the root's colour, u8 Y, i16 Co, i16 Cg.

mod block;
#[cfg(feature = "encoder")]
mod encode;
mod filter;
mod model;
mod prediction;
mod space;
mod transform;

#[cfg(feature = "encoder")]
pub use encode::{Options, Truth, encode_level, encode_trunk};
pub use filter::Filter;
pub use space::{Steps, Ycc};

use std::ops::Range;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use crate::cancel::Cancel;
use crate::coding::binary::Decoder;
use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use crate::geometry::{KernelMap, Octree};
use block::{Coding, Nodes, Quantiser, Source};
use model::{Circumstances, Model};

/// The most voxels of the trunk's deepest level.
pub const TRUNK_VOXELS: usize = 16_384;
/// Bytes of a slice before its entropy stream, and of the trunk.
const SLICE_FIXED: usize = 3;
const TRUNK_FIXED: usize = SLICE_FIXED + 5;

/// The decoded colours of a level, and what coding them has taught.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Coloured {
    steps: Steps,
    values: Vec<Ycc>,
    /// How large coefficients were around the parent of each voxel.
    energies: Vec<[u8; 3]>,
    /// What the first slice has learned.
    model: Model,
}

impl Coloured {
    /// Y, Co and Cg of every voxel, in Morton order, in units of 2^−6 of a 255th; whole 255ths if the steps are lossless.
    pub fn values(&self) -> &[Ycc] {
        &self.values
    }

    /// The steps of the level (of its first slice).
    pub fn steps(&self) -> Steps {
        self.steps
    }

    /// Display colours, rounded to the nearest.
    pub fn rgb(&self) -> Vec<[u8; 3]> {
        let fraction = self.steps.fraction();
        self.values
            .par_iter()
            .map(|ycc| space::display(*ycc, fraction))
            .collect()
    }

    /// Bytes of memory that a level of so many voxels takes, but for what is learned.
    pub const fn bytes_per_voxel() -> usize {
        size_of::<Ycc>() + size_of::<[u8; 3]>()
    }

    /// Bytes of what a slice learns.
    pub const fn learned_bytes() -> usize {
        Model::BYTES
    }
}

/// K: how deep the trunk of a stream is whose first level is `base`; `voxels` tells how many a level has.
pub fn trunk_depth(base: u8, voxels: impl Fn(u8) -> usize) -> u8 {
    let fits = |level: &u8| voxels(*level) <= TRUNK_VOXELS;
    (0..=base).rev().find(fits).unwrap_or(0)
}

/// The ranges of nodes that slices of at most `slice` nodes cover.
fn slices(nodes: usize, slice: usize) -> impl ExactSizeIterator<Item = Range<usize>> {
    (0..nodes.div_ceil(slice)).map(move |i| i * slice..nodes.min((i + 1) * slice))
}

/// Decodes the trunk: the root and the levels 1 to K, whose kernel maps are `maps`, from that of level 0 on.
///
/// # Errors
/// [`Error::Truncated`] or [`Error::Malformed`] if the payload is none.
///
/// # Panics
/// If the octree is not as deep as there are maps.
pub fn decode_trunk(isa: Isa, octree: &Octree, maps: &[KernelMap], payload: &Slice) -> Result<Coloured> {
    let depth = maps.len() - 1;
    let (coding, rest) = read_coding(payload, TRUNK_FIXED)?;
    let number = |at: usize| i16::from_le_bytes([payload.bytes[at], payload.bytes[at + 1]]);
    let root = [payload.bytes[3].into(), number(4), number(6)];
    if root[1..].iter().any(|x| !(-255..=255).contains(x)) {
        let at = format!("byte {}", payload.offset + 4);
        return Err(Error::malformed(
            Stage::Colour,
            at,
            "root's chroma",
            format!("{:?}", &root[1..]),
            "−255 to 255",
        ));
    }
    let mut source = Reading(Decoder::new(rest));
    let coloured = trunk(isa, octree, maps, coding, root, &mut source, |_| None);
    source
        .0
        .finish(&format!("byte {}, colours of levels 1 to {depth}", payload.offset))?;
    Ok(coloured)
}

/// Codes the levels 1 to K in turn, from a root of this colour; `coding` is that of level K, `truth` gives an encoder a level's colours.
fn trunk<'t, S: Source>(
    isa: Isa,
    octree: &Octree,
    maps: &[KernelMap],
    coding: Coding,
    root: [i16; 3],
    source: &mut S,
    truth: impl Fn(u8) -> Option<&'t [Ycc]>,
) -> Coloured {
    let depth = maps.len() - 1;
    let mut coloured = start(coding.steps, root);
    for level in 1..=depth {
        let coding = coding_above(coding, depth - level);
        let mut model = std::mem::replace(&mut coloured.model, Model::empty());
        let [above, map] = [&maps[level - 1], &maps[level]];
        let nodes = nodes(octree, level as u8, above, map, &coloured);
        let coded = isa.run(Pass {
            source,
            model: &mut model,
            nodes,
            range: 0..nodes.masks.len(),
            coding,
            truth: truth(level as u8),
        });
        let energies = spread_energies(nodes, &coded.energies);
        coloured = Coloured {
            steps: coding.steps,
            values: coded.values,
            energies,
            model,
        };
    }
    coloured
}

/// Decodes the colours of `level` from those of the level above and one payload for every `slice` nodes. `above_map` and `map` are the 3³ kernel
/// maps of the level above and of `level`.
///
/// # Errors
/// [`Error::Truncated`] or [`Error::Malformed`] if a payload is none, and [`Error::Cancelled`].
///
/// # Panics
/// If the maps or colours are another level's, or `slice` is 0.
#[allow(clippy::too_many_arguments)]
pub fn decode_level(
    isa: Isa,
    octree: &Octree,
    level: u8,
    above_map: &KernelMap,
    map: &KernelMap,
    above: &Coloured,
    payloads: &[Slice],
    slice: usize,
    cancel: &Cancel,
) -> Result<Coloured> {
    let nodes = nodes(octree, level, above_map, map, above);
    let ranges = slices(nodes.masks.len(), slice);
    if payloads.len() != ranges.len() {
        let at = format!("level {level}");
        return Err(Error::malformed(
            Stage::Colour,
            at,
            "number of colour slices",
            payloads.len(),
            ranges.len(),
        ));
    }
    let decode = |(range, payload): (Range<usize>, &Slice)| {
        cancel.check()?;
        let first = range.start == 0;
        let (coding, rest) = read_coding(payload, SLICE_FIXED)?;
        if coding.steps.is_lossless() != above.steps.is_lossless() {
            let at = format!("byte {}, level {level}", payload.offset);
            let expected = if above.steps.is_lossless() {
                "exact, as above"
            } else {
                "not exact, as above"
            };
            return Err(Error::malformed(
                Stage::Colour,
                at,
                "steps",
                format!("{:?}", coding.steps),
                expected,
            ));
        }
        let (mut source, mut model) = (Reading(Decoder::new(rest)), above.model.clone());
        let coded = isa.run(Pass {
            source: &mut source,
            model: &mut model,
            nodes,
            range,
            coding,
            truth: None,
        });
        source
            .0
            .finish(&format!("byte {}, colours of level {level}", payload.offset))?;
        // Nothing begins with what the others have learned.
        let model = if first { model } else { Model::empty() };
        Ok((coding.steps, coded, model))
    };
    let tasks: Vec<_> = ranges.zip(payloads).collect();
    // All of them, so that the error is that of the first slice that has one.
    let coded: Vec<Result<_>> = tasks.into_par_iter().map(decode).collect();
    Ok(join(nodes, coded.into_iter().collect::<Result<_>>()?))
}

/// Puts the slices of a level together.
fn join(nodes: Nodes<'_>, slices: Vec<(Steps, block::Coded, Model)>) -> Coloured {
    let (mut values, mut energies) = (Vec::new(), Vec::new());
    let mut first = None;
    for (steps, coded, model) in slices {
        values.extend(coded.values);
        energies.extend(coded.energies);
        first.get_or_insert((steps, model));
    }
    // A level has at least one node, and so a slice.
    let (steps, model) = first.unwrap_or_else(|| (Steps::LOSSLESS, Model::empty()));
    let energies = spread_energies(nodes, &energies);
    Coloured {
        steps,
        values,
        energies,
        model,
    }
}

/// What is known of a root of this colour.
fn start(steps: Steps, root: [i16; 3]) -> Coloured {
    let fraction = steps.fraction();
    Coloured {
        steps,
        values: vec![root.map(|x| space::clamp(i32::from(x) << fraction, fraction))],
        energies: vec![[0; 3]],
        model: Model::new(),
    }
}

/// The coding of the level that is `up` levels above.
fn coding_above(coding: Coding, up: usize) -> Coding {
    let steps = (0..up).fold(coding.steps, |steps, _| steps.above());
    Coding { steps, ..coding }
}

fn nodes<'a>(
    octree: &'a Octree,
    level: u8,
    map: &'a KernelMap,
    children: &'a KernelMap,
    above: &'a Coloured,
) -> Nodes<'a> {
    let masks = octree.occupancy(level - 1);
    assert_eq!(
        (map.len(), above.values.len()),
        (masks.len(), masks.len()),
        "maps and colours of the level above"
    );
    assert_eq!(children.len(), octree.level(level).len(), "the map of the level");
    Nodes {
        map,
        children,
        masks,
        first_child: octree.first_child(level - 1),
        values: &above.values,
        energies: &above.energies,
    }
}

/// The first bytes of a payload, of which `fixed` must be there, and what follows these.
fn read_coding<'a>(payload: &Slice<'a>, fixed: usize) -> Result<(Coding, &'a [u8])> {
    if payload.bytes.len() < fixed {
        return Err(Error::Truncated {
            stage: Stage::Colour,
            offset: (payload.offset + payload.bytes.len()) as u64,
            field: "steps of colours",
            needed: (fixed - payload.bytes.len()) as u64,
        });
    }
    let (head, rest) = payload.bytes.split_at(fixed);
    let steps = Steps {
        luma: head[0],
        chroma: head[1],
    };
    if !steps.is_valid() {
        let at = format!("byte {}", payload.offset);
        let expected = "luma 0 to 87 and chroma 0 to 87 or 254, or both 255";
        return Err(Error::malformed(
            Stage::Colour,
            at,
            "steps",
            format!("{steps:?}"),
            expected,
        ));
    }
    Ok((Coding { steps, gain: head[2] }, rest))
}

/// The energies of a level's nodes, smoothed over their neighbours, for each of their children.
fn spread_energies(nodes: Nodes<'_>, energies: &[[u8; 3]]) -> Vec<[u8; 3]> {
    /// By how many coordinates differ.
    const WEIGHTS: [u32; 4] = [40, 15, 7, 3];
    let smoothed = (0..energies.len()).into_par_iter().map(|node| {
        let (mut sums, mut weight) = ([0u32; 3], 0);
        for (k, &neighbour) in nodes.map.row(node).iter().enumerate() {
            if neighbour != KernelMap::ABSENT {
                let off = usize::from(k % 3 != 1) + usize::from(k / 3 % 3 != 1) + usize::from(k / 9 != 1);
                for (sum, energy) in sums.iter_mut().zip(energies[neighbour as usize]) {
                    *sum += WEIGHTS[off] * u32::from(energy);
                }
                weight += WEIGHTS[off];
            }
        }
        sums.map(|sum| (sum / weight.max(1)) as u8)
    });
    let smoothed: Vec<[u8; 3]> = smoothed.collect();
    let children = smoothed.iter().zip(nodes.masks);
    children
        .flat_map(|(energy, mask)| std::iter::repeat_n(*energy, mask.count_ones() as usize))
        .collect()
}

/// Coefficients from an entropy stream.
struct Reading<'a>(Decoder<'a>);

impl Source for Reading<'_> {
    #[inline(always)]
    fn coefficient(&mut self, model: &mut Model, c: &Circumstances, _: i32, _: Quantiser) -> i32 {
        model.code(&mut self.0, c, 0)
    }
}

/// Codes a slice, one way or the other.
struct Pass<'a, S> {
    source: &'a mut S,
    model: &'a mut Model,
    nodes: Nodes<'a>,
    range: Range<usize>,
    coding: Coding,
    truth: Option<&'a [Ycc]>,
}

impl<S: Source> Work for Pass<'_, S> {
    type Output = block::Coded;

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> block::Coded {
        let Pass {
            source,
            model,
            nodes,
            range,
            coding,
            truth,
        } = self;
        block::code(source, model, nodes, range, coding, truth)
    }
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
