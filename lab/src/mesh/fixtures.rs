//! Small meshes for tests.

use super::{Mesh, Part, Texture};

/// A rectangle from two of its edges, texture coordinates (0, 0) at `corner`, (1, 0) along `u` and (0, 1) along `v`.
pub fn quad(corner: [f32; 3], u: [f32; 3], v: [f32; 3], texture: Option<Texture>) -> Part {
    let at = |s: f32, t: f32| std::array::from_fn(|i| corner[i] + s * u[i] + t * v[i]);
    let uvs = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    Part {
        positions: uvs.iter().map(|uv| at(uv[0], uv[1])).collect(),
        uvs: if texture.is_some() { uvs } else { Vec::new() },
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        texture,
        factor: [1.0; 4],
    }
}

/// A rectangle in one colour, 0 to 1.
pub fn plain_quad(corner: [f32; 3], u: [f32; 3], v: [f32; 3], rgb: [f32; 3]) -> Part {
    Part {
        factor: [rgb[0], rgb[1], rgb[2], 1.0],
        ..quad(corner, u, v, None)
    }
}

/// A texture from a function of the texel.
pub fn texture(width: u32, height: u32, texel: impl Fn(u32, u32) -> [u8; 4]) -> Texture {
    Texture {
        width,
        height,
        rgba: (0..width * height).map(|i| texel(i % width, i / width)).collect(),
    }
}

/// One part.
pub fn mesh(part: Part) -> Mesh {
    Mesh { parts: vec![part] }
}
