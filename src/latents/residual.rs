//! The colour residual: the remaining error of a stream's colours, voxel by voxel.
//!
//! Latents say what the networks have learned to make colours of; past some rate more of them hardly help. What is left
//! of a level's colours, the cloud's less the generated ones, a stream may code as it is, as finely as wanted:
//! transformed over the octree, rounded, and coded by [`crate::latents::entropy::decode_coefficients`]. That is beyond
//! the paper; the transform is that of G-PCC's attributes (de Queiroz and Chou, [doi
//! 10.1109/TIP.2016.2575005](https://doi.org/10.1109/TIP.2016.2575005)).
//!
//! # Transform
//! Of the voxels of a slice, in Morton order, each but the first *joins at* the highest bit in which its key differs
//! from that of the voxel before. Bits are taken from the lowest up, and of one bit the voxels that join there in turn:
//! where voxel j joins at bit b, its *left* is the last voxel before it that joins above b (or the first), `v` is how
//! many voxels there are from the left to j, and `w` how many from j to the next that joins at b or above. With a = √(v
//! / (v + w)) and c = √(w / (v + w)) the values x of the left and y of j become a·x + c·y and a·y − c·x. Undone, from
//! the highest bit down: x = a·l − c·h, y = c·l + a·h. In the end the first voxel has the mean times the root of their
//! number, and the others what they differ by.
//!
//! # Payload
//! One chunk for each slice of the level's voxels, independent of the others:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | u8 | step of luma, fine |
//! | 1 | u8 | step of both chromas, fine |
//! | 2 | u8 | step of luma, coarse |
//! | 3 | u8 | step of both chromas, coarse |
//! | 4 | u8 | boundary, 0 to 63 |
//! | 5 | | coefficients, a triple for each voxel: first the first voxel's, then those of voxels that join at higher bits before those at lower ones, of one bit in order |
//!
//! *Coarse* are the triples of the first voxel and of those that join at the boundary or above, the others are fine: so
//! the coarse ones come first. A step of 0 says that its coefficients are not coded, and 0; not all four may
//! be 0. Coefficients are coded in two parts, coarse and fine; of each those channels are present whose step is not 0.
//! A boundary of 3·n parts what is wider than 2ⁿ voxels from what is not.
//!
//! A coefficient q of step s stands for q·(s/255). The three are those of a luma and two chromas, whose vectors are
//! [`BASIS`]; a voxel's sum of the three, in turn, is added to the colour of each of its Gaussians, which then is
//! clamped to `[0, 1]`. All in f32: equal streams give equal bits on every machine.

use std::num::NonZeroU8;
use std::ops::Range;

use rayon::prelude::*;

use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use crate::gaussians::Gaussians;
#[cfg(feature = "encoder")]
use crate::latents::entropy::encode_coefficients;
use crate::latents::entropy::{SlicePart, decode_coefficients};

/// The unit vectors of luma and two chromas, in red, green and blue.
#[allow(clippy::excessive_precision)] // the nearest f32, as the format has it
pub const BASIS: [[f32; 3]; 3] = [
    [0.577_350_26, 0.577_350_26, 0.577_350_26],
    [0.707_106_77, 0.0, -0.707_106_77],
    [-0.408_248_3, 0.816_496_6, -0.408_248_3],
];
/// The fraction of a step from which a magnitude is rounded up: what is near zero costs least.
#[cfg(feature = "encoder")]
const ROUND_UP: f32 = 0.67;

/// Bytes of a payload before its coefficients.
const FIXED: usize = 5;

/// Quantisation steps of coefficients, in 255ths; 0: they are not coded, and 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Steps {
    /// Of luma.
    pub luma: u8,
    /// Of both chromas.
    pub chroma: u8,
}

impl From<NonZeroU8> for Steps {
    /// Those that go well with a step of luma: chromas three eighths as coarse. That is as good at equal rates as equal
    /// steps, pictures' PSNR being what counts, and leaves fewer blotches.
    fn from(luma: NonZeroU8) -> Steps {
        let luma = luma.get();
        let chroma = (u16::from(luma) * 3 / 8).max(1) as u8;
        Steps { luma, chroma }
    }
}

