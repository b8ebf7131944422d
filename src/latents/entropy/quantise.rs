//! From real latents to whole ones, with an eye on what they cost.

use std::convert::Infallible;

use rayon::prelude::*;

use super::octants::{Predict, each_latent, range};
use super::rows::Row;
use super::slice::{Condition, row};
use super::tables::Tables;

/// Voxels of one task.
const BLOCK: usize = 4096;

/// What a latent makes up for, of what those of its siblings before it are off.
const MADE_UP: f32 = 0.05;

/// How real latents become whole ones.
///
/// Each becomes the whole number of small `(y − q)² + price · bits(q)` that is found from the nearest one on, either
/// way, as long as the next is better.
#[derive(Debug, Clone, Copy)]
pub struct Rounding<'a> {
    /// Latents are kept within ± this.
    pub limit: i16,
    /// For each channel λ, in squared latent steps a bit, at least 0: at 0 every latent goes to its nearest
    /// whole number.
    pub prices: &'a [f32],
}

impl Rounding<'_> {
    /// A latent of a channel under its row, whose values count from `centre`.
    fn round(self, channel: usize, (row, centre): (Row, i32), y: f32) -> i16 {
        let (bound, price) = (f32::from(self.limit), self.prices[channel]);
        let y = y.clamp(-bound, bound);
        let near = y.round_ties_even();
        if price <= 0.0 {
            return near as i16;
        }
        let cost = |q: f32| (y - q).powi(2) + price * row.bits(q as i32 - centre);
        let mut best = (cost(near), near);
        for step in [-1.0, 1.0] {
            let mut next = near + step;
            while next.abs() <= bound && cost(next) < best.0 {
                best = (cost(next), next);
                next += step;
            }
        }
        best.1 as i16
    }
}

/// Rounds the latents [voxels, K] of a level that is coded by [`super::encode_level`].
///
/// # Panics
/// If the latents are not whole voxels, the condition has not one mean and scale for each, or there is not one price
/// for each channel.
pub fn quantise(tables: &Tables, condition: Condition, latents: &[f32], rounding: Rounding) -> Vec<i16> {
    condition.check(tables, latents.len());
    let k = tables.channels();
    assert_eq!(rounding.prices.len(), k, "one price per channel");
    let mut out = vec![0; latents.len()];
    let blocks = out.par_chunks_mut(BLOCK * k).zip(latents.par_chunks(BLOCK * k));
    blocks.enumerate().for_each(|(b, (out, latents))| {
        let first = b * BLOCK * k;
        let condition = condition.of(first..first + latents.len());
        for (i, (q, &y)) in out.iter_mut().zip(latents).enumerate() {
            *q = rounding.round(i % k, condition.row(tables, i), y);
        }
    });
    out
}

/// Rounds the latents [voxels, K] of a level that is coded by [`super::encode_passes`], in the order of coding: each
/// pass is predicted from those before it as they were rounded. What costs more bits than it gains stays away from a
/// whole smooth place, which shows; so where there is a price, a twentieth of what the latents of siblings (voxels of
/// one parent) before it are off, all of them together, counts as a latent's own.
///
/// # Panics
/// As [`super::encode_passes`] does, and if there is not one price for each channel.
pub fn quantise_passes(
    tables: &Tables,
    keys: &[u64],
    predict: &Predict,
    latents: &[f32],
    rounding: Rounding,
    slice_voxels: usize,
) -> Vec<i16> {
    let k = tables.channels();
    assert_eq!(latents.len(), keys.len() * k, "K latents per voxel");
    assert_eq!(rounding.prices.len(), k, "one price per channel");
    let bound = f32::from(rounding.limit);
    let mut out = vec![0; latents.len()];
    let slices = out
        .par_chunks_mut(slice_voxels * k)
        .zip(latents.par_chunks(slice_voxels * k));
    slices.enumerate().for_each(|(i, (part, latents))| {
        let slice = range(i, slice_voxels, keys.len());
        let own_keys = &keys[slice.clone()];
        let mut off = vec![0.0; latents.len()];
        let Ok(()) = each_latent(tables, keys, slice, predict, part, |at, c, mu, sigma| {
            let siblings = (0..at).rev();
            let siblings = siblings.take_while(|&v| own_keys[v] >> 3 == own_keys[at] >> 3);
            let y = latents[at * k + c].clamp(-bound, bound);
            let made_up = match rounding.prices[c] > 0.0 {
                true => siblings.map(|v| MADE_UP * off[v * k + c]).sum(),
                false => 0.0,
            };
            let q = rounding.round(c, row(tables, c, mu, sigma), y + made_up);
            off[at * k + c] = y - f32::from(q);
            Ok::<_, Infallible>(q)
        });
    });
    out
}

