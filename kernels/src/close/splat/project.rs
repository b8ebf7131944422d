//! Gaussians seen by a camera.
//!
//! With the rows `m₁`, `m₂` of `M = J·W·R·S` the covariance is `[[a, b], [b, c]]`, `a = m₁² + ε`, `b = m₁·m₂`, `c =
//! m₂² + ε`. Its determinant is taken as `(m₁ × m₂)² + ε(m₁² + m₂²) + ε²` (Cauchy–Binet): a sum of squares, at least
//! `ε²`, nothing cancels. The quadratic form is evaluated as `u² + v²` with the factors of a Cholesky decomposition
//! that starts from the larger variance `p`: for `p = a`, `v = dx/√p` and `u = (dy − (b/p)·dx)/√(det/p)`. So the
//! exponent cannot be positive, and a needle of 3000 × 0.1 px keeps its α to 2·10⁻⁴ where the textbook form is wrong
//! by 1.

use super::extent::Extent;
use bytemuck::must_cast_slice_mut;

use super::camera::{COMPENSATED, Camera, ORTHOGRAPHIC, View};
use super::ellipse::{Ellipse, MAX_SCALE, MIN_COMPENSATION};
use crate::simd::{F32Vector, F64Vector, I32Vector, Isa, MaskVector, Simd, dispatch, four, three};

/// `√(log₂(e)/2)`: with it `exp(−½d²) = 2^−(d·FORM_SCALE)²`.
const FORM_SCALE: f32 = 0.849_321_8;
/// Squared lengths of quaternions within this of 1, as a factor, are taken as they are.
const LENGTHS: [f32; 2] = [1e-20, 1e20];

/// So many standard deviations from its centre, a Gaussian reaches over the near plane or doesn't.
const REACH: f32 = 3.0;

/// Gaussians, one slice per parameter, all of the same length.
#[derive(Debug, Clone, Copy)]
#[allow(missing_docs)]
pub struct Cloud<'a> {
    pub position: &'a [[f32; 3]],
    pub scale: &'a [[f32; 3]],
    pub rotation: &'a [[f32; 4]],
    pub opacity: &'a [f32],
    pub colour: &'a [[f32; 3]],
}

/// How many Gaussians are visible, and how many are not, by the first reason that applies.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[allow(missing_docs)]
pub struct Tally {
    pub visible: u32,
    pub not_finite: u32,
    pub no_rotation: u32,
    pub too_faint: u32,
    pub behind: u32,
    pub outside: u32,
    /// Of all that could be drawn otherwise, how many reach over the near plane, on whatever side their centres are; of
    /// those that are drawn like that, how many are visible.
    pub crossing: u32,
}

impl std::ops::Add for Tally {
    type Output = Tally;

    fn add(self, other: Tally) -> Tally {
        let Tally { behind, .. } = self;
        Tally {
            visible: self.visible + other.visible,
            not_finite: self.not_finite + other.not_finite,
            no_rotation: self.no_rotation + other.no_rotation,
            too_faint: self.too_faint + other.too_faint,
            behind: behind + other.behind,
            outside: self.outside + other.outside,
            crossing: self.crossing + other.crossing,
        }
    }
}

