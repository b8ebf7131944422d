//! Where in the picture a Gaussian may be seen that reaches over the near plane.
//!
//! What may reach the floor of α is an ellipsoid; the picture of the box around its part beyond the plane bounds it from outside. Without,
//! all that lies beside the camera, of which a room has thousands, would be looked at in every pixel.

use super::lanes::{Double, Lanes};
use super::project::{Camera, ORTHOGRAPHIC};

/// Boxes around what reaches over the near plane are so much larger, as a factor, for the sake of rounding.
const MARGIN: f32 = 1e-4;

/// Gaussians that reach over the near plane, as [`super::Crossing`] has them: what of them lies beyond it.
pub(super) struct Ahead<L> {
    /// Variance of the pixel's blur, or the Gaussians' own, that every axis is widened by.
    pub blur: L,
    /// The depths between which α may reach the floor.
    nearest: L,
    farthest: L,
}

impl<L: Lanes> Ahead<L> {
    /// `variance`: along z. `sigmas`: squared, where α is at the floor.
    #[inline(always)]
    pub fn new<const VARIANT: u8>(camera: &Camera<L>, depth: L, variance: L, sigmas: L) -> Self {
        let distance = match VARIANT & ORTHOGRAPHIC {
            0 => depth.max(camera.near_plane),
            _ => L::splat(1.0),
        };
        let blur = distance.mul(distance).mul(camera.pixel).max(camera.own);
        let half = variance.add(blur).mul(sigmas).sqrt();
        let half = half.mul_add(L::splat(MARGIN), half);
        let nearest = depth.sub(half).max(camera.near_plane);
        Ahead {
            blur,
            nearest,
            farthest: depth.add(half).max(nearest),
        }
    }

    /// The first and the end of the pixels along x (`k` 0) or y (1) that see the box around what reaches from `centre` by `half`: seen
    /// where it is widest, from nearest to farthest.
    #[inline(always)]
    pub fn covered<const VARIANT: u8>(&self, camera: &Camera<L>, k: usize, centre: L, half: L) -> [L; 2] {
        let zero = L::splat(0.0);
        let half = centre.abs().add(half).mul_add(L::splat(MARGIN), half);
        let (mut first, mut end) = (centre.sub(half), centre.add(half));
        if VARIANT & ORTHOGRAPHIC == 0 {
            first = first.div(L::select(first.lt(zero), self.nearest, self.farthest));
            end = end.div(L::select(zero.lt(end), self.nearest, self.farthest));
        }
        let (focal, middle) = (camera.focal[k].to_lanes(), camera.centre[k].to_lanes());
        let [low, high] = camera.window[k];
        let first = first.mul_add(focal, middle).sub(L::splat(1.5));
        let end = end.mul_add(focal, middle).add(L::splat(1.5));
        [first.max(low).min(high).ceil(), end.max(low).min(high).floor()]
    }
}
