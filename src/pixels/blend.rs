//! The pixels of one tile, front to back.
//!
//! For each ellipse in order: `α = min(0.99, opacity·exp(−½d²))`; below 1/255 it is skipped; a pixel whose transmittance `T` is below
//! 10⁻⁴ is finished. Otherwise `w = α·T`, the colour gains `w·colour` and `T` loses `w`: subtracting the same rounded `w` that was
//! added keeps the weights' sum at 1 to a few units in the last place, however many layers there are.

use super::exp2::exp2;
use crate::projection::{ALPHA_FLOOR, Bounds, Ellipse, Ellipses};
use crate::tiles::TILE;

/// The greatest α of one ellipse.
pub(super) const ALPHA_CEILING: f32 = 0.99;
/// A pixel that lets less light through than this is finished.
pub(super) const FINISHED: f32 = 1e-4;

/// Pixels side by side that are blended together.
const LANES: usize = 4;
const SIDE: usize = TILE as usize;
const QUADS: usize = SIDE / LANES;
/// Ellipses between two looks at whether the whole tile is finished.
const PATIENCE: usize = 16;

/// A few pixels of a row: exactly one cache line.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Quad {
    /// Transmittance: the share of what lies behind that is still seen.
    through: [f32; LANES],
    /// Red, green and blue so far.
    colour: [[f32; LANES]; 3],
}

/// A tile being drawn.
pub(super) struct Tile {
    quads: [[Quad; QUADS]; SIDE],
}

impl Tile {
    /// Nothing drawn yet.
    pub(super) fn new() -> Self {
        let clear = Quad {
            through: [1.0; LANES],
            colour: [[0.0; LANES]; 3],
        };
        Tile {
            quads: [[clear; QUADS]; SIDE],
        }
    }

    /// Blends the ellipses `ids`, nearest first, into the tile whose first pixel is `corner`.
    pub(super) fn blend(&mut self, corner: [u32; 2], ids: &[u32], ellipses: &Ellipses) {
        for some in ids.chunks(PATIENCE) {
            for &id in some {
                let bounds = &ellipses.bounds[id as usize];
                self.blend_one(corner, bounds, &ellipses.shape[id as usize]);
            }
            if self.finished() {
                return;
            }
        }
    }

    fn blend_one(&mut self, [left, top]: [u32; 2], bounds: &Bounds, ellipse: &Ellipse) {
        let rows = bounds.y0.max(top) - top..bounds.y1.min(top + TILE) - top;
        let first = (bounds.x0.max(left) - left) as usize / LANES;
        let end = ((bounds.x1.min(left + TILE) - left) as usize).div_ceil(LANES);
        let dx = left as f32 + 0.5 - ellipse.centre[0];
        for row in rows {
            let dy = (top + row) as f32 + 0.5 - ellipse.centre[1];
            let u = ellipse.u[0] * dx + ellipse.u[1] * dy;
            let v = ellipse.v[0] * dx + ellipse.v[1] * dy;
            blend_row(&mut self.quads[row as usize], ellipse, [u, v], first..end);
        }
    }

    fn finished(&self) -> bool {
        self.quads
            .as_flattened()
            .iter()
            .all(|quad| quad.through.iter().all(|&t| t < FINISHED))
    }

    /// Premultiplied red, green, blue, and the transmittance, of the pixel at column `x` and row `y` of the tile.
    pub(super) fn pixel(&self, x: usize, y: usize) -> [f32; 4] {
        let (quad, lane) = (&self.quads[y][x / LANES], x % LANES);
        let [r, g, b] = quad.colour.map(|c| c[lane]);
        [r, g, b, quad.through[lane]]
    }
}

/// Blends an ellipse into the quads `which` of a row; `u`, `v` is the form at the row's first pixel.
///
/// The quads are written out one by one because the compiler then makes four lanes of each quad's pixels; it would make four lanes
/// of a loop's quads, and gather.
#[inline(never)]
fn blend_row(
    row: &mut [Quad; QUADS],
    ellipse: &Ellipse,
    [u, v]: [f32; 2],
    which: std::ops::Range<usize>,
) {
    let [a, b, c, d] = row;
    if which.contains(&0) {
        a.blend(ellipse, u, v, 0);
    }
    if which.contains(&1) {
        b.blend(ellipse, u, v, LANES);
    }
    if which.contains(&2) {
        c.blend(ellipse, u, v, 2 * LANES);
    }
    if which.contains(&3) {
        d.blend(ellipse, u, v, 3 * LANES);
    }
}

impl Quad {
    /// `x`: the quad's first pixel, counted from where the form is `u`, `v`.
    #[inline(always)]
    fn blend(&mut self, ellipse: &Ellipse, u: f32, v: f32, x: usize) {
        let weight: [f32; LANES] = std::array::from_fn(|i| {
            let u = u + ellipse.u[0] * (x + i) as f32;
            let v = v + ellipse.v[0] * (x + i) as f32;
            let alpha = exp2(ellipse.log_opacity - (u * u + v * v));
            let through = self.through[i];
            let drawn = (alpha >= ALPHA_FLOOR) & (through >= FINISHED);
            let ceiled = if alpha < ALPHA_CEILING {
                alpha
            } else {
                ALPHA_CEILING
            };
            if drawn { ceiled * through } else { 0.0 }
        });
        for (through, weight) in self.through.iter_mut().zip(weight) {
            *through -= weight;
        }
        for (sums, colour) in self.colour.iter_mut().zip(ellipse.colour) {
            for (sum, weight) in sums.iter_mut().zip(weight) {
                *sum += weight * colour;
            }
        }
    }
}