/// Projects `cloud`, whose first Gaussian has the index `first`; the visible go to the beginning of `out`, in order.
///
/// # Panics
/// If the slices of `cloud` differ in length, or `out` is shorter.
pub fn project(isa: Isa, view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally {
    match (view.orthographic, view.compensated) {
        (false, false) => run::<0>(isa, view, cloud, first, out),
        (true, false) => run::<ORTHOGRAPHIC>(isa, view, cloud, first, out),
        (false, true) => run::<COMPENSATED>(isa, view, cloud, first, out),
        (true, true) => run::<{ ORTHOGRAPHIC | COMPENSATED }>(isa, view, cloud, first, out),
    }
}

fn run<const VARIANT: u8>(isa: Isa, view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally {
    dispatch!(isa, fn body<; const VARIANT: u8>(view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally)
}

#[inline(always)]
fn body<S: Simd, const VARIANT: u8>(simd: S, view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally {
    let count = cloud.position.len();
    let lengths = [
        cloud.scale.len(),
        cloud.rotation.len(),
        cloud.opacity.len(),
        cloud.colour.len(),
    ];
    assert_eq!(lengths, [count; 4], "as many of every parameter");
    assert!(out.len() >= count, "room for every Gaussian");
    let camera = Camera::new(simd, view);
    let mut tally = Tally::default();
    let mut at = 0;
    while at + S::LANES <= count {
        let group = Cloud {
            position: &cloud.position[at..],
            scale: &cloud.scale[at..],
            rotation: &cloud.rotation[at..],
            opacity: &cloud.opacity[at..],
            colour: &cloud.colour[at..],
        };
        let to = &mut out[tally.visible as usize..];
        camera.see::<VARIANT>(group, S::LANES, first + at as u32, &mut tally, to);
        at += S::LANES;
    }
    if at < count {
        let mut vectors = [[[0.0; 3]; 16]; 3];
        let (mut rotation, mut opacity) = ([[0.0; 4]; 16], [0.0; 16]);
        let rest = count - at;
        vectors[0][..rest].copy_from_slice(&cloud.position[at..]);
        vectors[1][..rest].copy_from_slice(&cloud.scale[at..]);
        vectors[2][..rest].copy_from_slice(&cloud.colour[at..]);
        rotation[..rest].copy_from_slice(&cloud.rotation[at..]);
        opacity[..rest].copy_from_slice(&cloud.opacity[at..]);
        let group = Cloud {
            position: &vectors[0],
            scale: &vectors[1],
            rotation: &rotation,
            opacity: &opacity,
            colour: &vectors[2],
        };
        let to = &mut out[tally.visible as usize..];
        camera.see::<VARIANT>(group, rest, first + at as u32, &mut tally, to);
    }
    tally
}

/// Parameters of a group of Gaussians, one to a lane.
struct Group<S: Simd> {
    position: [S::F32; 3],
    /// At most [`MAX_SCALE`].
    scale: [S::F32; 3],
    /// The columns of the rotation's matrix.
    axes: [[S::F32; 3]; 3],
    colour: [S::F32; 3],
    /// At most 1.
    opacity: S::F32,
    /// Whether all parameters are finite.
    finite: S::Mask,
    /// Whether the quaternion is a rotation: not zero.
    turned: S::Mask,
}

impl<S: Simd> Group<S> {
    #[inline(always)]
    fn load(simd: S, group: Cloud) -> Self {
        let one = S::F32::splat(simd, 1.0);
        let position = S::F32::load_deinterleaved3(simd, group.position);
        let scale = S::F32::load_deinterleaved3(simd, group.scale);
        let rotation = S::F32::load_deinterleaved4(simd, group.rotation);
        let colour = S::F32::load_deinterleaved3(simd, group.colour);
        let opacity = S::F32::load(simd, group.opacity);
        let ([px, py, pz], [sx, sy, sz], [r, g, b], [qw, qx, qy, qz]) = (position, scale, colour, rotation);
        let numbers = [px, py, pz, sx, sy, sz, r, g, b, qw, qx, qy, qz, opacity];
        let limit = S::F32::splat(simd, MAX_SCALE);
        let (axes, turned) = rotation_matrix(simd, rotation);
        Group {
            position,
            scale: three!(i => scale[i].abs().min(limit)),
            axes,
            colour,
            opacity: opacity.min(one),
            finite: all_finite(simd, numbers),
            turned,
        }
    }
}

/// The quadratic form of an ellipse in the image plane, with the factors that the module's text derives.
struct Form<S: Simd> {
    /// `a` and `c`: the variances along x and y, blur included.
    variances: [S::F32; 2],
    /// Whether `a` is the larger one.
    wide: S::Mask,
    /// The factors of `u` and `v`, scaled for powers of two.
    across: S::F32,
    lengthwise: S::F32,
    /// The factor of `u` along the other axis.
    tilted: S::F32,
    /// Without blur, and what blur adds: the determinant divided by the larger variance.
    minors: S::F32,
    blurred: S::F32,
}

impl<S: Simd> Form<S> {
    /// Of the ellipse with the rows `m1` and `m2` of `M`, each variance enlarged by `blur`.
    #[inline(always)]
    fn new(simd: S, m1: [S::F32; 3], m2: [S::F32; 3], blur: S::F32) -> Self {
        let (zero, one) = (S::F32::splat(simd, 0.0), S::F32::splat(simd, 1.0));
        let (a0, c0) = (dot(simd, m1, m1), dot(simd, m2, m2));
        let (a, c) = (a0 + blur, c0 + blur);
        let wide = c.le(a);
        let long: [S::F32; 3] = three!(i => S::F32::select(wide, m1[i], m2[i]));
        let short: [S::F32; 3] = three!(i => S::F32::select(wide, m2[i], m1[i]));
        // `1/√p` and `1/√(det/p)`, and `b/p`; `p` is the larger variance, blur included.
        let inverse = one / S::F32::select(wide, a, c);
        let root = inverse.sqrt();
        // Divided by √p before it is squared, the cross product stays far from overflow.
        let minors = cross(simd, three!(i => long[i] * root), short);
        let minors = dot(simd, minors, minors);
        let blurred = (a0 + c0 + blur) * inverse * blur;
        let across = S::F32::splat(simd, FORM_SCALE) / (minors + blurred).sqrt();
        let slope = dot(simd, long, short) * inverse;
        Form {
            variances: [a, c],
            wide,
            across,
            lengthwise: root * S::F32::splat(simd, FORM_SCALE),
            tilted: zero - slope * across,
            minors,
            blurred,
        }
    }

    /// The opacity that keeps a Gaussian's light as it was before the blur widened it.
    #[inline(always)]
    fn compensate(&self, simd: S, opacity: S::F32) -> S::F32 {
        let kept = (self.minors / (self.minors + self.blurred)).sqrt();
        opacity * kept.max(S::F32::splat(simd, MIN_COMPENSATION))
    }
}

/// What a group looks like, one to a lane: most of what an [`Ellipse`] stores.
struct Projected<S: Simd> {
    centre: [S::F32; 2],
    depth: S::F32,
    form: Form<S>,
    log_opacity: S::F32,
    /// The first and the end of the columns that are covered, and of the rows.
    columns: [S::F32; 2],
    rows: [S::F32; 2],
}

impl<S: Simd> Projected<S> {
    /// Makes the lanes of `crossing` what ray space calls for: no form in the plane, for they may be anywhere, a depth
    /// from the near plane on, and these columns and rows.
    #[inline(always)]
    fn replace(&mut self, simd: S, crossing: S::Mask, near: S::F32, [columns, rows]: [[S::F32; 2]; 2]) {
        let zero = S::F32::splat(simd, 0.0);
        let [x, y] = &mut self.centre;
        let form = &mut self.form;
        for number in [x, y, &mut form.across, &mut form.lengthwise, &mut form.tilted] {
            *number = S::F32::select(crossing, zero, *number);
        }
        self.depth = S::F32::select(crossing, self.depth.max(near), self.depth);
        for k in 0..2 {
            self.columns[k] = S::F32::select(crossing, columns[k], self.columns[k]);
            self.rows[k] = S::F32::select(crossing, rows[k], self.rows[k]);
        }
    }

    /// Stores the lanes of `left` as ellipses, one after the other; returns how many. `index`: the first lane's.
    #[inline(always)]
    fn store(&self, simd: S, colour: [S::F32; 3], index: u32, left: u32, out: &mut [Ellipse]) -> u32 {
        let zero = S::F32::splat(simd, 0.0);
        let mut indices = [0.0; 16];
        for (i, place) in indices.iter_mut().enumerate() {
            *place = f32::from_bits(index.wrapping_add(i as u32));
        }
        let Form {
            wide,
            across,
            lengthwise,
            tilted,
            ..
        } = self.form;
        let fields = [
            self.centre[0],
            self.centre[1],
            S::F32::select(wide, tilted, across),
            S::F32::select(wide, across, tilted),
            S::F32::select(wide, lengthwise, zero),
            S::F32::select(wide, zero, lengthwise),
            self.log_opacity,
            colour[0],
            colour[1],
            colour[2],
            self.columns[0].truncate_to_i32().as_f32(),
            self.rows[0].truncate_to_i32().as_f32(),
            self.columns[1].truncate_to_i32().as_f32(),
            self.rows[1].truncate_to_i32().as_f32(),
            self.depth,
            S::F32::load(simd, &indices),
        ];
        S::F32::store_records(&fields, left, must_cast_slice_mut(out)) as u32
    }
}

/// Which lanes are left, and how many were dropped for what reason.
struct Visible<'a> {
    left: u32,
    tally: &'a mut Tally,
}

impl Visible<'_> {
    /// Keeps the lanes of `bits`; the others count as `reason`.
    #[inline(always)]
    fn keep(&mut self, bits: u32, reason: fn(&mut Tally) -> &mut u32) {
        *reason(self.tally) += (self.left & !bits).count_ones();
        self.left &= bits;
    }
}

impl<S: Simd> Camera<S> {
    /// Sees the first `count` of `group`, at most as many as there are lanes.
    #[inline(always)]
    fn see<const VARIANT: u8>(&self, group: Cloud, count: usize, index: u32, tally: &mut Tally, out: &mut [Ellipse]) {
        let simd = self.simd;
        let one = S::F32::splat(simd, 1.0);
        let group = Group::load(simd, group);
        let place = self.transform(group.position);
        let (centre, form) = self.flatten::<VARIANT>(&group, place);
        let depth = place[2].to_f32();
        let representable = all_finite(
            simd,
            [depth, centre[0], centre[1], form.variances[0], form.variances[1]],
        );

        let mut opacity = group.opacity;
        if VARIANT & COMPENSATED != 0 {
            opacity = form.compensate(simd, opacity);
        }
        let opaque = one.le(opacity).bits() + 1 == 1 << S::LANES;
        let log_opacity = if opaque {
            S::F32::splat(simd, 0.0)
        } else {
            log2(simd, opacity)
        };
        // α is at the floor at d² = 2·ln(opacity/floor) standard deviations squared.
        let reach = self.reach(log_opacity);
        let [a, c] = form.variances;
        let columns = covered(simd, centre[0], (a * reach).sqrt(), self.window[0]);
        let rows = covered(simd, centre[1], (c * reach).sqrt(), self.window[1]);
        let inside = columns[0].lt(columns[1]).and(rows[0].lt(rows[1]));

        let mut visible = Visible {
            left: (1 << count) - 1,
            tally,
        };
        visible.keep(group.finite.bits(), |tally| &mut tally.not_finite);
        visible.keep(group.turned.bits(), |tally| &mut tally.no_rotation);
        visible.keep(self.floor.le(opacity).bits(), |tally| &mut tally.too_faint);
        let mut seen = Projected {
            centre,
            depth,
            form,
            log_opacity,
            columns,
            rows,
        };
        let along_rays = self.cross_near_plane::<VARIANT>(&group, place, &mut seen, &mut visible);
        visible.keep(self.near.lt(place[2]).bits() | along_rays, |tally| &mut tally.behind);
        visible.keep(representable.bits() | along_rays, |tally| &mut tally.not_finite);
        visible.keep(inside.bits() | along_rays, |tally| &mut tally.outside);
        let stored = seen.store(simd, group.colour, index, visible.left, out);
        visible.tally.visible += stored;
    }

    /// The position in the camera's axes.
    ///
    /// In double precision: the sum of a rotated position and a distant camera's translation is the one place where
    /// digits are lost.
    #[inline(always)]
    fn transform(&self, position: [S::F32; 3]) -> [S::F64; 3] {
        let [px, py, pz] = three!(i => S::F64::from_f32(position[i]));
        three!(k => {
            let [rx, ry, rz] = self.rotation[k];
            px.mul_add(rx, py.mul_add(ry, pz.mul_add(rz, self.translation[k])))
        })
    }

    /// The centre and the form in the image plane of a group whose centres are at `place` of the camera's axes.
    #[inline(always)]
    fn flatten<const VARIANT: u8>(&self, group: &Group<S>, place: [S::F64; 3]) -> ([S::F32; 2], Form<S>) {
        let inverse = S::F64::splat(self.simd, 1.0) / place[2];
        let (x, m1) = self.along::<VARIANT>(0, place[0], inverse, &group.axes, group.scale);
        let (y, m2) = self.along::<VARIANT>(1, place[1], inverse, &group.axes, group.scale);
        let own = if VARIANT & ORTHOGRAPHIC != 0 {
            self.blur
        } else {
            self.blur * inverse * inverse
        };
        let blur = own.to_f32().max(self.pixel_blur);
        ([x, y], Form::new(self.simd, m1, m2, blur))
    }

    /// Finds which Gaussians reach over the near plane. If those are evaluated in ray space, drops what is outside the
    /// picture and replaces what of `seen` has no meaning for them. Returns the lanes that are drawn like that.
    #[inline(always)]
    fn cross_near_plane<const VARIANT: u8>(
        &self,
        group: &Group<S>,
        place: [S::F64; 3],
        seen: &mut Projected<S>,
        visible: &mut Visible,
    ) -> u32 {
        let simd = self.simd;
        let ahead = three!(i => dot(simd, self.rows[2], group.axes[i]) * group.scale[i]);
        let variance = dot(simd, ahead, ahead);
        let beyond = seen.depth - self.near_plane;
        let crossing = (beyond * beyond).lt(variance * S::F32::splat(simd, REACH * REACH));
        let mut crossed = visible.left & crossing.bits();
        if !self.ray_space || crossed == 0 {
            visible.tally.crossing += crossed.count_ones();
            return 0;
        }
        let log_opacity = log2(simd, group.opacity);
        seen.log_opacity = S::F32::select(crossing, log_opacity, seen.log_opacity);
        let sigmas = self.reach(seen.log_opacity);
        let extent = Extent::new::<VARIANT>(self, seen.depth, variance, sigmas);
        let rows = three!(k => three!(i => dot(simd, self.rows[k], group.axes[i]) * group.scale[i]));
        let halves = three!(k => ((dot(simd, rows[k], rows[k]) + extent.blur) * sigmas).sqrt());
        let columns = extent.covered::<VARIANT>(self, 0, place[0].to_f32(), halves[0]);
        let rows = extent.covered::<VARIANT>(self, 1, place[1].to_f32(), halves[1]);
        let inside = columns[0].lt(columns[1]).and(rows[0].lt(rows[1])).bits();
        visible.keep(inside | !crossed, |tally| &mut tally.outside);
        crossed &= inside;
        visible.tally.crossing += crossed.count_ones();
        seen.replace(simd, crossing, self.near_plane, [columns, rows]);
        crossed
    }

    /// So many standard deviations, squared, α is from its peak to the floor.
    #[inline(always)]
    fn reach(&self, log_opacity: S::F32) -> S::F32 {
        let simd = self.simd;
        let powers = (log_opacity - self.log_floor).max(S::F32::splat(simd, 0.0));
        powers * S::F32::splat(simd, 2.0 * std::f32::consts::LN_2)
    }

    /// The centre along x (`k` 0) or y (1), and that row of `M`. `seen`: the centre's offset along that axis of the
    /// camera.
    #[inline(always)]
    fn along<const VARIANT: u8>(
        &self,
        k: usize,
        seen: S::F64,
        inverse: S::F64,
        axes: &[[S::F32; 3]; 3],
        scale: [S::F32; 3],
    ) -> (S::F32, [S::F32; 3]) {
        let simd = self.simd;
        let (offset, focal, row) = if VARIANT & ORTHOGRAPHIC != 0 {
            (seen, self.focal[k].to_f32(), self.rows[k])
        } else {
            let slope = seen * inverse;
            let [low, high] = self.slopes[k];
            let clamped = slope.max(low).min(high).to_f32();
            let row = three!(i => self.rows[2][i].neg_mul_add(clamped, self.rows[k][i]));
            (slope, (self.focal[k] * inverse).to_f32(), row)
        };
        let centre = self.focal[k].mul_add(offset, self.centre[k]).to_f32();
        let row = three!(i => row[i] * focal);
        (centre, three!(i => dot(simd, row, axes[i]) * scale[i]))
    }
}

/// The first and the end of the pixels from `low` to `high` whose centres lie within `half` of `centre`: none if they
/// don't rise.
#[inline(always)]
fn covered<S: Simd>(simd: S, centre: S::F32, half: S::F32, [low, high]: [S::F32; 2]) -> [S::F32; 2] {
    let middle = S::F32::splat(simd, 0.5);
    // Clamped before it is rounded, the number is small enough for that. NaN comes to an end of the range.
    let first = (centre - half - middle).max(low).min(high);
    let end = (centre + half + middle).max(low).min(high);
    [first.ceil(), end.floor()]
}

/// Whether all numbers of a lane are finite: zero times a number is zero exactly if it is.
#[inline(always)]
fn all_finite<S: Simd, const N: usize>(simd: S, numbers: [S::F32; N]) -> S::Mask {
    let zero = S::F32::splat(simd, 0.0);
    let mut products = zero;
    for number in numbers {
        products = number.mul_add(zero, products);
    }
    products.le(zero)
}

/// The columns of the rotation matrix of a quaternion `w, x, y, z` of any length, and whether that is one: not zero.
#[inline(always)]
fn rotation_matrix<S: Simd>(simd: S, mut q: [S::F32; 4]) -> ([[S::F32; 3]; 3], S::Mask) {
    let (zero, one) = (S::F32::splat(simd, 0.0), S::F32::splat(simd, 1.0));
    let [w, x, y, z] = q;
    let largest = w.abs().max(x.abs()).max(y.abs().max(z.abs()));
    let mut length = squared(simd, q);
    let usual = S::F32::splat(simd, LENGTHS[0])
        .le(length)
        .and(length.le(S::F32::splat(simd, LENGTHS[1])));
    if usual.bits() + 1 != 1 << S::LANES {
        // Rare: brought to a length whose square is a normal number. The other lanes must not notice.
        q = four!(i => S::F32::select(usual, q[i], q[i] / largest));
        length = squared(simd, q);
    }
    let double = S::F32::splat(simd, 2.0) / length;
    let [w, x, y, z] = q;
    let [x2, y2, z2] = [x * double, y * double, z * double];
    let [wx, wy, wz] = [w * x2, w * y2, w * z2];
    let [xx, xy, xz] = [x * x2, y * x2, z * x2];
    let [yy, yz, zz] = [y * y2, z * y2, z * z2];
    let columns = [
        [one - yy - zz, xy + wz, xz - wy],
        [xy - wz, one - xx - zz, yz + wx],
        [xz + wy, yz - wx, one - xx - yy],
    ];
    (columns, zero.lt(largest))
}

/// The binary logarithm of a positive normal number, to 10⁻⁷; exact for powers of two.
#[inline(always)]
pub(super) fn log2<S: Simd>(simd: S, x: S::F32) -> S::F32 {
    let (mantissa, exponent) = x.split_exponent();
    let one = S::F32::splat(simd, 1.0);
    let above = S::F32::splat(simd, std::f32::consts::SQRT_2).lt(mantissa);
    let mantissa = S::F32::select(above, mantissa * S::F32::splat(simd, 0.5), mantissa);
    let exponent = exponent + one.keep(above);
    // ln(m) = 2·artanh((m − 1)/(m + 1)), its series times 2/ln 2.
    let s = (mantissa - one) / (mantissa + one);
    let squared = s * s;
    let mut sum = S::F32::splat(simd, 0.320_598_9);
    for c in [0.412_198_6, 0.577_078, 0.961_796_7, 2.885_39] {
        sum = sum.mul_add(squared, S::F32::splat(simd, c));
    }
    sum.mul_add(s, exponent)
}

#[inline(always)]
fn squared<S: Simd>(_: S, [w, x, y, z]: [S::F32; 4]) -> S::F32 {
    w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z)))
}

#[inline(always)]
fn dot<S: Simd>(_: S, a: [S::F32; 3], b: [S::F32; 3]) -> S::F32 {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

#[inline(always)]
fn cross<S: Simd>(_: S, a: [S::F32; 3], b: [S::F32; 3]) -> [S::F32; 3] {
    three!(i => {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        a[k].neg_mul_add(b[j], a[j] * b[k])
    })
}
