//! The still life of the demo: a vase of flowers among small things on a round stone, not quite two units high.
//!
//! Voxelised at 10 bits a voxel is about 1/500 of a unit. There is fine print, thin stems and bars, single sheets
//! (leaves, petals), white on white, saturated and dark colours, and soft noise, so that a picture of it shows what a
//! codec does to each. Surfaces that nothing outside could see are left out where that is simple.

use std::f32::consts::{PI, TAU};
use std::sync::Arc;

use glam::{Affine3A, Quat, Vec2, Vec3};

use super::light::Light;
use super::patch::{Patch, Pattern};
use super::pattern::{self, hsv};
use super::rng::{Rng, fractal};
use super::scene_paint as paint;
use super::shapes;
use crate::mesh::Mesh;

/// Texels per unit: two a voxel.
const DENSITY: f32 = 1000.0;
/// Radius of the stone that all stands on, and the height of its top.
const RADIUS: f32 = 0.45;
const FLOOR: f32 = -0.86;
/// Height of the vase's mouth.
const MOUTH: f32 = FLOOR + 0.50;

/// What throws a shadow into its neighbours' sky: a ball for each thing of some size.
#[derive(Clone, Copy)]
enum Thing {
    Vase,
    Plaque,
    Knot,
    Cube,
    Stone,
    Cage,
    Books,
    Mug,
    Tower,
}

impl Thing {
    const ALL: [Thing; 9] = [
        Thing::Vase,
        Thing::Plaque,
        Thing::Knot,
        Thing::Cube,
        Thing::Stone,
        Thing::Cage,
        Thing::Books,
        Thing::Mug,
        Thing::Tower,
    ];

    fn ball(self) -> (Vec3, f32) {
        match self {
            Thing::Vase => (Vec3::new(0.0, FLOOR + 0.22, 0.0), 0.15),
            Thing::Plaque => (at(-20.0, 0.31, 0.11), 0.12),
            Thing::Knot => (at(42.0, 0.31, 0.11), 0.09),
            Thing::Cube => (at(80.0, 0.335, 0.05), 0.065),
            Thing::Stone => (at(117.0, 0.30, 0.07), 0.10),
            Thing::Cage => (at(160.0, 0.31, 0.08), 0.06),
            Thing::Books => (at(204.0, 0.30, 0.05), 0.10),
            Thing::Mug => (at(251.0, 0.31, 0.06), 0.075),
            Thing::Tower => (at(294.0, 0.32, 0.11), 0.075),
        }
    }
}

/// A place on the stone: degrees around it from the front, distance from its middle, height above it.
fn at(azimuth: f32, distance: f32, height: f32) -> Vec3 {
    let (sin, cos) = azimuth.to_radians().sin_cos();
    Vec3::new(distance * sin, FLOOR + height, distance * cos)
}

/// Turns what faces the front to face outwards at an azimuth.
fn facing(azimuth: f32) -> Quat {
    Quat::from_rotation_y(azimuth.to_radians())
}

struct Still {
    mesh: Mesh,
    density: f32,
}

impl Still {
    /// Adds patches in the light, and in the shadow of all things but their own.
    fn put(&mut self, own: Option<Thing>, patches: &[Patch], paint: &Pattern) {
        let other = |t: &Thing| own.is_none_or(|own| own as usize != *t as usize);
        let light = Light {
            occluders: Thing::ALL.into_iter().filter(other).map(Thing::ball).collect(),
            ..Light::studio()
        };
        let parts = patches.iter().map(|p| p.part(self.density, paint, Some(&light)));
        self.mesh.parts.extend(parts);
    }
}

/// The still life.
pub fn scene() -> Mesh {
    scene_at(DENSITY)
}

/// The still life with another number of texels per unit.
fn scene_at(density: f32) -> Mesh {
    let mut still = Still {
        mesh: Mesh::default(),
        density,
    };
    stone_table(&mut still);
    vase(&mut still);
    flowers(&mut still);
    plaque(&mut still);
    knot_and_cube(&mut still);
    stone_and_ring(&mut still);
    cage(&mut still);
    books(&mut still);
    mug(&mut still);
    tower(&mut still);
    marbles(&mut still);
    still.mesh
}

fn stone_table(still: &mut Still) {
    let raise = Affine3A::from_translation(Vec3::Y * FLOOR);
    let top = shapes::disc(0.08, RADIUS).placed(raise);
    still.put(None, &[top], &paint::floor(RADIUS));
    let side = shapes::lathe([160, 8], |v| {
        Vec2::new(RADIUS + 0.02 * (PI * v).sin(), FLOOR - 0.055 * v)
    });
    let text = "bits to photon * a still life for point clouds * \
                every letter here is five dots wide and seven high * ";
    still.put(None, &[side], &paint::rim(text));
}

