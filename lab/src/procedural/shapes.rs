//! Surfaces to build objects from, about the size of the unit sphere unless they take their size, y up.

use std::f32::consts::{PI, TAU};
use std::sync::Arc;

use glam::{Affine3A, Quat, Vec2, Vec3};

use super::patch::Patch;

/// A closed or open line in space over `[0, 1]`.
pub type Curve = Arc<dyn Fn(f32) -> Vec3 + Send + Sync>;

/// A direction from azimuth `u` and polar angle `v`, both in turns of the unit square.
fn polar(u: f32, v: f32) -> Vec3 {
    let (sin_u, cos_u) = (TAU * u).sin_cos();
    let (sin_v, cos_v) = pole_sin_cos(v);
    Vec3::new(sin_v * sin_u, cos_v, sin_v * cos_u)
}

/// Sine and cosine of half a turn times `v`, exactly 0 and ±1 at the poles so that the surface closes.
fn pole_sin_cos(v: f32) -> (f32, f32) {
    if v <= 0.0 {
        (0.0, 1.0)
    } else if v >= 1.0 {
        (0.0, -1.0)
    } else {
        (PI * v).sin_cos()
    }
}

/// The unit sphere.
pub fn sphere() -> Patch {
    Patch::new([96, 48], polar)
}

/// A superquadric: `ns` and `ew` are the exponents along meridians and parallels, 1 for a sphere, near 0 for a box, 2
/// for an octahedron.
pub fn superquadric(ns: f32, ew: f32) -> Patch {
    let power = |x: f32, e: f32| x.signum() * x.abs().powf(e);
    Patch::new([128, 96], move |u, v| {
        let (sin_u, cos_u) = (TAU * u).sin_cos();
        let (sin_v, cos_v) = pole_sin_cos(v);
        let ring = power(sin_v, ns);
        Vec3::new(ring * power(sin_u, ew), power(cos_v, ns), ring * power(cos_u, ew))
    })
}

/// A torus around the y axis, with the tube's centre line at radius `large`.
pub fn torus(large: f32, small: f32) -> Patch {
    let circle: Curve = Arc::new(move |t| {
        let (sin, cos) = (TAU * t).sin_cos();
        large * Vec3::new(sin, 0.0, cos)
    });
    tube(circle, [24, 128], move |_| small)
}

/// The centre line of a torus knot that winds `p` times around the axis and `q` times through the hole, within the unit
/// sphere.
pub fn torus_knot(p: u32, q: u32) -> Curve {
    Arc::new(move |t| {
        let (sin_p, cos_p) = (TAU * p as f32 * t).sin_cos();
        let (sin_q, cos_q) = (TAU * q as f32 * t).sin_cos();
        let ring = 0.66 + 0.34 * cos_q;
        Vec3::new(ring * sin_p, 0.34 * sin_q, ring * cos_p)
    })
}

/// A helix around the y axis: `turns` windings of radius 1 from y = −1 to 1.
pub fn helix(turns: f32) -> Curve {
    Arc::new(move |t| {
        let (sin, cos) = (TAU * turns * t).sin_cos();
        Vec3::new(sin, 2.0 * t - 1.0, cos)
    })
}

/// A smooth line through points (Catmull–Rom), at equal steps of the parameter. Two points or more.
pub fn through(points: &[Vec3]) -> Curve {
    let points = points.to_vec();
    Arc::new(move |t| {
        let last = points.len() - 1;
        let x = t.clamp(0.0, 1.0) * last as f32;
        let i = (x as usize).min(last - 1);
        let f = x - i as f32;
        let at = |k: isize| points[(i as isize + k).clamp(0, last as isize) as usize];
        let (a, b, c, d) = (at(-1), at(0), at(1), at(2));
        let bend = (2.0 * a - 5.0 * b + 4.0 * c - d) + (3.0 * (b - c) + d - a) * f;
        b + 0.5 * f * ((c - a) + f * bend)
    })
}

/// A tube along a curve, without caps; u runs around it and v along it. If the curve closes, so does the tube.
pub fn tube(curve: Curve, steps: [u32; 2], radius: impl Fn(f32) -> f32 + Send + Sync + 'static) -> Patch {
    let frames = Frames::along(&curve, steps[1] as usize);
    Patch::new(steps, move |u, v| {
        let (centre, side, up) = frames.at(v);
        let (sin, cos) = (TAU * u).sin_cos();
        centre + radius(v) * (side * sin + up * cos)
    })
}

/// Frames along a curve that turn as little as they can, and meet if the curve closes.
struct Frames {
    centres: Vec<Vec3>,
    sides: Vec<Vec3>,
    ups: Vec<Vec3>,
}

