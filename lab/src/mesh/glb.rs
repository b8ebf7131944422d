//! Reads self-contained binary glTF: triangles, texture coordinates, one base colour per material.

use std::path::Path;

use gltf::{Gltf, Node, Primitive};

use super::accessor::Blob;
use super::{Mesh, Part, Texture};
use crate::error::{LabError, Result};

/// Reads a mesh, all nodes of its scene, with their transforms applied.
///
/// # Errors
/// Names the file and what is wrong with it: not glTF, data outside the file, no triangles, a texture that cannot be
/// read.
pub fn load(path: &Path) -> Result<Mesh> {
    let bytes = std::fs::read(path).map_err(LabError::io(path))?;
    parse(&bytes).map_err(|detail| LabError::Mesh {
        path: path.to_owned(),
        detail,
    })
}

/// Reads a mesh from a file's bytes.
///
/// # Errors
/// What is wrong with the file, in words.
pub fn parse(bytes: &[u8]) -> Result<Mesh, String> {
    let gltf = Gltf::from_slice(bytes).map_err(|e| format!("not a usable glTF file: {e}"))?;
    let blob = binary_chunk(&gltf)?;
    let mut reader = Reader {
        blob,
        mesh: Mesh::default(),
    };
    let scene = gltf.default_scene().or_else(|| gltf.scenes().next());
    match scene {
        Some(scene) => {
            for node in scene.nodes() {
                reader.node(&node, glam::DMat4::IDENTITY, 0)?;
            }
        }
        // Without a scene nothing is said about placement: the meshes stand as they are.
        None => {
            for mesh in gltf.meshes() {
                for primitive in mesh.primitives() {
                    reader.primitive(&primitive, glam::DMat4::IDENTITY)?;
                }
            }
        }
    }
    if reader.mesh.parts.iter().all(|p| p.triangles.is_empty()) {
        return Err("no triangles".into());
    }
    Ok(reader.mesh)
}

/// The file's own binary chunk.
///
/// # Errors
/// If there is none.
pub(super) fn binary_chunk(gltf: &Gltf) -> Result<Blob<'_>, String> {
    let blob = gltf.blob.as_deref();
    blob.map(Blob)
        .ok_or_else(|| "no binary chunk: only self-contained .glb files are read".into())
}

/// Deeper than any sensible scene, and shallow enough for the stack; a cycle of nodes ends here.
const MAX_NODE_DEPTH: usize = 64;

struct Reader<'a> {
    blob: Blob<'a>,
    mesh: Mesh,
}

impl Reader<'_> {
    fn node(&mut self, node: &Node, parent: glam::DMat4, depth: usize) -> Result<(), String> {
        if depth > MAX_NODE_DEPTH {
            return Err(format!("nodes are nested deeper than {MAX_NODE_DEPTH}"));
        }
        let local = glam::Mat4::from_cols_array_2d(&node.transform().matrix());
        let transform = parent * local.as_dmat4();
        if let Some(mesh) = node.mesh() {
            for primitive in mesh.primitives() {
                self.primitive(&primitive, transform)?;
            }
        }
        for child in node.children() {
            self.node(&child, transform, depth + 1)?;
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &Primitive, transform: glam::DMat4) -> Result<(), String> {
        let mut part = part(self.blob, primitive)?;
        if transform != glam::DMat4::IDENTITY {
            for p in &mut part.positions {
                let q = transform.transform_point3(glam::Vec3::from(*p).as_dvec3());
                *p = q.as_vec3().into();
            }
        }
        self.mesh.parts.push(part);
        Ok(())
    }
}

/// A primitive in its mesh's own space.
///
/// # Errors
/// What is wrong with it, in words.
pub(super) fn part(blob: Blob, primitive: &Primitive) -> Result<Part, String> {
    if primitive.mode() != gltf::mesh::Mode::Triangles {
        return Err(format!("a primitive is {:?}, expected triangles", primitive.mode()));
    }
    let position = primitive
        .get(&gltf::Semantic::Positions)
        .ok_or("a primitive has no POSITION")?;
    let positions = blob.floats::<3>(&position, "POSITION")?;
    let triangles = triangles(blob, primitive, positions.len())?;
    let material = primitive.material();
    let colour = material.pbr_metallic_roughness();
    let (texture, uvs) = match colour.base_color_texture() {
        None => (None, Vec::new()),
        Some(info) => {
            let accessor = primitive
                .get(&gltf::Semantic::TexCoords(info.tex_coord()))
                .ok_or("a textured primitive has no texture coordinates")?;
            let uvs = blob.floats::<2>(&accessor, "TEXCOORD")?;
            if uvs.len() != positions.len() {
                return Err(format!(
                    "{} texture coordinates for {} positions",
                    uvs.len(),
                    positions.len()
                ));
            }
            (Some(texture(blob, &info.texture())?), uvs)
        }
    };
    Ok(Part {
        positions,
        uvs,
        triangles,
        texture,
        factor: colour.base_color_factor(),
    })
}

fn triangles(blob: Blob, primitive: &Primitive, vertices: usize) -> Result<Vec<[u32; 3]>, String> {
    let flat: Vec<u32> = match primitive.indices() {
        None => (0..vertices as u32).collect(),
        Some(accessor) => blob
            .unsigned::<1>(&accessor, "indices")?
            .into_iter()
            .flatten()
            .collect(),
    };
    if !flat.len().is_multiple_of(3) {
        return Err(format!("{} indices are not whole triangles", flat.len()));
    }
    if let Some(bad) = flat.iter().find(|&&i| i as usize >= vertices) {
        return Err(format!("index {bad} is outside of the {vertices} positions"));
    }
    Ok(flat.as_chunks::<3>().0.to_vec())
}

fn texture(blob: Blob, texture: &gltf::Texture) -> Result<Texture, String> {
    let gltf::image::Source::View { view, .. } = texture.source().source() else {
        return Err("a texture is outside of the file".into());
    };
    let data = view
        .offset()
        .checked_add(view.length())
        .and_then(|end| blob.0.get(view.offset()..end))
        .ok_or("a texture lies outside of the file")?;
    let picture = image::load_from_memory(data).map_err(|e| format!("a texture cannot be read: {e}"))?;
    Ok(picture.into())
}

impl From<image::DynamicImage> for Texture {
    fn from(picture: image::DynamicImage) -> Self {
        let picture = picture.into_rgba8();
        Texture {
            width: picture.width(),
            height: picture.height(),
            rgba: picture.pixels().map(|p| p.0).collect(),
        }
    }
}

#[cfg(test)]
#[path = "glb_tests.rs"]
pub(crate) mod tests;
