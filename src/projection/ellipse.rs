//! One Gaussian seen by one camera.
//!
//! With the rows `m₁`, `m₂` of `M = J·W·R·S` the covariance is `[[a, b], [b, c]]`, `a = m₁² + ε`, `b = m₁·m₂`, `c = m₂² + ε`. Its
//! determinant is taken as `(m₁ × m₂)² + ε(m₁² + m₂²) + ε²` (Cauchy–Binet): a sum of squares, at least `ε²`, nothing cancels. The
//! quadratic form is evaluated as `u² + v²` with the factors of a Cholesky decomposition that starts from the larger variance `p`:
//! for `p = a`, `v = dx/√p` and `u = (dy − (b/p)·dx)/√(det/p)`. So the exponent cannot be positive, and a needle of 3000 × 0.1 px
//! keeps its α to 2·10⁻⁴ where the textbook form is wrong by 1.

use glam::{DAffine3, Mat3, Quat, Vec3};

use super::{ALPHA_FLOOR, BLUR, Camera, MAX_SCALE};
use crate::gaussians::Gaussians;

/// `√(log₂(e)/2)`: with it `exp(−½d²) = 2^−(d·FORM_SCALE)²`.
const FORM_SCALE: f32 = 0.849_321_8;
/// `log₂` of [`ALPHA_FLOOR`].
const LOG_FLOOR: f32 = -7.994_353_4;

/// The pixels `x0 ≤ x < x1`, `y0 ≤ y < y1`. Never empty in [`super::Ellipses`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct Bounds {
    pub x0: u32,
    pub y0: u32,
    pub x1: u32,
    pub y1: u32,
}

/// What a pixel needs to know: `α(x, y) = 2^(log_opacity − u² − v²)` with `(u, v)` linear in the pixel's distance to the centre.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Ellipse {
    /// The centre in pixels.
    pub centre: [f32; 2],
    /// `u = u[0]·dx + u[1]·dy`.
    pub u: [f32; 2],
    /// `v = v[0]·dx + v[1]·dy`; one of the two is 0.
    pub v: [f32; 2],
    /// Binary logarithm of the opacity at the centre, at most 0.
    pub log_opacity: f32,
    /// Red, green and blue; not clamped.
    pub colour: [f32; 3],
}

/// Why a Gaussian is not drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Invisible {
    NotFinite,
    NoRotation,
    TooFaint,
    Behind,
    Outside,
}

/// A camera, prepared.
pub(super) struct View {
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
    pub(super) fn new(camera: &Camera) -> Self {
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
    ///
    /// The centre is transformed in double precision: the sum of a rotated position and a distant camera's translation is the one
    /// place where digits are lost.
    pub(super) fn see(
        &self,
        gaussians: &Gaussians,
        i: usize,
    ) -> Result<(f32, Bounds, Ellipse), Invisible> {
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
        require(opacity >= ALPHA_FLOOR, Invisible::TooFaint)?;
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
        let (a, c) = (m1.length_squared() + BLUR, m2.length_squared() + BLUR);
        let finite = Vec3::new(depth, x, y).is_finite() && a.is_finite() && c.is_finite();
        require(finite, Invisible::NotFinite)?;

        let log_opacity = opacity.min(1.0).log2();
        // α = 1/255 at d² = 2·ln(255·opacity) standard deviations squared.
        let reach = 2.0 * std::f32::consts::LN_2 * (log_opacity - LOG_FLOOR).max(0.0);
        let (x0, x1) = covered(x, (a * reach).sqrt(), self.size[0]);
        let (y0, y1) = covered(y, (c * reach).sqrt(), self.size[1]);
        require(x0 < x1 && y0 < y1, Invisible::Outside)?;

        let (u, v) = if a >= c {
            let (along, across, slope) = factors(m1, m2, a);
            ([-slope * across, across], [along, 0.0])
        } else {
            let (along, across, slope) = factors(m2, m1, c);
            ([across, -slope * across], [0.0, along])
        };
        let bounds = Bounds { x0, y0, x1, y1 };
        let shape = Ellipse {
            centre: [x, y],
            u,
            v,
            log_opacity,
            colour,
        };
        Ok((depth, bounds, shape))
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

/// `1/√p` and `1/√(det/p)`, both times [`FORM_SCALE`], and `b/p`; `p` is the variance (blur included) of the row `long`.
fn factors(long: Vec3, short: Vec3, p: f32) -> (f32, f32, f32) {
    let inverse = 1.0 / p;
    let root = inverse.sqrt();
    // Divided by √p before it is squared, the cross product stays far from overflow.
    let minors = (long * root).cross(short).length_squared();
    let blurred = BLUR * ((long.length_squared() + short.length_squared() + BLUR) * inverse);
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
    Some(Mat3::from_quat(Quat::from_xyzw(
        unit(x),
        unit(y),
        unit(z),
        unit(w),
    )))
}
