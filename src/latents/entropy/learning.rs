//! What a slice teaches about its own predictions while it is coded: means that were too low or too high, here or
//! nearby; scales that were too narrow or too wide; and means where nothing is predicted.
//!
//! All of it starts from its first values in every slice, and is learned latent by latent in the order of coding, by
//! the encoder and the decoder alike. Shifts to the right round down.
//!
//! # Where nothing is predicted
//! `μ` is the mean of the latents two away along each of the axes along which they differ, in the same slice, of those
//! that were coded before; those count four that differ along one axis, two along two, one along three; in sixteenths,
//! rounded to the nearest, halves up, and kept to 16 bits. `σ` is the first scale whose likeliest value, with a whole
//! mean, is no likelier than that of the channel's prior, 63 if there is none. If there are no such voxels, the prior
//! codes the latent, and nothing is learned from it. Else all that follows holds as for a latent that is predicted,
//! with weights and offsets of their own.
//!
//! # Residuals
//! A latent's residual is `16·y − μ`, kept within ±1023. Nearby are the voxels one or two away along each of the axes
//! along which they differ, in the same slice, of those that were coded before. They make four sets: one away along one
//! axis, one away along more, two away along one, two away along more. With `n` the voxels of a set that have
//! residuals, and `r` the sum of these in a channel, the set's input is `(r·⌊2¹⁶ / (n + 1)⌋) >> 12`. Two more inputs
//! are 16 times the residuals of the voxel's own latents one and two channels before; 0 if there are none.
//!
//! # Means
//! Every channel has an offset, in units of 2⁻¹⁰ of a sixteenth, at first 0, and a weight for every input, in units of
//! 2⁻¹⁸, at first ⅛ for what is one away, ¼ for what is two away, and 0; where nothing is predicted all are 0.
//! `μ′ = μ + (Σ (weight >> 6)·input + 2⁶·offset + 2¹⁵) >> 16`, kept within ±2047, is used. Then with the error `16·y −
//! μ′`, kept within ±16, the offset grows by 32 times the error, and is kept within ±2²¹; every weight by the error
//! times its input, that kept within ±256, and is kept within ±2¹⁹.
//!
//! # Scales
//! A latent's *gradient*, of its log-likelihood with respect to scale, is positive where a wider scale would have made
//! it likelier: with `p₊` and `p₋` what its entry (the last one, if it has none of its own there) has of 2¹⁶ in the
//! rows of the scale indices `σ′ + 1` and `σ′ − 1` (kept in 0 to 63) and of `μ′`, it is `2¹²·(p₊ − p₋) / (p₊ + p₋)`,
//! rounded towards zero. A voxel's gradient sum is that of its latents that have residuals.
//!
//! Places are of six kinds: by whether the mean gradient sum of the voxels nearby that have residuals is at least −256,
//! 0, 256 and 768, and those where there are none. Every channel has an offset for each kind, and one for all, in units
//! of 2⁻¹⁶ of a scale index, at first 0. `σ′ = σ + (both offsets + 2¹⁵) >> 16`, kept in 0 to 63, is used, and then they
//! grow by 24 and 36 times the gradient, and are kept within ±2²².

use b2p_kernels::LIMIT;

use super::neighbourhood::{CausalNeighbourhood, Neighbour};
use super::slice::UNPREDICTED;
use super::tables::{SCALES, Tables};

/// Residuals, in sixteenths, are kept within this.
const LARGEST_RESIDUAL: i32 = 1023;
/// What a mean is corrected by: four sets of voxels nearby, and the voxel's own latents before.
const SETS: usize = 4;
const INPUTS: usize = SETS + 2;
/// Inputs are in units of 2⁻⁴ of a sixteenth.
const INPUT_SHIFT: u32 = 4;
/// Weights are in units of 2⁻¹⁸; they are multiplied in steps of 2⁻¹².
const WEIGHT_SHIFT: u32 = 18;
const COARSER: u32 = 6;
const FIRST_WEIGHTS: [i32; INPUTS] = {
    let one = 1 << WEIGHT_SHIFT;
    [one / 8, one / 8, one / 4, one / 4, 0, 0]
};
const LARGEST_WEIGHT: i32 = 2 << WEIGHT_SHIFT;
/// What weights are multiplied with is in units of 2⁻¹⁶ of a sixteenth.
const PRODUCT_SHIFT: u32 = WEIGHT_SHIFT - COARSER + INPUT_SHIFT;

