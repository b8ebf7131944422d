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
//! *slope*, and is kept within ±2²². With `p₊` and `p₋` what the latent's entry (the last one, if it has none of its own there) has of 2¹⁶ in the rows of the
//! scale indices `σ′ + 1` and `σ′ − 1` (kept in 0 to 63) and of `μ′`, the slope is `2¹²·(p₊ − p₋) / (p₊ + p₋)`, rounded towards zero.
//!
//! A voxel's surprise is the sum of the slopes of its predicted latents. After each voxel that has any, `trend`, at first 0, grows by
//! a quarter of what the surprise is above it, rounded down. A place is lively if `4·trend` plus the surprises of the voxels up to eight
//! before and after it in Morton order, those in its slice and coded already, is positive.
//!
//! # Where nothing is predicted
//! `μ` is the mean of the voxels two away along any of the axes that come before it in Morton order and in its slice, so have the same octant; those
//! count four that differ along one axis, two along two, one along three; in sixteenths, rounded to the nearest, halves up, and kept to 16 bits. `σ` is the
//! first scale whose likeliest value, with a whole mean, is no likelier than that of the channel's prior, 63 if there is none. If there are no such voxels, the prior codes the
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::entropy::test_tables::{Random, tables};
    use std::collections::BTreeMap;

    /// One voxel: its key, latents, and the means and scale indices predicted for them.
    type Voxel = (u64, [i16; 2], [i16; 2], [u8; 2]);

    /// Voxels of all octants, close by and far away, in the order of coding; predictions are now right and now wrong.
    fn some(seed: u64, count: usize) -> Vec<Voxel> {
        let mut random = Random(seed);
        let mut draw = move |n: u64| random.next() % n;
        let keys: BTreeMap<u64, [u64; 5]> = (0..count)
            .map(|_| (draw(1 << 12), std::array::from_fn(|_| draw(1 << 20))))
            .collect();
        let mut voxels: Vec<Voxel> = keys
            .iter()
            .map(|(&key, r)| {
                let large = if r[0] % 50 == 0 { 3000 } else { 9 };
                let value = |r: u64| (r % large) as i16 - large as i16 / 2 + (key >> 9) as i16;
                let y = [value(r[1]), value(r[2]) / 4];
                let predicted = key & 7 > 1 || r[0] % 3 == 0;
                let sigma = |r: u64| match predicted {
                    true => (r % 64) as u8,
                    false => UNPREDICTED,
                };
                let mu = [(r[1] % 600) as i16 - 300, (r[3] % 5000) as i16 - 2500];
                (key, y, mu, [sigma(r[3]), sigma(r[4])])
            })
            .collect();
        voxels.sort_by_key(|&(key, ..)| (key & 7, key));
        voxels
    }

    /// What this module's documentation says, word by word.
    fn by_definition(voxels: &[Voxel]) -> Vec<([i64; 2], [i64; 2])> {
        let (tables, mut keys) = (tables(), Vec::new());
        keys.extend(voxels.iter().map(|v| v.0));
        keys.sort_unstable();
        let rank = |key: u64| keys.binary_search(&key).unwrap() as i64;
        let (mut means, mut scales, mut trend) = ([0i64; 2], [[0i64; 3]; 2], 0i64);
        let mut surprises: Vec<(i64, i64)> = Vec::new();
        let mut done: Vec<(u64, [i16; 2])> = Vec::new();
        let mut used = Vec::new();
        for &(key, y, mu, sigma) in voxels {
            let near = surprises.iter().filter(|s| (s.0 - rank(key)).abs() <= 8);
            let lively = 4 * trend + near.map(|s| s.1).sum::<i64>() > 0;
            let at = morton::decode(key).map(i64::from);
            let around: Vec<(i64, [i16; 2])> = done
                .iter()
                .filter_map(|&(other, y)| {
                    let there = morton::decode(other).map(i64::from);
                    let away: [i64; 3] = std::array::from_fn(|i| (there[i] - at[i]).abs());
                    let moved = away.iter().filter(|&&d| d > 0).count();
                    let two = away.iter().all(|&d| d == 0 || d == 2);
                    (two && other < key).then_some(([0, 4, 2, 1][moved], y))
                })
                .collect();
            let (mut m, mut s) = ([0; 2], [0; 2]);
            let mut surprise = None;
            for c in 0..2 {
                let all: i64 = around.iter().map(|a| a.0).sum();
                let place = match (sigma[c], all) {
                    (UNPREDICTED, 0) => {
                        (m[c], s[c]) = (mu[c].into(), UNPREDICTED.into());
                        continue;
                    }
                    (UNPREDICTED, _) => 2,
                    _ => usize::from(lively),
                };
                let scale = if place == 2 {
                    let sum: i64 = around.iter().map(|a| a.0 * 16 * i64::from(a.1[c])).sum();
                    m[c] = (2 * sum + all).div_euclid(2 * all).clamp(-32_768, 32_767);
                    i64::from(tables.prior_scale(c))
                } else {
                    m[c] = (i64::from(mu[c]) + means[c].div_euclid(1024)).clamp(-2047, 2047);
                    i64::from(sigma[c])
                };
                s[c] = (scale + (scales[c][place] + 32_768).div_euclid(65_536)).clamp(0, 63);
                let has = |sigma: i64| {
                    let (row, centre) = tables.gauss(m[c] as i16, sigma.clamp(0, 63) as u8);
                    i64::from(row.part(i32::from(y[c]) - centre))
                };
                let (more, less) = (has(s[c] + 1), has(s[c] - 1));
                let slope = 4096 * (more - less) / (more + less);
                scales[c][place] = (scales[c][place] + 48 * slope).clamp(-(1 << 22), 1 << 22);
                if place < 2 {
                    let error = (16 * i64::from(y[c]) - m[c]).clamp(-64, 64);
                    means[c] = (means[c] + 32 * error).clamp(-(1 << 21), 1 << 21);
                    *surprise.get_or_insert(0) += slope;
                }
            }
            if let Some(surprise) = surprise {
                surprises.push((rank(key), surprise));
                trend += (surprise - trend).div_euclid(4);
            }
            done.push((key, y));
            used.push((m, s));
        }
        used
    }

    #[test]
    fn what_is_learned_is_what_the_definition_says() {
        for (seed, count) in [(1, 1), (2, 3), (3, 40), (4, 700), (5, 3000)] {
            let voxels = some(seed, count);
            let mut keys: Vec<u64> = voxels.iter().map(|v| v.0).collect();
            keys.sort_unstable();
            let tables = tables().with_learning(true);
            let mut learning = Learning::of(&tables, &keys).expect("these tables learn");
            let mut coded = vec![0; 2 * keys.len()];
            let (mut unpredicted, mut alone) = (0, 0);
            for (&(key, y, mut mu, mut sigma), (m, s)) in voxels.iter().zip(by_definition(&voxels))
            {
                let voxel = keys.binary_search(&key).unwrap();
                unpredicted += usize::from(sigma[0] == UNPREDICTED);
                learning.prepare(voxel, &coded, &mut mu, &mut sigma);
                alone += usize::from(sigma[0] == UNPREDICTED);
                assert_eq!((mu.map(i64::from), sigma.map(i64::from)), (m, s));
                coded[2 * voxel..][..2].copy_from_slice(&y);
                learning.learn(voxel, &y);
            }
            assert!(count < 700 || (alone > 0 && unpredicted > 2 * alone));
        }
    }

    #[test]
    fn a_prior_starts_from_the_scale_that_is_as_sure() {
        let tables = tables();
        // Half of all latents are 0: so they are under a normal law 0.74 wide.
        let sigma = 0.11 * (64.0f64 / 0.11).powf(f64::from(tables.prior_scale(0)) / 63.0);
        assert!((0.7..0.85).contains(&sigma), "{sigma}");
    }
}
