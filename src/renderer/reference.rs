//! What the pictures should be: double precision, every Gaussian at every pixel, the textbook formulas.
//!
//! Slow, and meant for tests. It shares with the renderer only the definitions: the camera, the widened Jacobian's
//! range, the blur, the visibility `z > near`, the ceiling of α, and the order by the depth as an `f32` and then by
//! index.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use super::{Background, Image};
use crate::gaussians::Gaussians;
use crate::renderer::camera::{Camera, Projection};

/// Where the reference cuts off, and which effects it has: these are as much a part of the definition as the formulas.
#[derive(Debug, Clone, Copy)]
pub struct Cutoffs {
    /// Skip an α below this.
    pub alpha: f64,
    /// A pixel with less transmittance is finished.
    pub through: f64,
    /// Whether opacity is taken back by as much as the blur widens.
    pub compensated: bool,
    /// Whether what reaches over the near plane is evaluated in space.
    pub near_care: bool,
    /// Whether each pixel has an order of its own.
    pub ordered: bool,
}

impl Cutoffs {
    /// No α is too small, and light is followed until a billionth is left.
    pub const NONE: Cutoffs = Cutoffs {
        alpha: 0.0,
        through: 1e-9,
        compensated: false,
        near_care: true,
        ordered: false,
    };
}

/// An α below this is none: a million of them change a channel by 10⁻⁶ of its range. It bounds which pixels a splat is
/// looked at for.
const NOTHING: f64 = 1e-12;

struct Seen {
    depth: f32,
    shape: Shape,
    opacity: f64,
    colour: DVec3,
}

enum Shape {
    /// An ellipse on the picture.
    Flat {
        centre: DVec2,
        /// How far from the centre, along x and y, α may be above [`NOTHING`].
        reach: DVec2,
        /// Inverse of the covariance.
        conic: DMat2,
        /// How the depth changes by pixel.
        slope: DVec2,
        depth: f64,
    },
    /// What reaches over the near plane: from the camera's axes to the Gaussian's, in its own measure, and the centre.
    Solid { whiten: DMat3, centre: DVec3 },
}

impl Shape {
    /// α over opacity at a point of the picture, and the depth there.
    fn at(&self, point: DVec2, camera: &Camera) -> (f64, f64) {
        match self {
            Shape::Flat {
                centre,
                conic,
                slope,
                depth,
                ..
            } => {
                let d = point - centre;
                ((-0.5 * d.dot(*conic * d)).exp(), depth + slope.dot(d))
            }
            Shape::Solid { whiten, centre } => {
                let x = (point.x - camera.cx) / camera.fx;
                let y = (point.y - camera.cy) / camera.fy;
                let (eye, ray) = match camera.projection {
                    Projection::Pinhole => (DVec3::ZERO, DVec3::new(x, y, 1.0)),
                    Projection::Orthographic => (DVec3::new(x, y, 0.0), DVec3::Z),
                };
                let (from, along) = (*whiten * (eye - centre), *whiten * ray);
                let depth = (-from.dot(along) / along.dot(along)).max(camera.near);
                let nearest = from + along * depth;
                ((-0.5 * nearest.length_squared()).exp(), depth)
            }
        }
    }

    /// Whether there may be anything in the row of pixels at `y`.
    fn in_row(&self, y: f64) -> bool {
        match self {
            Shape::Flat { centre, reach, .. } => (y - centre.y).abs() <= reach.y,
            Shape::Solid { .. } => true,
        }
    }

    /// The columns of the picture, from the first to the end, in which there may be something.
    fn columns(&self, low: u32, high: u32) -> std::ops::Range<u32> {
        match self {
            Shape::Flat { centre, reach, .. } => {
                let column = |x: f64| (x - 0.5).clamp(low.into(), high.into());
                let end = column(centre.x + reach.x).floor() as u32 + 1;
                column(centre.x - reach.x).ceil() as u32..end.min(high)
            }
            Shape::Solid { .. } => low..high,
        }
    }
}

