//! Latents that are predicted from those of neighbours which were coded before them: a level's voxels are coded octant
//! by octant.

use std::ops::Range;

use b2p_kernels::{ExactConv, LIMIT, Taps};
use rayon::prelude::*;

use super::exact::SIGMAS;
use super::structure::{Neighbours, base_inputs, near_inputs};
use crate::layers::{Pool, apply};

use super::{Model, Shape};
use crate::geometry::KernelMap;
use crate::latents::entropy::UNPREDICTED;

/// Sets of neighbours that lie in another octant than the voxel itself: one for every set of axes along which they
/// differ.
const OTHERS: usize = 7;
/// A scale index enters a network shifted left by this.
const SIGMA_SHIFT: u8 = 3;
/// Voxels whose inputs are gathered at once.
const BLOCK: usize = 256;

/// How latents are distributed: means in sixteenths and scale indices, [voxels, K] each.
pub type Parameters = (Vec<i16>, Vec<u8>);

/// One pass over a slice: what is to be predicted, and from what.
#[derive(Debug, Clone)]
pub struct Pass<'a> {
    /// Each of the level's voxels' place in its parent, `x + 2y + 4z`.
    pub octants: &'a [u8],
    /// The level's 3³ kernel map.
    pub map: &'a KernelMap,
    /// The level's voxels that the slice holds.
    pub slice: Range<usize>,
    /// The voxels of the pass, all of one octant.
    pub voxels: &'a [u32],
    /// The latents [slice, K] so far, of which only those of neighbours in lower octants are looked at.
    pub latents: &'a [i16],
}

impl Shape {
    /// Whether networks correct what is predicted of the latents of roles up to this one.
    pub(crate) fn corrects_up_to(&self, role: usize) -> bool {
        self.near_channels.iter().take(role).any(|&near| near > 0)
    }
}

#[doc(hidden)]
impl Model {
    /// Whether the latents of a role are coded in passes, octant by octant, and predicted from neighbours.
    pub fn has_passes(&self, role: usize) -> bool {
        self.neighbours(role).is_some()
    }

