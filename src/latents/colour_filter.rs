//! The colour filter: how a stream corrects the colours that its heads generate.
//!
//! Heads have learned from other clouds. What they get wrong about one cloud as a whole, the encoder sees, and says in
//! 58 bytes a level: a colour becomes itself plus a quadratic function of itself and of how it differs from its
//! neighbourhood, clamped to `[0, 1]`. That is beyond the paper; video codecs filter their pictures likewise (the
//! adaptive loop filter of H.266, the restoration of AV1).
//!
//! # Contexts
//! The Gaussians of a *group* are the eight of a voxel, or, where a voxel has one, those of the voxels with the same
//! parent. Colours are taken relative to ½. Of each group the first mean is that of its Gaussians, weighted by their
//! opacities; the second, of the first means of the group and those of its neighbours under the 3³ kernel, weighted by
//! their sums of opacities and 4, 2, 1 or ½, as they differ along none to three axes; the third, of the second means
//! likewise. Sums run in the order of Gaussians and of kernel offsets; a mean of no weight is 0.
//!
//! # Payload
//! | offset | type | field |
//! |---|---|---|
//! | 0 | u8 | exponent e, at most 15 |
//! | 1 + 19·c | i8 × 19 | weights of channel c (red, green, blue), for the inputs below |
//!
//! The inputs: 1; r, g, b; r², g², b², rg, rb, gb; r, g, b of the first mean less the colour; of the second less the
//! first; of the third less the second. The first weight counts steps of 2⁻¹⁰, the others of 2⁻ᵉ. The products are
//! added in this order, in f32, and the sum to the colour: equal streams give equal bits on every machine.

use rayon::prelude::*;

use crate::container::Slice;
use crate::error::{Error, Result, Stage};
use crate::gaussians::Gaussians;
use crate::geometry::{KernelMap, Octree};

/// Inputs of each channel.
pub const INPUTS: usize = 19;
/// Bytes of a filter.
pub const BYTES: usize = 1 + 3 * INPUTS;
const MAX_EXPONENT: u8 = 15;
/// What the first weight counts in.
const BIAS_EXPONENT: u8 = 10;

/// Which Gaussians belong together.
#[derive(Debug, Clone, Copy)]
pub enum Groups<'a> {
    /// Eight in a row.
    Eights,
    /// For every group the first, as [`Octree::first_child`] has them.
    Siblings(&'a [u32]),
}

/// The three means around every Gaussian: see the module's documentation.
#[derive(Debug)]
pub struct ColourContexts {
    means: Vec<[[f32; 3]; 3]>,
    /// The group of every Gaussian, where they are not eights.
    groups: Option<Vec<u32>>,
}

/// One level's correction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColourFilter {
    /// Weights but the first count in steps of 2 to the minus this, at most 15.
    pub exponent: u8,
    /// Of red, green and blue.
    pub weights: [[i8; INPUTS]; 3],
}

impl ColourFilter {
    /// Reads the payload of a filter chunk of `level`.
    ///
    /// # Errors
    /// [`Error::Malformed`] if it has another length or a greater exponent.
    pub fn parse(payload: &Slice, level: u8) -> Result<Self> {
        let malformed = |field, value, expected: String| {
            let place = format!("byte {}, level {level}", payload.offset);
            Error::malformed(Stage::Gaussians, place, field, value, expected).breaks("14.1.1")
        };
        let Ok(bytes) = <&[u8; BYTES]>::try_from(payload.bytes) else {
            let (found, expected) = (payload.bytes.len(), BYTES.to_string());
            return Err(malformed("length of the colour filter", found, expected));
        };
        let exponent = bytes[0];
        if exponent > MAX_EXPONENT {
            let expected = format!("at most {MAX_EXPONENT}");
            return Err(malformed("exponent of the colour filter", exponent.into(), expected));
        }
        let weight = |c: usize, k: usize| bytes[1 + c * INPUTS + k] as i8;
        let weights = std::array::from_fn(|c| std::array::from_fn(|k| weight(c, k)));
        Ok(ColourFilter { exponent, weights })
    }

    /// The payload.
    pub fn to_bytes(&self) -> [u8; BYTES] {
        let mut bytes = [self.exponent; BYTES];
        let weights = self.weights.as_flattened();
        for (byte, weight) in bytes[1..].iter_mut().zip(weights) {
            *byte = *weight as u8;
        }
        bytes
    }

    /// The real value of one step of the weight of input `k`.
    pub fn step(exponent: u8, k: usize) -> f32 {
        let exponent = if k == 0 { BIAS_EXPONENT } else { exponent };
        1.0 / (1u32 << exponent) as f32
    }

