//! The exact zone's modules: context, predictive entropy model, feature reconstruction.

use b2p_kernels::{ExactConv, LIMIT, Taps};
use rayon::prelude::*;

use super::Model;
use crate::geometry::KernelMap;
use crate::layers::Inception;
use crate::layers::{Pool, apply, concat};

/// Standard deviations that a latent may have.
pub(super) const SIGMAS: i16 = 64;

#[doc(hidden)]
impl Model {
    /// The context of a role's voxels: their parents' features, upsampled.
    ///
    /// `g` holds the features [parents, C] of the role below; bit `x + 2y + 4z` of `occupancy[p]` tells whether parent
    /// `p` has the child in that octant. Gives [children, C].
    ///
    /// # Panics
    /// If `role` is not 1 or 2, or `g` and `occupancy` disagree in length.
    pub fn upsample(&self, role: usize, g: &[i16], occupancy: &[u8]) -> Vec<i16> {
        self.upsample_in(&mut Pool::new(), role, g, occupancy)
    }

    pub(crate) fn upsample_in(&self, pool: &mut Pool<i16>, role: usize, g: &[i16], occupancy: &[u8]) -> Vec<i16> {
        assert!(role == 1 || role == 2, "role {role} has no context");
        let c = self.shape.channels;
        assert_eq!(g.len(), occupancy.len() * c, "one feature per parent");
        let (parents, octants) = children(occupancy);
        match &self.exact.up {
            Some(up) => {
                let taps = Taps::Octants {
                    parents: &parents,
                    octants: &octants,
                };
                apply(pool, self.isa, &up[role - 1], taps, g, parents.len(), false)
            }
            None => {
                let mut out = pool.take(parents.len() * c);
                for (child, &parent) in out.chunks_exact_mut(c).zip(&parents) {
                    child.copy_from_slice(&g[parent as usize * c..][..c]);
                }
                out
            }
        }
    }

    /// Whether a role has latents.
    pub fn has_latents(&self, role: usize) -> bool {
        self.shape.latents_of(role) > 0
    }

    /// Whether a role's features are made, or are its context.
    pub fn makes_features(&self, role: usize) -> bool {
        role < self.shape.fr_roles
    }

    /// How the latents of a role are distributed: means in sixteenths, in ±2047, and scale indices below 64, [voxels,
    /// K] each.
    ///
    /// `context` is [`Model::upsample`]'s, `map` the level's 3³ kernel map.
    ///
    /// # Panics
    /// If `role` is not 1 or 2 or has no latents, or `context` and `map` disagree in length.
    pub fn entropy_parameters(&self, role: usize, context: &[i16], map: &KernelMap) -> (Vec<i16>, Vec<u8>) {
        self.entropy_parameters_in(&mut Pool::new(), role, context, map)
    }

    pub(crate) fn entropy_parameters_in(
        &self,
        pool: &mut Pool<i16>,
        role: usize,
        context: &[i16],
        map: &KernelMap,
    ) -> (Vec<i16>, Vec<u8>) {
        assert!(role == 1 || role == 2, "role {role} has a fixed prior");
        self.check(context, self.shape.channels, map);
        let pem = self.exact.pem[role - 1].as_ref();
        let pem = pem.expect("the caller asks has_latents first");
        let (isa, n) = (self.isa, map.len());
        let x = apply(pool, isa, &pem.conv_in, map.taps(), context, n, true);
        let x = self.blocks(pool, &pem.blocks, x, map);
        let mu = apply(pool, isa, &pem.mu, Taps::Same, &x, n, false);
        let sigma = apply(pool, isa, &pem.sigma, Taps::Same, &x, n, false);
        pool.give(x);
        let index = |q: &i16| (*q).clamp(0, SIGMAS - 1) as u8;
        let indices = sigma.iter().map(index).collect();
        pool.give(sigma);
        (mu, indices)
    }

    /// The features [voxels, C] of a role, from its latents [voxels, K], none if it has none, and, above role 0, its
    /// context [voxels, C]: the context itself where the model has nothing that reconstructs.
    ///
    /// # Panics
    /// If `role` is above 2, the context is there for role 0 or not for another, or lengths disagree.
    pub fn reconstruct(&self, role: usize, latents: &[i16], context: Option<&[i16]>, map: &KernelMap) -> Vec<i16> {
        let context = context.map(<[i16]>::to_vec);
        self.reconstruct_in(&mut Pool::new(), role, latents, context, map)
    }

    pub(crate) fn reconstruct_in(
        &self,
        pool: &mut Pool<i16>,
        role: usize,
        latents: &[i16],
        context: Option<Vec<i16>>,
        map: &KernelMap,
    ) -> Vec<i16> {
        assert_eq!(role > 0, context.is_some(), "all roles but 0 have a context");
        let (c, k) = (self.shape.channels, self.shape.latents_of(role));
        self.check(latents, k, map);
        if let Some(context) = &context {
            self.check(context, c, map);
        }
        let Some(fr) = &self.exact.fr[role] else {
            return context.expect("role 0 is reconstructed");
        };
        let limit = i32::from(LIMIT);
        let shift = self.shape.latent_shift;
        let raise = |&y: &i16| (i32::from(y) << shift).clamp(-limit, limit) as i16;
        let mut x: Vec<i16> = latents.par_iter().map(raise).collect();
        let known = match &context {
            Some(context) if k == 0 => context,
            Some(context) => {
                x = concat(pool, &x, k, context, c);
                &x
            }
            None => &x,
        };
        let (isa, n) = (self.isa, map.len());
        let hidden = apply(pool, isa, &fr.lin1, Taps::Same, known, n, true);
        pool.give(x);
        if let Some(context) = context {
            pool.give(context);
        }
        let x = self.blocks(pool, &fr.blocks, hidden, map);
        let features = apply(pool, isa, &fr.lin2, Taps::Same, &x, n, false);
        pool.give(x);
        features
    }

    fn blocks(&self, pool: &mut Pool<i16>, blocks: &[Inception<ExactConv>], x: Vec<i16>, map: &KernelMap) -> Vec<i16> {
        blocks
            .iter()
            .fold(x, |x, block| block.apply(pool, self.isa, map.taps(), x))
    }

    /// Panics unless `values` are `width` for each voxel of `map`.
    pub(super) fn check<T>(&self, values: &[T], width: usize, map: &KernelMap) {
        assert_eq!(map.volume(), 27, "layers need the 3³ kernel map");
        assert_eq!(values.len(), map.len() * width, "{width} values per voxel");
    }
}

/// For every child the index of its parent and its octant, children ascending.
fn children(occupancy: &[u8]) -> (Vec<u32>, Vec<u8>) {
    let count = occupancy.iter().map(|mask| mask.count_ones() as usize).sum();
    let (mut parents, mut octants) = (Vec::with_capacity(count), Vec::with_capacity(count));
    for (parent, mask) in (0..).zip(occupancy) {
        for octant in (0..8).filter(|octant| mask >> octant & 1 == 1) {
            parents.push(parent);
            octants.push(octant);
        }
    }
    (parents, octants)
}