    /// What predicts the passes over a level for [`crate::latents::entropy::encode_passes`] and
    /// [`crate::latents::entropy::decode_passes`]: [`Model::pass_parameters`] of a role, for a level with these
    /// octants, this 3³ kernel map, and these parameters of all its voxels, if it has any.
    pub fn passes<'a>(
        &'a self,
        role: usize,
        octants: &'a [u8],
        map: &'a KernelMap,
        level: Option<&'a Parameters>,
    ) -> impl Fn(Range<usize>, &[u32], &[i16]) -> Parameters + Sync + 'a {
        let level = level.map(|(mu, sigma)| (&mu[..], &sigma[..]));
        move |slice, voxels, latents| {
            let pass = Pass {
                octants,
                map,
                slice,
                voxels,
                latents,
            };
            self.pass_parameters(role, &pass, level)
        }
    }

    /// How the latents of a pass are distributed: means in sixteenths, in ±2047, and scale indices below 64; [voxels,
    /// K] each.
    ///
    /// `level` is what [`Model::entropy_parameters`] gave for all voxels of the level; the base level has none. A voxel
    /// with no neighbour that was coded before keeps the level's parameters; of the base level its scale index is
    /// [`UNPREDICTED`].
    ///
    /// Inputs of the network, in steps of 2^−shift, as latents have elsewhere. For each set of axes `s = 1 … 7` (1 = x,
    /// 2 = y, 4 = z) the neighbours that differ along just these axes, if their octant is the lower one: the means of
    /// their latents, rounded to the nearest (halves up), and 1 if there are any; zeros else. Above the base level it
    /// is not latents that count but what is left of them without their means (rounded down), and those of the voxel's
    /// parent make a set by themselves, before the others; then come the voxel's own means (rounded down) and scale
    /// indices (in eighths). Last the bits x, y, z of the octant. The network's results are, above the base level,
    /// added to the level's.
    ///
    /// # Panics
    /// If the role has no passes, `level` is there for the base level or not for another, voxels are of several
    /// octants, or lengths disagree.
    pub fn pass_parameters(&self, role: usize, pass: &Pass, level: Option<(&[i16], &[u8])>) -> Parameters {
        let k = self.shape.latents;
        let network = self.neighbours(role);
        let network = network.expect("the caller asks has_passes first");
        assert_eq!(pass.map.volume(), 27, "neighbours come from a 3³ map");
        assert_eq!(pass.octants.len(), pass.map.len(), "one octant per voxel");
        assert_eq!(pass.latents.len(), pass.slice.len() * k, "K latents per voxel");
        assert_eq!(role > 0, level.is_some(), "all roles but 0 have parameters");
        let mut octants = pass.voxels.iter().map(|&v| pass.octants[v as usize]);
        let octant = octants.next();
        assert!(octants.all(|o| Some(o) == octant), "a pass is of one octant");
        let mut mu = vec![0; pass.voxels.len() * k];
        let mut sigma = vec![UNPREDICTED; pass.voxels.len() * k];
        let outputs = mu.par_chunks_mut(BLOCK * k).zip(sigma.par_chunks_mut(BLOCK * k));
        outputs
            .zip(pass.voxels.par_chunks(BLOCK))
            .for_each(|((mu, sigma), voxels)| match level {
                None => self.base(network, pass, voxels, mu, sigma),
                Some(level) => self.near(network, pass, level, voxels, mu, sigma),
            });
        (mu, sigma)
    }

    /// The network that predicts a role's latents from neighbours, if there is one.
    fn neighbours(&self, role: usize) -> Option<&Neighbours<ExactConv>> {
        match role {
            0 => self.exact.base.as_ref(),
            _ => self.exact.near.get(role - 1)?.as_ref(),
        }
    }

    fn base(&self, network: &Neighbours<ExactConv>, pass: &Pass, voxels: &[u32], mu: &mut [i16], sigma: &mut [u8]) {
        let (k, shift) = (self.shape.latents, self.shape.latent_shift);
        let width = base_inputs(k);
        let mut inputs = vec![0; voxels.len() * width];
        let mut known = Vec::with_capacity(voxels.len());
        let add = |at: usize, sums: &mut [i32]| {
            let latents = &pass.latents[(at - pass.slice.start) * k..][..k];
            for (sum, &latent) in sums.iter_mut().zip(latents) {
                *sum += i32::from(latent) << shift;
            }
        };
        let mut gather = Gather::new(&self.shape, pass, voxels, OTHERS);
        for (&v, input) in voxels.iter().zip(inputs.chunks_exact_mut(width)) {
            known.push(gather.fill(pass, v as usize, add, input));
        }
        let (means, scales) = self.predict(network, &inputs, voxels.len());
        mu.copy_from_slice(&means);
        let sigma = sigma.chunks_exact_mut(k).zip(scales.chunks_exact(k));
        for ((sigma, scales), _) in sigma.zip(known).filter(|(_, known)| *known) {
            for (sigma, &q) in sigma.iter_mut().zip(scales) {
                *sigma = q.clamp(0, SIGMAS - 1) as u8;
            }
        }
    }

    fn near(
        &self,
        network: &Neighbours<ExactConv>,
        pass: &Pass,
        level: (&[i16], &[u8]),
        voxels: &[u32],
        mu: &mut [i16],
        sigma: &mut [u8],
    ) {
        let (k, shift, limit) = (self.shape.latents, self.shape.latent_shift, LIMIT);
        let width = near_inputs(k);
        let mut inputs = vec![0; voxels.len() * width];
        let mut known = Vec::with_capacity(voxels.len());
        // Means come in sixteenths.
        let steps = |sixteenths: i32| (sixteenths << shift) >> 4;
        let add = |at: usize, sums: &mut [i32]| {
            let latents = &pass.latents[(at - pass.slice.start) * k..][..k];
            let means = &level.0[at * k..][..k];
            for ((sum, &latent), &mean) in sums.iter_mut().zip(latents).zip(means) {
                *sum += steps(16 * i32::from(latent) - i32::from(mean));
            }
        };
        let own = 2 * OTHERS * (k + 1);
        let mut gather = Gather::new(&self.shape, pass, voxels, 2 * OTHERS);
        for (&v, input) in voxels.iter().zip(inputs.chunks_exact_mut(width)) {
            let v = v as usize;
            known.push(gather.fill(pass, v, add, input));
            for c in 0..k {
                let mean = steps(level.0[v * k + c].into());
                input[own + c] = mean.clamp(-i32::from(limit), limit.into()) as i16;
                input[own + k + c] = i16::from(level.1[v * k + c]) << SIGMA_SHIFT;
            }
        }
        let change = known
            .contains(&true)
            .then(|| self.predict(network, &inputs, voxels.len()));
        for (i, (&v, known)) in voxels.iter().zip(known).enumerate() {
            let (at, v) = (i * k..(i + 1) * k, v as usize * k..(v as usize + 1) * k);
            let (mu, sigma) = (&mut mu[at.clone()], &mut sigma[at.clone()]);
            mu.copy_from_slice(&level.0[v.clone()]);
            sigma.copy_from_slice(&level.1[v]);
            let Some((means, scales)) = change.as_ref().filter(|_| known) else {
                continue;
            };
            for (mu, change) in mu.iter_mut().zip(&means[at.clone()]) {
                *mu = (*mu + change).clamp(-limit, limit);
            }
            for (sigma, change) in sigma.iter_mut().zip(&scales[at]) {
                *sigma = (i16::from(*sigma) + change).clamp(0, SIGMAS - 1) as u8;
            }
        }
    }

    /// What a network says of `n` voxels: means and scale indices, not yet in their range.
    fn predict(&self, network: &Neighbours<ExactConv>, inputs: &[i16], n: usize) -> (Vec<i16>, Vec<i16>) {
        let pool = &mut Pool::new();
        let mut layer = |conv, x: &[i16], relu| apply(pool, self.isa, conv, Taps::Same, x, n, relu);
        let x = layer(&network.lin1, inputs, true);
        let x = layer(&network.lin2, &x, true);
        (layer(&network.mu, &x, false), layer(&network.sigma, &x, false))
    }
}

