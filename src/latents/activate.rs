//! From the network's raw numbers to Gaussians.
//!
//! Activations after the paper's semantics (offset, scale, rotation, opacity, colour; its §"3D Gaussian generation"),
//! which leaves their functions open. With `u` the edge of a generated voxel in the cube frame: position = voxel centre
//! + tanh(raw)·range·u, σ = softplus(raw + bias)·range·u, rotation = normalise(raw + (1, 0, 0, 0)), opacity =
//! sigmoid(raw + bias) where it is learned, else 1, colour = clamp(½ + raw, 0, 1). Equal raw numbers give equal bits on
//! every machine.

use b2p_kernels::zeros;
use rayon::prelude::*;

use crate::gaussians::{Frame, Gaussians};
use crate::geometry::Voxels;
use crate::latents::network::{RAW, Shape};
use crate::layers::activations::{GROUP, Lane, normalised, sigmoid, softplus, tanh};

/// Gaussians per parallel task.
const BLOCK: usize = 4096;

/// Activates raw numbers, [`RAW`] per Gaussian.
///
/// With `children` 8, voxel `p` generates Gaussians `8p + octant`, one for each child whether occupied or not, with
/// learned opacity; with 1, voxel `p` generates Gaussian `p`, opaque.
///
/// # Panics
/// If `raw` is not [`RAW`] numbers for each Gaussian of `voxels`.
pub fn activate(raw: &[f32], voxels: &Voxels, children: usize, shape: &Shape, frame: Frame) -> Gaussians {
    let count = voxels.len() * children;
    assert_eq!(raw.len(), count * RAW, "raw numbers for every Gaussian");
    let generated = voxels.depth() + u8::from(children == 8);
    let edge = 2.0 / (1u32 << generated) as f32;
    let mut gaussians = Gaussians {
        blur: shape.blur * edge * edge,
        position: zeros(count),
        scale: zeros(count),
        rotation: zeros(count),
        opacity: zeros(count),
        colour: zeros(count),
        frame,
        ..Gaussians::default()
    };
    gaussians
        .position
        .par_chunks_mut(BLOCK)
        .zip(gaussians.scale.par_chunks_mut(BLOCK))
        .zip(gaussians.rotation.par_chunks_mut(BLOCK))
        .zip(gaussians.opacity.par_chunks_mut(BLOCK))
        .zip(gaussians.colour.par_chunks_mut(BLOCK))
        .zip(raw.par_chunks(BLOCK * RAW))
        .enumerate()
        .for_each(|(block, (((((position, scale), rotation), opacity), colour), raw))| {
            for (g, raw) in raw.chunks(GROUP * RAW).enumerate() {
                let group = Group::new(raw, shape, children == 8);
                for j in 0..raw.len() / RAW {
                    let to = g * GROUP + j;
                    let centre = centre(voxels, children, block * BLOCK + to, edge);
                    for axis in 0..3 {
                        position[to][axis] = centre[axis] + group.offset[axis][j] * edge;
                        scale[to][axis] = group.scale[axis][j] * edge;
                        colour[to][axis] = group.colour[axis][j];
                    }
                    rotation[to] = group.rotation.map(|component| component[j]);
                    opacity[to] = group.opacity[j];
                }
            }
        });
    gaussians
}

/// Activated numbers, each kind apart; positions and scales in voxels.
struct Group {
    offset: [Lane; 3],
    scale: [Lane; 3],
    rotation: [Lane; 4],
    opacity: Lane,
    colour: [Lane; 3],
}

