//! What the base level's latents are predicted from, having no level below: neighbours that were coded before them.

use std::ops::Range;

use b2p_kernels::{LIMIT, Taps};

use super::layers::{Pool, apply};
use super::structure::base_inputs;
use super::{Model, Shape};
use crate::entropy::UNPREDICTED;
use crate::geometry::KernelMap;

/// Sets of neighbours that lie in another octant than the voxel itself: one for every set of axes along which they differ.
const OTHERS: usize = 7;
/// Standard deviations that a latent may have.
const SIGMAS: i16 = 64;

impl Shape {
    /// Bytes that predicting one voxel of the base level takes at most: the network's inputs, two hidden layers, means and scales.
    pub(crate) fn base_bytes(&self) -> usize {
        match self.base_channels {
            0 => 0,
            hidden => 2 * (base_inputs(self.latents) + 2 * hidden) + 5 * self.latents,
        }
    }
}

impl Model {
    /// Whether the base level's latents are predicted from neighbours.
    pub fn predicts_base(&self) -> bool {
        self.exact.base.is_some()
    }

    /// How the latents of base-level `voxels`, all of one octant, are distributed: means in sixteenths, in ±2047, and scale indices
    /// below 64, or [`UNPREDICTED`] for voxels that nothing is known of; [voxels, K] each.
    ///
    /// `octants[i]` is voxel `i`'s place in its parent, `x + 2y + 4z`; `map` is the level's 3³ kernel map; `latents` [slice, K] are
    /// those of the voxels in `slice`, of which only neighbours in lower octants are looked at.
    ///
    /// Inputs of the network, in steps of 2^−shift, as latents have elsewhere: for each set of axes `s = 1 … 7` (1 = x, 2 = y, 4 = z) the
    /// neighbours that differ along just these axes, if their octant is the lower one: the means of their latents, rounded to the
    /// nearest (halves up), and 1 if there are any; zeros else. Then the bits x, y, z of the octant.
    ///
    /// # Panics
    /// If the model does not predict the base level, or lengths disagree.
    pub fn base_parameters(
        &self,
        octants: &[u8],
        map: &KernelMap,
        slice: Range<usize>,
        voxels: &[u32],
        latents: &[i16],
    ) -> (Vec<i16>, Vec<u8>) {
        let k = self.shape.latents;
        let base = self.exact.base.as_ref();
        let base = base.expect("the caller asks predicts_base first");
        assert_eq!(map.volume(), 27, "neighbours come from a 3³ map");
        assert_eq!(octants.len(), map.len(), "one octant per voxel");
        assert_eq!(latents.len(), slice.len() * k, "K latents per voxel");
        let width = base_inputs(k);
        let mut inputs = vec![0; voxels.len() * width];
        let mut known = Vec::with_capacity(voxels.len());
        for (&v, input) in voxels.iter().zip(inputs.chunks_exact_mut(width)) {
            let (octant, row) = (octants[v as usize], map.row(v as usize));
            known.push(self.surroundings(octant, row, &slice, latents, input));
        }
        let pool = &mut Pool::new();
        let mut layer =
            |conv, x: &[i16], relu| apply(pool, self.isa, conv, Taps::Same, x, voxels.len(), relu);
        let x = layer(&base.lin1, &inputs, true);
        let x = layer(&base.lin2, &x, true);
        let mu = layer(&base.mu, &x, false);
        let mut sigma: Vec<u8> = layer(&base.sigma, &x, false)
            .into_iter()
            .map(|q| q.clamp(0, SIGMAS - 1) as u8)
            .collect();
        for (sigma, known) in sigma.chunks_exact_mut(k).zip(known) {
            if !known {
                sigma.fill(UNPREDICTED);
            }
        }
        (mu, sigma)
    }

    /// Fills one voxel's inputs; whether any neighbour is known.
    fn surroundings(
        &self,
        octant: u8,
        row: &[u32],
        slice: &Range<usize>,
        latents: &[i16],
        input: &mut [i16],
    ) -> bool {
        let k = self.shape.latents;
        let (shift, limit) = (self.shape.latent_shift, i64::from(LIMIT));
        let mut counts = [0i64; OTHERS];
        let mut sums = vec![0i64; OTHERS * k];
        for (tap, &neighbour) in row.iter().enumerate() {
            let other = axes(tap);
            // The highest of the axes along which they differ decides which octant is the lower one.
            let before = other > 0 && octant >> other.ilog2() & 1 == 1;
            if !before || neighbour == KernelMap::ABSENT || !slice.contains(&(neighbour as usize)) {
                continue;
            }
            counts[other - 1] += 1;
            let theirs = &latents[(neighbour as usize - slice.start) * k..][..k];
            let sums = &mut sums[(other - 1) * k..][..k];
            for (sum, &latent) in sums.iter_mut().zip(theirs) {
                *sum += i64::from(latent);
            }
        }
        let (sets, bits) = input.split_at_mut(OTHERS * (k + 1));
        let sums = sums.chunks_exact(k);
        for ((set, sum), &count) in sets.chunks_exact_mut(k + 1).zip(sums).zip(&counts) {
            if count == 0 {
                continue;
            }
            for (mean, &sum) in set.iter_mut().zip(sum) {
                let rounded = ((sum << (shift + 1)) + count).div_euclid(2 * count);
                *mean = rounded.clamp(-limit, limit) as i16;
            }
            set[k] = 1 << shift;
        }
        for (axis, bit) in bits.iter_mut().enumerate() {
            *bit = i16::from(octant >> axis & 1) << shift;
        }
        counts.iter().any(|&count| count > 0)
    }
}

/// Along which axes the neighbour at a place of a 3³ row lies elsewhere: bit 0 = x, 1 = y, 2 = z.
fn axes(tap: usize) -> usize {
    let aside = |place: usize, axis: usize| usize::from(place % 3 != 1) << axis;
    aside(tap, 0) | aside(tap / 3, 1) | aside(tap / 9, 2)
}
