//! Gaussians seen by a camera.
//!
//! With the rows `m₁`, `m₂` of `M = J·W·R·S` the covariance is `[[a, b], [b, c]]`, `a = m₁² + ε`, `b = m₁·m₂`, `c = m₂² + ε`. Its
//! determinant is taken as `(m₁ × m₂)² + ε(m₁² + m₂²) + ε²` (Cauchy–Binet): a sum of squares, at least `ε²`, nothing cancels. The
//! quadratic form is evaluated as `u² + v²` with the factors of a Cholesky decomposition that starts from the larger variance `p`:
//! for `p = a`, `v = dx/√p` and `u = (dy − (b/p)·dx)/√(det/p)`. So the exponent cannot be positive, and a needle of 3000 × 0.1 px
//! keeps its α to 2·10⁻⁴ where the textbook form is wrong by 1.

use super::ahead::Ahead;
use super::lanes::{Double, Lanes, Mask, by_level, four, three};
use super::{Bounds, Ellipse, MAX_SCALE, MIN_COMPENSATION};
use crate::Isa;

/// `√(log₂(e)/2)`: with it `exp(−½d²) = 2^−(d·FORM_SCALE)²`.
const FORM_SCALE: f32 = 0.849_321_8;
/// Squared lengths of quaternions within this of 1, as a factor, are taken as they are.
const LENGTHS: [f32; 2] = [1e-20, 1e20];

/// So many standard deviations from its centre, a Gaussian reaches over the near plane or doesn't.
const REACH: f32 = 3.0;

/// Bits of the variants of the kernel.
pub(super) const ORTHOGRAPHIC: u8 = 1;
const COMPENSATED: u8 = 2;

/// A camera, prepared.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Rows of the rotation to the camera's axes: x right, y down, z forward.
    pub rotation: [[f64; 3]; 3],
    /// Added after the rotation.
    pub translation: [f64; 3],
    /// What is not farther than this along z is not drawn.
    pub near: f64,
    /// Gaussians that reach over the near plane are drawn whatever side of it their centres are on: see [`super::Crossing`].
    pub near_care: bool,
    /// Pixels per unit of slope, or, of an orthographic camera, per unit of length.
    pub focal: [f64; 2],
    /// The principal point, in pixels.
    pub centre: [f64; 2],
    /// The ranges of `x/z` and `y/z` outside which the projection is linearised at the range's end.
    pub slopes: [[f64; 2]; 2],
    /// The pixels that are drawn; none is beyond 2²².
    pub window: Bounds,
    /// The least α that is drawn: of an ellipse, what is fainter may be left out. In `(0, 1]`.
    pub floor: f32,
    /// Parallel rays instead of a pinhole.
    pub orthographic: bool,
    /// Opacity is taken back by as much as the blur widens.
    pub compensated: bool,
    /// The Gaussians' own blur: a variance in squared units of length, finite, at least 0.
    pub blur: f64,
    /// The pixel's, in px², more than 0: what ellipses are widened by where the Gaussians' own comes to less.
    pub pixel_blur: f32,
}

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
    /// Of all that could be drawn otherwise, how many reach over the near plane, on whatever side their centres are; of those that are
    /// drawn like that, how many are visible.
    pub crossing: u32,
}

impl std::ops::Add for Tally {
    type Output = Tally;

