//! Simple motions made by code, each with an object that shows it.

use std::f64::consts::TAU;

use glam::{Affine3A, DQuat, DVec3, Vec3};

use crate::mesh::Mesh;
use crate::procedural::patch::Patch;
use crate::procedural::{pattern, scene, shapes};

/// A motion and its object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Procedural {
    /// The still life of the demo on a turntable: 30 degrees a second
    Turning,
    /// A body whose chest widens by 4 % every four seconds
    Breathing,
    /// A hanging cloth in the wind, a wave every two seconds
    Cloth,
    /// The still life of the demo, which does not move
    Still,
}

/// Degrees a second.
const TURN: f64 = 30.0;
/// Seconds.
const BREATH: f64 = 4.0;
/// Seconds.
const WAVE: f64 = 2.0;
/// Texels per unit of length.
const DENSITY: f32 = 400.0;

impl Procedural {
    /// What moves, as it is at rest.
    pub fn mesh(self) -> Mesh {
        match self {
            Procedural::Turning | Procedural::Still => scene(),
            Procedural::Breathing => body(),
            Procedural::Cloth => {
                let colours = [[0.7, 0.1, 0.15], [0.95, 0.9, 0.8], [0.1, 0.2, 0.5]].map(Vec3::from);
                let cloth = finer(shapes::panel(1.6, 2.0));
                Mesh {
                    parts: vec![cloth.part(DENSITY, &pattern::stripes(0.09, 0.6, colours.to_vec()), None)],
                }
            }
        }
    }

    /// Where a point of the object at rest is after `time` seconds.
    pub fn moved(self, point: [f32; 3], time: f64) -> [f32; 3] {
        let p = Vec3::from(point).as_dvec3();
        let moved = match self {
            Procedural::Still => return point,
            Procedural::Turning => DQuat::from_rotation_y((TURN * time).to_radians()) * p,
            Procedural::Breathing => {
                let breath = 0.5 - 0.5 * (TAU * time / BREATH).cos();
                // The chest moves most, head and hips little.
                let here = 0.04 * breath * (-((p.y - 0.2) / 0.4).powi(2)).exp();
                p + here * DVec3::new(p.x, 0.0, 1.5 * p.z)
            }
            Procedural::Cloth => {
                // The upper edge, at y = 1, is held.
                let free = (1.0 - p.y) / 2.0;
                let phase = TAU * (time / WAVE - 0.5 * p.y - 0.3 * p.x);
                p + free * DVec3::new(0.03 * phase.cos(), 0.04 * phase.cos(), 0.25 * phase.sin())
            }
        };
        moved.as_vec3().to_array()
    }
}

/// The same flat patch in 96 by 96 quads, which can bend.
fn finer(flat: Patch) -> Patch {
    Patch::new([96, 96], move |u, v| flat.point(u, v))
}

/// A trunk and a head.
fn body() -> Mesh {
    let trunk = shapes::superquadric(0.8, 0.9).placed(Affine3A::from_scale(Vec3::new(0.42, 0.8, 0.28)));
    let place = Affine3A::from_translation(Vec3::new(0.0, 1.0, 0.0)) * Affine3A::from_scale(Vec3::splat(0.27));
    let head = shapes::sphere().placed(place);
    let colours = [[0.15, 0.3, 0.45], [0.85, 0.8, 0.6], [0.55, 0.2, 0.15]].map(Vec3::from);
    let skin = [[0.85, 0.65, 0.5], [0.6, 0.4, 0.3]].map(Vec3::from);
    Mesh {
        parts: vec![
            trunk.part(DENSITY, &pattern::marble(0.3, colours.to_vec(), 5), None),
            head.part(DENSITY, &pattern::clouds(0.2, skin.to_vec(), 9), None),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motions_begin_at_rest_or_repeat() {
        let p = [0.3, 0.1, 0.2];
        assert_eq!(Procedural::Still.moved(p, 1.7), p);
        let near = |a: [f32; 3], b: [f32; 3]| Vec3::from(a).distance(Vec3::from(b)) < 1e-5;
        assert!(near(Procedural::Turning.moved(p, 3.0), [0.2, 0.1, -0.3]));
        assert!(near(Procedural::Turning.moved(p, 12.0), p));
        assert!(near(Procedural::Breathing.moved(p, BREATH), p));
        assert!(!near(Procedural::Breathing.moved(p, 0.5 * BREATH), p));
        let cloth = |t| Procedural::Cloth.moved(p, t);
        assert!(near(cloth(0.3), cloth(0.3 + WAVE)) && !near(cloth(0.3), cloth(0.8)));
        assert!(near(Procedural::Cloth.moved([0.4, 1.0, 0.0], 0.6), [0.4, 1.0, 0.0]));
    }
}