fn vase(still: &mut Still) {
    let body = shapes::smooth_profile(&[
        (0.073, MOUTH - 0.010),
        (0.085, MOUTH),
        (0.071, MOUTH - 0.017),
        (0.055, MOUTH - 0.066),
        (0.068, MOUTH - 0.133),
        (0.124, MOUTH - 0.207),
        (0.151, MOUTH - 0.290),
        (0.133, MOUTH - 0.382),
        (0.090, MOUTH - 0.465),
        (0.093, FLOOR),
    ]);
    still.put(Some(Thing::Vase), &[shapes::lathe([128, 160], body)], &paint::vase());
    let raise = Affine3A::from_translation(Vec3::Y * (MOUTH - 0.010));
    let soil = shapes::disc(0.0, 0.073).placed(raise);
    let earth = pattern::speckle(0.006, Vec3::splat(0.5), Vec3::new(0.20, 0.13, 0.09), 2);
    still.put(None, &[soil], &earth);
}

fn flowers(still: &mut Still) {
    let mut rng = Rng::new(20);
    let stalk = pattern::gradient(Vec3::Y, vec![Vec3::new(0.20, 0.38, 0.14), Vec3::new(0.42, 0.62, 0.24)]);
    let hues = [0.96, 0.78, 0.04, 0.88, 0.60, 0.99, 0.08];
    for (i, &hue) in hues.iter().enumerate() {
        let azimuth = 51.4 * i as f32 + 15.0;
        let out = Vec3::new(azimuth.to_radians().sin(), 0.0, azimuth.to_radians().cos());
        let (reach, height) = match i {
            0 => (0.05, 1.02),
            _ => (rng.range(0.18, 0.32), rng.range(0.48, 0.86)),
        };
        let root = Vec3::Y * (MOUTH - 0.02) + 0.035 * out;
        let head = root + reach * out + height * Vec3::Y;
        let bend = root + 0.35 * reach * out + 0.55 * height * Vec3::Y;
        let line = shapes::through(&[root, bend, head]);
        let stem = shapes::tube(line.clone(), [12, 80], |_| 0.0065);
        still.put(None, &[stem], &stalk);
        for (k, along) in [0.28, 0.46, 0.66].into_iter().enumerate() {
            let turn = Quat::from_rotation_y(azimuth.to_radians() + 2.2 * k as f32 + rng.range(-0.4, 0.4))
                * Quat::from_rotation_x(-rng.range(0.5, 0.9));
            let size = rng.range(0.15, 0.23);
            let leaf =
                shapes::leaf(size, 0.34 * size, 1.3).placed(Affine3A::from_rotation_translation(turn, line(along)));
            still.put(None, &[leaf], &paint::leaf());
        }
        let up = (head - bend).normalize() + 0.8 * out;
        blossom(still, head, up.normalize(), hue, 9 + 2 * (i as u32 % 3));
    }
}

/// Petals around a yellow button, which looks along `up`.
fn blossom(still: &mut Still, head: Vec3, up: Vec3, hue: f32, petals: u32) {
    let tilt = Affine3A::from_rotation_translation(Quat::from_rotation_arc(Vec3::Y, up), head);
    let sheets: Vec<Patch> = (0..petals)
        .map(|k| {
            let turn = Quat::from_rotation_y(TAU * k as f32 / petals as f32) * Quat::from_rotation_x(-0.35);
            shapes::leaf(0.118, 0.052, 0.7).placed(tilt * Affine3A::from_quat(turn))
        })
        .collect();
    still.put(None, &sheets, &paint::petal(hue));
    let flat = Affine3A::from_scale(Vec3::new(0.032, 0.019, 0.032));
    let button = shapes::sphere().placed(tilt * flat);
    still.put(
        None,
        &[button],
        &pattern::speckle(0.004, hsv(0.08, 0.9, 0.6), hsv(0.13, 0.85, 0.95), 6),
    );
}

fn plaque(still: &mut Still) {
    let own = Some(Thing::Plaque);
    let size = Vec3::new(0.36, 0.28, 0.020);
    let lean = facing(-20.0) * Quat::from_rotation_x(-0.2);
    let place = Affine3A::from_rotation_translation(lean, at(-20.0, 0.315, 0.141));
    let faces: Vec<Patch> = shapes::cuboid(size).iter().map(|f| f.placed(place)).collect();
    still.put(own, &faces[..1], &paint::plaque(size.truncate()));
    let wood = pattern::wood(0.02, Vec3::new(0.70, 0.47, 0.27), Vec3::new(0.42, 0.24, 0.12), 4);
    still.put(own, &faces[1..5], &wood);
}

