//! The camera nodes of glTF 2.0, JSON and binary.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::Value;

use super::{Named, check_count, checked, is_angle, no_angle, parsed, pose};
use crate::error::{Error, Result};
use crate::gaussians::Frame;
use crate::renderer::camera::{Camera, Projection};

/// What a binary file begins with.
pub(super) const MAGIC: &[u8] = b"glTF";
/// Nodes that a camera is below at most.
const MAX_DEPTH: usize = 1000;
/// The header of the file, and of its first chunk, which is the JSON.
const HEADERS: usize = 20;

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    cameras: Vec<Lens>,
    #[serde(default)]
    nodes: Vec<Node>,
}

#[derive(Deserialize, Clone, Copy)]
#[serde(tag = "type", rename_all = "lowercase")]
enum Lens {
    Perspective { perspective: Perspective },
    Orthographic { orthographic: Orthographic },
}

#[derive(Deserialize, Clone, Copy)]
struct Perspective {
    yfov: f64,
    znear: f64,
}

#[derive(Deserialize, Clone, Copy)]
struct Orthographic {
    xmag: f64,
    ymag: f64,
    znear: f64,
}

#[derive(Deserialize)]
struct Node {
    name: Option<String>,
    camera: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    #[serde(default)]
    translation: [f64; 3],
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl Lens {
    /// Fails unless the numbers are such as glTF allows.
    fn check(&self, name: &str) -> Result<()> {
        let near = match self {
            Lens::Perspective { perspective } if !is_angle(perspective.yfov) => {
                return Err(no_angle(&format!("glTF: {name}"), "yfov", perspective.yfov));
            }
            Lens::Perspective { perspective } => perspective.znear,
            Lens::Orthographic { orthographic } => orthographic.znear,
        };
        if near >= 0.0 && near.is_finite() {
            return Ok(());
        }
        Err(Error::Usage(format!(
            "glTF: {name}: znear is {near}, it must be 0 or more"
        )))
    }
}

impl Node {
    /// To the parent's space.
    fn transform(&self) -> DMat4 {
        match &self.matrix {
            Some(matrix) => DMat4::from_cols_array(matrix),
            None => DMat4::from_scale_rotation_translation(
                self.scale.unwrap_or([1.0; 3]).into(),
                DQuat::from_array(self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0])).normalize(),
                self.translation.into(),
            ),
        }
    }
}

/// The JSON of a binary file.
pub(super) fn json_of(bytes: &[u8]) -> Result<&[u8]> {
    let short = || Error::Usage("binary glTF: it ends before its JSON does".into());
    let headers = bytes.get(..HEADERS).ok_or_else(short)?;
    if &headers[16..] != b"JSON" {
        return Err(Error::Usage("binary glTF: its first chunk is no JSON".into()));
    }
    let length = u32::from_le_bytes([headers[12], headers[13], headers[14], headers[15]]);
    bytes[HEADERS..].get(..length as usize).ok_or_else(short)
}

/// The cameras, in the order of their nodes: OpenGL axes, from the camera to the world, whatever its scale. Pixels are
/// square; a pinhole's field of view is that of the picture's height.
pub(super) fn cameras(file: Value, frame: &Frame, size: (u32, u32)) -> Result<Vec<Named>> {
    let Scene { cameras, nodes } = parsed("glTF", file)?;
    let mut parents = vec![None; nodes.len()];
    for (parent, node) in nodes.iter().enumerate() {
        for &child in &node.children {
            let place = parents.get_mut(child);
            *place.ok_or_else(|| Error::Usage(format!("glTF: there is no node {child}")))? = Some(parent);
        }
    }
    let mut named = Vec::new();
    for (i, node) in nodes.iter().enumerate() {
        let Some(camera) = node.camera else { continue };
        let name = node.name.clone().unwrap_or_else(|| format!("node {i}"));
        let missing = || Error::Usage(format!("glTF: {name}: there is no camera {camera}"));
        let lens = cameras.get(camera).ok_or_else(missing)?;
        lens.check(&name)?;
        let mut transform = node.transform();
        let mut above = parents[i];
        for _ in 0..nodes.len().min(MAX_DEPTH) {
            let Some(parent) = above else { break };
            transform = nodes[parent].transform() * transform;
            above = parents[parent];
        }
        if above.is_some() {
            let what = format!("glTF: {name} is among its own children, or below more than {MAX_DEPTH} nodes");
            return Err(Error::Usage(what));
        }
        let camera = seen(*lens, transform, frame, size);
        named.push(checked(&name, camera)?);
        check_count("glTF", named.len())?;
    }
    Ok(named)
}

fn seen(lens: Lens, transform: DMat4, frame: &Frame, (width, height): (u32, u32)) -> Camera {
    let column = |k: usize| transform.col(k).truncate();
    let [x, y, z] = [0, 1, 2].map(|k| column(k).normalize_or_zero());
    let rotation = DMat3::from_cols(x, -y, -z).transpose();
    let eye: DVec3 = column(3);
    let half = [width, height].map(|side| f64::from(side) / 2.0);
    let unit = frame.unit();
    let (projection, fx, fy, near) = match lens {
        Lens::Perspective {
            perspective: Perspective { yfov, znear },
        } => {
            let focal = half[1] / (yfov / 2.0).tan();
            (Projection::Pinhole, focal, focal, znear)
        }
        Lens::Orthographic {
            orthographic: Orthographic { xmag, ymag, znear },
        } => {
            let [fx, fy] = [half[0] / xmag * unit, half[1] / ymag * unit];
            (Projection::Orthographic, fx, fy, znear)
        }
    };
    Camera {
        pose: pose(rotation, -(rotation * eye), frame),
        fx,
        fy,
        cx: half[0],
        cy: half[1],
        width,
        height,
        // A plane through the eye is allowed there, but not here.
        near: (near / unit).max(f64::from(f32::EPSILON)),
        projection,
        crop: None,
    }
}
