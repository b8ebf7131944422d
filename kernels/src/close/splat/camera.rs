//! A camera, and its numbers in vectors.

use super::ellipse::Bounds;
use crate::simd::{F32Vector, F64Vector, Simd, three};

/// Bits of the variants of the projection.
pub(super) const ORTHOGRAPHIC: u8 = 1;
pub(super) const COMPENSATED: u8 = 2;

/// A camera, prepared.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Rows of the rotation to the camera's axes: x right, y down, z forward.
    pub rotation: [[f64; 3]; 3],
    /// Added after the rotation.
    pub translation: [f64; 3],
    /// What is not farther than this along z is not drawn.
    pub near: f64,
    /// Gaussians that reach over the near plane are drawn whatever side of it their centres are on: see
    /// [`super::Crossing`].
    pub ray_space: bool,
    /// Pixels per unit of slope, or, of an orthographic camera, per unit of length.
    pub focal: [f64; 2],
    /// The principal point, in pixels.
    pub centre: [f64; 2],
    /// The ranges of `x/z` and `y/z` outside which the projection is linearised at the range's end.
    pub slopes: [[f64; 2]; 2],
    /// The pixels that are drawn; none is beyond 2²².
    pub window: Bounds,
    /// The least α that is drawn: of an ellipse, what is fainter may be left out. In `(0, 1]`.
    pub floor: f32,
    /// Parallel rays instead of a pinhole.
    pub orthographic: bool,
    /// Opacity is taken back by as much as the blur widens.
    pub compensated: bool,
    /// The Gaussians' own blur: a variance in squared units of length, finite, at least 0.
    pub blur: f64,
    /// The pixel's, in px², more than 0: what ellipses are widened by where the Gaussians' own comes to less.
    pub pixel_blur: f32,
}

/// A [`View`] in lanes.
pub(super) struct Camera<S: Simd> {
    pub simd: S,
    pub rotation: [[S::F64; 3]; 3],
    pub translation: [S::F64; 3],
    pub near: S::F64,
    pub ray_space: bool,
    pub near_plane: S::F32,
    pub focal: [S::F64; 2],
    pub centre: [S::F64; 2],
    pub slopes: [[S::F64; 2]; 2],
    pub rows: [[S::F32; 3]; 3],
    /// First and end of the window, by column and by row.
    pub window: [[S::F32; 2]; 2],
    pub floor: S::F32,
    pub log_floor: S::F32,
    /// The Gaussians' own blur in pixels at distance 1, and the pixel's in px².
    pub blur: S::F64,
    pub pixel_blur: S::F32,
    /// Both in units of length, the pixel's at distance 1.
    pub pixel: S::F32,
    pub own: S::F32,
}

impl<S: Simd> Camera<S> {
    #[inline(always)]
    pub fn new(simd: S, view: &View) -> Self {
        let pair = |[x, y]: [f64; 2]| [S::F64::splat(simd, x), S::F64::splat(simd, y)];
        let Bounds { x0, y0, x1, y1 } = view.window;
        Camera {
            simd,
            rotation: three!(i => three!(k => S::F64::splat(simd, view.rotation[i][k]))),
            translation: three!(i => S::F64::splat(simd, view.translation[i])),
            near: S::F64::splat(simd, view.near),
            ray_space: view.ray_space,
            near_plane: S::F32::splat(simd, view.near as f32),
            focal: pair(view.focal),
            centre: pair(view.centre),
            slopes: [pair(view.slopes[0]), pair(view.slopes[1])],
            rows: three!(i => three!(k => S::F32::splat(simd, view.rotation[i][k] as f32))),
            window: [
                [S::F32::splat(simd, x0 as f32), S::F32::splat(simd, x1 as f32)],
                [S::F32::splat(simd, y0 as f32), S::F32::splat(simd, y1 as f32)],
            ],
            floor: S::F32::splat(simd, view.floor),
            log_floor: S::F32::splat(simd, view.floor.log2()),
            blur: S::F64::splat(simd, view.blur * view.focal[0] * view.focal[1]),
            pixel_blur: S::F32::splat(simd, view.pixel_blur),
            pixel: S::F32::splat(
                simd,
                (f64::from(view.pixel_blur) / view.focal[0] / view.focal[1]) as f32,
            ),
            own: S::F32::splat(simd, view.blur as f32),
        }
    }
}