    fn add(self, other: Tally) -> Tally {
        Tally {
            visible: self.visible + other.visible,
            not_finite: self.not_finite + other.not_finite,
            no_rotation: self.no_rotation + other.no_rotation,
            too_faint: self.too_faint + other.too_faint,
            behind: self.behind + other.behind,
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
    by_level!(isa, fn body<const VARIANT: u8>(view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally)
}

#[inline(always)]
fn body<L: Lanes, const VARIANT: u8>(view: &View, cloud: Cloud, first: u32, out: &mut [Ellipse]) -> Tally {
    let count = cloud.position.len();
    let lengths = [
        cloud.scale.len(),
        cloud.rotation.len(),
        cloud.opacity.len(),
        cloud.colour.len(),
    ];
    assert_eq!(lengths, [count; 4], "as many of every parameter");
    assert!(out.len() >= count, "room for every Gaussian");
    let camera = Camera::<L>::new(view);
    let mut tally = Tally::default();
    let mut at = 0;
    while at + L::COUNT <= count {
        let group = Cloud {
            position: &cloud.position[at..],
            scale: &cloud.scale[at..],
            rotation: &cloud.rotation[at..],
            opacity: &cloud.opacity[at..],
            colour: &cloud.colour[at..],
        };
        let to = &mut out[tally.visible as usize..];
        camera.see::<VARIANT>(group, L::COUNT, first + at as u32, &mut tally, to);
        at += L::COUNT;
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

/// A [`View`] in lanes.
pub(super) struct Camera<L: Lanes> {
    rotation: [[L::Double; 3]; 3],
    translation: [L::Double; 3],
    near: L::Double,
    near_care: bool,
    pub(super) near_plane: L,
    pub(super) focal: [L::Double; 2],
    pub(super) centre: [L::Double; 2],
    slopes: [[L::Double; 2]; 2],
    rows: [[L; 3]; 3],
    /// First and end of the window, by column and by row.
    pub(super) window: [[L; 2]; 2],
    floor: L,
    log_floor: L,
    /// The Gaussians' own blur in pixels at distance 1, and the pixel's in px².
    blur: L::Double,
    pixel_blur: L,
    /// Both in units of length, the pixel's at distance 1.
    pub(super) pixel: L,
    pub(super) own: L,
}

impl<L: Lanes> Camera<L> {
    #[inline(always)]
    fn new(view: &View) -> Self {
        let pair = |[x, y]: [f64; 2]| [L::Double::splat(x), L::Double::splat(y)];
        let Bounds { x0, y0, x1, y1 } = view.window;
        Camera {
            rotation: three!(i => three!(k => L::Double::splat(view.rotation[i][k]))),
            translation: three!(i => L::Double::splat(view.translation[i])),
            near: L::Double::splat(view.near),
            near_care: view.near_care,
            near_plane: L::splat(view.near as f32),
            focal: pair(view.focal),
            centre: pair(view.centre),
            slopes: [pair(view.slopes[0]), pair(view.slopes[1])],
            rows: three!(i => three!(k => L::splat(view.rotation[i][k] as f32))),
            window: [
                [L::splat(x0 as f32), L::splat(x1 as f32)],
                [L::splat(y0 as f32), L::splat(y1 as f32)],
            ],
            floor: L::splat(view.floor),
            log_floor: L::splat(view.floor.log2()),
            blur: L::Double::splat(view.blur * view.focal[0] * view.focal[1]),
            pixel_blur: L::splat(view.pixel_blur),
            pixel: L::splat((f64::from(view.pixel_blur) / view.focal[0] / view.focal[1]) as f32),
            own: L::splat(view.blur as f32),
        }
    }

    /// Sees the first `count` of `group`, at most as many as there are lanes.
    ///
    /// The centre is transformed in double precision: the sum of a rotated position and a distant camera's translation is the one
    /// place where digits are lost.
    #[inline(always)]
    fn see<const VARIANT: u8>(&self, group: Cloud, count: usize, index: u32, tally: &mut Tally, out: &mut [Ellipse]) {
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let position = L::deal3(group.position);
        let scale = L::deal3(group.scale);
        let rotation = L::deal4(group.rotation);
        let colour = L::deal3(group.colour);
        let opacity = L::load(group.opacity);

        // Zero times a number is zero exactly if the number is finite.
        let mut products = opacity.mul(zero);
        for [x, y, z] in [position, scale, colour] {
            products = x.mul_add(zero, y.mul_add(zero, z.mul_add(zero, products)));
        }
        for x in rotation {
            products = x.mul_add(zero, products);
        }
        let finite = products.le(zero);

        let (axes, turned) = rotation_matrix(rotation);

        let [px, py, pz] = three!(i => L::Double::from_lanes(position[i]));
        let seen: [L::Double; 3] = three!(k => {
            let [rx, ry, rz] = self.rotation[k];
            px.mul_add(rx, py.mul_add(ry, pz.mul_add(rz, self.translation[k])))
        });
        let ahead = self.near.lt(seen[2]);
        let mut depth = seen[2].to_lanes();
        let inverse = L::Double::splat(1.0).div(seen[2]);

        let limit = L::splat(MAX_SCALE);
        let scale = three!(i => scale[i].abs().min(limit));
        let (mut x, m1) = self.along::<VARIANT>(0, seen[0], inverse, &axes, scale);
        let (mut y, m2) = self.along::<VARIANT>(1, seen[1], inverse, &axes, scale);
        let own = if VARIANT & ORTHOGRAPHIC != 0 {
            self.blur
        } else {
            self.blur.mul(inverse).mul(inverse)
        };
        let blur = own.to_lanes().max(self.pixel_blur);
        let (a0, c0) = (dot(m1, m1), dot(m2, m2));
        let (a, c) = (a0.add(blur), c0.add(blur));
        let products = depth.mul_add(zero, x.mul(zero));
        let products = y.mul_add(zero, a.mul_add(zero, c.mul_add(zero, products)));
        let representable = products.le(zero);

        let wide = c.le(a);
        let long: [L; 3] = three!(i => L::select(wide, m1[i], m2[i]));
        let short: [L; 3] = three!(i => L::select(wide, m2[i], m1[i]));
        // `1/√p` and `1/√(det/p)`, and `b/p`; `p` is the larger variance, blur included.
        let p = L::select(wide, a, c);
        let inverse = one.div(p);
        let root = inverse.sqrt();
        // Divided by √p before it is squared, the cross product stays far from overflow.
        let minors = cross(three!(i => long[i].mul(root)), short);
        let minors = dot(minors, minors);
        let blurred = a0.add(c0).add(blur).mul(inverse).mul(blur);
        let across = L::splat(FORM_SCALE).div(minors.add(blurred).sqrt());
        let slope = dot(long, short).mul(inverse);
        let lengthwise = root.mul(L::splat(FORM_SCALE));

        let uncompensated = opacity.min(one);
        let mut opacity = uncompensated;
        if VARIANT & COMPENSATED != 0 {
            let kept = minors.div(minors.add(blurred)).sqrt();
            opacity = opacity.mul(kept.max(L::splat(MIN_COMPENSATION)));
        }
        let bright = self.floor.le(opacity);
        let mut log_opacity = if one.le(opacity).bits() + 1 == 1 << L::COUNT {
            zero
        } else {
            log2(opacity)
        };
        // α is at the floor at d² = 2·ln(opacity/floor) standard deviations squared.
        let reach = self.reach(log_opacity);
        let (mut x0, mut x1) = covered(x, a.mul(reach).sqrt(), self.window[0]);
        let (mut y0, mut y1) = covered(y, c.mul(reach).sqrt(), self.window[1]);
        let inside = x0.lt(x1).and(y0.lt(y1));

        let mut left = (1 << count) - 1;
        for (mask, missing) in [
            (finite, &mut tally.not_finite),
            (turned, &mut tally.no_rotation),
            (bright, &mut tally.too_faint),
        ] {
            let bits = mask.bits();
            *missing += (left & !bits).count_ones();
            left &= bits;
        }
        let ahead_of = three!(i => dot(self.rows[2], axes[i]).mul(scale[i]));
        let variance = dot(ahead_of, ahead_of);
        let beyond = depth.sub(self.near_plane);
        let crossing = beyond.mul(beyond).lt(variance.mul(L::splat(REACH * REACH)));
        let mut crossed = left & crossing.bits();
        if self.near_care && crossed != 0 {
            log_opacity = L::select(crossing, log2(uncompensated), log_opacity);
            let sigmas = self.reach(log_opacity);
            let ahead = Ahead::new::<VARIANT>(self, depth, variance, sigmas);
            let rows = three!(k => three!(i => dot(self.rows[k], axes[i]).mul(scale[i])));
            let halves = three!(k => dot(rows[k], rows[k]).add(ahead.blur).mul(sigmas).sqrt());
            let across = ahead.covered::<VARIANT>(self, 0, seen[0].to_lanes(), halves[0]);
            let along = ahead.covered::<VARIANT>(self, 1, seen[1].to_lanes(), halves[1]);
            let visible = across[0].lt(across[1]).and(along[0].lt(along[1])).bits();
            tally.outside += (crossed & !visible).count_ones();
            left &= visible | !crossed;
            crossed &= visible;
            x0 = L::select(crossing, across[0], x0);
            x1 = L::select(crossing, across[1], x1);
            y0 = L::select(crossing, along[0], y0);
            y1 = L::select(crossing, along[1], y1);
        }
        tally.crossing += crossed.count_ones();
        let cared = if self.near_care { crossed } else { 0 };
        for (mask, missing) in [
            (ahead, &mut tally.behind),
            (representable, &mut tally.not_finite),
            (inside, &mut tally.outside),
        ] {
            let bits = mask.bits() | cared;
            *missing += (left & !bits).count_ones();
            left &= bits;
        }

        let (mut across, mut lengthwise) = (across, lengthwise);
        let mut tilted = zero.sub(slope.mul(across));
        if cared != 0 {
            // They may be anywhere, and have no form in the plane.
            let either = |yes, no| L::select(crossing, yes, no);
            for form in [&mut x, &mut y, &mut across, &mut lengthwise, &mut tilted] {
                *form = either(zero, *form);
            }
            depth = either(depth.max(self.near_plane), depth);
        }
        let mut indices = [0.0; 16];
        for (i, place) in indices.iter_mut().enumerate() {
            *place = f32::from_bits(index.wrapping_add(i as u32));
        }
        let fields = [
            x,
            y,
            L::select(wide, tilted, across),
            L::select(wide, across, tilted),
            L::select(wide, lengthwise, zero),
            L::select(wide, zero, lengthwise),
            log_opacity,
            colour[0],
            colour[1],
            colour[2],
            x0.to_integer(),
            y0.to_integer(),
            x1.to_integer(),
            y1.to_integer(),
            depth,
            L::load(&indices),
        ];
        tally.visible += L::collect(&fields, left, out) as u32;
    }

    /// So many standard deviations, squared, α is from its peak to the floor.
    #[inline(always)]
    fn reach(&self, log_opacity: L) -> L {
        let powers = log_opacity.sub(self.log_floor).max(L::splat(0.0));
        powers.mul(L::splat(2.0 * std::f32::consts::LN_2))
    }

    /// The centre along x (`k` 0) or y (1), and that row of `M`. `seen`: the centre's offset along that axis of the camera.
    #[inline(always)]
    fn along<const VARIANT: u8>(
        &self,
        k: usize,
        seen: L::Double,
        inverse: L::Double,
        axes: &[[L; 3]; 3],
        scale: [L; 3],
    ) -> (L, [L; 3]) {
        let (offset, focal, row) = if VARIANT & ORTHOGRAPHIC != 0 {
            (seen, self.focal[k].to_lanes(), self.rows[k])
        } else {
            let slope = seen.mul(inverse);
            let [low, high] = self.slopes[k];
            let clamped = slope.max(low).min(high).to_lanes();
            let row = three!(i => self.rows[2][i].neg_mul_add(clamped, self.rows[k][i]));
            (slope, self.focal[k].mul(inverse).to_lanes(), row)
        };
        let centre = self.focal[k].mul_add(offset, self.centre[k]).to_lanes();
        let row = three!(i => row[i].mul(focal));
        (centre, three!(i => dot(row, axes[i]).mul(scale[i])))
    }
}

/// The first and the end of the pixels from `low` to `high` whose centres lie within `half` of `centre`: none if they don't rise.
#[inline(always)]
fn covered<L: Lanes>(centre: L, half: L, [low, high]: [L; 2]) -> (L, L) {
    let middle = L::splat(0.5);
    // Clamped before it is rounded, the number is small enough for that. NaN comes to an end of the range.
    let first = centre.sub(half).sub(middle).max(low).min(high);
    let end = centre.add(half).add(middle).max(low).min(high);
    (first.ceil(), end.floor())
}

/// The columns of the rotation matrix of a quaternion `w, x, y, z` of any length, and whether that is one: not zero.
#[inline(always)]
fn rotation_matrix<L: Lanes>(mut q: [L; 4]) -> ([[L; 3]; 3], L::Mask) {
    let (zero, one) = (L::splat(0.0), L::splat(1.0));
    let [w, x, y, z] = q;
    let largest = w.abs().max(x.abs()).max(y.abs().max(z.abs()));
    let mut length = squared(q);
    let usual = L::splat(LENGTHS[0]).le(length).and(length.le(L::splat(LENGTHS[1])));
    if usual.bits() + 1 != 1 << L::COUNT {
        // Rare: brought to a length whose square is a normal number. The other lanes must not notice.
        q = four!(i => L::select(usual, q[i], q[i].div(largest)));
        length = squared(q);
    }
    let double = L::splat(2.0).div(length);
    let [w, x, y, z] = q;
    let [x2, y2, z2] = [x.mul(double), y.mul(double), z.mul(double)];
    let [wx, wy, wz] = [w.mul(x2), w.mul(y2), w.mul(z2)];
    let [xx, xy, xz] = [x.mul(x2), y.mul(x2), z.mul(x2)];
    let [yy, yz, zz] = [y.mul(y2), z.mul(y2), z.mul(z2)];
    let columns = [
        [one.sub(yy).sub(zz), xy.add(wz), xz.sub(wy)],
        [xy.sub(wz), one.sub(xx).sub(zz), yz.add(wx)],
        [xz.add(wy), yz.sub(wx), one.sub(xx).sub(yy)],
    ];
    (columns, zero.lt(largest))
}

/// The binary logarithm of a positive normal number, to 10⁻⁷; exact for powers of two.
#[inline(always)]
pub(super) fn log2<L: Lanes>(x: L) -> L {
    let (mantissa, exponent) = x.split();
    let one = L::splat(1.0);
    let above = L::splat(std::f32::consts::SQRT_2).lt(mantissa);
    let mantissa = L::select(above, mantissa.mul(L::splat(0.5)), mantissa);
    let exponent = exponent.add(one.keep(above));
    // ln(m) = 2·artanh((m − 1)/(m + 1)), its series times 2/ln 2.
    let s = mantissa.sub(one).div(mantissa.add(one));
    let squared = s.mul(s);
    let mut sum = L::splat(0.320_598_9);
    for c in [0.412_198_6, 0.577_078, 0.961_796_7, 2.885_39] {
        sum = sum.mul_add(squared, L::splat(c));
    }
    sum.mul_add(s, exponent)
}

#[inline(always)]
fn squared<L: Lanes>([w, x, y, z]: [L; 4]) -> L {
    w.mul_add(w, x.mul_add(x, y.mul_add(y, z.mul(z))))
}

#[inline(always)]
fn dot<L: Lanes>(a: [L; 3], b: [L; 3]) -> L {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2].mul(b[2])))
}

#[inline(always)]
fn cross<L: Lanes>(a: [L; 3], b: [L; 3]) -> [L; 3] {
    three!(i => {
        let (j, k) = ((i + 1) % 3, (i + 2) % 3);
        a[k].neg_mul_add(b[j], a[j].mul(b[k]))
    })
}