/// Draws `gaussians`, which must be finite but for those that no camera would show.
pub fn render(gaussians: &Gaussians, camera: &Camera, background: Background, cutoffs: Cutoffs) -> Image {
    let mut seen: Vec<Seen> = (0..gaussians.len())
        .filter_map(|i| see(gaussians, camera, i, cutoffs))
        .collect();
    // Stable: ties keep the order of the input.
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let [width, height] = camera.size();
    let window = camera.window();
    let mut pixels = vec![[0.0; 4]; width as usize * height as usize];
    let rows = pixels.par_chunks_mut(width as usize).zip(window.y0..window.y1);
    rows.for_each(|(row, y)| {
        let y = f64::from(y) + 0.5;
        let mut sums = vec![(DVec3::ZERO, 1.0); row.len()];
        let blend = |(colour, through): &mut (DVec3, f64), s: &Seen, alpha: f64| {
            if alpha >= cutoffs.alpha && *through >= cutoffs.through {
                let weight = alpha.min(0.99) * *through;
                *colour += s.colour * weight;
                *through -= weight;
            }
        };
        let mut layers = vec![Vec::new(); if cutoffs.ordered { row.len() } else { 0 }];
        for s in seen.iter().filter(|s| s.shape.in_row(y)) {
            for x in s.shape.columns(window.x0, window.x1) {
                let (share, depth) = s.shape.at(DVec2::new(f64::from(x) + 0.5, y), camera);
                let (alpha, x) = (s.opacity * share, (x - window.x0) as usize);
                match layers.get_mut(x) {
                    Some(layers) => layers.push((depth, alpha, s)),
                    None => blend(&mut sums[x], s, alpha),
                }
            }
        }
        for (layers, sums) in layers.iter_mut().zip(&mut sums) {
            layers.sort_by(|a, b| a.0.total_cmp(&b.0));
            for (_, alpha, s) in layers {
                blend(sums, s, *alpha);
            }
        }
        for (pixel, (colour, through)) in row.iter_mut().zip(sums) {
            let (over, alpha) = match background {
                Background::Transparent => (DVec3::ZERO, 1.0 - through),
                Background::Colour(c) => (c.map(f64::from).into(), 1.0),
            };
            let [r, g, b]: [f64; 3] = (colour + over * through).into();
            *pixel = [r, g, b, alpha].map(|x| x as f32);
        }
    });
    Image { width, height, pixels }
}

fn see(gaussians: &Gaussians, camera: &Camera, i: usize, cutoffs: Cutoffs) -> Option<Seen> {
    let position = DVec3::from(gaussians.position[i].map(f64::from));
    let scale = DVec3::from(gaussians.scale[i].map(|s| f64::from(s).abs().min(1e4)));
    let [w, x, y, z] = gaussians.rotation[i].map(f64::from);
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let opacity = f64::from(gaussians.opacity[i]).min(1.0);
    let colour = DVec3::from(gaussians.colour[i].map(f64::from));
    let finite =
        position.is_finite() && scale.is_finite() && rotation.is_finite() && opacity.is_finite() && colour.is_finite();
    let t = camera.pose.transform_point3(position);
    if !(finite && rotation.length() > 0.0) {
        return None;
    }
    let axes = camera.pose.matrix3 * DMat3::from_quat(rotation.normalize());
    let reach = 3.0 * (axes.row(2) * scale).length();
    let crosses = cutoffs.near_care && (t.z - camera.near).abs() < reach;
    if !(t.z > camera.near || crosses) {
        return None;
    }
    if crosses {
        let pinhole = camera.projection == Projection::Pinhole;
        let distance = if pinhole { t.z.max(camera.near) } else { 1.0 };
        let blur = f64::from(gaussians.pixel_blur()) * distance * distance / (camera.fx * camera.fy);
        let variance = scale * scale + blur.max(gaussians.blur.into());
        let whiten = DMat3::from_diagonal(variance.map(|v| 1.0 / v.sqrt())) * axes.transpose();
        return Some(Seen {
            depth: (t.z as f32).max(camera.near as f32),
            shape: Shape::Solid { whiten, centre: t },
            opacity,
            colour,
        });
    }
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
    let blur = own.max(gaussians.pixel_blur().into());
    let covariance = DMat2::from_cols(DVec2::new(a + blur, b), DVec2::new(b, c + blur));
    let kept = ((a * c - b * b).max(0.0) / covariance.determinant()).sqrt();
    let opacity = if cutoffs.compensated {
        opacity * kept.max(0.005)
    } else {
        opacity
    };
    let far = (2.0 * (opacity / NOTHING).ln().max(0.0)).sqrt();
    let ahead = sigma.z_axis;
    let conic = covariance.inverse();
    Some(Seen {
        depth: t.z as f32,
        shape: Shape::Flat {
            reach: DVec2::new((a + blur).sqrt(), (c + blur).sqrt()) * far,
            centre: DVec2::new(camera.fx * at.x + camera.cx, camera.fy * at.y + camera.cy),
            slope: conic * DVec2::new(jx.dot(ahead), jy.dot(ahead)),
            conic,
            depth: t.z,
        },
        opacity,
        colour,
    })
}
