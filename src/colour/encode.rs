//! The colour encoder: rate–distortion optimised quantisation (RDOQ) of coefficients, and the fit of the colour filter.

use std::ops::Range;

use b2p_kernels::smooth::Values;
use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::block::Coding;
use super::filter::{TERMS, neighbourhood, responses, solve, terms, widen};
use super::importance::Importance;
use super::model::{BINS, CoefficientContext, Model};
use super::node::{CoefficientCoder, Quantiser};
use super::space::{FRACTION, from_rgb};
use super::transform::{EVEN, forward};
use super::weights::{self, Weights};
use super::{CodeSlice, Guide, LevelColours, Steps, Ycc, join, nodes, slices, trunk};
use crate::coding::ONE;
use crate::coding::binary::Encoder;
use crate::geometry::{Octree, SiblingMap, Voxels, Window, morton};

/// Encoding parameters of a level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// The quantisation steps.
    pub steps: Steps,
    /// The Lagrangian multiplier of RDOQ: squared error, in squared steps, that one bit must save. 0 rounds to the
    /// nearest integer.
    pub lambda: f32,
    /// Factor of the predicted differences, in units of 1/256; `None` for the best of three in the middle slice of the
    /// level.
    pub gain: Option<u8>,
}

impl Options {
    /// Default λ for these steps, and the best gain.
    pub fn new(steps: Steps) -> Options {
        Options {
            steps,
            lambda: 0.05,
            gain: None,
        }
    }

    /// Coding parameters with each gain to try.
    fn codings(&self) -> Vec<Coding> {
        let steps = self.steps;
        let coding = |gain| Coding { steps, gain };
        self.gain.map_or(GAINS.map(coding).to_vec(), |gain| vec![coding(gain)])
    }
}

/// Gains that are tried: differences of rough surfaces are predicted too large, those of smooth ones are not.
const GAINS: [u8; 3] = [190, 225, 255];
/// Squared error, in squared steps, that a bit must save, where gains are compared.
const GAIN_LAMBDA: f64 = 0.08;

/// Original colours by level: those of the finest coded level, and the transform's means for the levels above.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    levels: Vec<Vec<Ycc>>,
    lossless: bool,
    /// How errors count, unless all count alike.
    importance: Option<Importance>,
}

impl Truth {
    /// Averages the colours of a cloud's voxels in each voxel of level `top`, the last one of the stream, and transforms
    /// them up to the root; the colour trunk ends with level `trunk`. If `lossless`, colours are rounded to whole
    /// 255ths. A voxel of the octree that holds none of the cloud's has the mean of those of the cloud's that are
    /// nearest, at most one away.
    ///
    /// # Panics
    /// If `colours` does not have one entry per voxel, or the octree is less deep than `top`.
    pub fn new(voxels: &Voxels, colours: &[[u8; 3]], octree: &Octree, trunk: u8, top: u8, lossless: bool) -> Truth {
        let means = Truth::finest(voxels, colours, octree, top, lossless);
        Truth::of_values(octree, trunk, top, means, lossless)
    }

    /// The colours of level `top` alone, as [`Truth::new`] has them.
    ///
    /// # Panics
    /// If `colours` does not have one entry per voxel, or the octree is less deep than `top`.
    pub fn finest(voxels: &Voxels, colours: &[[u8; 3]], octree: &Octree, top: u8, lossless: bool) -> Vec<Ycc> {
        assert_eq!(voxels.len(), colours.len(), "one colour per voxel");
        let shift = 3 * (voxels.depth() - top);
        let fraction = if lossless { 0 } else { FRACTION };
        let means = octree.level(top).keys().par_iter().map(|key| {
            let mut sum = ColourSum::default();
            sum.add(voxels, colours, shift, *key);
            if sum.count == 0 {
                sum.add_nearest(voxels, colours, shift, *key, top);
            }
            from_rgb(sum.mean(fraction)).map(|x| x as i16)
        });
        means.collect()
    }

    /// Colours of the voxels of level `top`, in the units of [`LevelColours::values`], transformed up to the root.
    ///
    /// # Panics
    /// If `values` does not have one entry per voxel of level `top`.
    pub fn of_values(octree: &Octree, trunk: u8, top: u8, values: Vec<Ycc>, lossless: bool) -> Truth {
        assert_eq!(values.len(), octree.level(top).len(), "one colour per voxel");
        Truth {
            levels: means_above(octree, trunk, top, values),
            lossless,
            importance: None,
        }
    }

    /// The same colours, whose errors below the trunk count by `importance`.
    pub fn with_importance(self, importance: Importance) -> Truth {
        Truth {
            importance: Some(importance),
            ..self
        }
    }