/// Offsets of means are in units of 2⁻¹⁰ of a sixteenth, those of scales in units of 2⁻¹⁶ of an index.
const MEAN_SHIFT: u32 = 10;
const SCALE_SHIFT: u32 = 16;
const LARGEST_MEAN_OFFSET: i32 = 2048 << MEAN_SHIFT;
const LARGEST_SCALE_OFFSET: i32 = 64 << SCALE_SHIFT;
/// What errors, in sixteenths, and gradients move them by.
const MEAN_RATE: i32 = 32;
const SCALE_RATE: i32 = 36;
const PLACE_RATE: i32 = 24;
/// Errors beyond this, a step of a latent, say no more.
const LARGEST_ERROR: i32 = 16;
/// A gradient of 1.
const GRADIENT_SHIFT: u32 = 12;

/// Mean gradient sums that separate kinds of places.
const GRADIENT_BOUNDS: [i32; 4] = [-256, 0, 256, 768];
const PLACES: usize = GRADIENT_BOUNDS.len() + 2;
/// The kind of places where nothing is known nearby.
const STRANGE: usize = PLACES - 1;

/// What was learned so far in one slice.
#[derive(Debug)]
pub(super) struct Learning<'a> {
    tables: &'a Tables,
    neighbourhood: CausalNeighbourhood,
    /// Where latents are predicted, and where not.
    channels: Vec<[Channel; 2]>,
    /// Of the latents coded so far, [voxels, K].
    residuals: Vec<i16>,
    /// Of each voxel that has residuals.
    gradient_sums: Vec<Option<i32>>,
    here: VoxelState,
}

/// What was learned of one channel.
#[derive(Debug, Clone)]
struct Channel {
    weights: [i32; INPUTS],
    mean: i32,
    scale: i32,
    scales: [i32; PLACES],
}

/// The voxel at hand.
#[derive(Debug, Default)]
struct VoxelState {
    voxel: usize,
    /// Sums of residuals in the causal neighbourhood, [sets, K], and the factor of each set's mean.
    sums: Vec<i32>,
    factors: [i32; SETS],
    /// The kind of place.
    place: usize,
    /// The latents two away and what each counts, if something is not predicted.
    two_away: Vec<(usize, i32)>,
    gradient_sum: Option<i32>,
    /// None if the prior codes it.
    latent: Option<Latent>,
}

/// How the latent at hand is coded.
#[derive(Debug, Clone, Copy)]
struct Latent {
    unpredicted: bool,
    /// The mean before it is corrected, and by what it is.
    mean: i16,
    inputs: [i32; INPUTS],
    mu: i16,
    sigma: u8,
}

impl<'a> Learning<'a> {
    /// Of the slice of voxels with these keys, ascending, if passes under these tables learn.
    pub fn of(tables: &'a Tables, keys: &[u64]) -> Option<Self> {
        let k = tables.channels();
        let channel = |weights| Channel {
            weights,
            mean: 0,
            scale: 0,
            scales: [0; PLACES],
        };
        tables.learning().then(|| Learning {
            tables,
            neighbourhood: CausalNeighbourhood::new(keys),
            channels: vec![[channel(FIRST_WEIGHTS), channel([0; INPUTS])]; k],
            residuals: vec![0; keys.len() * k],
            gradient_sums: vec![None; keys.len()],
            here: VoxelState {
                sums: vec![0; SETS * k],
                ..VoxelState::default()
            },
        })
    }

