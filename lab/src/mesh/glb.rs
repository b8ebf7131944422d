//! Reads self-contained binary glTF: triangles, texture coordinates, one base colour per material.

use std::path::Path;

use gltf::accessor::{DataType, Dimensions};
use gltf::{Accessor, Gltf, Node, Primitive};

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
    let blob = gltf
        .blob
        .as_deref()
        .ok_or("no binary chunk: only self-contained .glb files are read")?;
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

/// Deeper than any sensible scene, and shallow enough for the stack; a cycle of nodes ends here.
const MAX_NODE_DEPTH: usize = 64;

struct Reader<'a> {
    blob: &'a [u8],
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
        if primitive.mode() != gltf::mesh::Mode::Triangles {
            return Err(format!("a primitive is {:?}, expected triangles", primitive.mode()));
        }
        let position = primitive
            .get(&gltf::Semantic::Positions)
            .ok_or("a primitive has no POSITION")?;
        let mut positions = self.vectors::<3>(&position, Dimensions::Vec3, "POSITION")?;
        if positions.iter().flatten().any(|x| !x.is_finite()) {
            return Err("a POSITION is not finite".into());
        }
        if transform != glam::DMat4::IDENTITY {
            for p in &mut positions {
                let q = transform.transform_point3(glam::Vec3::from(*p).as_dvec3());
                *p = q.as_vec3().into();
            }
        }
        let triangles = self.triangles(primitive, positions.len())?;
        let material = primitive.material();
        let colour = material.pbr_metallic_roughness();
        let (texture, uvs) = match colour.base_color_texture() {
            None => (None, Vec::new()),
            Some(info) => {
                let accessor = primitive
                    .get(&gltf::Semantic::TexCoords(info.tex_coord()))
                    .ok_or("a textured primitive has no texture coordinates")?;
                let uvs = self.vectors::<2>(&accessor, Dimensions::Vec2, "TEXCOORD")?;
                if uvs.len() != positions.len() {
                    return Err(format!(
                        "{} texture coordinates for {} positions",
                        uvs.len(),
                        positions.len()
                    ));
                }
                (Some(self.texture(&info.texture())?), uvs)
            }
        };
        self.mesh.parts.push(Part {
            positions,
            uvs,
            triangles,
            texture,
            factor: colour.base_color_factor(),
        });
        Ok(())
    }

    fn triangles(&self, primitive: &Primitive, vertices: usize) -> Result<Vec<[u32; 3]>, String> {
        let flat: Vec<u32> = match primitive.indices() {
            None => (0..vertices as u32).collect(),
            Some(accessor) => {
                let data = self.bytes(&accessor, "indices")?;
                let width = accessor.size();
                let ok = matches!(accessor.data_type(), DataType::U8 | DataType::U16 | DataType::U32);
                if accessor.dimensions() != Dimensions::Scalar || !ok {
                    return Err("indices are not unsigned integers".into());
                }
                data.map(|b| {
                    let mut wide = [0; 4];
                    wide[..width].copy_from_slice(&b[..width]);
                    u32::from_le_bytes(wide)
                })
                .collect()
            }
        };
        if !flat.len().is_multiple_of(3) {
            return Err(format!("{} indices are not whole triangles", flat.len()));
        }
        if let Some(bad) = flat.iter().find(|&&i| i as usize >= vertices) {
            return Err(format!("index {bad} is outside of the {vertices} positions"));
        }
        Ok(flat.as_chunks::<3>().0.to_vec())
    }

    fn vectors<const N: usize>(
        &self,
        accessor: &Accessor,
        dimensions: Dimensions,
        name: &str,
    ) -> Result<Vec<[f32; N]>, String> {
        if accessor.data_type() != DataType::F32 || accessor.dimensions() != dimensions {
            return Err(format!("{name} is not {N} 32-bit floats"));
        }
        let value = |b: &[u8], i: usize| f32::from_le_bytes([b[4 * i], b[4 * i + 1], b[4 * i + 2], b[4 * i + 3]]);
        Ok(self
            .bytes(accessor, name)?
            .map(|b| std::array::from_fn(|i| value(b, i)))
            .collect())
    }

    /// The bytes of each of an accessor's items.
    fn bytes(&self, accessor: &Accessor, name: &str) -> Result<impl Iterator<Item = &[u8]>, String> {
        let view = match accessor.view() {
            Some(view) if accessor.sparse().is_none() => view,
            _ => {
                return Err(format!("{name} is sparse or has no data, which is not read"));
            }
        };
        let outside = || format!("{name} lies outside of the file");
        let (size, count) = (accessor.size(), accessor.count());
        let stride = view.stride().unwrap_or(size);
        if stride < size {
            return Err(format!("{name} has items of {size} bytes every {stride}"));
        }
        let start = view.offset().checked_add(accessor.offset()).ok_or_else(outside)?;
        let length = match count {
            0 => 0,
            n => stride
                .checked_mul(n - 1)
                .and_then(|x| x.checked_add(size))
                .ok_or_else(outside)?,
        };
        let end = start.checked_add(length).ok_or_else(outside)?;
        let data = self.blob.get(start..end).ok_or_else(outside)?;
        Ok((0..count).map(move |i| &data[i * stride..i * stride + size]))
    }

    fn texture(&self, texture: &gltf::Texture) -> Result<Texture, String> {
        let gltf::image::Source::View { view, .. } = texture.source().source() else {
            return Err("a texture is outside of the file".into());
        };
        let data = view
            .offset()
            .checked_add(view.length())
            .and_then(|end| self.blob.get(view.offset()..end))
            .ok_or("a texture lies outside of the file")?;
        let picture = image::load_from_memory(data).map_err(|e| format!("a texture cannot be read: {e}"))?;
        Ok(picture.into())
    }
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
mod tests;
