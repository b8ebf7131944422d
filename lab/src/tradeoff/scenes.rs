//! Scenes that fast renderers break on, and scenes that call for effects.

use glam::DAffine3;

use b2p::Result;
use b2p::gaussians::{Gaussians, Harmonics};
use b2p::renderer::camera::Camera;

/// Gaussians, and where they are seen from.
pub struct Scene {
    /// What is hard about it.
    pub name: &'static str,
    /// What is drawn.
    pub gaussians: Gaussians,
    /// The camera.
    pub camera: Camera,
}

/// Numbers in `[0, 1)` that need no quality, only variety: the upper bits of a linear congruential generator (Knuth,
/// MMIX).
pub struct Random(pub u64);

impl Random {
    /// The next.
    pub fn unit(&mut self) -> f32 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u32 << 24) as f32
    }

    fn within(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }
}

/// One Gaussian; scenes override what they are about.
#[derive(Clone, Copy)]
struct Splat {
    position: [f32; 3],
    scale: [f32; 3],
    rotation: [f32; 4],
    opacity: f32,
    colour: [f32; 3],
}

const RED: Splat = Splat {
    position: [0.0, 0.0, 2.0],
    scale: [0.1; 3],
    rotation: [1.0, 0.0, 0.0, 0.0],
    opacity: 1.0,
    colour: [1.0, 0.1, 0.0],
};

fn gather(splats: impl IntoIterator<Item = Splat>) -> Gaussians {
    let mut all = Gaussians::default();
    for splat in splats {
        all.position.push(splat.position);
        all.scale.push(splat.scale);
        all.rotation.push(splat.rotation);
        all.opacity.push(splat.opacity);
        all.colour.push(splat.colour);
    }
    all
}

/// Splats of all shapes anywhere in the cube.
fn scattered(seed: u64, count: usize) -> impl Iterator<Item = Splat> {
    let mut random = Random(seed);
    (0..count).map(move |_| Splat {
        position: std::array::from_fn(|_| random.within(-1.0, 1.0)),
        scale: std::array::from_fn(|_| 10f32.powf(random.within(-3.0, -0.7))),
        rotation: std::array::from_fn(|_| random.within(-1.0, 1.0)),
        opacity: random.unit(),
        colour: std::array::from_fn(|_| random.unit()),
    })
}

/// Opaque discs on a sphere of radius 0.8, facing outwards, as a decoder makes them.
fn surface(count: usize, width: f32) -> impl Iterator<Item = Splat> {
    let golden = std::f32::consts::PI * (3.0 - 5f32.sqrt());
    (0..count).map(move |i| {
        let y = 1.0 - 2.0 * (i as f32 + 0.5) / count as f32;
        let (sin, cos) = (golden * i as f32).sin_cos();
        let ring = (1.0 - y * y).sqrt();
        let normal = [cos * ring, y, sin * ring];
        Splat {
            position: normal.map(|x| 0.8 * x),
            scale: [width, width, 0.4 * width],
            // From the z axis to the normal.
            rotation: [1.0 + normal[2], -normal[1], normal[0], 0.0],
            colour: normal.map(|x| 0.5 + 0.5 * x),
            ..RED
        }
    })
}

/// A camera in the origin that looks along z.
fn straight(focal: f64, width: u32, height: u32) -> Camera {
    Camera::centred(DAffine3::IDENTITY, focal, width, height)
}

fn orbit(radius: f64, side: u32) -> Result<Camera> {
    Camera::orbit(30.0, 10.0, radius, 45.0, side, side)
}