    /// Looks around a voxel of the slice, which comes next; `sigma` are the scale indices predicted for its latents.
    pub fn look_around(&mut self, voxel: usize, sigma: &[u8]) {
        let k = self.channels.len();
        let here = &mut self.here;
        (here.voxel, here.gradient_sum) = (voxel, None);
        here.sums.fill(0);
        here.two_away.clear();
        let unpredicted = sigma.contains(&UNPREDICTED);
        let (mut counts, mut total) = ([0; SETS], 0);
        self.neighbourhood.before(voxel, |near| {
            if unpredicted && near.two {
                here.two_away.push((near.voxel, 8 >> near.axes));
            }
            if let Some(gradient_sum) = self.gradient_sums[near.voxel] {
                let set = set(near);
                counts[set] += 1;
                total += gradient_sum;
                let residuals = &self.residuals[near.voxel * k..][..k];
                for (sum, &residual) in here.sums[set * k..][..k].iter_mut().zip(residuals) {
                    *sum += i32::from(residual);
                }
            }
        });
        here.factors = counts.map(|count| (1 << 16) / (count + 1));
        let known: i32 = counts.iter().sum();
        here.place = match known {
            0 => STRANGE,
            _ => (GRADIENT_BOUNDS.iter())
                .filter(|&&bound| total >= known * bound)
                .count(),
        };
    }

    /// The mean and scale index that the voxel's next latent, of channel `c`, is coded under, for those that were
    /// predicted. `coded` are the slice's latents so far, [voxels, K].
    pub fn prepare(&mut self, c: usize, mu: i16, sigma: u8, coded: &[i16]) -> (i16, u8) {
        let k = self.channels.len();
        let here = &mut self.here;
        let unpredicted = sigma == UNPREDICTED;
        if unpredicted && here.two_away.is_empty() {
            here.latent = None;
            return (mu, sigma);
        }
        let (mean, sigma) = match unpredicted {
            true => {
                let latents = here.two_away.iter();
                let latents = latents.map(|&(v, count)| (coded[v * k + c], count));
                (mean(latents), self.tables.prior_scale(c))
            }
            false => (mu, sigma),
        };
        let mut inputs = [0; INPUTS];
        for (set, input) in inputs[..SETS].iter_mut().enumerate() {
            *input = (here.sums[set * k + c] * here.factors[set]) >> 12;
        }
        for (back, input) in inputs[SETS..].iter_mut().enumerate().take(c) {
            let residual = self.residuals[here.voxel * k + c - 1 - back];
            *input = i32::from(residual) << INPUT_SHIFT;
        }
        let channel = &self.channels[c][usize::from(unpredicted)];
        // At most 2¹³·2¹⁴ each, and 2²⁷.
        let weighed: i32 = (channel.weights.iter().zip(inputs))
            .map(|(weight, input)| (weight >> COARSER) * input)
            .sum();
        let offset = channel.mean << (PRODUCT_SHIFT - MEAN_SHIFT);
        let moved = (weighed + offset + (1 << (PRODUCT_SHIFT - 1))) >> PRODUCT_SHIFT;
        let limit = i32::from(LIMIT);
        let mu = (i32::from(mean) + moved).clamp(-limit, limit) as i16;
        let offset = channel.scale + channel.scales[here.place];
        let moved = (offset + (1 << (SCALE_SHIFT - 1))) >> SCALE_SHIFT;
        let sigma = (i32::from(sigma) + moved).clamp(0, SCALES as i32 - 1) as u8;
        here.latent = Some(Latent {
            unpredicted,
            mean,
            inputs,
            mu,
            sigma,
        });
        (mu, sigma)
    }