impl Steps {
    /// Nothing.
    pub const NONE: Steps = Steps { luma: 0, chroma: 0 };

    /// What the coefficients of luma and chromas count in.
    fn units(self) -> [f32; 3] {
        let [luma, chroma] = [self.luma, self.chroma].map(|step| f32::from(step) / 255.0);
        [luma, chroma, chroma]
    }

    /// The channels that are coded.
    fn channels(self) -> Range<usize> {
        usize::from(self.luma == 0)..if self.chroma == 0 { 1 } else { 3 }
    }
}

/// Quantisation steps of a residual, by spatial frequency.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResidualSteps {
    /// Where voxels join below [`ResidualSteps::boundary`].
    pub fine: Steps,
    /// Where they join there or above, and for the first voxel.
    pub coarse: Steps,
    /// A bit of Morton keys, at most [`ResidualSteps::MAX_BOUNDARY`]: 3·n for what is wider than 2ⁿ voxels.
    pub boundary: u8,
}

impl ResidualSteps {
    /// The highest bit.
    pub const MAX_BOUNDARY: u8 = 63;

    /// That of the payload of a residual's chunk; `None` if it is none that can be.
    pub fn read(payload: &[u8]) -> Option<ResidualSteps> {
        let fixed = *payload.first_chunk::<FIXED>()?;
        let [luma, chroma, coarse_luma, coarse_chroma, boundary] = fixed;
        let coded = [luma, chroma, coarse_luma, coarse_chroma] != [0; 4];
        (coded && boundary <= ResidualSteps::MAX_BOUNDARY).then_some(ResidualSteps {
            fine: Steps { luma, chroma },
            coarse: Steps {
                luma: coarse_luma,
                chroma: coarse_chroma,
            },
            boundary,
        })
    }

    #[cfg(feature = "encoder")]
    fn to_bytes(self) -> [u8; FIXED] {
        let ResidualSteps { fine, coarse, boundary } = self;
        [fine.luma, fine.chroma, coarse.luma, coarse.chroma, boundary]
    }

    /// How many of the coefficients of a slice with these Morton keys are coarse: the first ones.
    fn coarse_of(self, keys: &[u64]) -> usize {
        let joins = keys.windows(2).map(|pair| (pair[0] ^ pair[1]).ilog2());
        let coarse = joins.filter(|bit| *bit >= u32::from(self.boundary)).count();
        (coarse + 1).min(keys.len())
    }

    /// The parts that coarse and fine triples are coded in.
    fn parts<T>(self, (coarse, fine): (T, T)) -> [SlicePart<T>; 2] {
        [(self.coarse, coarse), (self.fine, fine)].map(|(steps, triples)| SlicePart {
            present: steps.channels(),
            triples,
        })
    }
}

/// What to add to the colours of a level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColourResidual {
    /// Voxels of a slice.
    slice: usize,
    /// One for each slice.
    precisions: Vec<ResidualSteps>,
    /// Three for each voxel, in the order in which they are coded.
    coefficients: Vec<[i16; 3]>,
}

/// How a voxel that joins others does so.
#[derive(Debug, Clone, Copy)]
struct Join {
    voxel: u32,
    left: u32,
    /// a and c of the module's documentation.
    weights: [f32; 2],
}