/// What has broken renderers, each small enough to be drawn in double precision in a moment.
///
/// # Errors
/// [`Error::Usage`](crate::Error::Usage) if one of the cameras were none, as they all are.
pub fn hard_scenes() -> Result<Vec<Scene>> {
    let scene = |name, gaussians, camera| Scene {
        name,
        gaussians,
        camera,
    };
    let needles = (0..24).map(|i| {
        let angle = i as f32 * 0.131;
        let (sin, cos) = (angle / 2.0).sin_cos();
        // 3000 × 0.1 px at a distance of 2 and a focal length of 1000 px.
        Splat {
            position: [0.0, 0.0, 2.0 + 0.01 * i as f32],
            scale: [6.0, 2e-4, 2e-4],
            rotation: [cos, 0.0, 0.0, sin],
            opacity: 0.6,
            colour: [angle.sin().abs(), 0.4, angle.cos().abs()],
        }
    });
    // Plates that a camera sees almost from their edges.
    let grazing = (0..40).map(|i| {
        let tilt = std::f32::consts::FRAC_PI_4 - 2e-4 * i as f32;
        Splat {
            position: [0.0, -0.5 + 0.025 * i as f32, 2.0],
            scale: [0.5, 0.5, 1e-4],
            rotation: [tilt.cos(), tilt.sin(), 0.0, 0.0],
            opacity: 0.8,
            colour: [0.2, 0.025 * i as f32, 0.9],
        }
    });
    let layers = (0..1000).map(|i| Splat {
        position: [0.0, 0.0, 1.0 + i as f32 * 1e-4],
        scale: [50.0, 50.0, 0.0],
        opacity: 1.0 / 300.0,
        ..RED
    });
    let outlier = Splat {
        position: [-3e5, 0.0, -1e6],
        ..RED
    };
    // Single voxels of a 10-bit cloud.
    let voxels = (0..9).map(|i| Splat {
        position: [(i % 3) as f32 * 0.5 - 0.5, (i / 3) as f32 * 0.5 - 0.5, 0.0],
        scale: [1e-3; 3],
        ..RED
    });
    let vast = scattered(5, 60).map(|splat| Splat {
        scale: splat.scale.map(|s| s * 1e6),
        ..splat
    });
    Ok(vec![
        scene("needles of 3000 × 0.1 px", gather(needles), straight(1000.0, 150, 130)),
        scene(
            "plates seen from their edges",
            gather(grazing),
            straight(120.0, 120, 120),
        ),
        scene("1000 layers of 1/300", gather(layers), straight(50.0, 40, 40)),
        scene(
            "20,000 splats far below a pixel",
            gather(surface(20_000, 0.008)),
            orbit(40.0, 48)?,
        ),
        scene(
            "the silhouette of many overlapping splats",
            gather(surface(6000, 0.02)),
            orbit(3.0, 120)?,
        ),
        scene(
            "an outlier a million times as far",
            gather(scattered(4, 200).chain([outlier])),
            orbit(3.0, 90)?,
        ),
        scene(
            "single voxels",
            gather(voxels),
            Camera::orbit(0.0, 0.0, 3.0, 45.0, 90, 90)?,
        ),
        scene("splats as wide as the world", gather(vast), orbit(3.0, 60)?),
        scene(
            "from among the splats",
            gather(scattered(8, 150)),
            Camera::orbit(70.0, -20.0, 0.3, 100.0, 75, 50)?,
        ),
    ])
}

/// A surface of many small splats, and its camera at a distance where each is about `pixels` wide in a picture of
/// `side` pixels.
///
/// # Errors
/// As [`Camera::check`].
pub fn dense_surface(count: usize, pixels: f64, side: u32) -> Result<(Gaussians, Camera)> {
    let width = 0.8 * (4.0 * std::f64::consts::PI / count as f64).sqrt() / 2.0;
    let camera = orbit(3.0, side)?;
    let radius = (width * camera.fx / pixels).max(1.0);
    Ok((gather(surface(count, width as f32)), orbit(radius, side)?))
}

/// The same with view-dependent colour of degree 3.
pub fn iridescent(mut gaussians: Gaussians) -> Gaussians {
    let mut random = Random(6);
    let coefficients = (0..15 * gaussians.len()).map(|_| [0; 3].map(|_| random.within(-0.1, 0.1)));
    gaussians.harmonics = Harmonics {
        count: 15,
        coefficients: coefficients.collect(),
    };
    gaussians
}

/// Splats that stand in each other, in other orders at every pixel than their centres are.
pub fn interleaved(count: usize) -> Gaussians {
    let mut random = Random(9);
    gather((0..count).map(|_| Splat {
        position: std::array::from_fn(|_| random.within(-0.8, 0.8)),
        scale: [0.15, 0.15, 0.002],
        rotation: std::array::from_fn(|_| random.within(-1.0, 1.0)),
        opacity: 0.7,
        colour: std::array::from_fn(|_| random.unit()),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_scene_can_be_drawn_and_none_is_empty() {
        let mut names = Vec::new();
        for scene in hard_scenes().unwrap() {
            scene.gaussians.check_lengths().unwrap();
            scene.camera.check().unwrap();
            assert!(!scene.gaussians.is_empty() && !names.contains(&scene.name));
            names.push(scene.name);
        }
    }

    #[test]
    fn a_dense_surface_has_splats_as_wide_as_asked_for() {
        for pixels in [0.2, 1.0, 3.0] {
            let (gaussians, camera) = dense_surface(10_000, pixels, 256).unwrap();
            let seen = f64::from(gaussians.scale[0][0]) * camera.fx / camera.pose.translation.z;
            assert!((seen / pixels - 1.0).abs() < 0.1, "{seen} {pixels}");
        }
    }
}
