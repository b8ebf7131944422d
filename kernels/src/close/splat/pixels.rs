//! The pixels of one block: one splat more.

use bytemuck::must_cast_slice_mut;

use super::block::{AREA, Block, COLUMNS, EffectData, ROWS, SIDE, Splat};
use super::ellipse::{ALPHA_CEILING, Crossing, FINISHED, WAITING};
use crate::simd::{F32Vector, I32Vector, LEAST_EXPONENT, MaskVector, Simd};

/// Puts an ellipse on the block. `u`, `v`: its form in the block's middle. False, and nothing done, if every pixel is
/// finished.
#[inline(always)]
pub(super) fn blend<S: Simd>(simd: S, block: &mut Block, splat: &Splat, form: [f32; 2]) -> bool {
    let mut open = 0;
    for part in 0..AREA / S::LANES {
        let lanes = part * S::LANES;
        let (through, unfinished) = light(simd, block, lanes);
        open |= unfinished.bits();
        let alpha = planar(simd, splat, form, lanes).keep(unfinished);
        let weight = pass(simd, block, lanes, through, alpha);
        add(simd, block, lanes, weight, splat.colour);
    }
    open != 0
}

/// As [`blend`], of a Gaussian that reaches over the near plane. `at`: the block's first pixel in the tile, whose own
/// is `corner`.
#[inline(always)]
pub(super) fn cross<S: Simd>(
    simd: S,
    block: &mut Block,
    splat: &Splat,
    at: [u32; 2],
    corner: [u32; 2],
    crossing: &Crossing,
) -> bool {
    let mut open = 0;
    for part in 0..AREA / S::LANES {
        let lanes = part * S::LANES;
        let (through, unfinished) = light(simd, block, lanes);
        open |= unfinished.bits();
        let (alpha, _) = spatial(simd, splat, at, corner, crossing, lanes);
        let weight = pass(simd, block, lanes, through, alpha.keep(unfinished));
        add(simd, block, lanes, weight, splat.colour);
    }
    open != 0
}

/// The transmittance, and where it is not finished.
#[inline(always)]
fn light<S: Simd>(simd: S, block: &Block, lanes: usize) -> (S::F32, S::Mask) {
    let transmittance = S::F32::load(simd, &block.through[lanes..]);
    (transmittance, S::F32::splat(simd, FINISHED).le(transmittance))
}

/// α of an ellipse.
#[inline(always)]
fn planar<S: Simd>(simd: S, splat: &Splat, [u, v]: [f32; 2], lanes: usize) -> S::F32 {
    let u = S::F32::load(simd, &splat.u[lanes..]) + S::F32::splat(simd, u);
    let v = S::F32::load(simd, &splat.v[lanes..]) + S::F32::splat(simd, v);
    let power = v.neg_mul_add(v, u.neg_mul_add(u, S::F32::splat(simd, splat.log_opacity)));
    power.exp2().min(S::F32::splat(simd, ALPHA_CEILING))
}

/// α of a Gaussian that reaches over the near plane, and the depth where it is greatest.
#[inline(always)]
fn spatial<S: Simd>(
    simd: S,
    splat: &Splat,
    at: [u32; 2],
    corner: [u32; 2],
    crossing: &Crossing,
    lanes: usize,
) -> (S::F32, S::F32) {
    let middle = |k: usize| S::F32::splat(simd, (corner[k] + at[k]) as f32 + 0.5 * SIDE as f32);
    let x = S::F32::load(simd, &COLUMNS[lanes..]) + middle(0);
    let y = S::F32::load(simd, &ROWS[lanes..]) + middle(1);
    let zero = S::F32::splat(simd, 0.0);
    let (mut from, mut along) = ([zero; 3], [zero; 3]);
    for k in 0..3 {
        for (to, [a, b, c]) in [(&mut from[k], crossing.from[k]), (&mut along[k], crossing.along[k])] {
            *to = x.mul_add(
                S::F32::splat(simd, a),
                y.mul_add(S::F32::splat(simd, b), S::F32::splat(simd, c)),
            );
        }
    }
    let dot = |a: [S::F32; 3], b: [S::F32; 3]| a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]));
    // Where there is no nearest point, a quotient of zeroes, the plane is taken.
    let depth = (zero - dot(from, along)) / dot(along, along);
    let depth = depth.max(S::F32::splat(simd, crossing.near));
    let mut power = S::F32::splat(simd, splat.log_opacity);
    for (from, along) in from.into_iter().zip(along) {
        let x = along.mul_add(depth, from);
        power = x.neg_mul_add(x, power);
    }
    let drawn = S::F32::splat(simd, LEAST_EXPONENT).le(power);
    let alpha = power.exp2().min(S::F32::splat(simd, ALPHA_CEILING));
    (alpha.keep(drawn), depth)
}