/// Fills inputs of one voxel of a pass after the other.
struct Gather {
    channels: usize,
    shift: u8,
    octant: u8,
    /// Where neighbours of a lower octant lie in a row of the kernel map, and to which set they belong.
    before: Vec<(usize, usize)>,
    counts: Vec<i32>,
    /// Far from overflow: of at most eight latents of 16 bits, shifted by at most ten.
    sums: Vec<i32>,
}

impl Gather {
    /// `sets` is one for every set of axes, or twice as many: then siblings make sets by themselves.
    fn new(shape: &Shape, pass: &Pass, voxels: &[u32], sets: usize) -> Self {
        let octant = voxels.first().map_or(0, |&v| pass.octants[v as usize]);
        // The highest of the axes along which they differ decides which octant is the lower one.
        let before = |&(_, other): &(usize, usize)| other > 0 && octant >> other.ilog2() & 1 == 1;
        let set = |(tap, other): (usize, usize)| match sets {
            OTHERS => (tap, other - 1),
            _ => (tap, 2 * (other - 1) + usize::from(!is_sibling(tap, octant))),
        };
        let taps = (0..27).map(|tap| (tap, axes(tap)));
        Gather {
            channels: shape.latents,
            shift: shape.latent_shift,
            octant,
            before: taps.filter(before).map(set).collect(),
            counts: vec![0; sets],
            sums: vec![0; sets * shape.latents],
        }
    }

    /// Fills what is known of a voxel's neighbours at the start of `input`, and its octant at the end; whether any
    /// neighbour is known. `add` adds the values of a voxel.
    fn fill(&mut self, pass: &Pass, voxel: usize, add: impl Fn(usize, &mut [i32]), input: &mut [i16]) -> bool {
        let k = self.channels;
        let row = pass.map.row(voxel);
        self.counts.fill(0);
        self.sums.fill(0);
        for &(tap, set) in &self.before {
            let at = row[tap] as usize;
            if row[tap] != KernelMap::ABSENT && pass.slice.contains(&at) {
                self.counts[set] += 1;
                add(at, &mut self.sums[set * k..][..k]);
            }
        }
        let limit = i32::from(LIMIT);
        let (sets, sums) = (input.chunks_exact_mut(k + 1), self.sums.chunks_exact(k));
        for ((set, sum), &count) in sets.zip(sums).zip(&self.counts) {
            if count == 0 {
                continue;
            }
            for (mean, &sum) in set.iter_mut().zip(sum) {
                let rounded = match count {
                    1 => sum,
                    _ => (2 * sum + count).div_euclid(2 * count),
                };
                *mean = rounded.clamp(-limit, limit) as i16;
            }
            set[k] = 1 << self.shift;
        }
        let bits = input.len() - 3;
        for (axis, bit) in input[bits..].iter_mut().enumerate() {
            *bit = i16::from(self.octant >> axis & 1) << self.shift;
        }
        self.counts.iter().any(|&count| count > 0)
    }
}

/// Along which axes the neighbour at a place of a 3³ row lies elsewhere: bit 0 = x, 1 = y, 2 = z.
fn axes(tap: usize) -> usize {
    let aside = |place: usize, axis: usize| usize::from(place % 3 != 1) << axis;
    aside(tap, 0) | aside(tap / 3, 1) | aside(tap / 9, 2)
}

/// Whether that neighbour of a voxel in that octant has the same parent.
fn is_sibling(tap: usize, octant: u8) -> bool {
    let inside = |place: usize, axis: u8| match place % 3 {
        0 => octant >> axis & 1 == 1,
        1 => true,
        _ => octant >> axis & 1 == 0,
    };
    inside(tap, 0) && inside(tap / 3, 1) && inside(tap / 9, 2)
}
