//! What the pictures should be: double precision, every Gaussian at every pixel, the textbook formulas.
//!
//! Slow, and meant for tests. It shares with the renderer only the definitions: the camera, the widened Jacobian's range, the blur,
//! the visibility `z > near`, the ceiling of α, and the order by the depth as an `f32` and then by index.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};

use super::{Background, Image};
use crate::gaussians::Gaussians;
use crate::projection::{Camera, Projection};

/// Where the reference cuts off.
#[derive(Debug, Clone, Copy)]
pub struct Cutoffs {
    /// Skip an α below this.
    pub alpha: f64,
    /// A pixel with less transmittance is finished.
    pub through: f64,
    /// Whether opacity is taken back by as much as the blur widens: not a cut-off, but as much a part of the definition.
    pub compensated: bool,
}

impl Cutoffs {
    /// No α is too small, and light is followed until a billionth is left.
    pub const NONE: Cutoffs = Cutoffs {
        alpha: 0.0,
        through: 1e-9,
        compensated: false,
    };
    /// What defines a picture: an α below 1/255 is none.
    pub const DEFINITION: Cutoffs = Cutoffs {
        alpha: 1.0 / 255.0,
        ..Cutoffs::NONE
    };
    /// Those of the renderer.
    pub const RENDERER: Cutoffs = Cutoffs {
        alpha: 1.0 / 255.0,
        through: 1.0 / 1024.0,
        compensated: false,
    };
}

struct Seen {
    depth: f32,
    centre: DVec2,
    /// Inverse of the covariance.
    conic: DMat2,
    opacity: f64,
    colour: DVec3,
}

/// Draws `gaussians`, which must be finite but for those that no camera would show.
pub fn render(
    gaussians: &Gaussians,
    camera: &Camera,
    background: Background,
    cutoffs: Cutoffs,
) -> Image {
    let mut seen: Vec<Seen> = (0..gaussians.len())
        .filter_map(|i| see(gaussians, camera, i, cutoffs.compensated))
        .collect();
    // Stable: ties keep the order of the input.
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x, y)));
    let pixels = pixels.map(|(x, y)| {
        let point = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let (mut colour, mut through) = (DVec3::ZERO, 1.0);
        for s in &seen {
            if through < cutoffs.through {
                break;
            }
            let d = point - s.centre;
            let alpha = s.opacity * (-0.5 * d.dot(s.conic * d)).exp();
            if alpha < cutoffs.alpha {
                continue;
            }
            let weight = alpha.min(0.99) * through;
            colour += s.colour * weight;
            through -= weight;
        }
        let (over, alpha) = match background {
            Background::Transparent => (DVec3::ZERO, 1.0 - through),
            Background::Colour(c) => (c.map(f64::from).into(), 1.0),
        };
        let [r, g, b]: [f64; 3] = (colour + over * through).into();
        [r, g, b, alpha].map(|x| x as f32)
    });
    Image {
        width: camera.width,
        height: camera.height,
        pixels: pixels.collect(),
    }
}

fn see(gaussians: &Gaussians, camera: &Camera, i: usize, compensated: bool) -> Option<Seen> {
    let position = DVec3::from(gaussians.position[i].map(f64::from));
    let scale = DVec3::from(gaussians.scale[i].map(f64::from));
    let [w, x, y, z] = gaussians.rotation[i].map(f64::from);
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let opacity = f64::from(gaussians.opacity[i]).min(1.0);
    let colour = DVec3::from(gaussians.colour[i].map(f64::from));
    let finite = position.is_finite()
        && scale.is_finite()
        && rotation.is_finite()
        && opacity.is_finite()
        && colour.is_finite();
    let t = camera.pose.transform_point3(position);
    let visible = finite && rotation.length() > 0.0 && t.z > camera.near;
    if !visible {
        return None;
    }
    let axes = camera.pose.matrix3 * DMat3::from_quat(rotation.normalize());
    let sigma = axes * DMat3::from_diagonal(scale * scale) * axes.transpose();

    let limit = |slope: f64, focal: f64, centre: f64, size: u32| {
        let (size, margin) = (f64::from(size), 0.15 * f64::from(size));
        slope.clamp((-centre - margin) / focal, (size - centre + margin) / focal)
    };
    let sx = limit(t.x / t.z, camera.fx, camera.cx, camera.width);
    let sy = limit(t.y / t.z, camera.fy, camera.cy, camera.height);
    let pinhole = camera.projection == Projection::Pinhole;
    let (jx, jy, at) = if pinhole {
        (
            DVec3::new(1.0, 0.0, -sx) * (camera.fx / t.z),
            DVec3::new(0.0, 1.0, -sy) * (camera.fy / t.z),
            t / t.z,
        )
    } else {
        (DVec3::X * camera.fx, DVec3::Y * camera.fy, t)
    };
    let b = jx.dot(sigma * jy);
    let (a, c) = (jx.dot(sigma * jx), jy.dot(sigma * jy));
    let near = if pinhole { t.z } else { 1.0 };
    let own = f64::from(gaussians.blur) * camera.fx * camera.fy / (near * near);
    let blur = own.max(0.3);
    let covariance = DMat2::from_cols(DVec2::new(a + blur, b), DVec2::new(b, c + blur));
    let kept = ((a * c - b * b).max(0.0) / covariance.determinant()).sqrt();
    let opacity = if compensated {
        opacity * kept.max(0.005)
    } else {
        opacity
    };
    Some(Seen {
        depth: t.z as f32,
        centre: DVec2::new(camera.fx * at.x + camera.cx, camera.fy * at.y + camera.cy),
        conic: covariance.inverse(),
        opacity,
        colour,
    })
}