impl ColourResidual {
    /// Reads the payloads of the residual chunks of `level`, one for every `slice` of its voxels, whose Morton keys are
    /// `keys`; `None` if there are none.
    ///
    /// # Errors
    /// [`Error::Malformed`] if one tells nothing, or of a boundary beyond keys, or its coefficients do not decode.
    ///
    /// # Panics
    /// If there are payloads, but not one for every `slice` of the keys.
    pub fn parse(payloads: &[Slice], keys: &[u64], slice: usize, level: u8) -> Result<Option<Self>> {
        if payloads.is_empty() {
            return Ok(None);
        }
        assert_eq!(payloads.len(), keys.len().div_ceil(slice), "a payload each");
        let mut coefficients = vec![[0; 3]; keys.len()];
        let parse = |((payload, keys), triples): ((&Slice, &[u64]), &mut [[i16; 3]])| {
            let at = format!("byte {}, residual of level {level}", payload.offset);
            let Some(precision) = ResidualSteps::read(payload.bytes) else {
                let field = "steps of the colour residual";
                let expected = "four steps, not all 0, and a bit up to 63";
                let found = format!("{:?}", &payload.bytes[..payload.bytes.len().min(FIXED)]);
                return Err(Error::malformed(Stage::Gaussians, at, field, found, expected).breaks("14.2.1"));
            };
            let mut parts = precision.parts(triples.split_at_mut(precision.coarse_of(keys)));
            decode_coefficients(&payload.bytes[FIXED..], &mut parts, &at)?;
            Ok(precision)
        };
        let parts = payloads.par_iter().zip(keys.par_chunks(slice));
        let parts = parts.zip(coefficients.par_chunks_mut(slice));
        // All of them, so that the first fault is always the same.
        let precisions: Vec<Result<ResidualSteps>> = parts.map(parse).collect();
        Ok(Some(ColourResidual {
            slice,
            precisions: precisions.into_iter().collect::<Result<_>>()?,
            coefficients,
        }))
    }

    /// The residual, quantised in these steps, that brings colours nearer to what they are `missing`, voxel by voxel;
    /// `keys` are the voxels' Morton keys.
    ///
    /// # Panics
    /// If there are more or fewer of the one than of the other, a slice has none, or the precision is none that can be
    /// written.
    #[cfg(feature = "encoder")]
    pub fn of(missing: &[[f32; 3]], keys: &[u64], slice: usize, precision: ResidualSteps) -> Self {
        assert_eq!(missing.len(), keys.len(), "a difference for every voxel");
        assert!(slice > 0, "slices of something");
        let written = ResidualSteps::read(&precision.to_bytes());
        assert!(written.is_some(), "steps and a boundary: {precision:?}");
        let part = |(missing, keys): (&[[f32; 3]], &[u64])| {
            let mut values: Vec<_> = missing
                .iter()
                .map(|rgb| BASIS.map(|unit| unit[0] * rgb[0] + unit[1] * rgb[1] + unit[2] * rgb[2]))
                .collect();
            let joins = joins(keys);
            for join in joins.iter().rev() {
                let [a, c] = join.weights;
                let (x, y) = (values[join.left as usize], values[join.voxel as usize]);
                values[join.left as usize] = each(|k| a * x[k] + c * y[k]);
                values[join.voxel as usize] = each(|k| a * y[k] - c * x[k]);
            }
            let order = joins.iter().map(|join| join.voxel as usize);
            let coarse = precision.coarse_of(keys);
            let rounded = |(place, voxel): (usize, usize)| {
                let fine = place >= coarse;
                let steps = if fine { precision.fine } else { precision.coarse };
                let units = steps.units();
                let mut triple = [0; 3];
                for k in steps.channels() {
                    let steps = values[voxel][k] / units[k];
                    let whole = (steps.abs() + (1.0 - ROUND_UP)).floor();
                    triple[k] = whole.min(i16::MAX.into()).copysign(steps) as i16;
                }
                triple
            };
            let order = [0].into_iter().chain(order).enumerate();
            order.map(rounded).collect()
        };
        let parts = missing.par_chunks(slice).zip(keys.par_chunks(slice));
        let parts: Vec<Vec<_>> = parts.map(part).collect();
        ColourResidual {
            slice,
            precisions: vec![precision; parts.len()],
            coefficients: parts.concat(),
        }
    }

    /// The payloads, one for each slice of the voxels `keys` that it was made for.
    #[cfg(feature = "encoder")]
    pub fn to_payloads(&self, keys: &[u64]) -> Vec<Vec<u8>> {
        let slices = self.coefficients.par_chunks(self.slice);
        let slices = slices.zip(&self.precisions).zip(keys.par_chunks(self.slice));
        let payload = |((triples, precision), keys): ((&[[i16; 3]], &ResidualSteps), &[u64])| {
            let parts = precision.parts(triples.split_at(precision.coarse_of(keys)));
            let mut bytes = precision.to_bytes().to_vec();
            bytes.extend(encode_coefficients(&parts));
            bytes
        };
        slices.map(payload).collect()
    }

