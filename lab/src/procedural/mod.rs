//! Meshes of the project's own making, textures included: nothing here comes from a file.
//!
//! [`objects()`] are shapes and paints by chance, for variety in training and for tests. [`scene()`] is the still life
//! that the demo shows. [`named`] finds either by name. Equal seeds give equal meshes wherever the platform's sine is
//! the same.

pub mod font;
pub mod light;
pub mod objects;
pub mod patch;
pub mod pattern;
pub mod rng;
mod scene;
mod scene_paint;
pub mod shapes;

pub use objects::objects;
pub use scene::scene;

use crate::mesh::Mesh;

/// What a name must start with where a mesh's file name would also do.
pub const PREFIX: &str = "procedural:";

/// The mesh called `procedural:scene`, or `procedural:NAME` with the name of one of the [`objects()`] of seed 0, or
/// `procedural:NAME@SEED`. None if there is no such mesh.
pub fn named(name: &str) -> Option<Mesh> {
    let name = name.strip_prefix(PREFIX)?;
    if name == "scene" {
        return Some(scene());
    }
    let (name, seed) = name.split_once('@').unwrap_or((name, "0"));
    objects::object(name, seed.parse().ok()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_need_the_prefix_and_a_number_as_seed() {
        assert!(named("procedural:cord").is_some());
        assert!(named("procedural:cord@7").is_some());
        assert!(named("cord").is_none());
        assert!(named("procedural:cord@x").is_none());
        assert!(named("procedural:elephant").is_none());
    }
}
