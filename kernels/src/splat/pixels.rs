//! The pixels of one block: one splat more.

use super::blend::{AREA, Block, SIDE};
use super::lanes::{LEAST_POWER, Lanes, Mask};
use super::layout::{COLUMNS, More, ROWS, Splat};
use super::{ALPHA_CEILING, Crossing, FINISHED, WAITING};

/// Puts an ellipse on the block. `u`, `v`: its form in the block's middle. False, and nothing done, if every pixel is finished.
#[inline(always)]
pub(super) fn blend<L: Lanes>(block: &mut Block, splat: &Splat, form: [f32; 2]) -> bool {
    let mut open = 0;
    for part in 0..AREA / L::COUNT {
        let lanes = part * L::COUNT;
        let (through, unfinished) = light::<L>(block, lanes);
        open |= unfinished.bits();
        let alpha = planar::<L>(splat, form, lanes).keep(unfinished);
        let weight = pass::<L>(block, lanes, through, alpha);
        add::<L>(block, lanes, weight, splat.colour);
    }
    open != 0
}

/// As [`blend`], of a Gaussian that reaches over the near plane. `at`: the block's first pixel in the tile, whose own is `corner`.
#[inline(always)]
pub(super) fn cross<L: Lanes>(
    block: &mut Block,
    splat: &Splat,
    at: [u32; 2],
    corner: [u32; 2],
    crossing: &Crossing,
) -> bool {
    let mut open = 0;
    for part in 0..AREA / L::COUNT {
        let lanes = part * L::COUNT;
        let (through, unfinished) = light::<L>(block, lanes);
        open |= unfinished.bits();
        let (alpha, _) = spatial::<L>(splat, at, corner, crossing, lanes);
        let weight = pass::<L>(block, lanes, through, alpha.keep(unfinished));
        add::<L>(block, lanes, weight, splat.colour);
    }
    open != 0
}

/// The transmittance, and where it is not finished.
#[inline(always)]
fn light<L: Lanes>(block: &Block, lanes: usize) -> (L, L::Mask) {
    let through = L::load(&block.through[lanes..]);
    (through, L::splat(FINISHED).le(through))
}

/// α of an ellipse.
#[inline(always)]
fn planar<L: Lanes>(splat: &Splat, [u, v]: [f32; 2], lanes: usize) -> L {
    let u = L::load(&splat.u[lanes..]).add(L::splat(u));
    let v = L::load(&splat.v[lanes..]).add(L::splat(v));
    let power = v.neg_mul_add(v, u.neg_mul_add(u, L::splat(splat.log_opacity)));
    power.exp2().min(L::splat(ALPHA_CEILING))
}

/// α of a Gaussian that reaches over the near plane, and the depth where it is greatest.
#[inline(always)]
fn spatial<L: Lanes>(splat: &Splat, at: [u32; 2], corner: [u32; 2], crossing: &Crossing, lanes: usize) -> (L, L) {
    let middle = |k: usize| L::splat((corner[k] + at[k]) as f32 + 0.5 * SIDE as f32);
    let x = L::load(&COLUMNS[lanes..]).add(middle(0));
    let y = L::load(&ROWS[lanes..]).add(middle(1));
    let zero = L::splat(0.0);
    let (mut from, mut along) = ([zero; 3], [zero; 3]);
    for k in 0..3 {
        for (to, [a, b, c]) in [(&mut from[k], crossing.from[k]), (&mut along[k], crossing.along[k])] {
            *to = x.mul_add(L::splat(a), y.mul_add(L::splat(b), L::splat(c)));
        }
    }
    let dot = |a: [L; 3], b: [L; 3]| a[0].mul_add(b[0], a[1].mul_add(b[1], a[2].mul(b[2])));
    // Where there is no nearest point, a quotient of zeroes, the plane is taken.
    let depth = zero.sub(dot(from, along)).div(dot(along, along));
    let depth = depth.max(L::splat(crossing.near));
    let mut power = L::splat(splat.log_opacity);
    for (from, along) in from.into_iter().zip(along) {
        let x = along.mul_add(depth, from);
        power = x.neg_mul_add(x, power);
    }
    let drawn = L::splat(LEAST_POWER).le(power);
    let alpha = power.exp2().min(L::splat(ALPHA_CEILING));
    (alpha.keep(drawn), depth)
}

/// Lets light through a layer of `alpha`; returns what stays there. That is the difference between what was and what is let through,
/// rounded as they are, so that the sum of all that stays, and what is let through in the end, is 1.
#[inline(always)]
fn pass<L: Lanes>(block: &mut Block, lanes: usize, through: L, alpha: L) -> L {
    let left = alpha.neg_mul_add(through, through);
    left.store(&mut block.through[lanes..]);
    through.sub(left)
}

/// Adds `weight` of a colour.
#[inline(always)]
fn add<L: Lanes>(block: &mut Block, lanes: usize, weight: L, colour: [f32; 3]) {
    for (sums, colour) in block.colour.iter_mut().zip(colour) {
        let sum = L::load(&sums[lanes..]);
        let sum = weight.mul_add(L::splat(colour), sum);
        sum.store(&mut sums[lanes..]);
    }
}

