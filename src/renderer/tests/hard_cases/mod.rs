//! Splats, cameras and sizes that have broken renderers, each on every instruction set of the machine.
//!
//! | case | | in |
//! |---:|---|---|
//! | 1 | the zero quaternion; quaternions of other lengths than 1 | `numbers` |
//! | 2 | NaN and ±∞ in each parameter; an endless logit of opacity (in a file: `gaussians::ply`) | `numbers` |
//! | 3 | scales of exactly 0 along one, two and three axes | `shapes` |
//! | 4 | scales up to 10³⁸ | `shapes` |
//! | 5 | needles of 3000 × 0.1 px at any angle | `shapes` |
//! | 6 | no covariance between x and y | `shapes` |
//! | 7 | a circle: two equal eigenvalues | `shapes` |
//! | 8 | a centre in the camera, behind it, just before and just behind the near plane | `cameras` |
//! | 9 | a centre behind, an ellipsoid that reaches in front of the near plane | `cameras` |
//! | 10 | a centre outside of the field of view | `cameras` |
//! | 11 | a principal point outside of the picture | `cameras` |
//! | 12 | 10⁴ splats that all cover all pixels | `crowds` |
//! | 13 | 10⁶ splats in one pixel | `crowds` |
//! | 14 | coincident splats | `crowds` |
//! | 15 | depths of −0, subnormal, ∞, and one bit apart | `numbers` |
//! | 16 | an outlier a million times as far as the rest | `crowds` |
//! | 17 | α = 1 everywhere | `crowds` |
//! | 18 | opaque points far below a pixel, with anti-aliasing | `shapes` |
//! | 19 | a thousand layers of α = 1/300 | `crowds` |
//! | 20 | white on white | `crowds` |
//! | 21 | zooms from ×0.01 to ×100 | `cameras` |
//! | 22 | nothing to draw; sides of 1, of 65535, and of no whole tile | `cameras` |
//! | 23 | colours beyond [0, 1], up to 10³⁰ | `numbers` |
//! | 24 | cameras that are none | `cameras` |
//! | 25 | every instruction set, any number of threads | `crowds` |

mod cameras;
mod crowds;
mod numbers;
mod shapes;

use super::effects::with;
use super::*;
use crate::renderer::{EffectMode, Effects};

/// A splat two units in front of a camera at the origin that looks along +z.
const AHEAD: Splat = Splat {
    position: [0.0, 0.0, 2.0],
    ..RED
};

/// σ in cube-frame units of a splat at [`AHEAD`] that is `pixels` wide under focal length `focal`.
fn sigma(pixels: f32, focal: f64) -> f32 {
    pixels * 2.0 / focal as f32
}

fn visible(splat: Splat, camera: &Camera) -> bool {
    draw_on(&scene([splat]), camera, Background::WHITE).1.visible == 1
}

/// With no care for what reaches over the near plane.
fn careless(scene: &Gaussians, camera: &Camera, isa: Isa) -> (Image, Stats) {
    let effects = Effects {
        near: EffectMode::Off,
        ..Effects::default()
    };
    with(scene, camera, isa, effects)
}
