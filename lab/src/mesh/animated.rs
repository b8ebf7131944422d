//! Animated glTF: node hierarchies, skins and morph targets, posed at any time.
//!
//! A vertex is first morphed: `p + Σ wᵢ · targetᵢ`. With a skin it then goes to `Σ wⱼ · globalⱼ · inverse bindⱼ · p`,
//! and the node's own transform has no effect (glTF 2.0, 3.7.3.1); without one to `global · p`.

use std::path::Path;

use glam::{DMat4, DQuat, DVec3};
use gltf::animation::{Animation, Property};
use gltf::{Gltf, Node};
use rayon::prelude::*;

use super::accessor::Blob;
use super::glb::{binary_chunk, part};
use super::keyframes::Curve;
use super::{Mesh, Part};
use crate::error::{LabError, Result};

/// An animated scene. [`Animated::mesh`] has what does not move; [`Animated::pose`] where its vertices are.
#[derive(Debug)]
pub struct Animated {
    nodes: Vec<Bone>,
    /// Every node after its parent.
    order: Vec<usize>,
    pieces: Vec<Piece>,
    curves: Vec<(usize, Property, Curve)>,
    span: [f64; 2],
}

#[derive(Debug)]
struct Bone {
    parent: Option<usize>,
    rest: DMat4,
    scale: DVec3,
    rotation: DQuat,
    translation: DVec3,
}

/// A primitive of a node.
#[derive(Debug)]
struct Piece {
    node: usize,
    part: Part,
    /// How far each target moves each vertex; empty for a target that moves none.
    targets: Vec<Vec<[f32; 3]>>,
    /// Weights of the targets where the animation gives none.
    weights: Vec<f64>,
    skin: Option<Binding>,
}

#[derive(Debug)]
struct Binding {
    /// Node and inverse bind matrix.
    joints: Vec<(usize, DMat4)>,
    /// Joint and weight, for each vertex; the weights of a vertex have the sum 1.
    influences: Vec<Vec<(u32, f64)>>,
}

/// Reads an animated scene; `animation` counts from 0.
///
/// # Errors
/// Names the file and what is wrong with it, as [`super::glb::load`]; also if there is no such animation.
pub fn load(path: &Path, animation: usize) -> Result<Animated> {
    let bytes = std::fs::read(path).map_err(LabError::io(path))?;
    parse(&bytes, animation).map_err(|detail| LabError::Mesh {
        path: path.to_owned(),
        detail,
    })
}

/// Reads an animated scene from a file's bytes.
///
/// # Errors
/// What is wrong with the file, in words.
pub fn parse(bytes: &[u8], animation: usize) -> Result<Animated, String> {
    let gltf = Gltf::from_slice(bytes).map_err(|e| format!("not a usable glTF file: {e}"))?;
    let blob = binary_chunk(&gltf)?;
    let nodes = bones(&gltf)?;
    let order = parents_first(&nodes)?;
    let count = gltf.animations().count();
    let chosen = gltf.animations().nth(animation);
    let chosen = chosen.ok_or_else(|| format!("there is no animation {animation}, the file has {count}"))?;
    let pieces = pieces(&gltf, blob)?;
    if pieces.iter().all(|p| p.part.triangles.is_empty()) {
        return Err("no triangles".into());
    }
    let curves = curves(blob, &chosen, &pieces)?;
    let spans = curves.iter().map(|(_, _, c)| c.span());
    let span = spans.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]);
    let span = span.ok_or("the animation moves nothing")?;
    Ok(Animated {
        nodes,
        order,
        pieces,
        curves,
        span,
    })
}

impl Animated {
    /// First and last key's time in seconds.
    pub fn span(&self) -> [f64; 2] {
        self.span
    }

    /// Triangles, texture coordinates and textures, in no pose that means anything.
    pub fn mesh(&self) -> Mesh {
        Mesh {
            parts: self.pieces.iter().map(|p| p.part.clone()).collect(),
        }
    }

    /// Where the vertices of each part of [`Animated::mesh`] are at a time in seconds.
    pub fn pose(&self, time: f64) -> Vec<Vec<[f32; 3]>> {
        let globals = self.globals(time);
        let pose = |piece: &Piece| piece.pose(&globals, &self.weights(piece, time));
        self.pieces.iter().map(pose).collect()
    }