    /// Learns from the latent that was prepared last.
    pub fn learn(&mut self, c: usize, y: i16) {
        let k = self.channels.len();
        let here = &mut self.here;
        let Some(latent) = here.latent else {
            return;
        };
        let channel = &mut self.channels[c][usize::from(latent.unpredicted)];
        let gradient = gradient(self.tables, &latent, y);
        let grow = |offset: &mut i32, rate: i32| {
            let grown = *offset + rate * gradient;
            *offset = grown.clamp(-LARGEST_SCALE_OFFSET, LARGEST_SCALE_OFFSET);
        };
        grow(&mut channel.scale, SCALE_RATE);
        grow(&mut channel.scales[here.place], PLACE_RATE);
        let error = 16 * i32::from(y) - i32::from(latent.mu);
        let error = error.clamp(-LARGEST_ERROR, LARGEST_ERROR);
        let mean = channel.mean + MEAN_RATE * error;
        channel.mean = mean.clamp(-LARGEST_MEAN_OFFSET, LARGEST_MEAN_OFFSET);
        let most = LARGEST_ERROR << INPUT_SHIFT;
        for (weight, input) in channel.weights.iter_mut().zip(latent.inputs) {
            let grown = *weight + error * input.clamp(-most, most);
            *weight = grown.clamp(-LARGEST_WEIGHT, LARGEST_WEIGHT);
        }
        let residual = 16 * i32::from(y) - i32::from(latent.mean);
        self.residuals[here.voxel * k + c] = residual.clamp(-LARGEST_RESIDUAL, LARGEST_RESIDUAL) as i16;
        *here.gradient_sum.get_or_insert(0) += gradient;
        self.gradient_sums[here.voxel] = here.gradient_sum;
    }
}

