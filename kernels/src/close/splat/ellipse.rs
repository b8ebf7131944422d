//! What is drawn: ellipses, and Gaussians that reach over the near plane.

use bytemuck::{Pod, Zeroable};

/// The greatest α of one ellipse.
pub const ALPHA_CEILING: f32 = 0.99;
/// A pixel that lets less light through than this is finished: what is not drawn is less than a quarter of a step of
/// eight bits.
pub const FINISHED: f32 = 1.0 / 1024.0;
/// With [`super::Loop::Order`], so many splats of a pixel wait for one that may be nearer.
pub const WAITING: usize = 8;
/// Standard deviations above this are drawn as this.
pub const MAX_SCALE: f32 = 1e4;
/// What is left of a splat's opacity, at least, by the compensation for its widening.
pub const MIN_COMPENSATION: f32 = 0.005;

/// A splat on the picture: `α(x, y) = 2^(log_opacity − u² − v²)` with `(u, v)` linear in the pixel's distance to the
/// centre.
///
/// One cache line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C, align(64))]
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
    /// The pixels that it may touch.
    pub bounds: Bounds,
    /// Distance along the viewing direction, for the order of drawing. Positive and finite.
    pub depth: f32,
    /// The Gaussian's index in the input.
    pub index: u32,
}

/// A Gaussian that reaches over the near plane, where no ellipse approximates it: α is opacity·2^(−|x|²) at the point
/// nearest to its centre, in its own measure, of the part of a pixel's ray that is beyond the plane. At depth `t` on
/// the ray of pixel `(px, py)`, `x = from·(px, py, 1) + t·along·(px, py, 1)`.
///
/// Its [`Ellipse`] has forms of zeroes, and the bounds of a box around what of it lies beyond the plane.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Crossing {
    /// The Gaussian's index in the input.
    pub index: u32,
    /// Depth of the near plane.
    pub near: f32,
    /// Rows of a matrix.
    pub from: [[f32; 3]; 3],
    /// Rows of a matrix.
    pub along: [[f32; 3]; 3],
}

/// The pixels `x0 ≤ x < x1`, `y0 ≤ y < y1`. Never empty for a visible splat.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
#[allow(missing_docs)]
pub struct Bounds {
    pub x0: u32,
    pub y0: u32,
    pub x1: u32,
    pub y1: u32,
}

impl Ellipse {
    /// Whether it stands for a [`Crossing`].
    pub fn crosses(&self) -> bool {
        self.u == [0.0; 2] && self.v == [0.0; 2]
    }

    /// The bits of its fields, in their order.
    #[inline(always)]
    pub(super) fn fields(&self) -> &[f32; 16] {
        bytemuck::must_cast_ref(self)
    }
}
