//! From the network's raw numbers to Gaussians.
//!
//! Activations after the paper's semantics (offset, scale, rotation, opacity, colour; its §"3D Gaussian generation"), which leaves
//! their functions open. With `u` the edge of a generated voxel in the cube frame:
//! position = voxel centre + tanh(raw)·range·u, σ = softplus(raw + bias)·range·u, rotation = normalise(raw + (1, 0, 0, 0)),
//! opacity = sigmoid(raw + bias) where it is learned, else 1, colour = clamp(½ + raw, 0, 1). Equal raw numbers give equal bits on every
//! machine.

use rayon::prelude::*;

use super::activations::{sigmoid, softplus, tanh};
use super::{Frame, Gaussians};
use crate::geometry::Voxels;
use crate::network::{RAW, Shape};

/// Gaussians per parallel task.
const BLOCK: usize = 4096;

/// Activates raw numbers, [`RAW`] per Gaussian.
///
/// With `children` 8, voxel `p` generates Gaussians `8p + octant`, one for each child whether occupied or not, with learned opacity;
/// with 1, voxel `p` generates Gaussian `p`, opaque.
///
/// # Panics
/// If `raw` is not [`RAW`] numbers for each Gaussian of `voxels`.
pub fn activate(
    raw: &[f32],
    voxels: &Voxels,
    children: usize,
    shape: &Shape,
    frame: Frame,
) -> Gaussians {
    let count = voxels.len() * children;
    assert_eq!(raw.len(), count * RAW, "raw numbers for every Gaussian");
    let generated = voxels.depth() + u8::from(children == 8);
    let edge = 2.0 / (1u32 << generated) as f32;
    let mut gaussians = Gaussians {
        position: vec![[0.0; 3]; count],
        scale: vec![[0.0; 3]; count],
        rotation: vec![[0.0; 4]; count],
        opacity: vec![1.0; count],
        colour: vec![[0.0; 3]; count],
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
        .for_each(
            |(block, (((((position, scale), rotation), opacity), colour), raw))| {
                for (j, raw) in raw.chunks_exact(RAW).enumerate() {
                    let i = block * BLOCK + j;
                    let centre = centre(voxels, children, i, edge);
                    for axis in 0..3 {
                        position[j][axis] =
                            centre[axis] + tanh(raw[axis]) * shape.offset_range * edge;
                        scale[j][axis] =
                            softplus(raw[3 + axis] + shape.scale_bias) * shape.scale_range * edge;
                        colour[j][axis] = (0.5 + raw[11 + axis]).clamp(0.0, 1.0);
                    }
                    rotation[j] = normalised([raw[6] + 1.0, raw[7], raw[8], raw[9]]);
                    if children == 8 {
                        opacity[j] = sigmoid(raw[10] + shape.opacity_bias);
                    }
                }
            },
        );
    gaussians
}

/// The centre of the voxel that Gaussian `i` belongs to. Exact in f32 down to level 20, and within half a voxel at 21 and 22.
fn centre(voxels: &Voxels, children: usize, i: usize, edge: f32) -> [f32; 3] {
    let parent = voxels.coordinate(i / children);
    let coordinate = match children {
        8 => std::array::from_fn(|axis| 2 * parent[axis] + (i as u32 >> axis & 1)),
        _ => parent,
    };
    coordinate.map(|v| ((f64::from(v) + 0.5) * f64::from(edge) - 1.0) as f32)
}

/// The unit quaternion along `q`; the identity for zero.
fn normalised(q: [f32; 4]) -> [f32; 4] {
    let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    if norm > 0.0 {
        q.map(|v| (f64::from(v) / norm) as f32)
    } else {
        [1.0, 0.0, 0.0, 0.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_zeros_give_opaque_grey_balls_at_the_voxel_centres() {
        let voxels = Voxels::new(2, vec![0, 63]);
        let gaussians = activate(
            &[0.0; 2 * RAW],
            &voxels,
            1,
            &Shape::tiny(),
            Frame::default(),
        );
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
        let gaussians = activate(
            &[0.0; 8 * RAW],
            &voxels,
            8,
            &Shape::tiny(),
            Frame::default(),
        );
        assert_eq!(gaussians.position[0], [0.25; 3]);
        assert_eq!(gaussians.position[1], [0.75, 0.25, 0.25]);
        assert_eq!(gaussians.position[4], [0.25, 0.25, 0.75]);
        assert!(gaussians.opacity.iter().all(|o| (0.85..0.9).contains(o)));
    }

    #[test]
    fn extreme_raw_numbers_stay_finite_and_in_range() {
        let voxels = Voxels::new(3, vec![5]);
        for extreme in [65504.0, -65504.0] {
            let g = activate(
                &[extreme; 8 * RAW],
                &voxels,
                8,
                &Shape::tiny(),
                Frame::default(),
            );
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
