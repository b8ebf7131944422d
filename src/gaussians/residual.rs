//! The colour residual: what a stream's colours are still off, voxel by voxel.
//!
//! Latents say what the networks have learned to make colours of; past some rate more of them hardly help. What is left of a level's colours, the
//! cloud's less the generated ones, a stream may code as it is, as finely as wanted: transformed over the octree, rounded, and coded by
//! [`crate::entropy::decode_coefficients`]. That is beyond the paper; the transform is that of G-PCC's attributes (de Queiroz and Chou,
//! [doi 10.1109/TIP.2016.2575005](https://doi.org/10.1109/TIP.2016.2575005)).
//!
//! # Transform
//! Of the voxels of a slice, in Morton order, each but the first *joins at* the highest bit in which its key differs from that of the voxel before.
//! Bits are taken from the lowest up, and of one bit the voxels that join there in turn: where voxel j joins at bit b, its *left* is the last
//! voxel before it that joins above b (or the first), `v` is how many voxels there are from the left to j, and `w` how many from j to the next that joins at b or above. With
//! a = √(v / (v + w)) and c = √(w / (v + w)) the values x of the left and y of j become a·x + c·y and a·y − c·x. Undone, from the highest bit
//! down: x = a·l − c·h, y = c·l + a·h. In the end the first voxel has the mean times the root of their number, and the others what they differ by.
//!
//! # Payload
//! One chunk for each slice of the level's voxels, independent of the others:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | u8 | step of luma, 1 to 255 |
//! | 1 | u8 | step of both chromas, 1 to 255 |
//! | 2 | | coefficients, a triple for each voxel: first the first voxel's, then those of voxels that join at higher bits before those at lower ones, of one bit in order |
//!
//! A coefficient q of step s stands for q·(s/255). The three are those of a luma and two chromas, whose vectors are [`BASIS`]; a voxel's sum of the three, in turn, is added to the colour of
//! each of its Gaussians, which then is clamped to `[0, 1]`. All in f32: equal streams give equal bits on every machine.

use std::num::NonZeroU8;

use rayon::prelude::*;

use super::Gaussians;
use crate::bitstream::Slice;
use crate::entropy::decode_coefficients;
#[cfg(feature = "encoder")]
use crate::entropy::encode_coefficients;
use crate::error::{Error, Result, Stage};

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

/// How finely coefficients are told, in 255ths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Steps {
    /// Of luma.
    pub luma: NonZeroU8,
    /// Of both chromas.
    pub chroma: NonZeroU8,
}

impl From<NonZeroU8> for Steps {
    /// Those that go well with a step of luma: chromas three eighths as coarse. That is as good at equal rates as equal steps, pictures' PSNR being
    /// what counts, and leaves fewer blotches.
    fn from(luma: NonZeroU8) -> Steps {
        let chroma = u16::from(luma.get()) * 3 / 8;
        let chroma = NonZeroU8::new(chroma as u8).unwrap_or(NonZeroU8::MIN);
        Steps { luma, chroma }
    }
}

impl Steps {
    /// What the coefficients of luma and chromas count in.
    fn units(self) -> [f32; 3] {
        let [luma, chroma] = [self.luma, self.chroma].map(|step| f32::from(step.get()) / 255.0);
        [luma, chroma, chroma]
    }
}

