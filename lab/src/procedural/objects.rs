//! Objects by chance: every shape with every kind of paint, alone and in heaps.

use std::f32::consts::{PI, TAU};

use glam::{Affine3A, Quat, Vec2, Vec3};

use super::light::Light;
use super::patch::Patch;
use super::pattern;
use super::rng::{Rng, fractal};
use super::shapes;
use crate::mesh::Mesh;

/// Texels per unit of length on objects that fill the unit sphere: more than voxels of a 10-bit cloud.
const DENSITY: f32 = 700.0;

/// A shape by chance, about as large as the unit sphere.
type Shape = fn(&mut Rng) -> Vec<Patch>;

/// The shapes that [`objects`] makes one each of, by name.
const SHAPES: [(&str, Shape); 16] = [
    ("sphere", |_| vec![shapes::sphere()]),
    ("box", cuboid),
    ("torus", torus),
    ("knot", knot),
    ("lathe", lathe),
    ("fluted", fluted),
    ("superquadric", superquadric),
    ("stone", stone),
    ("spring", spring),
    ("cage", cage),
    ("rings", rings),
    ("rods", rods),
    ("leaves", leaves),
    ("panels", panels),
    ("cord", cord),
    ("steps", steps),
];

/// How many heaps of small objects [`objects`] makes.
const HEAPS: usize = 4;

/// One object of every shape, and heaps of many small ones, in sizes about that of the unit sphere. Shapes vary and
/// paint is drawn by chance; equal seeds give equal objects.
pub fn objects(seed: u64) -> Vec<(String, Mesh)> {
    let single = SHAPES.iter().map(|(name, _)| (*name).to_owned());
    let heaps = (1..=HEAPS).map(|i| format!("heap{i}"));
    single
        .chain(heaps)
        .filter_map(|name| object(&name, seed).map(|mesh| (name, mesh)))
        .collect()
}

/// The object of [`objects`] that has this name, if one does.
pub fn object(name: &str, seed: u64) -> Option<Mesh> {
    object_at(DENSITY, name, seed)
}

/// An object with another number of texels per unit of length.
fn object_at(density: f32, name: &str, seed: u64) -> Option<Mesh> {
    let heap = name
        .strip_prefix("heap")
        .and_then(|n| n.parse::<u64>().ok())
        .filter(|n| (1..=HEAPS as u64).contains(n));
    if let Some(number) = heap {
        return Some(self::heap(&mut Rng::new(seed ^ number << 40), density));
    }
    let index = SHAPES.iter().position(|(shape, _)| *shape == name)?;
    let mut rng = Rng::new(seed ^ (index as u64 + 100) << 40);
    let patches = SHAPES[index].1(&mut rng);
    let turn = Affine3A::from_quat(rotation(&mut rng));
    Some(Mesh {
        parts: painted(&mut rng, &patches, turn, 0.12, density),
    })
}

/// Patches placed and painted, with details up to `coarsest` in size; boxes and the like get several paints.
fn painted(rng: &mut Rng, patches: &[Patch], place: Affine3A, coarsest: f32, density: f32) -> Vec<crate::mesh::Part> {
    let light = rng.chance(0.6).then(|| Light {
        to_key: rng.direction(),
        ..Light::studio()
    });
    let paints = 1 + rng.below(3) as usize;
    let patterns: Vec<_> = (0..paints)
        .map(|_| {
            let size = 0.006 * (coarsest / 0.006).powf(rng.unit());
            pattern::any(rng, size)
        })
        .collect();
    patches
        .iter()
        .enumerate()
        .map(|(i, patch)| {
            let placed = patch.placed(place);
            placed.part(density, &patterns[i % paints], light.as_ref())
        })
        .collect()
}

fn rotation(rng: &mut Rng) -> Quat {
    Quat::from_rotation_arc(Vec3::Y, rng.direction()) * Quat::from_rotation_y(rng.range(0.0, TAU))
}

/// Small objects side by side, as many as find room, none inside another.
fn heap(rng: &mut Rng, density: f32) -> Mesh {
    let mut balls: Vec<(Vec3, f32)> = Vec::new();
    let mut mesh = Mesh::default();
    for _ in 0..120 {
        let radius = rng.range(0.12, 0.34);
        let reach = 1.0 - radius;
        let centre = Vec3::from(std::array::from_fn::<f32, 3, _>(|_| rng.range(-reach, reach)));
        if balls.iter().any(|(c, r)| c.distance(centre) < r + radius) {
            continue;
        }
        balls.push((centre, radius));
        let patches = SHAPES[rng.below(SHAPES.len() as u32) as usize].1(rng);
        let turn = rotation(rng);
        let place = Affine3A::from_scale_rotation_translation(Vec3::splat(radius), turn, centre);
        mesh.parts.extend(painted(rng, &patches, place, 0.06, density));
    }
    mesh
}