    /// The factors of λ in the nodes of a level, if there are any.
    fn factors(&self, level: u8) -> &[f32] {
        self.importance
            .as_ref()
            .map_or(&[], |importance| importance.factors(level))
    }

    /// The colours of a level, in the units of [`LevelColours::values`].
    pub fn level(&self, level: u8) -> &[Ycc] {
        &self.levels[usize::from(level)]
    }

    /// Whether chroma is 0 in every voxel.
    pub fn is_grey(&self) -> bool {
        self.levels
            .last()
            .is_some_and(|values| values.iter().all(|ycc| ycc[1..] == [0, 0]))
    }
}

/// Colours of level `top` and the transform's means of all levels above, from the root on.
fn means_above(octree: &Octree, trunk: u8, top: u8, values: Vec<Ycc>) -> Vec<Vec<Ycc>> {
    let maps: Vec<SiblingMap> = (0..=trunk).map(|level| octree.sibling_map(level)).collect();
    let of_trunk = weights::of_trunk(octree, &maps, top);
    let mut levels = vec![values];
    for level in (0..top).rev() {
        let (masks, first) = (octree.occupancy(level), octree.first_child(level));
        let below = &levels[levels.len() - 1];
        let estimated = trunk < level + 1 && level + 1 < top;
        let map = estimated.then(|| octree.sibling_map(level + 1));
        let weights = match level < trunk {
            true => Weights::Given(&of_trunk[usize::from(level) + 1]),
            false => Weights::below_trunk(level + 1, top),
        };
        let mean = |(node, (mask, first)): (usize, (&u8, &u32))| {
            let first = *first as usize;
            let window = map.as_ref().map_or(Window::EMPTY, |map| map.window(node));
            let children = super::block::spread(*mask, &below[first..]);
            let mut own = EVEN[0];
            let weighting = weights.weighting(*mask, first, &window, &mut own);
            forward(*mask, weighting, children).0.map(|x| x as i16)
        };
        let means = masks.par_iter().zip(first).enumerate().map(mean).collect();
        levels.push(means);
    }
    levels.reverse();
    levels
}

/// Colours of a cloud's voxels.
#[derive(Debug, Default)]
struct ColourSum {
    sum: [u64; 3],
    count: u64,
}

impl ColourSum {
    /// Adds the voxels in the voxel `key`, `shift / 3` levels above.
    fn add(&mut self, voxels: &Voxels, colours: &[[u8; 3]], shift: u8, key: u64) {
        for colour in &colours[voxels.within(key, shift)] {
            for (sum, c) in self.sum.iter_mut().zip(colour) {
                *sum += u64::from(*c);
            }
            self.count += 1;
        }
    }

    /// Adds the voxels in those neighbours of the voxel `key` of level `level` that are nearest to it.
    fn add_nearest(&mut self, voxels: &Voxels, colours: &[[u8; 3]], shift: u8, key: u64, level: u8) {
        let at = morton::decode(key).map(i64::from);
        for distance in 1..=3 {
            for k in 0..27i64 {
                let offset = [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1];
                let place: [i64; 3] = std::array::from_fn(|i| at[i] + offset[i]);
                let inside = place.iter().all(|x| (0..1i64 << level).contains(x));
                if inside && offset.iter().map(|x| x * x).sum::<i64>() == distance {
                    self.add(voxels, colours, shift, morton::encode(place.map(|x| x as u32)));
                }
            }
            if self.count > 0 {
                return;
            }
        }
    }

    /// The mean, with so many fractional bits.
    fn mean(&self, fraction: u32) -> [i32; 3] {
        self.sum
            .map(|sum| (((sum << (fraction + 1)) + self.count) / (2 * self.count).max(1)) as i32)
    }
}