    /// Every node's transform to the scene.
    fn globals(&self, time: f64) -> Vec<DMat4> {
        let mut locals: Vec<_> = self
            .nodes
            .iter()
            .map(|n| (n.scale, n.rotation, n.translation))
            .collect();
        let mut moves = vec![false; locals.len()];
        for (node, property, curve) in &self.curves {
            let local = &mut locals[*node];
            match property {
                Property::Translation => local.2 = DVec3::from_slice(&curve.at(time)),
                Property::Rotation => local.1 = curve.rotation_at(time),
                Property::Scale => local.0 = DVec3::from_slice(&curve.at(time)),
                Property::MorphTargetWeights => continue,
            }
            moves[*node] = true;
        }
        let mut globals = vec![DMat4::IDENTITY; locals.len()];
        for &node in &self.order {
            let (scale, rotation, translation) = locals[node];
            let local = if moves[node] {
                DMat4::from_scale_rotation_translation(scale, rotation, translation)
            } else {
                self.nodes[node].rest
            };
            let parent = self.nodes[node].parent.map_or(DMat4::IDENTITY, |p| globals[p]);
            globals[node] = parent * local;
        }
        globals
    }

    fn weights(&self, piece: &Piece, time: f64) -> Vec<f64> {
        let is_own = |(node, property, _): &&(usize, Property, Curve)| {
            *node == piece.node && *property == Property::MorphTargetWeights
        };
        match self.curves.iter().find(is_own) {
            Some((_, _, curve)) => curve.at(time),
            None => piece.weights.clone(),
        }
    }
}

impl Piece {
    fn pose(&self, globals: &[DMat4], weights: &[f64]) -> Vec<[f32; 3]> {
        let matrices: Vec<DMat4> = match &self.skin {
            Some(skin) => skin
                .joints
                .iter()
                .map(|(node, inverse)| globals[*node] * *inverse)
                .collect(),
            None => vec![globals[self.node]],
        };
        let vertex = |(i, p): (usize, &[f32; 3])| {
            let mut place = glam::Vec3::from(*p).as_dvec3();
            for (target, weight) in self.targets.iter().zip(weights) {
                let moved = target.get(i).copied().unwrap_or_default();
                place += *weight * glam::Vec3::from(moved).as_dvec3();
            }
            let posed = match &self.skin {
                Some(skin) => skin.influences[i]
                    .iter()
                    .map(|(joint, weight)| *weight * matrices[*joint as usize].transform_point3(place))
                    .sum(),
                None => matrices[0].transform_point3(place),
            };
            posed.as_vec3().to_array()
        };
        self.part.positions.par_iter().enumerate().map(vertex).collect()
    }
}

fn bones(gltf: &Gltf) -> Result<Vec<Bone>, String> {
    let mut nodes: Vec<Bone> = gltf
        .nodes()
        .map(|node| {
            let rest = glam::Mat4::from_cols_array_2d(&node.transform().matrix()).as_dmat4();
            let (translation, rotation, scale) = node.transform().decomposed();
            Bone {
                parent: None,
                rest,
                scale: glam::Vec3::from(scale).as_dvec3(),
                rotation: DQuat::from_array(rotation.map(f64::from)),
                translation: glam::Vec3::from(translation).as_dvec3(),
            }
        })
        .collect();
    for node in gltf.nodes() {
        for child in node.children() {
            if nodes[child.index()].parent.replace(node.index()).is_some() {
                return Err(format!("node {} is the child of two nodes", child.index()));
            }
        }
    }
    Ok(nodes)
}

fn parents_first(nodes: &[Bone]) -> Result<Vec<usize>, String> {
    let mut children = vec![Vec::new(); nodes.len()];
    let mut order = Vec::with_capacity(nodes.len());
    for (i, node) in nodes.iter().enumerate() {
        match node.parent {
            Some(parent) => children[parent].push(i),
            None => order.push(i),
        }
    }
    let mut next = 0;
    while next < order.len() {
        order.extend_from_slice(&children[order[next]]);
        next += 1;
    }
    if order.len() < nodes.len() {
        return Err("nodes are their own ancestors".into());
    }
    Ok(order)
}

/// All primitives under the scene, or of all nodes where there is no scene.
fn pieces(gltf: &Gltf, blob: Blob) -> Result<Vec<Piece>, String> {
    let scene = gltf.default_scene().or_else(|| gltf.scenes().next());
    let mut open: Vec<Node> = match scene {
        Some(scene) => scene.nodes().collect(),
        None => gltf.nodes().collect(),
    };
    open.reverse();
    let mut seen = vec![false; gltf.nodes().count()];
    let mut pieces = Vec::new();
    while let Some(node) = open.pop() {
        if std::mem::replace(&mut seen[node.index()], true) {
            continue;
        }
        let mut below: Vec<Node> = node.children().collect();
        below.reverse();
        open.extend(below);
        let Some(mesh) = node.mesh() else { continue };
        let weights = node.weights().or(mesh.weights()).unwrap_or_default();
        let weights: Vec<f64> = weights.iter().map(|&w| f64::from(w)).collect();
        for primitive in mesh.primitives() {
            let part = part(blob, &primitive)?;
            let vertices = part.positions.len();
            let targets = targets(blob, &primitive, vertices)?;
            let mut weights = weights.clone();
            weights.resize(targets.len(), 0.0);
            let skin = match node.skin() {
                Some(skin) => Some(Binding::read(blob, &skin, &primitive, vertices)?),
                None => None,
            };
            pieces.push(Piece {
                node: node.index(),
                part,
                targets,
                weights,
                skin,
            });
        }
    }
    Ok(pieces)
}