fn cuboid(rng: &mut Rng) -> Vec<Patch> {
    let size = Vec3::from(std::array::from_fn::<f32, 3, _>(|_| rng.range(0.3, 1.0)));
    shapes::cuboid(2.0 * size / size.length())
}

fn torus(rng: &mut Rng) -> Vec<Patch> {
    let small = rng.range(0.08, 0.35);
    vec![shapes::torus(1.0 - small, small)]
}

fn knot(rng: &mut Rng) -> Vec<Patch> {
    let (p, q) = [(2, 3), (3, 2), (2, 5), (3, 4)][rng.below(4) as usize];
    let radius = rng.range(0.05, 0.13);
    let line = shapes::torus_knot(p, q);
    vec![shapes::tube(line, [20, 320], move |_| radius)]
}

/// Radii by chance between a closed top and bottom.
fn profile(rng: &mut Rng) -> Vec<(f32, f32)> {
    let points = 5 + rng.below(4);
    let mut line = vec![(0.0, 0.85)];
    for i in 0..points {
        let y = 0.85 - 1.7 * i as f32 / (points - 1) as f32;
        line.push((rng.range(0.12, 0.5), y));
    }
    line.push((0.0, -0.85));
    line
}

fn lathe(rng: &mut Rng) -> Vec<Patch> {
    let line = profile(rng);
    vec![if rng.chance(0.5) {
        shapes::lathe([96, 160], shapes::smooth_profile(&line))
    } else {
        shapes::lathe([96, 160], shapes::sharp_profile(&line))
    }]
}

fn fluted(rng: &mut Rng) -> Vec<Patch> {
    let lobes = 3.0 + rng.below(9) as f32;
    let depth = rng.range(0.08, 0.3);
    let twist = rng.range(-3.0, 3.0);
    let line = profile(rng);
    let body = shapes::lathe([160, 160], shapes::smooth_profile(&line));
    vec![body.warped(move |p| {
        let angle = p.x.atan2(p.z) + twist * p.y;
        let swell = 1.0 + depth * (lobes * angle).cos();
        Vec3::new(p.x * swell, p.y, p.z * swell)
    })]
}

fn superquadric(rng: &mut Rng) -> Vec<Patch> {
    let size = 1.0 / 3f32.sqrt();
    let (ns, ew) = (rng.range(0.2, 1.8), rng.range(0.2, 1.8));
    vec![shapes::superquadric(ns, ew).warped(move |p| p * size * 1.3)]
}

fn stone(rng: &mut Rng) -> Vec<Patch> {
    let (rough, fine) = (rng.range(0.1, 0.45), rng.range(0.9, 2.5));
    let seed = rng.bits() as u32;
    vec![shapes::sphere().warped(move |p| 0.75 * p * (1.0 + rough * fractal(p * fine, 5, seed)))]
}

fn spring(rng: &mut Rng) -> Vec<Patch> {
    let radius = rng.range(0.03, 0.1);
    let (turns, width) = (rng.range(2.0, 6.0), rng.range(0.3, 0.6));
    let line = shapes::helix(turns);
    let narrow: shapes::Curve = std::sync::Arc::new(move |t| line(t) * Vec3::new(width, 0.75, width));
    vec![shapes::tube(narrow, [16, 360], move |_| radius)]
}

fn cage(rng: &mut Rng) -> Vec<Patch> {
    let mut parts = shapes::cage(rng.range(0.015, 0.06));
    if rng.chance(0.5) {
        parts.push(shapes::sphere().warped(|p| 0.5 * p));
    }
    parts
}

fn rings(rng: &mut Rng) -> Vec<Patch> {
    (0..3 + rng.below(4))
        .map(|i| {
            let large = 0.95 - 0.13 * i as f32;
            let ring = shapes::torus(large, rng.range(0.012, 0.04));
            ring.placed(Affine3A::from_quat(rotation(rng)))
        })
        .collect()
}

fn rods(rng: &mut Rng) -> Vec<Patch> {
    (0..8 + rng.below(10))
        .map(|_| {
            let (a, b) = (rng.direction(), rng.direction());
            shapes::rod(0.95 * a, 0.95 * b, rng.range(0.008, 0.035))
        })
        .collect()
}