/// Encodes the trunk: the root and the levels 1 to K. `maps` are the maps of the levels 0 to K, `top` is the
/// stream's last level, `guides` what a previous frame tells of the levels from 1 on, if anything. Returns the payload
/// and the colours that it decodes to.
///
/// # Panics
/// If the octree has fewer than K levels.
pub fn encode_trunk(
    isa: Isa,
    octree: &Octree,
    maps: &[SiblingMap],
    top: u8,
    truth: &Truth,
    options: Options,
    guides: &[Guide<'_>],
) -> (Vec<u8>, LevelColours) {
    let fraction = options.steps.fraction();
    let half = (1 << fraction) >> 1;
    let root = truth.level(0)[0].map(|x| (x + half) >> fraction);
    let root = [
        root[0].clamp(0, 255),
        root[1].clamp(-255, 255),
        root[2].clamp(-255, 255),
    ];
    let encode = |coding: Coding| {
        let mut bytes = vec![coding.steps.luma, coding.steps.chroma, coding.gain, root[0] as u8];
        bytes.extend(root[1..].iter().flat_map(|x| x.to_le_bytes()));
        bytes.push(top);
        let mut coder = RdoEncoder::new(options.lambda);
        let truth = |level| Some(truth.level(level));
        let each = &mut |_: u8, _: &LevelColours| {};
        let colours = trunk(isa, octree, maps, top, coding, root, &mut coder, truth, guides, each);
        let error = coder.error;
        bytes.extend(coder.encoder.finish());
        (cost(error, bytes.len()), bytes, colours)
    };
    let (_, bytes, colours) = encode(best(options.codings(), |coding| encode(coding).0));
    (bytes, colours)
}

/// Encodes the colours of `level`. Returns one payload for every `slice` nodes of the level above, and the colours that
/// they decode to.
///
/// # Panics
/// If maps or colours belong to another level, or `slice` is 0.
#[allow(clippy::too_many_arguments)]
pub fn encode_level(
    isa: Isa,
    octree: &Octree,
    level: u8,
    above_map: &SiblingMap,
    map: &SiblingMap,
    above: &LevelColours,
    truth: &Truth,
    slice: usize,
    options: Options,
    guide: Option<Guide<'_>>,
) -> (Vec<Vec<u8>>, LevelColours) {
    let weights = Weights::below_trunk(level, above.last);
    let mut nodes = nodes(octree, level, above_map, map, weights, above);
    nodes.guide = guide;
    let encode = |range: Range<usize>, coding: Coding| {
        let (mut coder, mut model) = (RdoEncoder::new(options.lambda), above.model.clone());
        coder.factors = truth.factors(level - 1);
        let first = nodes.first_child[range.start] as usize;
        let truth = Some(&truth.level(level)[first..]);
        let coded = isa.run(CodeSlice {
            coder: &mut coder,
            model: &mut model,
            nodes,
            range,
            coding,
            truth,
        });
        let mut bytes = vec![coding.steps.luma, coding.steps.chroma, coding.gain];
        let error = coder.error;
        bytes.extend(coder.encoder.finish());
        (cost(error, bytes.len()), bytes, (coding.steps, coded, model))
    };
    let ranges: Vec<_> = slices(nodes.masks.len(), slice).collect();
    let middle = &ranges[ranges.len() / 2];
    let coding = best(options.codings(), |coding| encode(middle.clone(), coding).0);
    let coded: Vec<_> = ranges.into_par_iter().map(|range| encode(range, coding)).collect();
    let (payloads, coded) = coded.into_iter().map(|(_, bytes, coded)| (bytes, coded)).unzip();
    (payloads, join(isa, nodes, above.last, coded))
}

/// The coding of least cost. A single one is not tried.
fn best(codings: Vec<Coding>, cost: impl Fn(Coding) -> f64 + Sync) -> Coding {
    if let [coding] = codings[..] {
        return coding;
    }
    let costs: Vec<f64> = codings.par_iter().map(|coding| cost(*coding)).collect();
    let least = (1..codings.len()).fold(0, |least, i| if costs[i] < costs[least] { i } else { least });
    codings[least]
}

/// Lagrangian cost of a squared error, in squared steps, and a number of bytes.
fn cost(error: f64, bytes: usize) -> f64 {
    error + GAIN_LAMBDA * 8.0 * bytes as f64
}

/// Above this magnitude coefficients are rounded to the nearest integer, without RDOQ.
const LARGE: f32 = 12.0;

/// Encodes coefficients, each the candidate of least Lagrangian cost.
struct RdoEncoder<'a> {
    encoder: Encoder,
    /// λ, and that of the node at hand.
    usual: f32,
    lambda: f32,
    /// The factors of λ in all nodes of the level; if there are none, they are 1.
    factors: &'a [f32],
    /// Sum of squared errors so far, in squared steps.
    error: f64,
}

impl RdoEncoder<'_> {
    fn new(lambda: f32) -> Self {
        RdoEncoder {
            encoder: Encoder::default(),
            usual: lambda,
            lambda,
            factors: &[],
            error: 0.0,
        }
    }

    /// The magnitude that minimises squared error + λ · bits. Candidates are the nearest integer, the one below it, and
    /// 0.
    #[inline(always)]
    fn quantise<I: Instructions>(&self, simd: I, model: &Model, c: &CoefficientContext, target: f32) -> i32 {
        let nearest = target.round();
        if nearest == 0.0 || nearest > LARGE || self.lambda == 0.0 {
            return nearest as i32;
        }
        let mut bits = [0.0; LARGE as usize + 1];
        let bits = &mut bits[..=nearest as usize];
        estimate_bits(simd, model, c, bits);
        let cost = |value: i32| {
            let sign = if value == 0 { 0.0 } else { 1.0 };
            let error = target - value as f32;
            error * error + self.lambda * (bits[value as usize] + sign)
        };
        let nearest = nearest as i32;
        let candidates = [nearest, nearest - 1, 0];
        candidates
            .into_iter()
            .min_by(|a, b| cost(*a).total_cmp(&cost(*b)))
            .unwrap_or(nearest)
    }
}

