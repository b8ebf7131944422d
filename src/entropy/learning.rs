//! What a slice teaches about its own predictions while it is coded: means that were too low or too high, scales that were too narrow or
//! too wide, and means where nothing is predicted.
//!
//! All of it starts anew in every slice, and is learned latent by latent in the order of coding, by the encoder and the decoder alike.
//!
//! # Means
//! Every channel has an offset, in units of 2⁻¹⁰ of a sixteenth, at first 0. Where `μ` and `σ` are predicted, `μ′ = μ + ⌊offset / 2¹⁰⌋`,
//! kept within ±2047, is used, and then the offset grows by 32 times `16·y − μ′`, kept within ±64, and is
//! kept within ±2²¹.
//!
//! # Scales
//! Every channel has an offset for calm places, one for lively ones, and one for where nothing is predicted, in units of 2⁻¹⁶ of a scale
//! index, at first 0. `σ′ = σ + ⌊(offset + 2¹⁵) / 2¹⁶⌋`, kept in 0 to 63, is used, and then the offset grows by 48 times the latent's
//! *slope*, and is kept within ±2²². With `p₊` and `p₋` what the latent's entry has of 2¹⁶ in the rows of the scale indices `σ′ + 1`
//! and `σ′ − 1` (kept in 0 to 63) and of `μ′`, the slope is `2¹²·(p₊ − p₋) / (p₊ + p₋)`, rounded towards zero.
//!
//! A voxel's surprise is the sum of the slopes of its predicted latents. After each voxel that has any, `trend`, at first 0, grows by
//! a quarter of what the surprise is above it, rounded down. A place is lively if `4·trend` plus the surprises of the voxels up to eight
//! before and after it in Morton order, those in its slice and coded already, is positive.
//!
//! # Where nothing is predicted
//! `μ` is the mean of the voxels two away along any of the axes that come before it in Morton order and in its slice, so have the same octant; those
//! count four that differ along one axis, two along two, one along three; in sixteenths, rounded to the nearest, halves up, and kept to 16 bits. `σ` is the
//! first scale whose likeliest value, with a whole mean, is no likelier than that of the channel's prior. If there are no such voxels, the prior codes the
//! latent, and nothing is learned.

use b2p_kernels::LIMIT;

use super::slice::UNPREDICTED;
use super::tables::{SCALES, Tables};
use crate::geometry::morton;

/// Offsets of means are in units of 2⁻¹⁰ of a sixteenth, those of scales in units of 2⁻¹⁶ of an index.
const MEAN_SHIFT: u32 = 10;
const SCALE_SHIFT: u32 = 16;
const LARGEST_MEAN_OFFSET: i32 = 2048 << MEAN_SHIFT;
const LARGEST_SCALE_OFFSET: i32 = 64 << SCALE_SHIFT;
/// What errors, in sixteenths, and slopes move them by.
const MEAN_RATE: i32 = 32;
const SCALE_RATE: i32 = 48;
/// Errors beyond this say no more.
const LARGEST_ERROR: i32 = 64;
/// A slope of 1.
const SLOPE_SHIFT: u32 = 12;
/// How far surprises are looked for, in Morton order.
const REACH: usize = 8;

/// What was learned so far in one slice.
#[derive(Debug)]
pub(super) struct Learning<'a> {
    tables: &'a Tables,
    /// The Morton keys of the slice.
    keys: &'a [u64],
    channels: Vec<Channel>,
    /// Voxel by voxel, 0 of those that are not coded or not predicted.
    surprises: Vec<i32>,
    trend: i32,
    /// How the voxel at hand is coded, channel by channel.
    at_hand: Vec<Latent>,
}

/// What was learned of one channel.
#[derive(Debug, Clone, Default)]
struct Channel {
    mean: i32,
    scales: [i32; 3],
}

/// What a latent teaches about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    Calm,
    Lively,
    /// Nothing is predicted, but there are others nearby.
    Unpredicted,
    /// There are none: it teaches nothing.
    Alone,
}

/// How one latent is coded.
#[derive(Debug, Clone, Copy)]
struct Latent {
    place: Place,
    mu: i16,
    sigma: u8,
}

impl<'a> Learning<'a> {
    /// Of the slice of voxels with these keys, ascending, if passes under these tables learn.
    pub fn of(tables: &'a Tables, keys: &'a [u64]) -> Option<Self> {
        tables.learning().then(|| Learning {
            tables,
            keys,
            channels: vec![Channel::default(); tables.channels()],
            surprises: vec![0; keys.len()],
            trend: 0,
            at_hand: Vec::with_capacity(tables.channels()),
        })
    }