/// Which set a voxel nearby is of.
fn set(near: Neighbour) -> usize {
    2 * usize::from(near.two) + usize::from(near.axes > 1)
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
fn gradient(tables: &Tables, coded: &Latent, latent: i16) -> i32 {
    let part = |sigma: u8| {
        let (row, centre) = tables.gauss(coded.mu, sigma);
        row.part(i32::from(latent) - centre) as i32
    };
    let wider = part((coded.sigma + 1).min(SCALES as u8 - 1));
    let narrower = part(coded.sigma.saturating_sub(1));
    ((wider - narrower) << GRADIENT_SHIFT) / (wider + narrower)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::morton;
    use crate::latents::entropy::tests::tables;
    use crate::testing::Random;
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
        struct Done {
            at: [i64; 3],
            y: [i16; 2],
            residuals: [i64; 2],
            gradient_sum: Option<i64>,
        }
        let tables = tables();
        let within = |x: i64, most: i64| x.clamp(-most, most);
        let (eighth, quarter) = (1 << 15, 1 << 16);
        // Where latents are predicted, and where not.
        let mut weights = [[[eighth, eighth, quarter, quarter, 0, 0]; 2], [[0; 6]; 2]];
        let (mut means, mut all, mut kinds) = ([[0i64; 2]; 2], [[0i64; 2]; 2], [[[0i64; 6]; 2]; 2]);
        let (mut done, mut used): (Vec<Done>, Vec<_>) = (Vec::new(), Vec::new());
        for &(key, y, mu, sigma) in voxels {
            let at = morton::decode(key).map(i64::from);
            // Which set, and along how many axes.
            let nearby: Vec<(usize, i64, &Done)> = (done.iter())
                .filter_map(|other| {
                    let away: [i64; 3] = std::array::from_fn(|i| (other.at[i] - at[i]).abs());
                    let axes = away.iter().filter(|&&d| d > 0).count();
                    let two = away.contains(&2);
                    let near = away.iter().all(|&d| d == 0 || d == 1 + i64::from(two));
                    let set = 2 * usize::from(two) + usize::from(axes > 1);
                    near.then_some((set, axes as i64, other))
                })
                .collect();
            let told: Vec<i64> = nearby.iter().filter_map(|n| n.2.gradient_sum).collect();
            let at_least = |least: &&i64| told.iter().sum::<i64>() >= told.len() as i64 * **least;
            let kind = match told.len() {
                0 => 5,
                _ => [-256, 0, 256, 768].iter().filter(at_least).count(),
            };
            let (mut m, mut s) = ([0; 2], [0; 2]);
            let (mut residuals, mut gradient_sum) = ([0; 2], None);
            for c in 0..2 {
                let mut inputs = [0; 6];
                let mut two_away = (0, 0);
                for (set, axes, other) in &nearby {
                    if *set >= 2 {
                        let count = [4, 2, 1][*axes as usize - 1];
                        two_away.0 += count * 16 * i64::from(other.y[c]);
                        two_away.1 += count;
                    }
                }
                let u = usize::from(sigma[c] == UNPREDICTED);
                let (mean, scale) = match (u, two_away.1) {
                    (0, _) => (i64::from(mu[c]), i64::from(sigma[c])),
                    (_, 0) => {
                        (m[c], s[c]) = (mu[c].into(), UNPREDICTED.into());
                        continue;
                    }
                    (_, count) => {
                        let mean = (2 * two_away.0 + count).div_euclid(2 * count);
                        (mean.clamp(-32_768, 32_767), tables.prior_scale(c).into())
                    }
                };
                for (set, input) in inputs[..4].iter_mut().enumerate() {
                    let known = (nearby.iter()).filter(|near| near.0 == set && near.2.gradient_sum.is_some());
                    let r: i64 = known.clone().map(|near| near.2.residuals[c]).sum();
                    *input = (r * (65_536 / (known.count() as i64 + 1))) >> 12;
                }
                if c == 1 {
                    inputs[4] = 16 * residuals[0];
                }
                let weighed: i64 = (0..6).map(|i| (weights[u][c][i] >> 6) * inputs[i]).sum();
                m[c] = within(mean + ((weighed + 64 * means[u][c] + 32_768) >> 16), 2047);
                let scale = scale + ((all[u][c] + kinds[u][c][kind] + 32_768) >> 16);
                s[c] = scale.clamp(0, 63);
                let has = |sigma: i64| {
                    let (row, centre) = tables.gauss(m[c] as i16, sigma.clamp(0, 63) as u8);
                    i64::from(row.part(i32::from(y[c]) - centre))
                };
                let (more, less) = (has(s[c] + 1), has(s[c] - 1));
                let gradient = 4096 * (more - less) / (more + less);
                let grown = |x: i64, rate: i64| within(x + rate * gradient, 1 << 22);
                all[u][c] = grown(all[u][c], 36);
                kinds[u][c][kind] = grown(kinds[u][c][kind], 24);
                let error = within(16 * i64::from(y[c]) - m[c], 16);
                means[u][c] = within(means[u][c] + 32 * error, 1 << 21);
                for (weight, input) in weights[u][c].iter_mut().zip(inputs) {
                    *weight = within(*weight + error * within(input, 256), 1 << 19);
                }
                residuals[c] = within(16 * i64::from(y[c]) - mean, 1023);
                *gradient_sum.get_or_insert(0) += gradient;
            }
            used.push((m, s));
            done.push(Done {
                at,
                y,
                residuals,
                gradient_sum,
            });
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
            let (mut two_away, mut alone) = (0, 0);
            for (&(key, y, mu, sigma), wanted) in voxels.iter().zip(by_definition(&voxels)) {
                let voxel = keys.binary_search(&key).unwrap();
                learning.look_around(voxel, &sigma);
                let mut used = ([0; 2], [0; 2]);
                for c in 0..2 {
                    let (m, s) = learning.prepare(c, mu[c], sigma[c], &coded);
                    (used.0[c], used.1[c]) = (m.into(), s.into());
                    learning.learn(c, y[c]);
                    coded[2 * voxel + c] = y[c];
                    two_away += usize::from(sigma[c] == UNPREDICTED && s != UNPREDICTED);
                    alone += usize::from(s == UNPREDICTED);
                }
                assert_eq!(used, wanted, "voxel {voxel} of {count}");
            }
            assert!(count < 700 || (alone > 0 && two_away > alone));
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
