//! Colour gradients along the surface (`docs/format.md`, clause 6.6.3).

use super::discs::Disc;
use crate::geometry::ones;

/// Ridge regularisation of the least squares, since the colours of few neighbours are mostly noise.
const DAMPING: f32 = 0.3;

/// Places of a 3³ row, as steps from the middle.
const OFFSETS: [[f32; 3]; 27] = {
    let mut offsets = [[0.0; 3]; 27];
    let mut k = 0;
    while k < 27 {
        offsets[k] = [(k % 3) as f32 - 1.0, (k / 3 % 3) as f32 - 1.0, (k / 9) as f32 - 1.0];
        k += 1;
    }
    offsets
};

/// A colour as floats, and a 0 that fills a vector.
#[inline(always)]
fn with_zero([r, g, b]: [u8; 3]) -> [f32; 4] {
    [r, g, b, 0].map(f32::from)
}

/// The gradient of R, G and B per voxel along both axes `u`, `v` of a disc's plane, by least squares over the occupied
/// ones of the 26 neighbours. `row` is the voxel's of its level's map, and `mask` has a bit for each of its places that
/// is occupied.
#[inline(always)]
pub fn gradient(mask: u32, row: &[u32], colours: &[[u8; 3]], voxel: usize, [u, v]: [[f32; 3]; 2]) -> [[f32; 3]; 2] {
    let own = with_zero(colours[voxel]);
    let (mut uu, mut uv, mut vv) = (DAMPING, 0.0, DAMPING);
    let (mut ru, mut rv) = ([0.0f32; 4], [0.0f32; 4]);
    for k in ones(mask) {
        let (offset, q) = (OFFSETS[k], row[k]);
        let along = |axis: [f32; 3]| offset[0] * axis[0] + offset[1] * axis[1] + offset[2] * axis[2];
        let (a, b) = (along(u), along(v));
        uu += a * a;
        uv += a * b;
        vv += b * b;
        let colour = with_zero(colours[q as usize]);
        for channel in 0..4 {
            let change = colour[channel] - own[channel];
            ru[channel] += a * change;
            rv[channel] += b * change;
        }
    }
    let determinant = uu * vv - uv * uv;
    let solve = |a: f32, b: f32, c: f32, d: f32| (a * b - c * d) / determinant;
    [
        [0, 1, 2].map(|c| solve(vv, ru[c], uv, rv[c])),
        [0, 1, 2].map(|c| solve(uu, rv[c], uv, ru[c])),
    ]
}

/// The axes of a disc's plane: the rotated x and y.
#[inline(always)]
pub fn plane(disc: &Disc) -> [[f32; 3]; 2] {
    let [w, x, y, _] = disc.rotation;
    [
        [1.0 - 2.0 * y * y, 2.0 * x * y, -2.0 * w * y],
        [2.0 * x * y, 1.0 - 2.0 * x * x, 2.0 * w * x],
    ]
}