    /// Corrects the colours of a level.
    ///
    /// # Panics
    /// If the contexts are of other Gaussians.
    pub fn apply(&self, gaussians: &mut Gaussians, contexts: &ColourContexts) {
        let weight = |c: usize, k: usize| f32::from(self.weights[c][k]) * Self::step(self.exponent, k);
        // A fourth channel makes a vector of it.
        let weights: [[f32; 4]; INPUTS] =
            std::array::from_fn(|k| std::array::from_fn(|c| if c < 3 { weight(c, k) } else { 0.0 }));
        let correct = |(i, colour): (usize, &mut [f32; 3])| {
            let mut sum = [0.0; 4];
            for (input, weights) in contexts.inputs(i, *colour).iter().zip(&weights) {
                for (sum, weight) in sum.iter_mut().zip(weights) {
                    *sum += input * weight;
                }
            }
            for (x, by) in colour.iter_mut().zip(sum) {
                *x = (*x + by).clamp(0.0, 1.0);
            }
        };
        let colours = gaussians.colour.par_iter_mut().enumerate();
        colours.with_min_len(4096).for_each(correct);
    }
}

impl ColourContexts {
    /// Those of the Gaussians that the voxels of `level` generate, eight each or one. `map` is the level's 3³ kernel
    /// map, `above` that of the level above.
    ///
    /// # Panics
    /// If they are of other levels, or voxels have one Gaussian each and there is no level above.
    pub fn of_level(
        gaussians: &Gaussians,
        octree: &Octree,
        level: u8,
        map: &KernelMap,
        above: Option<&KernelMap>,
    ) -> Self {
        match above {
            Some(above) if gaussians.len() == map.len() => {
                let first = octree.first_child(level - 1);
                ColourContexts::new(gaussians, Groups::Siblings(first), above)
            }
            _ => ColourContexts::new(gaussians, Groups::Eights, map),
        }
    }

    /// Those of a level's Gaussians; `map` is the 3³ kernel map of the voxels that the groups belong to.
    ///
    /// # Panics
    /// If there are more or fewer groups than rows of the map.
    pub fn new(gaussians: &Gaussians, groups: Groups, map: &KernelMap) -> Self {
        let count = gaussians.len();
        let starts = |group: usize| match groups {
            Groups::Eights => 8 * group,
            Groups::Siblings(first) => first.get(group).map_or(count, |&first| first as usize),
        };
        assert_eq!(starts(map.len()), count, "Gaussians of every group");
        let first = |group: usize| {
            let range = starts(group)..starts(group + 1);
            let weights = &gaussians.opacity[range.clone()];
            let colours = gaussians.colour[range].iter();
            let colours = colours.map(|colour| colour.map(|x| x - 0.5));
            mean(weights.iter().copied().zip(colours))
        };
        let spread = |means: &[([f32; 3], f32)]| -> Vec<([f32; 3], f32)> {
            let around = |group: usize| {
                let near = map.row(group).iter().zip(NEARNESS);
                let near = near.filter(|(at, _)| **at != KernelMap::ABSENT);
                let near = near.map(|(&at, nearness)| {
                    let (mean, weight) = means[at as usize];
                    (nearness * weight, mean)
                });
                (mean(near).0, means[group].1)
            };
            over(map.len(), around)
        };
        let first = over(map.len(), first);
        let second = spread(&first);
        let third = spread(&second);
        let means = over(map.len(), |i| [first[i].0, second[i].0, third[i].0]);
        let groups = match groups {
            Groups::Eights => None,
            Groups::Siblings(_) => {
                let mut of = Vec::with_capacity(count);
                for group in 0..map.len() {
                    of.resize(starts(group + 1), group as u32);
                }
                Some(of)
            }
        };
        ColourContexts { means, groups }
    }

    /// What Gaussian `i` of this colour is corrected by.
    #[inline(always)]
    pub fn inputs(&self, i: usize, colour: [f32; 3]) -> [f32; INPUTS] {
        let group = self.groups.as_ref().map_or(i / 8, |of| of[i] as usize);
        let [first, second, third] = self.means[group];
        let own @ [r, g, b] = colour.map(|x| x - 0.5);
        let mut inputs = [0.0; INPUTS];
        inputs[0] = 1.0;
        inputs[1..4].copy_from_slice(&own);
        inputs[4..10].copy_from_slice(&[r * r, g * g, b * b, r * g, r * b, g * b]);
        for (c, own) in own.into_iter().enumerate() {
            inputs[10 + c] = first[c] - own;
            inputs[13 + c] = second[c] - first[c];
            inputs[16 + c] = third[c] - second[c];
        }
        inputs
    }
}

/// Weights of the offsets of a 3³ kernel.
const NEARNESS: [f32; 27] = {
    let mut nearness = [0.0; 27];
    let mut k = 0;
    while k < 27 {
        let axes = (k % 3 != 1) as usize + (k / 3 % 3 != 1) as usize + (k / 9 != 1) as usize;
        nearness[k] = [4.0, 2.0, 1.0, 0.5][axes];
        k += 1;
    }
    nearness
};