/// Estimates the bits of each magnitude 0 to `costs.len() − 1`, without the sign. All are below the escape.
#[inline(always)]
fn estimate_bits<I: Instructions>(simd: I, model: &Model, c: &CoefficientContext, costs: &mut [f32]) {
    let decisions = model.magnitude(simd, c);
    let mut sum = 0.0;
    for (magnitude, cost) in costs.iter_mut().enumerate() {
        let one = model.predict(simd, &decisions, magnitude.min(BINS - 1)).one as f32 / ONE as f32;
        *cost = sum - (1.0 - one).log2();
        sum -= one.log2();
    }
}

impl CoefficientCoder for RdoEncoder<'_> {
    #[inline(always)]
    fn start(&mut self, node: usize) {
        if let Some(factor) = self.factors.get(node) {
            self.lambda = factor * self.usual;
        }
    }

    #[inline(always)]
    fn coefficient<I: Instructions>(
        &mut self,
        simd: I,
        model: &mut Model,
        c: &CoefficientContext,
        target: i32,
        quantiser: Quantiser,
    ) -> i32 {
        let Quantiser { scale, unit } = quantiser;
        let exact = unit == 1;
        let steps = target.unsigned_abs() as f32 * scale.forward as f32 / (4096.0 * unit as f32);
        let chosen = if exact {
            target.abs()
        } else {
            let chosen = self.quantise(simd, model, c, steps);
            let error = f64::from(steps) - f64::from(chosen);
            self.error += error * error;
            chosen
        };
        model.code(simd, &mut self.encoder, c, if target < 0 { -chosen } else { chosen })
    }
}

/// Fits the weights of a filter pass to the original colours `truth` by least squares.
pub(super) fn fit_pass(isa: Isa, values: &[Ycc], map: &SiblingMap, steps: Steps, truth: &[Ycc]) -> [[i8; TERMS]; 3] {
    let values = &widen(values);
    let blocks: Vec<usize> = (0..values.len()).step_by(FIT_BLOCK).collect();
    let sums: Vec<_> = blocks
        .into_par_iter()
        .map(|first| {
            isa.run(Fit {
                first,
                values,
                map,
                steps,
                truth,
            })
        })
        .collect();
    let mut total = NormalEquations::default();
    for sum in sums {
        for t in 0..3 {
            for i in 0..TERMS {
                total[t].1[i] += sum[t].1[i];
                (0..TERMS).for_each(|j| total[t].0[i][j] += sum[t].0[i][j]);
            }
        }
    }
    total.map(|(a, b)| solve(a, b))
}

/// Number of voxels of one task of [`fit_pass`].
const FIT_BLOCK: usize = 16_384;

/// Normal equations of each channel: matrix and right-hand side.
type NormalEquations = [([[f64; TERMS]; TERMS], [f64; TERMS]); 3];

/// Accumulates the normal equations of a block of voxels.
struct Fit<'a> {
    first: usize,
    values: &'a [Values],
    map: &'a SiblingMap,
    steps: Steps,
    truth: &'a [Ycc],
}

impl Work for Fit<'_> {
    type Output = NormalEquations;

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> NormalEquations {
        let Fit {
            first,
            values,
            map,
            steps,
            truth,
        } = self;
        let responses = responses(steps);
        let mut sums = NormalEquations::default();
        let mut windows = map.windows(first);
        for voxel in first..values.len().min(first + FIT_BLOCK) {
            let Some((window, corner)) = windows.next() else {
                break;
            };
            let terms = terms(&responses.means(instructions, neighbourhood(values, voxel, window, corner)));
            for t in 0..3 {
                let residual = f64::from(truth[voxel][t]) - f64::from(values[voxel][t]);
                let x = terms[t].map(|x| f64::from(x) / 4.0);
                let (a, b) = &mut sums[t];
                for i in 0..TERMS {
                    b[i] += x[i] * residual;
                    for j in 0..TERMS {
                        a[i][j] += x[i] * x[j];
                    }
                }
            }
        }
        sums
    }
}
