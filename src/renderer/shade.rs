//! What each Gaussian adds to the picture in place of its own colour.

use glam::{DQuat, DVec3, Vec3};
use rayon::prelude::*;

use crate::gaussians::Gaussians;
use crate::renderer::camera::{Camera, Projection};
use crate::renderer::effects::EffectSet;

/// Gaussians per parallel task.
const BLOCK: usize = 4096;

/// What a picture shows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Channel {
    /// Colours.
    #[default]
    Colour,
    /// In all three channels, the distance of the centres along the viewing direction, in cube-frame units.
    /// Premultiplied as colours are: divided by alpha it is the mean of what is seen.
    Depth,
    /// The axis along which a Gaussian is thinnest, turned to the eye, in the camera's axes, from [−1, 1] to [0, 1].
    /// Premultiplied.
    Normal,
}

/// Fills `shades` with what each Gaussian is drawn as: whatever `channel` asks for, and of colours those of the view.
pub(super) fn fill(
    gaussians: &Gaussians,
    camera: &Camera,
    channel: Channel,
    effects: &EffectSet,
    shades: &mut Vec<[f32; 3]>,
) {
    let rotation = camera.pose.matrix3;
    let eye = (rotation.transpose() * -camera.pose.translation).as_vec3();
    let along = rotation.row(2).as_vec3();
    let towards = |i: usize| match camera.projection {
        Projection::Pinhole => (Vec3::from(gaussians.position[i]) - eye).normalize_or(along),
        Projection::Orthographic => along,
    };
    let shade = |i: usize| -> [f32; 3] {
        match channel {
            Channel::Colour if effects.harmonics => {
                let towards = towards(i).into();
                gaussians.harmonics.seen(i, gaussians.colour[i], towards)
            }
            Channel::Colour => gaussians.colour[i],
            Channel::Depth => {
                let centre = DVec3::from(gaussians.position[i].map(f64::from));
                [camera.pose.transform_point3(centre).z as f32; 3]
            }
            Channel::Normal => {
                let [w, x, y, z] = gaussians.rotation[i].map(f64::from);
                let scale = gaussians.scale[i];
                let thinnest = (0..3).fold(
                    0,
                    |least, k| {
                        if scale[k].abs() < scale[least].abs() { k } else { least }
                    },
                );
                let turn = DQuat::from_xyzw(x, y, z, w).normalize();
                let normal = rotation * (turn * DVec3::AXES[thinnest]);
                let seen = rotation * towards(i).as_dvec3();
                let normal = if normal.dot(seen) > 0.0 { -normal } else { normal };
                (normal * 0.5 + 0.5).as_vec3().into()
            }
        }
    };
    shades.resize(gaussians.len(), [0.0; 3]);
    shades.par_chunks_mut(BLOCK).enumerate().for_each(|(block, shades)| {
        for (j, to) in shades.iter_mut().enumerate() {
            *to = shade(block * BLOCK + j);
        }
    });
}
