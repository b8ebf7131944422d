//! Surfels: opaque discs in closed form, from the voxels of a level and their colours. No network, no model file.
//!
//! A voxel's normal is the least axis of the covariance of its neighbourhood (`moments.rs`). Its disc lies in the plane through the
//! neighbourhood's mean, which takes the staircase of voxels away, or nearer to the voxel where the neighbourhood is no plane. It is as wide as the
//! voxels of such a plane are apart, and next to nothing thick, so that silhouettes do not grow; the fewer neighbours lie beside the
//! voxel, the rounder it is. With [`PerVoxel::Four`] four smaller discs follow the colours' gradient.
//!
//! Sums are of integers; the rest is IEEE f32 additions, multiplications, divisions and square roots in a fixed order. So the Gaussians
//! are the same bits on every machine and for any number of threads.

mod colours;
mod discs;
mod lanes;
mod moments;
mod normals;
mod passes;
#[cfg(test)]
mod tests;

use b2p_kernels::{Isa, zeros};
use rayon::prelude::*;

use super::{Frame, Gaussians};
use crate::geometry::{KernelMap, Voxels};
use discs::Disc;

/// Voxels that one task handles.
const BLOCK: usize = 1024;
/// [`Gaussians::blur`], in voxels squared.
const BLUR: f32 = 0.003;
/// Where the four discs of a voxel lie along the axes of their plane, in voxels from its disc's centre.
const APART: f32 = 0.25;
/// How wide they are beside the one disc.
const NARROWED: f32 = 0.6;

/// Discs for each voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PerVoxel {
    /// One, of the voxel's colour: where voxels are small in pictures.
    #[default]
    One,
    /// Four, of colours interpolated between neighbours: where voxels are large. At level 8 of six 10-bit objects they gained 0.2 dB over whole
    /// pictures, 0.35 dB over the foreground and 2 of SSIMULACRA2; at level 9 −0.3, +0.2 and 0.5, for twice the time.
    Four,
}

impl PerVoxel {
    /// How many.
    pub fn count(self) -> usize {
        match self {
            PerVoxel::One => 1,
            PerVoxel::Four => 4,
        }
    }
}

/// The discs of `voxels`, those of the first voxel first.
///
/// `map` is the voxels' 3³ kernel map, `colours` are theirs, sRGB. `frame` says where the cube lies; the Gaussians are in cube-frame units.
///
/// # Panics
/// If `map` is not a 3³ map, or it, `voxels` and `colours` disagree in length.
pub fn surfels(
    isa: Isa,
    voxels: &Voxels,
    map: &KernelMap,
    colours: &[[u8; 3]],
    per_voxel: PerVoxel,
    frame: Frame,
) -> Gaussians {
    assert_eq!(map.volume(), 27, "surfels need a 3³ map");
    assert_eq!(map.len(), voxels.len(), "one row of the map per voxel");
    assert_eq!(colours.len(), voxels.len(), "one colour per voxel");
    let alone = moments::of_voxels(voxels);
    let near = moments::step(isa, map, &alone);
    let mut far = moments::step(isa, map, &near);
    for _ in 2..moments::ROUNDS {
        far = moments::step(isa, map, &far);
    }
    let count = voxels.len() * per_voxel.count();
    let edge = 2.0 / (1u32 << voxels.depth()) as f32;
    let mut gaussians = Gaussians {
        blur: BLUR * edge * edge,
        position: zeros(count),
        scale: zeros(count),
        rotation: zeros(count),
        opacity: vec![1.0; count],
        colour: zeros(count),
        frame,
        ..Gaussians::default()
    };
    let block = BLOCK * per_voxel.count();
    gaussians
        .position
        .par_chunks_mut(block)
        .zip(gaussians.scale.par_chunks_mut(block))
        .zip(gaussians.rotation.par_chunks_mut(block))
        .zip(gaussians.colour.par_chunks_mut(block))
        .zip(near[..voxels.len()].par_chunks(BLOCK).zip(far.par_chunks(BLOCK)))
        .enumerate()
        .for_each(|(b, ((((position, scale), rotation), colour), (near, far)))| {
            let first = b * BLOCK;
            let coordinates: Vec<[u32; 3]> = (first..first + near.len()).map(|i| voxels.coordinate(i)).collect();
            let coordinates = &coordinates;
            let discs = isa.run(passes::Fit { coordinates, near, far });
            let n = per_voxel.count();
            for (j, (disc, &coordinate)) in discs.iter().zip(coordinates).enumerate() {
                let parts = match per_voxel {
                    PerVoxel::One => [(disc.centre, colours[first + j].map(f32::from)); 4],
                    PerVoxel::Four => quarters(disc, map, colours, first + j),
                };
                let narrowed = if n == 1 { 1.0 } else { NARROWED };
                let radius = disc.radius * narrowed * edge;
                for (part, (offset, rgb)) in parts.into_iter().take(n).enumerate() {
                    let to = j * n + part;
                    position[to] = placed(coordinate, offset, edge);
                    scale[to] = [radius, radius, disc.thickness * edge];
                    rotation[to] = disc.rotation;
                    colour[to] = rgb.map(|v| v / 255.0);
                }
            }
        });
    gaussians
}

/// A place in the cube frame, `offset` voxels from the centre of a voxel; `edge` is a voxel's. Exact centres down to level 20.
fn placed(coordinate: [u32; 3], offset: [f32; 3], edge: f32) -> [f32; 3] {
    std::array::from_fn(|axis| {
        let centre = (f64::from(coordinate[axis]) + 0.5) * f64::from(edge) - 1.0;
        centre as f32 + offset[axis] * edge
    })
}

/// Centres, relative to the voxel's, and colours in 0..=255 of the four discs that take the place of a voxel's one.
fn quarters(disc: &Disc, map: &KernelMap, colours: &[[u8; 3]], voxel: usize) -> [([f32; 3], [f32; 3]); 4] {
    let [u, v] = colours::plane(disc);
    let [along_u, along_v] = colours::gradient(map, colours, voxel, [u, v]);
    let own = colours[voxel].map(f32::from);
    [(-APART, -APART), (APART, -APART), (-APART, APART), (APART, APART)].map(|(a, b)| {
        let offset = [0, 1, 2].map(|axis| disc.centre[axis] + a * u[axis] + b * v[axis]);
        let rgb = [0, 1, 2].map(|c| own[c] + a * along_u[c] + b * along_v[c]);
        (offset, rgb.map(|v| v.clamp(0.0, 255.0)))
    })
}