/// What to add to the colours of a level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColourResidual {
    /// Voxels of a slice.
    slice: usize,
    /// One for each slice.
    steps: Vec<Steps>,
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
    /// Reads the payloads of the residual chunks of `level`, one for every `slice` voxels; `None` if there are none.
    ///
    /// # Errors
    /// [`Error::Malformed`] if one has no step, or its coefficients do not decode.
    pub fn parse(payloads: &[Slice], slice: usize, level: u8) -> Result<Option<Self>> {
        if payloads.is_empty() {
            return Ok(None);
        }
        let voxels = payloads.iter().map(|payload| payload.voxels as usize).sum();
        let mut coefficients = vec![[0; 3]; voxels];
        let parse = |(payload, part): (&Slice, &mut [[i16; 3]])| {
            let at = format!("byte {}, residual of level {level}", payload.offset);
            let steps = match payload.bytes {
                [luma, chroma, ..] => NonZeroU8::new(*luma).zip(NonZeroU8::new(*chroma)),
                _ => None,
            };
            let Some((luma, chroma)) = steps else {
                let (field, expected) = ("steps of the colour residual", "two from 1 to 255");
                let found = format!("{:?}", &payload.bytes[..payload.bytes.len().min(2)]);
                return Err(Error::malformed(
                    Stage::Gaussians,
                    at,
                    field,
                    found,
                    expected,
                ));
            };
            let code = &payload.bytes[2..];
            decode_coefficients(code, part, &at)?;
            Ok(Steps { luma, chroma })
        };
        let parts = payloads.par_iter().zip(coefficients.par_chunks_mut(slice));
        // All of them, so that the first fault is always the same.
        let steps: Vec<Result<Steps>> = parts.map(parse).collect();
        Ok(Some(ColourResidual {
            slice,
            steps: steps.into_iter().collect::<Result<_>>()?,
            coefficients,
        }))
    }

    /// The residual, in these steps, that brings colours nearer to what they are `missing`, voxel by voxel; `keys` are the voxels' Morton keys.
    ///
    /// # Panics
    /// If there are more or fewer of the one than of the other, or a slice has none.
    #[cfg(feature = "encoder")]
    pub fn of(missing: &[[f32; 3]], keys: &[u64], slice: usize, steps: Steps) -> Self {
        assert_eq!(missing.len(), keys.len(), "a difference for every voxel");
        assert!(slice > 0, "slices of something");
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
            let units = steps.units();
            let rounded = |voxel: usize| {
                std::array::from_fn(|k| {
                    let steps = values[voxel][k] / units[k];
                    let whole = (steps.abs() + (1.0 - ROUND_UP)).floor();
                    whole.min(i16::MAX.into()).copysign(steps) as i16
                })
            };
            let order = joins.iter().map(|join| join.voxel as usize);
            [0].into_iter().chain(order).map(rounded).collect()
        };
        let parts = missing.par_chunks(slice).zip(keys.par_chunks(slice));
        let parts: Vec<Vec<_>> = parts.map(part).collect();
        ColourResidual {
            slice,
            steps: vec![steps; parts.len()],
            coefficients: parts.concat(),
        }
    }

    /// The payloads, one for each slice.
    #[cfg(feature = "encoder")]
    pub fn to_payloads(&self) -> Vec<Vec<u8>> {
        let slices = self.coefficients.par_chunks(self.slice).zip(&self.steps);
        let payload = |(part, steps): (&[[i16; 3]], &Steps)| {
            let mut bytes = vec![steps.luma.get(), steps.chroma.get()];
            bytes.extend(encode_coefficients(part));
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
        let slices = self.coefficients.par_chunks(self.slice).zip(&self.steps);
        colours
            .zip(keys)
            .zip(slices)
            .for_each(|((colours, keys), (coefficients, steps))| {
                let values = differences(coefficients, keys, steps.units());
                for (colours, value) in colours.chunks_mut(each).zip(values) {
                    for colour in colours {
                        for (k, x) in colour.iter_mut().enumerate() {
                            let by = value[0] * BASIS[0][k]
                                + value[1] * BASIS[1][k]
                                + value[2] * BASIS[2][k];
                            *x = (*x + by).clamp(0.0, 1.0);
                        }
                    }
                }
            });
    }
}