/// The weighted mean, and the sum of the weights.
fn mean(values: impl Iterator<Item = (f32, [f32; 3])>) -> ([f32; 3], f32) {
    let (mut sum, mut weights) = ([0.0; 3], 0.0);
    for (weight, value) in values {
        weights += weight;
        for (sum, x) in sum.iter_mut().zip(value) {
            *sum += weight * x;
        }
    }
    let mean = sum.map(|x| if weights > 0.0 { x / weights } else { 0.0 });
    (mean, weights)
}

fn over<T: Send>(count: usize, f: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    let each = (0..count).into_par_iter().with_min_len(1024);
    each.map(f).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels};

    fn filter(exponent: u8, set: &[(usize, usize, i8)]) -> ColourFilter {
        let mut weights = [[0; INPUTS]; 3];
        for &(channel, input, weight) in set {
            weights[channel][input] = weight;
        }
        ColourFilter { exponent, weights }
    }

    fn gaussians(colours: &[[f32; 3]], opacity: f32) -> Gaussians {
        Gaussians {
            colour: colours.to_vec(),
            opacity: vec![opacity; colours.len()],
            position: vec![[0.0; 3]; colours.len()],
            ..Gaussians::default()
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let filter = filter(7, &[(0, 0, -128), (1, 18, 127), (2, 9, 1)]);
        let bytes = filter.to_bytes();
        let payload = Slice {
            voxels: 1,
            bytes: &bytes,
            offset: 100,
        };
        assert_eq!(ColourFilter::parse(&payload, 3).unwrap(), filter);
    }

    #[test]
    fn another_length_or_a_great_exponent_is_refused() {
        for (bytes, wrong) in [
            (vec![0; BYTES - 1], "length"),
            (vec![0; BYTES + 1], "length"),
            (vec![16; BYTES], "exponent"),
        ] {
            let payload = Slice {
                voxels: 1,
                bytes: &bytes,
                offset: 100,
            };
            let error = ColourFilter::parse(&payload, 3).unwrap_err().to_string();
            assert!(error.contains(wrong) && error.contains("100"), "{error}");
        }
    }

    #[test]
    fn a_filter_of_zeros_changes_nothing() {
        let mut some = gaussians(&[[0.1, 0.9, 0.3]; 8], 0.5);
        let before = some.clone();
        let around = ColourContexts::new(&some, Groups::Eights, &KernelMap::root());
        filter(0, &[]).apply(&mut some, &around);
        assert_eq!(some, before);
    }

    #[test]
    fn a_colour_moves_towards_the_mean_of_its_siblings_by_the_weight_of_their_difference() {
        let mut colours = [[0.25; 3]; 8];
        colours[3] = [0.75; 3];
        let mut some = gaussians(&colours, 1.0);
        let around = ColourContexts::new(&some, Groups::Siblings(&[0]), &KernelMap::root());
        filter(1, &[(0, 10, 2)]).apply(&mut some, &around);
        let mean = 0.25 + 0.5 / 8.0;
        for (i, colour) in some.colour.iter().enumerate() {
            assert_eq!(*colour, [mean, colours[i][1], colours[i][2]], "{i}");
        }
    }

    #[test]
    fn neighbours_count_by_their_opacities_and_how_near_they_are() {
        let octree = Octree::new(Voxels::new(2, vec![0, 1, 3, 7])).unwrap();
        let mut some = gaussians(&[[0.5; 3]; 32], 0.0);
        // Of the four voxels in a corner, the second is bright and half as opaque as the first; the others have
        // nothing.
        some.opacity[0] = 1.0;
        some.opacity[8] = 0.5;
        some.colour[8] = [1.0; 3];
        let around = ColourContexts::new(&some, Groups::Eights, &octree.kernel_map(2));
        let second = |group: usize| around.inputs(8 * group + 1, [0.5; 3])[13];
        assert_eq!(second(0), 0.5 * (2.0 * 0.5) / (4.0 + 2.0 * 0.5));
        assert_eq!(second(1), 0.5 * (4.0 * 0.5) / (2.0 + 4.0 * 0.5) - 0.5);
    }

    #[test]
    fn colours_stay_colours_whatever_the_weights() {
        let colours = [[0.0, 1.0, 0.5]; 8];
        for weight in [-128, 127] {
            let mut some = gaussians(&colours, 1.0);
            let around = ColourContexts::new(&some, Groups::Eights, &KernelMap::root());
            let all = ColourFilter {
                exponent: 0,
                weights: [[weight; INPUTS]; 3],
            };
            all.apply(&mut some, &around);
            let all = some.colour.iter().flatten();
            assert!(all.clone().all(|x| (0.0..=1.0).contains(x)), "{all:?}");
        }
    }
}