/// As [`blend`] and [`cross`], without colours: what stays in each pixel. `None`, and nothing done, if every pixel is finished.
#[inline(always)]
pub(super) fn weigh<L: Lanes>(
    block: &mut Block,
    splat: &Splat,
    form: [f32; 2],
    at: [u32; 2],
    corner: [u32; 2],
    crossing: Option<&Crossing>,
) -> Option<[f32; AREA]> {
    let mut open = 0;
    let mut weights = [0.0; AREA];
    for part in 0..AREA / L::COUNT {
        let lanes = part * L::COUNT;
        let (through, unfinished) = light::<L>(block, lanes);
        open |= unfinished.bits();
        let alpha = match crossing {
            Some(crossing) => spatial::<L>(splat, at, corner, crossing, lanes).0,
            None => planar::<L>(splat, form, lanes),
        };
        let weight = pass::<L>(block, lanes, through, alpha.keep(unfinished));
        weight.store(&mut weights[lanes..]);
    }
    (open != 0).then_some(weights)
}

/// What a block's pixels show most of.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Best {
    weight: [f32; AREA],
    /// The bits of the Gaussian's index.
    pub id: [f32; AREA],
}

impl Best {
    pub const NONE: Best = Best {
        weight: [0.0; AREA],
        id: [f32::from_bits(u32::MAX); AREA],
    };

    /// Notes what stays of a Gaussian in each pixel.
    #[inline(always)]
    pub(super) fn note<L: Lanes>(&mut self, weights: &[f32; AREA], index: u32) {
        for part in 0..AREA / L::COUNT {
            let lanes = part * L::COUNT;
            let weight = L::load(&weights[lanes..]);
            let best = L::load(&self.weight[lanes..]);
            let more_of = best.lt(weight);
            let id = L::splat(f32::from_bits(index));
            let id = L::select(more_of, id, L::load(&self.id[lanes..]));
            id.store(&mut self.id[lanes..]);
            best.max(weight).store(&mut self.weight[lanes..]);
        }
    }
}

/// Depth, α, and colour of the splats that wait, in each pixel, for something that may be nearer there: the nearest first.
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

    /// Lets the nearest of those that wait, and of the splat, be blended in each pixel; the others wait. α below `least` does not.
    #[inline(always)]
    pub(super) fn add<L: Lanes>(
        &mut self,
        block: &mut Block,
        splat: &Splat,
        form: [f32; 2],
        more: &More,
        at: [u32; 2],
        corner: [u32; 2],
        crossing: Option<&Crossing>,
        least: f32,
    ) -> bool {
        let mut open = 0;
        for part in 0..AREA / L::COUNT {
            let lanes = part * L::COUNT;
            let (through, unfinished) = light::<L>(block, lanes);
            open |= unfinished.bits();
            let (alpha, depth) = match crossing {
                Some(crossing) => spatial::<L>(splat, at, corner, crossing, lanes),
                None => {
                    let [first, right, down] = more.depth;
                    let middle = |k: usize| at[k] as f32 + 0.5 * SIDE as f32;
                    let first = L::splat(first + right * middle(0) + down * middle(1));
                    let depth = L::load(&COLUMNS[lanes..]).mul_add(L::splat(right), first);
                    let depth = L::load(&ROWS[lanes..]).mul_add(L::splat(down), depth);
                    (planar::<L>(splat, form, lanes), depth)
                }
            };
            // What is as good as nothing needs no place, and goes first.
            let depth = L::select(L::splat(least).le(alpha), depth, L::splat(f32::NEG_INFINITY));
            let [r, g, b] = splat.colour;
            let mut new = [depth, alpha, L::splat(r), L::splat(g), L::splat(b)];
            let mut nearest = new;
            for k in 0..WAITING {
                let sooner = new[0].lt(L::load(&self.0[k][0][lanes..]));
                for i in 0..5 {
                    let waiting = L::load(&self.0[k][i][lanes..]);
                    let first = L::select(sooner, new[i], waiting);
                    new[i] = L::select(sooner, waiting, new[i]);
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
            let weight = pass::<L>(block, lanes, through, nearest[1].keep(unfinished));
            layer::<L>(block, lanes, weight, &nearest[2..]);
        }
        open != 0
    }

    /// Blends all that waits.
    #[inline(always)]
    pub(super) fn blend<L: Lanes>(&self, block: &mut Block) {
        for place in &self.0 {
            for part in 0..AREA / L::COUNT {
                let lanes = part * L::COUNT;
                let (through, unfinished) = light::<L>(block, lanes);
                let alpha = L::load(&place[1][lanes..]);
                let weight = pass::<L>(block, lanes, through, alpha.keep(unfinished));
                let mut colour = [alpha; 3];
                for (to, from) in colour.iter_mut().zip(&place[2..]) {
                    *to = L::load(&from[lanes..]);
                }
                layer::<L>(block, lanes, weight, &colour);
            }
        }
    }
}

/// Adds `weight` of colours, one to a lane.
#[inline(always)]
fn layer<L: Lanes>(block: &mut Block, lanes: usize, weight: L, colour: &[L]) {
    for (sums, colour) in block.colour.iter_mut().zip(colour) {
        let sum = L::load(&sums[lanes..]);
        weight.mul_add(*colour, sum).store(&mut sums[lanes..]);
    }
}