/// The luma and chromas of a slice's voxels.
fn differences(coefficients: &[[i16; 3]], keys: &[u64], units: [f32; 3]) -> Vec<[f32; 3]> {
    let mut values = vec![[0.0; 3]; keys.len()];
    let mut coefficients = coefficients
        .iter()
        .map(|triple| each(|k| f32::from(triple[k]) * units[k]));
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
    // Voxels that the next may still join, with the bit at which they join themselves, higher ones first; and where their own join stands.
    let mut open: Vec<(usize, usize, usize)> = vec![(0, usize::MAX, usize::MAX)];
    for voxel in 1..=keys.len() {
        let own = if voxel < keys.len() {
            bit(voxel)
        } else {
            usize::MAX - 1
        };
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
mod tests {
    use super::*;
    use crate::entropy::test_tables::Random;
    use std::collections::BTreeSet;

    fn keys(seed: u64, count: usize, depth: u32) -> Vec<u64> {
        let mut random = Random(seed);
        let draw = (0..count).map(|_| random.next() >> (64 - 3 * depth));
        draw.collect::<BTreeSet<_>>().into_iter().collect()
    }

    fn steps(luma: u8, chroma: u8) -> Steps {
        let [luma, chroma] = [luma, chroma].map(|step| NonZeroU8::new(step).unwrap());
        Steps { luma, chroma }
    }

    fn colours(seed: u64, count: usize) -> Vec<[f32; 3]> {
        let mut random = Random(seed);
        let mut draw = || (random.next() >> 40) as f32 / (1 << 24) as f32 - 0.5;
        (0..count).map(|_| [draw(), draw(), draw()]).collect()
    }

    fn grey(count: usize) -> Gaussians {
        Gaussians {
            colour: vec![[0.5; 3]; count],
            ..Gaussians::default()
        }
    }

    /// What the module's documentation says of one slice, word by word: coefficients in the order of the payload.
    fn by_definition(values: &[[f64; 3]], keys: &[u64]) -> Vec<[f64; 3]> {
        let joins_at = |j: usize| {
            (0..64)
                .rev()
                .find(|b| (keys[j] ^ keys[j - 1]) >> b & 1 == 1)
        };
        let mut x = values.to_vec();
        let mut order = Vec::new();
        for bit in 0..63 {
            let joining = (1..keys.len()).filter(|&j| joins_at(j) == Some(bit));
            let joining: Vec<_> = joining.collect();
            for &j in &joining {
                let left = (1..j).rev().find(|&i| joins_at(i) > Some(bit)).unwrap_or(0);
                let next = (j + 1..keys.len()).find(|&i| joins_at(i) >= Some(bit));
                let (v, w) = (j - left, next.unwrap_or(keys.len()) - j);
                let root = |n: usize| (n as f64 / (v + w) as f64).sqrt();
                let (a, c) = (root(v), root(w));
                let (low, high) = (x[left], x[j]);
                x[left] = std::array::from_fn(|k| a * low[k] + c * high[k]);
                x[j] = std::array::from_fn(|k| a * high[k] - c * low[k]);
            }
            order.splice(0..0, joining);
        }
        order.insert(0, 0);
        order.into_iter().map(|j| x[j]).collect()
    }

    #[test]
    fn coefficients_are_those_of_the_definition_and_those_decode_to_the_colours() {
        for (seed, count, depth) in [(1, 1, 1), (2, 2, 21), (3, 9, 1), (4, 300, 3), (5, 700, 21)] {
            let keys = keys(seed, count, depth);
            let missing = colours(seed, keys.len());
            let residual = ColourResidual::of(&missing, &keys, keys.len(), steps(1, 1));
            let luma = |rgb: &[f32; 3]| {
                BASIS.map(|unit| (0..3).map(|k| f64::from(unit[k] * rgb[k])).sum::<f64>())
            };
            let values: Vec<_> = missing.iter().map(luma).collect();
            for (found, want) in residual
                .coefficients
                .iter()
                .zip(by_definition(&values, &keys))
            {
                for (q, want) in found.iter().zip(want) {
                    let off = f64::from(*q) - 255.0 * want;
                    assert!(
                        off.abs() < f64::from(ROUND_UP) + 1e-3,
                        "{q} for {}",
                        255.0 * want
                    );
                }
            }
            let mut decoded = grey(keys.len());
            residual.apply(&mut decoded, &keys);
            let squares = |(got, want): (&[f32; 3], &[f32; 3])| -> f32 {
                (0..3).map(|k| (got[k] - 0.5 - want[k]).powi(2)).sum()
            };
            // The transform keeps squares, so those of the colours are those of the rounding.
            let off: f32 = decoded.colour.iter().zip(&missing).map(squares).sum();
            let most = 3.0 * keys.len() as f32 * (ROUND_UP / 255.0).powi(2);
            assert!(off < most, "{off} of {most}");
        }
    }

    #[test]
    fn finer_steps_take_more_bytes_and_bring_colours_nearer() {
        let keys: Vec<u64> = (0..4096).collect();
        let missing: Vec<_> = colours(7, 4096)
            .iter()
            .map(|c| c.map(|x| 0.3 * x))
            .collect();
        let mut before = (usize::MAX, 0.0);
        for step in [1, 8, 40, 200] {
            let residual = ColourResidual::of(&missing, &keys, 1000, steps(step, step));
            let bytes = residual.to_payloads().iter().map(Vec::len).sum();
            let mut decoded = grey(keys.len());
            residual.apply(&mut decoded, &keys);
            let pairs = decoded
                .colour
                .as_flattened()
                .iter()
                .zip(missing.as_flattened());
            let off: f32 = pairs.map(|(got, want)| (got - 0.5 - want).powi(2)).sum();
            assert!(
                bytes < before.0 && off > before.1,
                "step {step}: {bytes}, {off}"
            );
            before = (bytes, off);
        }
    }

    #[test]
    fn what_is_written_is_read_and_slices_do_not_know_of_each_other() {
        let keys = keys(8, 500, 4);
        let missing = colours(8, keys.len());
        let whole = ColourResidual::of(&missing, &keys, 64, steps(12, 7));
        let payloads = whole.to_payloads();
        let slices: Vec<_> = (payloads.iter().zip(keys.chunks(64)))
            .map(|(bytes, keys)| Slice {
                voxels: keys.len() as u32,
                bytes,
                offset: 9,
            })
            .collect();
        assert_eq!(ColourResidual::parse(&slices, 64, 3).unwrap(), Some(whole));
        for ((payload, missing), keys) in
            payloads.iter().zip(missing.chunks(64)).zip(keys.chunks(64))
        {
            let alone = ColourResidual::of(missing, keys, 64, steps(12, 7));
            assert_eq!(alone.to_payloads(), std::slice::from_ref(payload));
        }
    }

    #[test]
    fn all_gaussians_of_a_voxel_get_the_same_and_stay_colours() {
        let residual = ColourResidual {
            slice: 2,
            steps: vec![steps(255, 9), steps(1, 100)],
            coefficients: vec![[2, 0, 0], [0, 0, 0], [0, 1, 0]],
        };
        let mut some = grey(24);
        some.colour[20] = [0.1, 0.2, 0.9];
        residual.apply(&mut some, &[0, 1, 5]);
        // Two voxels share the mean, and one is alone with a difference of red and blue.
        assert_eq!(some.colour[..16], [[1.0; 3]; 16]);
        let by = 100.0 / 255.0 * BASIS[1][0];
        assert_eq!(some.colour[16], [0.5 + by, 0.5, 0.5 - by]);
        assert_eq!(some.colour[20], [0.1 + by, 0.2, 0.9 - by]);
    }

    #[test]
    fn chromas_are_told_more_finely_unless_said_otherwise() {
        for (luma, chroma) in [(1, 1), (2, 1), (8, 3), (64, 24), (255, 95)] {
            assert_eq!(
                Steps::from(NonZeroU8::new(luma).unwrap()),
                steps(luma, chroma)
            );
        }
    }

    #[test]
    fn the_basis_is_orthonormal() {
        for (i, a) in BASIS.iter().enumerate() {
            for (j, b) in BASIS.iter().enumerate() {
                let dot: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                assert!((dot - f32::from(u8::from(i == j))).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn a_payload_without_steps_or_code_is_refused() {
        for (bytes, wrong) in [
            (&[][..], "steps of the colour residual"),
            (&[9], "steps of the colour residual"),
            (&[0, 1, 2, 3, 4, 5, 6], "steps of the colour residual"),
            (&[1, 0, 2, 3, 4, 5, 6], "steps of the colour residual"),
            (&[1, 2, 3], "length of the slice"),
        ] {
            let payload = Slice {
                voxels: 1,
                bytes,
                offset: 100,
            };
            let error = ColourResidual::parse(&[payload], 64, 3)
                .unwrap_err()
                .to_string();
            assert!(error.contains(wrong), "{error}");
            assert!(error.contains("byte 100, residual of level 3"), "{error}");
        }
    }
}