impl Frames {
    fn along(curve: &Curve, steps: usize) -> Self {
        let centres: Vec<Vec3> = (0..=steps).map(|i| curve(i as f32 / steps as f32)).collect();
        let closed = centres[0].distance(centres[steps]) < 1e-4;
        let tangent = |i: usize| {
            let before = if i > 0 {
                i - 1
            } else if closed {
                steps - 1
            } else {
                0
            };
            let after = if i < steps {
                i + 1
            } else if closed {
                1
            } else {
                steps
            };
            (centres[after] - centres[before]).normalize_or(Vec3::Y)
        };
        let mut up = tangent(0).any_orthonormal_vector();
        let mut ups = vec![up];
        for i in 1..=steps {
            up = Quat::from_rotation_arc(tangent(i - 1), tangent(i)) * up;
            ups.push(up.reject_from(tangent(i)).normalize());
        }
        if closed {
            let (first, last, axis) = (ups[0], ups[steps], tangent(0));
            let twist = last.cross(first).dot(axis).atan2(last.dot(first));
            for (i, up) in ups.iter_mut().enumerate() {
                *up = Quat::from_axis_angle(tangent(i), twist * i as f32 / steps as f32) * *up;
            }
        }
        let sides = (0..=steps).map(|i| ups[i].cross(tangent(i))).collect();
        Frames { centres, sides, ups }
    }

    fn at(&self, v: f32) -> (Vec3, Vec3, Vec3) {
        let last = self.centres.len() - 1;
        let x = v.clamp(0.0, 1.0) * last as f32;
        let i = (x as usize).min(last - 1);
        let f = x - i as f32;
        let between = |a: &[Vec3]| a[i].lerp(a[i + 1], f);
        (
            between(&self.centres),
            between(&self.sides).normalize(),
            between(&self.ups).normalize(),
        )
    }
}

/// A surface of revolution: `profile` gives radius and height from the top down.
pub fn lathe(steps: [u32; 2], profile: impl Fn(f32) -> Vec2 + Send + Sync + 'static) -> Patch {
    Patch::new(steps, move |u, v| {
        let p = profile(v);
        let (sin, cos) = (TAU * u).sin_cos();
        Vec3::new(p.x * sin, p.y, p.x * cos)
    })
}

/// A profile for [`lathe`]: a smooth line through radii and heights, with radii not below 0.
pub fn smooth_profile(points: &[(f32, f32)]) -> impl Fn(f32) -> Vec2 + Send + Sync + 'static {
    let line: Vec<Vec3> = points.iter().map(|&(r, y)| Vec3::new(r, y, 0.0)).collect();
    let curve = through(&line);
    move |t| {
        let p = curve(t);
        Vec2::new(p.x.max(0.0), p.y)
    }
}

/// A profile for [`lathe`]: straight from point to point, at constant speed.
pub fn sharp_profile(points: &[(f32, f32)]) -> impl Fn(f32) -> Vec2 + Send + Sync + 'static {
    let points: Vec<Vec2> = points.iter().map(|&p| p.into()).collect();
    let mut reached = vec![0.0];
    for pair in points.windows(2) {
        reached.push(reached[reached.len() - 1] + pair[0].distance(pair[1]));
    }
    move |t| {
        let total = reached[reached.len() - 1];
        let x = t.clamp(0.0, 1.0) * total;
        let i = reached.partition_point(|&r| r < x).clamp(1, points.len() - 1);
        let f = (x - reached[i - 1]) / (reached[i] - reached[i - 1]).max(1e-9);
        points[i - 1].lerp(points[i], f)
    }
}

/// A rod with round ends from `a` to `b`.
pub fn rod(a: Vec3, b: Vec3, radius: f32) -> Patch {
    let length = a.distance(b);
    let turn = Quat::from_rotation_arc(Vec3::Y, (b - a).normalize_or(Vec3::Y));
    let place = Affine3A::from_rotation_translation(turn, a);
    let cap = 0.5 * PI * radius;
    lathe([16, 48], move |v| {
        let along = v * (length + 2.0 * cap);
        let straight = (along - cap).clamp(0.0, length);
        let (sin, cos) = pole_sin_cos((along - straight) / (2.0 * cap));
        Vec2::new(radius * sin, length - straight + radius * cos)
    })
    .placed(place)
}

/// A flat rectangle that faces +z, centred on the origin.
pub fn panel(width: f32, height: f32) -> Patch {
    Patch::new([4, 4], move |u, v| {
        Vec3::new((u - 0.5) * width, (0.5 - v) * height, 0.0)
    })
}

/// The six faces of a box, front, right, back, left, top, bottom; each upright seen from outside.
pub fn cuboid(size: Vec3) -> Vec<Patch> {
    let half = size / 2.0;
    let side = |turn: Quat, width: f32, height: f32, out: f32| {
        panel(width, height).placed(Affine3A::from_quat(turn) * Affine3A::from_translation(Vec3::new(0.0, 0.0, out)))
    };
    let around = |turns: f32| Quat::from_rotation_y(turns * PI / 2.0);
    vec![
        side(around(0.0), size.x, size.y, half.z),
        side(around(1.0), size.z, size.y, half.x),
        side(around(2.0), size.x, size.y, half.z),
        side(around(3.0), size.z, size.y, half.x),
        side(Quat::from_rotation_x(-PI / 2.0), size.x, size.z, half.y),
        side(Quat::from_rotation_x(PI / 2.0), size.x, size.z, half.y),
    ]
}