    /// Replaces what was predicted for the latents of the slice's voxel `voxel` by what they are coded under. `coded` are the slice's
    /// latents so far, [voxels, K].
    pub fn prepare(&mut self, voxel: usize, coded: &[i16], mu: &mut [i16], sigma: &mut [u8]) {
        let place = match self.is_lively(voxel) {
            true => Place::Lively,
            false => Place::Calm,
        };
        let nearest = match sigma.contains(&UNPREDICTED) {
            true => self.nearest(voxel),
            false => Vec::new(),
        };
        self.at_hand.clear();
        for (c, (mu, sigma)) in mu.iter_mut().zip(sigma).enumerate() {
            let channel = &self.channels[c];
            let place = match *sigma {
                UNPREDICTED if nearest.is_empty() => Place::Alone,
                UNPREDICTED => {
                    let latents = nearest
                        .iter()
                        .map(|&(v, count)| (coded[v * self.channels.len() + c], count));
                    *mu = mean(latents);
                    *sigma = self.tables.prior_scale(c);
                    Place::Unpredicted
                }
                _ => {
                    let moved = i32::from(*mu) + (channel.mean >> MEAN_SHIFT);
                    *mu = moved.clamp(-i32::from(LIMIT), LIMIT.into()) as i16;
                    place
                }
            };
            if place != Place::Alone {
                let offset = channel.scales[place as usize];
                let moved = (offset + (1 << (SCALE_SHIFT - 1))) >> SCALE_SHIFT;
                *sigma = (i32::from(*sigma) + moved).clamp(0, SCALES as i32 - 1) as u8;
            }
            let (mu, sigma) = (*mu, *sigma);
            self.at_hand.push(Latent { place, mu, sigma });
        }
    }

    /// Learns from the latents of the voxel that was prepared last.
    pub fn learn(&mut self, voxel: usize, latents: &[i16]) {
        let mut surprise = None;
        for ((coded, channel), &y) in self.at_hand.iter().zip(&mut self.channels).zip(latents) {
            if coded.place == Place::Alone {
                continue;
            }
            let slope = slope(self.tables, coded, y);
            let offset = &mut channel.scales[coded.place as usize];
            *offset =
                (*offset + SCALE_RATE * slope).clamp(-LARGEST_SCALE_OFFSET, LARGEST_SCALE_OFFSET);
            if coded.place != Place::Unpredicted {
                let error = 16 * i32::from(y) - i32::from(coded.mu);
                let moved = channel.mean + MEAN_RATE * error.clamp(-LARGEST_ERROR, LARGEST_ERROR);
                channel.mean = moved.clamp(-LARGEST_MEAN_OFFSET, LARGEST_MEAN_OFFSET);
                *surprise.get_or_insert(0) += slope;
            }
        }
        if let Some(surprise) = surprise {
            self.surprises[voxel] = surprise;
            self.trend += (surprise - self.trend) >> 2;
        }
    }

    fn is_lively(&self, voxel: usize) -> bool {
        let end = self.surprises.len().min(voxel + REACH + 1);
        let around = &self.surprises[voxel.saturating_sub(REACH)..end];
        4 * self.trend + around.iter().sum::<i32>() > 0
    }

    /// The voxels that a mean is taken of where nothing is predicted, and what each counts.
    fn nearest(&self, voxel: usize) -> Vec<(usize, i32)> {
        let (before, key) = (&self.keys[..voxel], self.keys[voxel]);
        let here = morton::decode(key);
        let mut nearest = Vec::new();
        for tap in 0..27u32 {
            let steps = [tap % 3, tap / 3 % 3, tap / 9];
            let there: [u32; 3] =
                std::array::from_fn(|axis| (here[axis] + 2 * steps[axis]).wrapping_sub(2));
            let other = morton::encode(there);
            let inside = there.iter().all(|&x| x >> morton::MAX_DEPTH == 0);
            if inside
                && other < key
                && let Ok(v) = before.binary_search(&other)
            {
                let axes = steps.iter().filter(|&&step| step != 1).count();
                nearest.push((v, 8 >> axes));
            }
        }
        nearest
    }
}

/// The mean of latents that count so much, in sixteenths.
fn mean(latents: impl Iterator<Item = (i16, i32)>) -> i16 {
    // At most 26 of them, which count 4 at most.
    let (sum, count) = latents.fold((0, 0), |(sum, all), (latent, count)| {
        (sum + count * i32::from(latent), all + count)
    });
    let mean = (32 * sum + count).div_euclid(2 * count);
    mean.clamp(i16::MIN.into(), i16::MAX.into()) as i16
}

/// How much likelier a wider scale would have made a latent, from −1 to 1.
fn slope(tables: &Tables, coded: &Latent, latent: i16) -> i32 {
    let part = |sigma: u8| {
        let (row, centre) = tables.gauss(coded.mu, sigma);
        row.part(i32::from(latent) - centre) as i32
    };
    let wider = part((coded.sigma + 1).min(SCALES as u8 - 1));
    let narrower = part(coded.sigma.saturating_sub(1));
    ((wider - narrower) << SLOPE_SHIFT) / (wider + narrower)
}