/// The displacements of each morph target.
fn targets(blob: Blob, primitive: &gltf::Primitive, vertices: usize) -> Result<Vec<Vec<[f32; 3]>>, String> {
    let read = |target: gltf::mesh::MorphTarget| match target.positions() {
        None => Ok(Vec::new()),
        Some(accessor) => {
            let moves = blob.floats::<3>(&accessor, "the POSITION of a morph target")?;
            match moves.len() == vertices {
                true => Ok(moves),
                false => Err(format!("a morph target has {} vertices of {vertices}", moves.len())),
            }
        }
    };
    primitive.morph_targets().map(read).collect()
}

impl Binding {
    fn read(blob: Blob, skin: &gltf::Skin, primitive: &gltf::Primitive, vertices: usize) -> Result<Self, String> {
        let nodes: Vec<usize> = skin.joints().map(|j| j.index()).collect();
        let inverses = match skin.inverse_bind_matrices() {
            Some(accessor) => blob.floats::<16>(&accessor, "an inverse bind matrix")?,
            None => vec![glam::Mat4::IDENTITY.to_cols_array(); nodes.len()],
        };
        if inverses.len() < nodes.len() {
            let (have, joints) = (inverses.len(), nodes.len());
            return Err(format!("a skin has {have} inverse bind matrices for {joints} joints"));
        }
        let matrices = inverses.iter().map(|m| glam::Mat4::from_cols_array(m).as_dmat4());
        let joints: Vec<(usize, DMat4)> = nodes.into_iter().zip(matrices).collect();
        let mut influences = vec![Vec::new(); vertices];
        for set in 0.. {
            let named = gltf::Semantic::Joints(set);
            let (Some(of), Some(by)) = (primitive.get(&named), primitive.get(&gltf::Semantic::Weights(set))) else {
                break;
            };
            let of = blob.unsigned::<4>(&of, "JOINTS")?;
            let by = blob.floats::<4>(&by, "WEIGHTS")?;
            if of.len() != vertices || by.len() != vertices {
                return Err(format!(
                    "{} joints and {} weights for {vertices} vertices",
                    of.len(),
                    by.len()
                ));
            }
            for (influence, (of, by)) in influences.iter_mut().zip(of.into_iter().zip(by)) {
                let pairs = of.into_iter().zip(by).filter(|(_, w)| *w != 0.0);
                influence.extend(pairs.map(|(joint, weight)| (joint, f64::from(weight))));
            }
        }
        for influence in &mut influences {
            if let Some((joint, _)) = influence.iter().find(|(j, _)| *j as usize >= joints.len()) {
                return Err(format!("a vertex names joint {joint} of {}", joints.len()));
            }
            let sum: f64 = influence.iter().map(|(_, w)| w).sum();
            if !(sum > 0.0) {
                return Err("a vertex of a skinned mesh has no weights".into());
            }
            influence.iter_mut().for_each(|(_, w)| *w /= sum);
        }
        Ok(Binding { joints, influences })
    }
}

fn curves(blob: Blob, animation: &Animation, pieces: &[Piece]) -> Result<Vec<(usize, Property, Curve)>, String> {
    let mut curves = Vec::new();
    for channel in animation.channels() {
        let (node, property) = (channel.target().node().index(), channel.target().property());
        let sampler = channel.sampler();
        let output = sampler.output();
        let name = "an animation's values";
        let (width, values) = match property {
            Property::Rotation => (4, blob.floats::<4>(&output, name)?.into_iter().flatten().collect()),
            Property::Translation | Property::Scale => {
                (3, blob.floats::<3>(&output, name)?.into_iter().flatten().collect())
            }
            Property::MorphTargetWeights => {
                let piece = pieces.iter().find(|p| p.node == node);
                let Some(width) = piece.map(|p| p.targets.len()).filter(|&n| n > 0) else {
                    continue;
                };
                (
                    width,
                    blob.floats::<1>(&output, name)?
                        .into_iter()
                        .flatten()
                        .collect::<Vec<f32>>(),
                )
            }
        };
        let times = blob.floats::<1>(&sampler.input(), "an animation's times")?;
        let times = times.into_iter().flatten().map(f64::from).collect();
        let values = values.into_iter().map(f64::from).collect();
        curves.push((
            node,
            property,
            Curve::new(times, values, width, sampler.interpolation())?,
        ));
    }
    Ok(curves)
}

#[cfg(test)]
#[path = "animated_tests.rs"]
mod tests;