fn knot_and_cube(still: &mut Still) {
    let stand = facing(42.0) * Quat::from_rotation_x(PI / 2.0);
    let place = Affine3A::from_scale_rotation_translation(Vec3::splat(0.11), stand, at(42.0, 0.32, 0.133));
    let knot = shapes::tube(shapes::torus_knot(2, 3), [24, 400], |_| 0.22).placed(place);
    let bands = vec![
        hsv(0.0, 0.9, 0.85),
        Vec3::splat(0.97),
        hsv(0.60, 0.9, 0.55),
        Vec3::splat(0.97),
    ];
    still.put(Some(Thing::Knot), &[knot], &pattern::stripes(0.015, 0.9, bands));

    let turned = Affine3A::from_rotation_translation(facing(62.0), at(80.0, 0.35, 0.048));
    let faces: Vec<Patch> = shapes::cuboid(Vec3::splat(0.095))
        .iter()
        .map(|f| f.placed(turned))
        .collect();
    let colours = (0..7).map(|i| hsv(i as f32 / 7.0, 1.0, 0.9)).collect();
    still.put(
        Some(Thing::Cube),
        &faces[..5],
        &pattern::mosaic(0.0136, colours, Vec3::splat(0.06), 9),
    );
}

fn stone_and_ring(still: &mut Still) {
    let base = at(117.0, 0.30, 0.070);
    let stone = shapes::sphere().warped(move |p| {
        let rough = 1.0 + 0.28 * fractal(p * 1.4, 6, 41);
        base + p * rough * Vec3::new(0.112, 0.083, 0.10)
    });
    still.put(Some(Thing::Stone), &[stone], &paint::granite(base.y + 0.045));

    let upright = facing(136.0) * Quat::from_rotation_x(PI / 2.0 - 0.25);
    let place = Affine3A::from_rotation_translation(upright, at(136.0, 0.395, 0.072));
    let ring = shapes::torus(0.065, 0.010).placed(place);
    let wheel: Pattern = Arc::new(|s| hsv(s.uv.y, 1.0, 1.0));
    still.put(None, &[ring], &wheel);
}

fn cage(still: &mut Still) {
    let radius = 0.122;
    let centre = at(160.0, 0.32, radius * 0.85 + 0.006);
    let place = Affine3A::from_scale_rotation_translation(Vec3::splat(radius), facing(20.0), centre);
    let bars: Vec<Patch> = shapes::cage(0.04).iter().map(|b| b.placed(place)).collect();
    let brass = pattern::clouds(0.05, vec![hsv(0.11, 0.75, 0.55), hsv(0.13, 0.55, 0.95)], 51);
    still.put(Some(Thing::Cage), &bars, &brass);

    let low = Vec3::new(centre.x, FLOOR + 0.056, centre.z);
    let place = Affine3A::from_scale_rotation_translation(Vec3::splat(0.046), facing(160.0), low);
    let ball = shapes::sphere().placed(place);
    still.put(
        Some(Thing::Cage),
        &[ball],
        &pattern::dots(0.022, Vec3::splat(0.96), hsv(0.99, 0.95, 0.80)),
    );
}

fn books(still: &mut Still) {
    let own = Some(Thing::Books);
    let stack = [
        (
            Vec3::new(0.25, 0.050, 0.18),
            208.0,
            hsv(0.98, 0.75, 0.45),
            "Gaussian Splats",
            0.0024,
        ),
        (
            Vec3::new(0.22, 0.036, 0.16),
            200.0,
            hsv(0.45, 0.70, 0.32),
            "Octrees, v. II",
            0.0022,
        ),
        (
            Vec3::new(0.18, 0.030, 0.13),
            219.0,
            hsv(0.60, 0.75, 0.38),
            "ENTROPY",
            0.0022,
        ),
    ];
    let mut base = 0.0;
    for (size, azimuth, cloth, title, dot) in stack {
        let place = Affine3A::from_rotation_translation(facing(azimuth), at(204.0, 0.30, base + size.y / 2.0));
        let faces: Vec<Patch> = shapes::cuboid(size).iter().map(|f| f.placed(place)).collect();
        still.put(
            own,
            &[faces[0].clone(), faces[4].clone()],
            &paint::cover(cloth, title, dot),
        );
        still.put(own, &faces[1..4], &paint::pages());
        base += size.y;
    }
}