/// A flat round sheet that faces up, around the y axis; v runs outwards from `inner`.
pub fn disc(inner: f32, outer: f32) -> Patch {
    lathe([96, 12], move |v| Vec2::new(inner + (outer - inner) * v, 0.0))
}

/// A thin leaf, one sheet: it grows from the origin along +z, `length` long and `width` wide, and its tip bends down by
/// `droop` radians. v runs from tip to root.
pub fn leaf(length: f32, width: f32, droop: f32) -> Patch {
    Patch::new([12, 32], move |u, v| {
        let t = 1.0 - v;
        let across = (0.5 - u) * width * (PI * t.powf(0.8)).sin().max(0.0);
        let bend = droop * t;
        let (along, down) = if droop.abs() < 1e-3 {
            (t, 0.0)
        } else {
            (bend.sin() / droop, (1.0 - bend.cos()) / droop)
        };
        let fold = 0.35 * across.abs();
        Vec3::new(across, fold - length * down, length * along)
    })
}

/// The edges of an icosahedron as rods, with `radius` as their thickness, within the unit sphere.
pub fn cage(radius: f32) -> Vec<Patch> {
    let g = (1.0 + 5f32.sqrt()) / 2.0;
    let mut corners = Vec::new();
    for (a, b) in [(1.0, g), (-1.0, g), (1.0, -g), (-1.0, -g)] {
        for corner in [[0.0, a, b], [a, b, 0.0], [b, 0.0, a]] {
            corners.push(Vec3::from(corner).normalize());
        }
    }
    let edge = 2.0 / (1.0 + g * g).sqrt();
    let mut rods = Vec::new();
    for (i, &a) in corners.iter().enumerate() {
        for &b in &corners[..i] {
            if (a.distance(b) - edge).abs() < 1e-3 {
                rods.push(rod(a, b, radius));
            }
        }
    }
    rods
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Volume enclosed by the patches' triangles, positive if they face outwards.
    fn volume(patches: &[Patch]) -> f32 {
        let white: super::super::patch::Pattern = Arc::new(|_| Vec3::ONE);
        let parts = patches.iter().map(|p| p.part(1.0, &white, None));
        parts
            .flat_map(|part| {
                let at = move |i: u32| Vec3::from(part.positions[i as usize]);
                let cone = move |t: [u32; 3]| at(t[0]).dot(at(t[1]).cross(at(t[2]))) / 6.0;
                part.triangles.clone().into_iter().map(cone)
            })
            .sum()
    }

    fn assert_volume(patches: &[Patch], expected: f32) {
        let found = volume(patches);
        assert!((found / expected - 1.0).abs() < 0.02, "{found}, expected {expected}");
    }

    #[test]
    fn closed_shapes_enclose_the_volume_they_should() {
        assert_volume(&[sphere()], 4.0 / 3.0 * PI);
        assert_volume(&[superquadric(1.0, 1.0)], 4.0 / 3.0 * PI);
        assert_volume(&[superquadric(2.0, 2.0)], 4.0 / 3.0);
        assert_volume(&[torus(0.8, 0.2)], 2.0 * PI * PI * 0.8 * 0.04);
        assert_volume(&cuboid(Vec3::new(1.0, 2.0, 3.0)), 6.0);
        let cylinder = sharp_profile(&[(0.0, 1.0), (0.5, 1.0), (0.5, -1.0), (0.0, -1.0)]);
        assert_volume(&[lathe([64, 120], cylinder)], PI * 0.5);
        let (a, b) = (Vec3::ONE, Vec3::new(2.0, 0.0, -1.0));
        let capsule = PI * 0.01 * a.distance(b) + 4.0 / 3.0 * PI * 0.001;
        assert_volume(&[rod(a, b, 0.1)], capsule * 0.985);
    }

    #[test]
    fn a_knots_tube_closes_without_a_seam() {
        let knot = tube(torus_knot(2, 3), [12, 256], |_| 0.1);
        for i in 0..12 {
            let u = i as f32 / 12.0;
            assert!(knot.point(u, 0.0).distance(knot.point(u, 1.0)) < 1e-3);
        }
        assert!(volume(&[knot]) > 0.0);
    }

    #[test]
    fn a_leaf_is_a_sheet_that_faces_up_at_its_root_and_droops() {
        let leaf = leaf(1.0, 0.3, 1.2);
        assert!(leaf.normal(0.5, 0.95).y > 0.6);
        assert!(leaf.point(0.5, 0.0).y < -0.4);
        assert!(leaf.point(0.5, 1.0).length() < 1e-5);
    }

    #[test]
    fn smooth_lines_pass_their_points() {
        let points = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Z];
        let line = through(&points);
        for (i, p) in points.iter().enumerate() {
            assert!(line(i as f32 / 3.0).distance(*p) < 1e-5);
        }
    }

    #[test]
    fn a_cage_has_the_thirty_edges_of_an_icosahedron() {
        assert_eq!(cage(0.01).len(), 30);
    }
}