/// Blends a layer of `alpha`; returns its weight: the difference between the transmittances before and after it,
/// rounded as they are, so that all weights and the last transmittance add up to 1.
#[inline(always)]
fn pass<S: Simd>(_: S, block: &mut Block, lanes: usize, through: S::F32, alpha: S::F32) -> S::F32 {
    let left = alpha.neg_mul_add(through, through);
    left.store(&mut block.through[lanes..]);
    through - left
}

/// Adds `weight` of a colour.
#[inline(always)]
fn add<S: Simd>(simd: S, block: &mut Block, lanes: usize, weight: S::F32, colour: [f32; 3]) {
    for (sums, colour) in block.colour.iter_mut().zip(colour) {
        let sum = S::F32::load(simd, &sums[lanes..]);
        let sum = weight.mul_add(S::F32::splat(simd, colour), sum);
        sum.store(&mut sums[lanes..]);
    }
}

/// As [`blend`] and [`cross`], without colours: what stays in each pixel. `None`, and nothing done, if every pixel is
/// finished.
#[inline(always)]
pub(super) fn weigh<S: Simd>(
    simd: S,
    block: &mut Block,
    splat: &Splat,
    form: [f32; 2],
    at: [u32; 2],
    corner: [u32; 2],
    crossing: Option<&Crossing>,
) -> Option<[f32; AREA]> {
    let mut open = 0;
    let mut weights = [0.0; AREA];
    for part in 0..AREA / S::LANES {
        let lanes = part * S::LANES;
        let (through, unfinished) = light(simd, block, lanes);
        open |= unfinished.bits();
        let alpha = match crossing {
            Some(crossing) => spatial(simd, splat, at, corner, crossing, lanes).0,
            None => planar(simd, splat, form, lanes),
        };
        let weight = pass(simd, block, lanes, through, alpha.keep(unfinished));
        weight.store(&mut weights[lanes..]);
    }
    (open != 0).then_some(weights)
}

/// What a block's pixels show most of.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Best {
    weight: [f32; AREA],
    /// The Gaussian's index, or [`u32::MAX`].
    id: [u32; AREA],
}

impl Best {
    pub const NONE: Best = Best {
        weight: [0.0; AREA],
        id: [u32::MAX; AREA],
    };

    /// What a pixel shows most of, or [`u32::MAX`].
    pub fn id(&self, pixel: usize) -> u32 {
        self.id[pixel]
    }

    /// Notes what stays of a Gaussian in each pixel.
    #[inline(always)]
    pub(super) fn note<S: Simd>(&mut self, simd: S, weights: &[f32; AREA], index: u32) {
        for part in 0..AREA / S::LANES {
            let lanes = part * S::LANES;
            let weight = S::F32::load(simd, &weights[lanes..]);
            let best = S::F32::load(simd, &self.weight[lanes..]);
            let more_of = best.lt(weight);
            let ids: &mut [i32] = must_cast_slice_mut(&mut self.id[lanes..]);
            let id = S::I32::splat(simd, index as i32);
            S::I32::select(more_of, id, S::I32::load(simd, ids)).store(ids);
            best.max(weight).store(&mut self.weight[lanes..]);
        }
    }
}

/// Depth, α, and colour of the splats that wait, in each pixel, for something that may be nearer there: the nearest
/// first.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Pending([[[f32; AREA]; 5]; WAITING]);