    /// Adds it to the colours of the Gaussians that the voxels `keys` generate, equally many each.
    ///
    /// # Panics
    /// If it is of more or fewer voxels, or they have no such Gaussians.
    pub fn apply(&self, gaussians: &mut Gaussians, keys: &[u64]) {
        assert_eq!(self.coefficients.len(), keys.len(), "a residual's voxels");
        if keys.is_empty() {
            return;
        }
        let count = gaussians.colour.len();
        let each = count / keys.len();
        assert_eq!(each * keys.len(), count, "as many for each voxel");
        let colours = gaussians.colour.par_chunks_mut(self.slice * each);
        let keys = keys.par_chunks(self.slice);
        let slices = self.coefficients.par_chunks(self.slice);
        colours
            .zip(keys)
            .zip(slices.zip(&self.precisions))
            .for_each(|((colours, keys), (coefficients, precision))| {
                let values = differences(coefficients, keys, *precision);
                for (colours, value) in colours.chunks_mut(each).zip(values) {
                    for colour in colours {
                        for (k, x) in colour.iter_mut().enumerate() {
                            let by = value[0] * BASIS[0][k] + value[1] * BASIS[1][k] + value[2] * BASIS[2][k];
                            *x = (*x + by).clamp(0.0, 1.0);
                        }
                    }
                }
            });
    }
}

/// The luma and chromas of a slice's voxels.
fn differences(coefficients: &[[i16; 3]], keys: &[u64], precision: ResidualSteps) -> Vec<[f32; 3]> {
    let mut values = vec![[0.0; 3]; keys.len()];
    let coarse = precision.coarse_of(keys);
    let [coarse_units, fine_units] = [precision.coarse, precision.fine].map(Steps::units);
    let mut coefficients = coefficients.iter().enumerate().map(|(place, triple)| {
        let units = if place < coarse { coarse_units } else { fine_units };
        each(|k| f32::from(triple[k]) * units[k])
    });
    values[0] = coefficients.next().unwrap_or_default();
    for (join, high) in joins(keys).iter().zip(coefficients) {
        let (low, [a, c]) = (values[join.left as usize], join.weights);
        values[join.left as usize] = each(|k| a * low[k] - c * high[k]);
        values[join.voxel as usize] = each(|k| c * low[k] + a * high[k]);
    }
    values
}

fn each(f: impl Fn(usize) -> f32) -> [f32; 3] {
    std::array::from_fn(f)
}

/// How each voxel but the first joins, in the order of coefficients.
fn joins(keys: &[u64]) -> Vec<Join> {
    let bit = |voxel: usize| (keys[voxel] ^ keys[voxel - 1]).ilog2() as usize;
    // Where each bit's begin, from the highest down.
    let mut at = [0u32; u64::BITS as usize];
    (1..keys.len()).for_each(|voxel| at[bit(voxel)] += 1);
    let mut sum = 0;
    for begin in at.iter_mut().rev() {
        let count = *begin;
        *begin = sum;
        sum += count;
    }
    let none = Join {
        voxel: 0,
        left: 0,
        weights: [0.0; 2],
    };
    let mut joins = vec![none; keys.len().saturating_sub(1)];
    // Voxels that the next may still join, with the bit at which they join themselves, higher ones first; and where
    // their own join stands.
    let mut open: Vec<(usize, usize, usize)> = vec![(0, usize::MAX, usize::MAX)];
    for voxel in 1..=keys.len() {
        let own = if voxel < keys.len() { bit(voxel) } else { usize::MAX - 1 };
        while let Some(&(before, bit, place)) = open.last()
            && bit <= own
        {
            // All voxels from `before` to here are its part.
            open.pop();
            let left = joins[place].left as usize;
            let (v, w) = ((before - left) as f32, (voxel - before) as f32);
            joins[place].weights = [(v / (v + w)).sqrt(), (w / (v + w)).sqrt()];
        }
        if voxel < keys.len() {
            let place = at[own] as usize;
            at[own] += 1;
            let left = open.last().map_or(0, |&(left, ..)| left);
            joins[place] = Join {
                voxel: voxel as u32,
                left: left as u32,
                weights: [0.0; 2],
            };
            open.push((voxel, own, place));
        }
    }
    joins
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
