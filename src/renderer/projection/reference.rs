//! One Gaussian seen by one camera, step by step: what the kernel is held to.

use glam::{DAffine3, Mat3, Quat, Vec3};

use super::{Bounds, Camera, Ellipse, Ellipses, How, MAX_SCALE};
use crate::gaussians::Gaussians;
use b2p_kernels::Isa;

/// `√(log₂(e)/2)`: with it `exp(−½d²) = 2^−(d·FORM_SCALE)²`.
const FORM_SCALE: f32 = 0.849_321_8;
/// The least α that is drawn, and its binary logarithm.
const FLOOR: f32 = 1.0 / 1024.0;
const LOG_FLOOR: f32 = -10.0;

/// Why a Gaussian is not drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Invisible {
    NotFinite,
    NoRotation,
    TooFaint,
    Behind,
    Outside,
}

/// A camera, prepared.
struct View {
    pose: DAffine3,
    near: f64,
    focal: [f64; 2],
    centre: [f64; 2],
    slopes: [[f64; 2]; 2],
    /// Rows of the world-to-camera rotation.
    rows: [Vec3; 3],
    size: [u32; 2],
}

impl View {
    fn new(camera: &Camera) -> Self {
        let rotation = camera.pose.matrix3;
        View {
            pose: camera.pose,
            near: camera.near,
            focal: [camera.fx, camera.fy],
            centre: [camera.cx, camera.cy],
            slopes: camera.slope_ranges(),
            rows: std::array::from_fn(|i| rotation.row(i).as_vec3()),
            size: [camera.width, camera.height],
        }
    }

    /// Depth, pixels and shape of Gaussian `i`, or why it is not drawn.
    fn see(&self, gaussians: &Gaussians, i: usize) -> Result<Ellipse, Invisible> {
        let position = Vec3::from(gaussians.position[i]);
        let scale = Vec3::from(gaussians.scale[i]);
        let rotation = gaussians.rotation[i];
        let opacity = gaussians.opacity[i];
        let colour = gaussians.colour[i];
        let finite = position.is_finite()
            && scale.is_finite()
            && rotation.iter().all(|x| x.is_finite())
            && opacity.is_finite()
            && Vec3::from(colour).is_finite();
        require(finite, Invisible::NotFinite)?;
        let axes = rotation_matrix(rotation).ok_or(Invisible::NoRotation)?;
        require(opacity >= FLOOR, Invisible::TooFaint)?;
        let seen = self.pose.transform_point3(position.as_dvec3());
        require(seen.z > self.near, Invisible::Behind)?;
        let depth = seen.z as f32;

        let inverse = 1.0 / seen.z;
        let scale = scale.abs().min(Vec3::splat(MAX_SCALE));
        let along = |k: usize, offset: f64| {
            let slope = offset * inverse;
            let centre = (self.focal[k] * slope + self.centre[k]) as f32;
            let [low, high] = self.slopes[k];
            let row = self.rows[k] - self.rows[2] * slope.clamp(low, high) as f32;
            let row = axes.transpose_mul_vec3(row * (self.focal[k] * inverse) as f32);
            (centre, row * scale)
        };
        let (x, m1) = along(0, seen.x);
        let (y, m2) = along(1, seen.y);
        let own = f64::from(gaussians.blur) * self.focal[0] * self.focal[1] * inverse * inverse;
        let blur = gaussians.pixel_blur().max(own as f32);
        let (a, c) = (m1.length_squared() + blur, m2.length_squared() + blur);
        let finite = Vec3::new(depth, x, y).is_finite() && a.is_finite() && c.is_finite();
        require(finite, Invisible::NotFinite)?;

        let log_opacity = opacity.min(1.0).log2();
        // α is at the floor at d² = 2·ln(opacity/floor) standard deviations squared.
        let reach = 2.0 * std::f32::consts::LN_2 * (log_opacity - LOG_FLOOR).max(0.0);
        let (x0, x1) = covered(x, (a * reach).sqrt(), self.size[0]);
        let (y0, y1) = covered(y, (c * reach).sqrt(), self.size[1]);
        require(x0 < x1 && y0 < y1, Invisible::Outside)?;

        let (u, v) = if a >= c {
            let (along, across, slope) = factors(m1, m2, a, blur);
            ([-slope * across, across], [along, 0.0])
        } else {
            let (along, across, slope) = factors(m2, m1, c, blur);
            ([across, -slope * across], [0.0, along])
        };
        let bounds = Bounds { x0, y0, x1, y1 };
        let shape = Ellipse {
            centre: [x, y],
            u,
            v,
            log_opacity,
            colour,
            bounds,
            depth,
            index: i as u32,
        };
        Ok(shape)
    }
}