impl Row<'_> {
    /// About what it costs to code `d`.
    fn bits(&self, d: i32) -> f32 {
        let entry = d - self.low();
        let values = self.escape() as i32;
        let (entry, beyond) = if entry < 0 {
            (self.escape(), -entry)
        } else if entry >= values {
            (self.escape(), entry - values + 1)
        } else {
            (entry as usize, 0)
        };
        let more = if beyond > 0 { 2 + 2 * beyond.ilog2() } else { 0 };
        16.0 - f32::from(self.interval(entry).size).log2() + more as f32
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use super::*;
    use crate::latents::entropy::tests::tables;
    use crate::latents::entropy::{encode_passes, encode_slice};

    /// Channels of the tables.
    const K: usize = 2;

    /// Latents spread evenly around means of their own.
    fn some(count: usize) -> (Vec<f32>, Vec<i16>, Vec<u8>) {
        let unit = |i: usize, k: usize| (i * k % 1009) as f32 / 1009.0 - 0.5;
        let mu: Vec<i16> = (0..count).map(|i| (unit(i, 31) * 200.0) as i16).collect();
        let y = |(i, mu): (usize, &i16)| f32::from(*mu) / 16.0 + 3.0 * unit(i, 617);
        let y = mu.iter().enumerate().map(y).collect();
        (y, mu, (0..count).map(|i| (i % 40) as u8).collect())
    }

    fn at(limit: i16, prices: &[f32]) -> Rounding<'_> {
        Rounding { limit, prices }
    }

    #[test]
    fn without_a_price_every_latent_goes_to_its_nearest_number_within_the_limit() {
        let (y, mu, sigma) = some(100 * K);
        let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
        let q = quantise(&tables(), condition, &y, at(5, &[0.0; K]));
        for (q, y) in q.iter().zip(&y) {
            assert_eq!(f32::from(*q), y.clamp(-5.0, 5.0).round_ties_even());
        }
    }

    #[test]
    fn the_higher_lambda_the_fewer_bits_are_spent() {
        let (y, mu, sigma) = some(3000 * K);
        let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
        let lengths: Vec<usize> = [0.0, 0.05, 0.2, 1.0, 5.0]
            .into_iter()
            .map(|price| {
                let q = quantise(&tables(), condition, &y, at(127, &[price; K]));
                encode_slice(&tables(), condition, &q).len()
            })
            .collect();
        assert!(lengths.windows(2).all(|w| w[1] < w[0]), "{lengths:?}");
    }

    #[test]
    fn no_whole_number_between_a_latent_and_what_it_became_would_have_been_better() {
        let (y, mu, sigma) = some(500 * K);
        let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
        let (tables, prices) = (tables(), [3.0; K]);
        let q = quantise(&tables, condition, &y, at(127, &prices));
        let mut far = 0;
        for (i, (&q, &y)) in q.iter().zip(&y).enumerate() {
            let (row, centre) = condition.row(&tables, i);
            let cost = |q: i32| (y - q as f32).powi(2) + 3.0 * row.bits(q - centre);
            let (near, q) = (y.round_ties_even() as i32, i32::from(q));
            let best = (near.min(q)..=near.max(q)).map(cost).fold(f32::MAX, f32::min);
            assert_eq!(cost(q), best, "{y} became {q}");
            far += usize::from((near - q).abs() > 1);
        }
        assert!(far > 0, "some move by more than one");
    }

    #[test]
    fn passes_round_each_latent_under_what_its_decoder_will_know() {
        let keys: Vec<u64> = (0..3000).map(|i| 3 * i).collect();
        let slice = 1000;
        let (noise, ..) = some(keys.len() * K);
        let wave = |(i, noise): (usize, &f32)| 9.0 * (i as f32 / 70.0).sin() + noise / 60.0;
        let y: Vec<f32> = noise.iter().enumerate().map(wave).collect();
        // Every voxel is expected to be like the one before it, if that is known by then.
        let predict = |slice: Range<usize>, voxels: &[u32], known: &[i16]| {
            let before = |&v: &u32| {
                let v = v as usize;
                let known = (v > slice.start && keys[v - 1] & 7 < keys[v] & 7)
                    .then(|| known[(v - 1 - slice.start) * K..][..K].to_vec());
                known.unwrap_or_default()
            };
            let befores: Vec<Vec<i16>> = voxels.iter().map(before).collect();
            let mu = befores.iter().flat_map(|b| match &b[..] {
                [] => vec![0; K],
                b => b.iter().map(|b| 16 * b).collect(),
            });
            let sigma = befores.iter().flat_map(|b| [if b.is_empty() { 40 } else { 20 }; K]);
            (mu.collect(), sigma.collect())
        };
        for learning in [false, true] {
            let tables = tables().with_learning(learning);
            let rounding = at(127, &[0.1; K]);
            let q = quantise_passes(&tables, &keys, &predict, &y, rounding, slice);
            let mut known = vec![0; slice * K];
            for (i, latents) in q.chunks(slice * K).enumerate() {
                let own = range(i, slice, keys.len());
                let Ok(()) = each_latent(&tables, &keys, own, &predict, &mut known, |at, c, mu, sigma| {
                    let first = i * slice;
                    let off = |v: usize| y[v * K + c] - f32::from(q[v * K + c]);
                    let before = first..first + at;
                    let siblings = before.filter(|v| keys[*v] / 8 == keys[first + at] / 8);
                    let wanted = y[(first + at) * K + c] + siblings.rev().map(|v| MADE_UP * off(v)).sum::<f32>();
                    let rounded = rounding.round(c, row(&tables, c, mu, sigma), wanted);
                    assert_eq!(latents[at * K + c], rounded);
                    Ok::<_, Infallible>(rounded)
                });
            }
            let free = quantise_passes(&tables, &keys, &predict, &y, at(127, &[0.0; K]), slice);
            let nearest = |(q, y): (&i16, &f32)| f32::from(*q) == y.round_ties_even();
            assert!(free.iter().zip(&y).all(nearest));
            let bytes = |latents: &[i16]| -> usize {
                let slices = encode_passes(&tables, &keys, &predict, latents, slice);
                slices.iter().map(Vec::len).sum()
            };
            assert!(bytes(&q) < bytes(&free));
        }
    }
}