fn mug(still: &mut Still) {
    let own = Some(Thing::Mug);
    let place = Affine3A::from_scale_rotation_translation(Vec3::splat(0.85), facing(251.0), at(251.0, 0.315, 0.0));
    let body = shapes::smooth_profile(&[
        (0.070, 0.145),
        (0.074, 0.172),
        (0.078, 0.176),
        (0.081, 0.170),
        (0.082, 0.110),
        (0.081, 0.050),
        (0.070, 0.010),
        (0.060, 0.0),
    ]);
    let body = shapes::lathe([128, 64], body).placed(place);
    still.put(own, &[body], &paint::porcelain());
    let line = [
        (0.078, 0.14),
        (0.115, 0.145),
        (0.130, 0.095),
        (0.110, 0.05),
        (0.077, 0.04),
    ];
    let line: Vec<Vec3> = line.iter().map(|&(x, y)| Vec3::new(x, y, 0.0)).collect();
    let handle = shapes::tube(shapes::through(&line), [16, 64], |_| 0.010).placed(place);
    still.put(own, &[handle], &pattern::plain(Vec3::new(0.985, 0.98, 0.97)));
    let coffee = shapes::disc(0.0, 0.070).placed(place * Affine3A::from_translation(Vec3::Y * 0.145));
    let brown = vec![Vec3::new(0.16, 0.08, 0.04), Vec3::new(0.36, 0.20, 0.10)];
    still.put(own, &[coffee], &pattern::clouds(0.04, brown, 61));
}

fn tower(still: &mut Still) {
    let own = Some(Thing::Tower);
    let place = Affine3A::from_rotation_translation(facing(294.0), at(294.0, 0.325, 0.0));
    let (radius, height) = (0.058, 0.22);
    let wall = shapes::lathe([96, 48], move |v| Vec2::new(radius + 0.006 * v * v, height * (1.0 - v)));
    still.put(own, &[wall.placed(place)], &paint::tower(TAU * (radius + 0.006)));
    let roof = shapes::sharp_profile(&[(0.0, 0.35), (0.076, height - 0.008), (0.058, height)]);
    let slate = vec![hsv(0.58, 0.25, 0.50), hsv(0.60, 0.45, 0.22)];
    still.put(
        own,
        &[shapes::lathe([96, 48], roof).placed(place)],
        &pattern::scales(0.018, slate),
    );
    let pole = shapes::rod(Vec3::Y * 0.345, Vec3::Y * 0.405, 0.0035).placed(place);
    still.put(own, &[pole], &pattern::plain(hsv(0.12, 0.6, 0.8)));
    let flag = Patch::new([24, 4], |u, v| {
        Vec3::new(0.070 * u, 0.402 - 0.036 * v, 0.008 * u * (TAU * 1.2 * u).sin())
    });
    let halves = vec![hsv(0.0, 0.9, 0.85), Vec3::splat(0.96), hsv(0.36, 0.8, 0.5)];
    still.put(own, &[flag.placed(place)], &pattern::stripes(0.0121, PI / 2.0, halves));
}

fn marbles(still: &mut Still) {
    let mut rng = Rng::new(33);
    for azimuth in [5.0, 13.0, 61.0, 98.0, 182.0, 230.0, 272.0, 319.0, 325.0] {
        let radius = rng.range(0.015, 0.025);
        let centre = at(azimuth, rng.range(0.375, 0.395), radius);
        let ball =
            shapes::sphere().placed(Affine3A::from_translation(centre) * Affine3A::from_scale(Vec3::splat(radius)));
        let hue = rng.unit();
        let swirl = vec![hsv(hue, 0.9, 0.8), Vec3::splat(0.95), hsv(hue + 0.4, 0.9, 0.5)];
        still.put(None, &[ball], &pattern::marble(0.05, swirl, rng.bits() as u32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scene_stands_upright_and_is_whole() {
        let mesh = scene_at(60.0);
        let all = mesh.parts.iter().flat_map(|p| &p.positions);
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &p in all {
            lo = lo.min(p.into());
            hi = hi.max(p.into());
        }
        let size = hi - lo;
        assert!(
            (1.5..1.8).contains(&size.y) && size.y > size.x && size.y > size.z,
            "{size}"
        );
        assert!(lo.y >= FLOOR - 0.056, "something hangs below the stone: {lo}");
        for part in &mesh.parts {
            let corners = part.positions.len() as u32;
            assert!(part.triangles.iter().flatten().all(|&i| i < corners));
            assert!(!part.triangles.is_empty());
        }
    }

    #[test]
    fn the_scene_is_the_same_every_time() {
        let look = |mesh: &Mesh| -> Vec<u8> {
            let textures = mesh.parts.iter().filter_map(|p| p.texture.as_ref());
            textures.flat_map(|t| t.rgba[t.rgba.len() / 2]).collect()
        };
        assert_eq!(look(&scene_at(60.0)), look(&scene_at(60.0)));
    }
}