/// The pixels `first..end` of `size` whose centres lie within `half` of `centre`. Empty if `first ≥ end`.
fn covered(centre: f32, half: f32, size: u32) -> (u32, u32) {
    let within = |x: f32| x.clamp(0.0, size as f32);
    let low = within(centre - half - 0.5);
    // Rounded up by hand: without SSE 4.1 `ceil` is a call.
    let first = low as u32 + u32::from((low as u32 as f32) < low);
    (first, within(centre + half + 0.5) as u32)
}

/// Phrased for what holds, so that NaN is refused.
fn require(holds: bool, otherwise: Invisible) -> Result<(), Invisible> {
    if holds { Ok(()) } else { Err(otherwise) }
}

/// `1/√p` and `1/√(det/p)`, both times [`FORM_SCALE`], and `b/p`; `p` is the variance (blur included) of the row
/// `long`.
fn factors(long: Vec3, short: Vec3, p: f32, blur: f32) -> (f32, f32, f32) {
    let inverse = 1.0 / p;
    let root = inverse.sqrt();
    // Divided by √p before it is squared, the cross product stays far from overflow.
    let minors = (long * root).cross(short).length_squared();
    let blurred = blur * ((long.length_squared() + short.length_squared() + blur) * inverse);
    let across = FORM_SCALE / (minors + blurred).sqrt();
    (FORM_SCALE * root, across, long.dot(short) * inverse)
}

/// The rotation of a quaternion `w, x, y, z` of any length but zero.
fn rotation_matrix(wxyz: [f32; 4]) -> Option<Mat3> {
    // The square of any f32 but zero is a normal f64.
    let square = |x: f32| f64::from(x) * f64::from(x);
    let [w, x, y, z] = wxyz;
    let squared = square(w) + square(x) + square(y) + square(z);
    if squared == 0.0 {
        return None;
    }
    let inverse = 1.0 / squared.sqrt();
    let unit = |x: f32| (f64::from(x) * inverse) as f32;
    Some(Mat3::from_quat(Quat::from_xyzw(unit(x), unit(y), unit(z), unit(w))))
}

/// Gaussians of every kind that a kernel tells apart, in a number that no vector divides.
fn gaussians() -> Gaussians {
    let mut state = 7u64;
    let mut random = move |low: f32, high: f32| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * ((state >> 40) as f32 / (1u32 << 24) as f32)
    };
    let mut all = Gaussians::default();
    for i in 0..20_011 {
        let mut position: [f32; 3] = std::array::from_fn(|_| random(-1.5, 1.5));
        let mut scale: [f32; 3] = std::array::from_fn(|_| 10f32.powf(random(-4.0, 0.0)));
        let length = 10f32.powf(random(-15.0, 15.0));
        let mut rotation: [f32; 4] = std::array::from_fn(|_| random(-length, length));
        let mut opacity = if i % 3 == 0 { 1.0 } else { random(-0.1, 1.1) };
        let mut colour: [f32; 3] = std::array::from_fn(|_| random(0.0, 1.0));
        let poison = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY][i % 3];
        match i % 97 {
            0 => position[i % 3] = poison,
            1 => scale[i % 3] = poison,
            2 => rotation[i % 4] = poison,
            3 => opacity = poison,
            4 => colour[i % 3] = poison,
            5 => rotation = [0.0, -0.0, 0.0, 0.0],
            6 => rotation = [1e-45, 0.0, 0.0, 0.0],
            7 => rotation = rotation.map(|x| x / length * 1e38),
            8 => scale = [0.0, scale[1], 0.0],
            9 => scale = [f32::MAX; 3],
            10 => position = position.map(|x| x * 1e38),
            11 => opacity = FLOOR,
            12 => opacity = FLOOR.next_down(),
            _ => {}
        }
        all.position.push(position);
        all.scale.push(scale);
        all.rotation.push(rotation);
        all.opacity.push(opacity);
        all.colour.push(colour);
    }
    all
}