impl Pending {
    /// Nothing waits: places of no opacity, before everything.
    pub const NONE: Pending = {
        let nothing = [
            [f32::NEG_INFINITY; AREA],
            [0.0; AREA],
            [0.0; AREA],
            [0.0; AREA],
            [0.0; AREA],
        ];
        Pending([nothing; WAITING])
    };

    /// Lets the nearest of those that wait, and of the splat, be blended in each pixel; the others wait. α below
    /// `least` does not.
    #[inline(always)]
    pub(super) fn add<S: Simd>(
        &mut self,
        simd: S,
        block: &mut Block,
        splat: &Splat,
        form: [f32; 2],
        data: &EffectData,
        at: [u32; 2],
        corner: [u32; 2],
        crossing: Option<&Crossing>,
        least: f32,
    ) -> bool {
        let mut open = 0;
        for part in 0..AREA / S::LANES {
            let lanes = part * S::LANES;
            let (through, unfinished) = light(simd, block, lanes);
            open |= unfinished.bits();
            let (alpha, depth) = match crossing {
                Some(crossing) => spatial(simd, splat, at, corner, crossing, lanes),
                None => {
                    let [first, right, down] = data.depth;
                    let middle = |k: usize| at[k] as f32 + 0.5 * SIDE as f32;
                    let first = S::F32::splat(simd, first + right * middle(0) + down * middle(1));
                    let depth = S::F32::load(simd, &COLUMNS[lanes..]).mul_add(S::F32::splat(simd, right), first);
                    let depth = S::F32::load(simd, &ROWS[lanes..]).mul_add(S::F32::splat(simd, down), depth);
                    (planar(simd, splat, form, lanes), depth)
                }
            };
            // What is as good as nothing needs no place, and goes first.
            let depth = S::F32::select(
                S::F32::splat(simd, least).le(alpha),
                depth,
                S::F32::splat(simd, f32::NEG_INFINITY),
            );
            let [r, g, b] = splat.colour;
            let mut new = [
                depth,
                alpha,
                S::F32::splat(simd, r),
                S::F32::splat(simd, g),
                S::F32::splat(simd, b),
            ];
            let mut nearest = new;
            for k in 0..WAITING {
                let sooner = new[0].lt(S::F32::load(simd, &self.0[k][0][lanes..]));
                for i in 0..5 {
                    let waiting = S::F32::load(simd, &self.0[k][i][lanes..]);
                    let first = S::F32::select(sooner, new[i], waiting);
                    new[i] = S::F32::select(sooner, waiting, new[i]);
                    if k == 0 {
                        nearest[i] = first;
                    } else {
                        first.store(&mut self.0[k - 1][i][lanes..]);
                    }
                }
            }
            for (last, new) in self.0[WAITING - 1].iter_mut().zip(&new) {
                new.store(&mut last[lanes..]);
            }
            let weight = pass(simd, block, lanes, through, nearest[1].keep(unfinished));
            layer(simd, block, lanes, weight, &nearest[2..]);
        }
        open != 0
    }

    /// Blends all that waits.
    #[inline(always)]
    pub(super) fn blend<S: Simd>(&self, simd: S, block: &mut Block) {
        for place in &self.0 {
            for part in 0..AREA / S::LANES {
                let lanes = part * S::LANES;
                let (through, unfinished) = light(simd, block, lanes);
                let alpha = S::F32::load(simd, &place[1][lanes..]);
                let weight = pass(simd, block, lanes, through, alpha.keep(unfinished));
                let mut colour = [alpha; 3];
                for (to, from) in colour.iter_mut().zip(&place[2..]) {
                    *to = S::F32::load(simd, &from[lanes..]);
                }
                layer(simd, block, lanes, weight, &colour);
            }
        }
    }
}

/// Adds `weight` of colours, one to a lane.
#[inline(always)]
fn layer<S: Simd>(simd: S, block: &mut Block, lanes: usize, weight: S::F32, colour: &[S::F32]) {
    for (sums, colour) in block.colour.iter_mut().zip(colour) {
        let sum = S::F32::load(simd, &sums[lanes..]);
        weight.mul_add(*colour, sum).store(&mut sums[lanes..]);
    }
}