impl Group {
    /// Up to [`GROUP`] Gaussians; what is missing is as if raw numbers were zero.
    fn new(raw: &[f32], shape: &Shape, translucent: bool) -> Group {
        let mut lanes = [[0.0; GROUP]; RAW];
        for (j, raw) in raw.chunks_exact(RAW).enumerate() {
            for (lane, &raw) in lanes.iter_mut().zip(raw) {
                lane[j] = raw;
            }
        }
        let three = |first: usize| [lanes[first], lanes[first + 1], lanes[first + 2]];
        let offset = |x: f32| tanh(x) * shape.offset_range;
        let scale = |x: f32| softplus(x + shape.scale_bias) * shape.scale_range;
        let opacity = match translucent {
            true => lanes[10].map(|x| sigmoid(x + shape.opacity_bias)),
            false => [1.0; GROUP],
        };
        let rotation = [lanes[6].map(|w| w + 1.0), lanes[7], lanes[8], lanes[9]];
        Group {
            offset: three(0).map(|lane| lane.map(offset)),
            scale: three(3).map(|lane| lane.map(scale)),
            rotation: normalised(rotation),
            opacity,
            colour: three(11).map(|lane| lane.map(|x| (0.5 + x).clamp(0.0, 1.0))),
        }
    }
}

/// The centre of the voxel that Gaussian `i` belongs to. Exact in f32 down to level 20, and within half a voxel at 21
/// and 22.
fn centre(voxels: &Voxels, children: usize, i: usize, edge: f32) -> [f32; 3] {
    let parent = voxels.coordinate(i / children);
    let coordinate = match children {
        8 => std::array::from_fn(|axis| 2 * parent[axis] + (i as u32 >> axis & 1)),
        _ => parent,
    };
    coordinate.map(|v| ((f64::from(v) + 0.5) * f64::from(edge) - 1.0) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_zeros_give_opaque_grey_balls_at_the_voxel_centres() {
        let voxels = Voxels::new(2, vec![0, 63]);
        let gaussians = activate(&[0.0; 2 * RAW], &voxels, 1, &Shape::tiny(), Frame::default());
        assert_eq!(gaussians.position, [[-0.75; 3], [0.75; 3]]);
        assert_eq!(gaussians.rotation[0], [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(gaussians.opacity, [1.0, 1.0]);
        assert_eq!(gaussians.colour[1], [0.5; 3]);
        assert!(
            (gaussians.scale[0][0] / 0.5 - 0.55).abs() < 0.01,
            "σ is about half a voxel"
        );
    }

    #[test]
    fn eight_children_surround_their_parent_s_centre() {
        let voxels = Voxels::new(1, vec![7]);
        let gaussians = activate(&[0.0; 8 * RAW], &voxels, 8, &Shape::tiny(), Frame::default());
        assert_eq!(gaussians.position[0], [0.25; 3]);
        assert_eq!(gaussians.position[1], [0.75, 0.25, 0.25]);
        assert_eq!(gaussians.position[4], [0.25, 0.25, 0.75]);
        assert!(gaussians.opacity.iter().all(|o| (0.85..0.9).contains(o)));
    }

    #[test]
    fn the_model_says_how_blurred_its_gaussians_are_in_generated_voxels() {
        let shape = Shape {
            blur: 0.25,
            ..Shape::tiny()
        };
        for (children, edge) in [(1, 1.0), (8, 0.5)] {
            let (raw, voxels) = (vec![0.0; children * RAW], Voxels::new(1, vec![7]));
            let gaussians = activate(&raw, &voxels, children, &shape, Frame::default());
            assert_eq!(gaussians.blur, 0.25 * edge * edge);
        }
    }

    #[test]
    fn extreme_raw_numbers_stay_finite_and_in_range() {
        let voxels = Voxels::new(3, vec![5]);
        for extreme in [65504.0, -65504.0] {
            let g = activate(&[extreme; 8 * RAW], &voxels, 8, &Shape::tiny(), Frame::default());
            assert!(g.position.iter().flatten().all(|v| v.abs() < 1.2));
            assert!(g.scale.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
            assert!(
                g.rotation
                    .iter()
                    .all(|q| (q.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5)
            );
            assert!(
                g.opacity
                    .iter()
                    .chain(g.colour.iter().flatten())
                    .all(|v| (0.0..=1.0).contains(v))
            );
        }
    }
}