fn leaves(rng: &mut Rng) -> Vec<Patch> {
    let mut parts = vec![shapes::rod(-0.95 * Vec3::Y, 0.6 * Vec3::Y, 0.025)];
    let count = 9 + rng.below(12);
    for i in 0..count {
        let height = -0.7 + 1.3 * i as f32 / count as f32;
        let (length, width) = (rng.range(0.4, 0.85), rng.range(0.12, 0.4));
        let leaf = shapes::leaf(length, width, rng.range(0.2, 1.6));
        let turn = Quat::from_rotation_y(2.4 * i as f32) * Quat::from_rotation_x(-rng.range(0.0, 1.0));
        parts.push(leaf.placed(Affine3A::from_rotation_translation(turn, height * Vec3::Y)));
    }
    parts
}

fn panels(rng: &mut Rng) -> Vec<Patch> {
    (0..2 + rng.below(4))
        .map(|_| {
            let (width, height) = (rng.range(0.4, 1.2), rng.range(0.4, 1.2));
            let curl = rng.range(-1.2, 1.2);
            let sheet = Patch::new([32, 8], move |u, v| {
                Vec3::new(
                    (u - 0.5) * width,
                    (0.5 - v) * height,
                    0.2 * (curl * PI * (u - 0.5)).cos(),
                )
            });
            let place = Affine3A::from_rotation_translation(rotation(rng), 0.3 * rng.direction());
            sheet.placed(place)
        })
        .collect()
}

fn cord(rng: &mut Rng) -> Vec<Patch> {
    let mut points: Vec<Vec3> = Vec::new();
    for _ in 0..9 {
        points.push(rng.direction() * rng.range(0.3, 0.9));
    }
    let radius = rng.range(0.02, 0.09);
    vec![shapes::tube(shapes::through(&points), [16, 320], move |t| {
        radius * (4.0 * t * (1.0 - t)).sqrt().max(0.02)
    })]
}

/// Discs of falling radius upon each other, in one profile, so that nothing is hidden inside.
fn steps(rng: &mut Rng) -> Vec<Patch> {
    let count = 4 + rng.below(6);
    let mut line = vec![(0.0, 0.8)];
    for i in 0..count {
        let radius = 0.12 + 0.5 * (i as f32 + rng.unit()) / count as f32;
        let level = |k: u32| 0.8 - 1.6 * k as f32 / count as f32;
        line.extend([(radius, level(i)), (radius, level(i + 1))]);
    }
    line.push((0.0, -0.8));
    let round = shapes::sharp_profile(&line);
    vec![shapes::lathe([96, 200], move |t| -> Vec2 { round(t) })]
}

#[cfg(test)]
mod tests {
    use super::*;

    const COARSE: f32 = 40.0;

    fn bounds(mesh: &Mesh) -> (Vec3, Vec3) {
        let all = mesh.parts.iter().flat_map(|p| &p.positions);
        all.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &p| {
            (lo.min(p.into()), hi.max(p.into()))
        })
    }

    #[test]
    fn every_object_is_textured_and_about_as_large_as_the_unit_sphere() {
        for (name, _) in SHAPES {
            let mesh = object_at(COARSE, name, 3).unwrap();
            let (lo, hi) = bounds(&mesh);
            assert!((hi - lo).max_element() > 0.8, "{name}: {lo} {hi}");
            assert!(hi.abs().max(lo.abs()).max_element() < 1.45, "{name}: {lo} {hi}");
            for part in &mesh.parts {
                let texture = part.texture.as_ref().unwrap();
                let texels = (texture.width * texture.height) as usize;
                assert_eq!(texture.rgba.len(), texels, "{name}");
                assert_eq!(part.uvs.len(), part.positions.len(), "{name}");
            }
        }
    }

    #[test]
    fn equal_seeds_give_equal_objects_and_others_do_not() {
        let positions = |seed| object_at(COARSE, "lathe", seed).unwrap().parts[0].positions.clone();
        assert_eq!(positions(1), positions(1));
        assert_ne!(positions(1), positions(2));
    }

    #[test]
    fn a_heap_holds_many_things_and_an_unknown_name_nothing() {
        assert!(object_at(COARSE, "heap1", 0).unwrap().parts.len() > 12);
        assert!(object("heap5", 0).is_none());
        assert!(object("teapot", 0).is_none());
    }
}
