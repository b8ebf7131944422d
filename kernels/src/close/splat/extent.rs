//! Where in the picture a Gaussian may be seen that reaches over the near plane.
//!
//! What may reach the minimum α is an ellipsoid; the picture of the box around its part beyond the plane bounds it from
//! outside. Without, all that lies beside the camera, of which a room has thousands, would be looked at in every pixel.

use super::camera::{Camera, ORTHOGRAPHIC};
use crate::simd::{F32Vector, F64Vector, Simd};

/// Boxes around what reaches over the near plane are so much larger, as a factor, for the sake of rounding.
const MARGIN: f32 = 1e-4;

/// The part beyond the near plane of Gaussians that cross it, given as [`super::Crossing`].
pub(super) struct Extent<S: Simd> {
    /// Variance of the pixel's blur, or the Gaussians' own, that every axis is widened by.
    pub blur: S::F32,
    /// The depths between which α may reach the floor.
    nearest: S::F32,
    farthest: S::F32,
}

impl<S: Simd> Extent<S> {
    /// `variance`: along z. `sigmas`: squared, where α is at the floor.
    #[inline(always)]
    pub fn new<const VARIANT: u8>(camera: &Camera<S>, depth: S::F32, variance: S::F32, sigmas: S::F32) -> Self {
        let simd = camera.simd;
        let distance = match VARIANT & ORTHOGRAPHIC {
            0 => depth.max(camera.near_plane),
            _ => S::F32::splat(simd, 1.0),
        };
        let blur = (distance * distance * camera.pixel).max(camera.own);
        let half = ((variance + blur) * sigmas).sqrt();
        let half = half.mul_add(S::F32::splat(simd, MARGIN), half);
        let nearest = (depth - half).max(camera.near_plane);
        Extent {
            blur,
            nearest,
            farthest: (depth + half).max(nearest),
        }
    }

    /// The first and the end of the pixels along x (`k` 0) or y (1) that see the box around what reaches from `centre`
    /// by `half`: seen where it is widest, from nearest to farthest.
    #[inline(always)]
    pub fn covered<const VARIANT: u8>(
        &self,
        camera: &Camera<S>,
        k: usize,
        centre: S::F32,
        half: S::F32,
    ) -> [S::F32; 2] {
        let simd = camera.simd;
        let zero = S::F32::splat(simd, 0.0);
        let half = (centre.abs() + half).mul_add(S::F32::splat(simd, MARGIN), half);
        let (mut first, mut end) = (centre - half, centre + half);
        if VARIANT & ORTHOGRAPHIC == 0 {
            first = first / S::F32::select(first.lt(zero), self.nearest, self.farthest);
            end = end / S::F32::select(zero.lt(end), self.nearest, self.farthest);
        }
        let (focal, middle) = (camera.focal[k].to_f32(), camera.centre[k].to_f32());
        let [low, high] = camera.window[k];
        let first = first.mul_add(focal, middle) - S::F32::splat(simd, 1.5);
        let end = end.mul_add(focal, middle) + S::F32::splat(simd, 1.5);
        [first.max(low).min(high).ceil(), end.max(low).min(high).floor()]
    }
}
