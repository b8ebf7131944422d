//! Textured triangle meshes: where clouds and ground-truth pictures come from.

mod accessor;
pub mod animated;
#[cfg(test)]
pub(crate) mod fixtures;
pub mod glb;
mod keyframes;

/// A mesh in its own units, y up.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// One part per material.
    pub parts: Vec<Part>,
}

/// Triangles that share a material.
#[derive(Debug, Clone)]
pub struct Part {
    /// Vertex positions.
    pub positions: Vec<[f32; 3]>,
    /// Texture coordinates per vertex, v down, repeating; empty if the part has no texture.
    pub uvs: Vec<[f32; 2]>,
    /// Three vertex indices each.
    pub triangles: Vec<[u32; 3]>,
    /// The unlit base colour; none means white.
    pub texture: Option<Texture>,
    /// Multiplies the texture, linear in its 8-bit values, RGBA in `[0, 1]`.
    pub factor: [f32; 4],
}

/// An 8-bit sRGB picture with alpha, row by row from the top.
#[derive(Debug, Clone)]
pub struct Texture {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// `width · height` pixels.
    pub rgba: Vec<[u8; 4]>,
}