#[test]
fn on_every_instruction_set_the_kernel_sees_what_plain_rust_sees_one_by_one() {
    let mut all = gaussians();
    for (azimuth, radius, blur) in [(0.0, 3.0, 0.0), (77.0, 0.4, 3e-5), (200.0, 40.0, 1e-3)] {
        all.blur = blur;
        let camera = Camera::orbit(azimuth, 20.0, radius, 60.0, 310, 200).unwrap();
        let view = View::new(&camera);
        let expected: Vec<Result<Ellipse, Invisible>> = (0..all.len()).map(|i| view.see(&all, i)).collect();
        let count = |what: Invisible| {
            let mut same = 0;
            for e in &expected {
                same += u64::from(*e == Err(what));
            }
            same
        };
        for isa in Isa::available() {
            let how = How {
                isa,
                compensated: false,
                floor: FLOOR,
                near_care: false,
                slopes: false,
                colours: None,
            };
            let mut ellipses = Ellipses::default();
            let dropped = ellipses
                .project(&all, &camera, how, &mut Vec::<()>::new(), |_, _| {}, |_, _| {})
                .unwrap()
                .dropped;
            assert_eq!(dropped.not_finite, count(Invisible::NotFinite), "{isa}");
            assert_eq!(dropped.no_rotation, count(Invisible::NoRotation), "{isa}");
            assert_eq!(dropped.too_faint, count(Invisible::TooFaint), "{isa}");
            assert_eq!(dropped.behind, count(Invisible::Behind), "{isa}");
            // An edge may be within rounding of a pixel's centre.
            let seen = expected.iter().flatten().count();
            assert!(seen.abs_diff(ellipses.len()) <= 5, "{isa}");
            let mut compared = 0;
            for run in ellipses.runs.iter() {
                let ellipses = run.of(&ellipses.all);
                for found in ellipses {
                    if let Ok(expected) = &expected[found.index as usize] {
                        assert_same(found, expected, isa);
                        compared += 1;
                    }
                }
            }
            assert!(compared + 5 >= seen && compared > 1000, "{isa}: {compared}");
        }
    }
}

fn assert_same(found: &Ellipse, expected: &Ellipse, isa: Isa) {
    let context = || format!("{isa}: {found:?}, not {expected:?}");
    let near = |a: f32, b: f32, size: f32| (a - b).abs() <= 3e-5 * size.abs() + 1e-30;
    assert!(near(found.depth, expected.depth, expected.depth), "{}", context());
    assert_eq!(found.colour, expected.colour);
    for k in 0..2 {
        let size = expected.centre[k].abs().max(1.0);
        assert!(near(found.centre[k], expected.centre[k], size), "{}", context());
    }
    assert!((found.log_opacity - expected.log_opacity).abs() < 1e-5, "{}", context());
    // Of a needle, two steps nearly cancel where the ellipse is: their size is what counts.
    let size = |x: [f32; 2]| x[0].abs().max(x[1].abs());
    for (a, b) in [(found.u, expected.u), (found.v, expected.v)] {
        // Where both variances are the same to the last bit, either may come first.
        let swapped = (a[0] == 0.0) != (b[0] == 0.0) || (a[1] == 0.0) != (b[1] == 0.0);
        assert!(
            swapped || (0..2).all(|k| near(a[k], b[k], 10.0 * size(b))),
            "{}",
            context()
        );
    }
    let sides = |b: &Bounds| [b.x0, b.y0, b.x1, b.y1];
    for (a, b) in sides(&found.bounds).into_iter().zip(sides(&expected.bounds)) {
        assert!(a.abs_diff(b) <= 1, "{}", context());
    }
}
