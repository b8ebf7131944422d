//! The pixels of one tile, front to back.
//!
//! For each ellipse in order: `α = min(0.99, opacity·exp(−½d²))`; below 1/255 it is skipped; a pixel whose transmittance `T` is below
//! 10⁻⁴ is finished. Otherwise `w = α·T`, the colour gains `w·colour` and `T` loses `w`: subtracting the same rounded `w` that was
//! added keeps the weights' sum at 1 to a few units in the last place, however many layers there are.
//!
//! Splats are a few pixels wide, so a tile is cut into blocks of 4×4 pixels. For each splat, the blocks that its ellipse reaches are
//! found all at once, a block to a lane, and of these the ones that still let light through are blended, a pixel to a lane.

use super::lanes::{Lanes, Mask, by_level, four};
use super::{ALPHA_CEILING, Ellipse, FINISHED, LOG_FLOOR};
use crate::Isa;
use crate::isa::dispatch;

/// Side of a tile in pixels.
pub const TILE: u32 = 32;

/// Side of a block in pixels, and of a window in blocks.
const SIDE: u32 = 4;
/// Pixels of a block, and blocks of a window.
const AREA: usize = 16;
/// Blocks side by side in a tile.
const BLOCKS: u32 = TILE / SIDE;
/// Ellipses whose blocks are laid out before they are blended, and the most blocks.
const SPLATS: usize = 32;
const ITEMS: usize = 512;
/// By so much, in powers of two, a block may be beyond an ellipse and still be looked at, for the sake of rounding.
const SLACK: f32 = 1e-3;

/// Column and row of the pixels of a block, counted from its middle.
const COLUMNS: [f32; AREA] = lane_places(false, 1.0, 1.5);
const ROWS: [f32; AREA] = lane_places(true, 1.0, 1.5);
/// Column and row, in pixels, of the blocks of a window, counted from its first.
const BLOCK_COLUMNS: [f32; AREA] = lane_places(false, SIDE as f32, 0.0);
const BLOCK_ROWS: [f32; AREA] = lane_places(true, SIDE as f32, 0.0);
/// The number in the tile of each block of a window, less the first's.
const PLACES: [f32; AREA] = {
    let mut places = [0.0; AREA];
    let mut i = 0;
    while i < AREA {
        places[i] = f32::from_bits(i as u32 / SIDE * BLOCKS + i as u32 % SIDE);
        i += 1;
    }
    places
};
/// The bits of a window of so many columns.
const WINDOW: [u64; 5] = [0, 0x0101_0101, 0x0303_0303, 0x0707_0707, 0x0f0f_0f0f];

const fn lane_places(row: bool, step: f32, middle: f32) -> [f32; AREA] {
    let mut places = [0.0; AREA];
    let mut i = 0;
    while i < AREA {
        let place = if row {
            i / SIDE as usize
        } else {
            i % SIDE as usize
        };
        places[i] = place as f32 * step - middle;
        i += 1;
    }
    places
}

/// 4×4 pixels.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Block {
    /// Transmittance: the share of what lies behind that is still seen.
    through: [f32; AREA],
    /// Red, green and blue so far.
    colour: [[f32; AREA]; 3],
}

const CLEAR: Block = Block {
    through: [1.0; AREA],
    colour: [[0.0; AREA]; 3],
};

/// A tile being drawn: [`TILE`]² pixels.
#[derive(Debug, Clone)]
pub struct Tile {
    blocks: [Block; (BLOCKS * BLOCKS) as usize],
    /// The blocks, row by row, that are in the picture and still let light through.
    open: u64,
    corner: [u32; 2],
    work: Work,
}

impl Default for Tile {
    fn default() -> Self {
        Tile {
            blocks: [CLEAR; (BLOCKS * BLOCKS) as usize],
            open: 0,
            corner: [0; 2],
            work: Work {
                u: [0.0; ITEMS],
                v: [0.0; ITEMS],
                place: [0.0; ITEMS],
                items: 0,
                splats: [Splat {
                    u: [0.0; AREA],
                    v: [0.0; AREA],
                    log_opacity: 0.0,
                    colour: [0.0; 3],
                }; SPLATS],
            },
        }
    }
}

impl Tile {
    /// Clears it and puts its first pixel at `corner` of a picture of `size`.
    ///
    /// # Panics
    /// If the corner is outside the picture.
    pub fn start(&mut self, corner: [u32; 2], size: [u32; 2]) {
        assert!(corner[0] < size[0] && corner[1] < size[1]);
        self.blocks.fill(CLEAR);
        self.corner = corner;
        self.work.items = 0;
        let [columns, rows] = [0, 1].map(|k| (size[k] - corner[k]).min(TILE).div_ceil(SIDE));
        self.open = rectangle(0, columns, 0, rows);
    }

    /// Blends ellipses, nearest first: those of `all` that the lower halves of `keys` number. False once every pixel is finished.
    /// `next`: what will probably be blended after these, to be fetched already.
    ///
    /// # Panics
    /// If there is no such ellipse.
    pub fn blend(&mut self, isa: Isa, keys: &[u64], next: &[u64], all: &[Ellipse]) -> bool {
        let tile = &mut *self;
        if tile.open != 0 {
            by_level!(isa, fn body(tile: &mut Tile, keys: &[u64], next: &[u64], all: &[Ellipse]));
        }
        self.open != 0
    }

    /// Writes the tile's pixels into `rows`, whose first is the tile's first and of which each is `stride` pixels long: premultiplied
    /// colour and transmittance, of which each channel takes `behind` times the transmittance and alpha one more. How many of them
    /// something was drawn on.
    ///
    /// # Panics
    /// If `rows` do not hold the part of the tile, `width` wide, that they begin.
    pub fn write(
        &self,
        isa: Isa,
        behind: [f32; 4],
        rows: &mut [[f32; 4]],
        stride: usize,
        width: usize,
    ) -> u32 {
        let (tile, mut drawn) = (self, 0);
        let count = &mut drawn;
        dispatch!(isa, fn write(tile: &Tile, behind: [f32; 4], rows: &mut [[f32; 4]], stride: usize, width: usize, count: &mut u32));
        drawn
    }
}

#[inline(always)]
fn write(
    tile: &Tile,
    behind: [f32; 4],
    rows: &mut [[f32; 4]],
    stride: usize,
    width: usize,
    count: &mut u32,
) {
    let side = SIDE as usize;
    for (y, row) in rows.chunks_mut(stride).take(TILE as usize).enumerate() {
        let blocks = &tile.blocks[y / side * BLOCKS as usize..][..BLOCKS as usize];
        let lanes = y % side * side;
        for (block, pixels) in blocks.iter().zip(row[..width].chunks_mut(side)) {
            let part = |from: &[f32; AREA]| -> [f32; SIDE as usize] {
                std::array::from_fn(|i| from[lanes + i])
            };
            let through = part(&block.through);
            let [r, g, b] = [0, 1, 2].map(|k| part(&block.colour[k]));
            let mixed: [[f32; 4]; SIDE as usize] = std::array::from_fn(|i| {
                let t = through[i];
                [
                    r[i] + t * behind[0],
                    g[i] + t * behind[1],
                    b[i] + t * behind[2],
                    1.0 + t * behind[3],
                ]
            });
            *count += through.iter().map(|&t| u32::from(t < 1.0)).sum::<u32>();
            match <&mut [[f32; 4]; SIDE as usize]>::try_from(&mut *pixels) {
                Ok(pixels) => *pixels = mixed,
                Err(_) => pixels.copy_from_slice(&mixed[..pixels.len()]),
            }
        }
    }
}

/// The bits of the blocks in the columns `x0..x1` and the rows `y0..y1`.
#[inline(always)]
fn rectangle(x0: u32, x1: u32, y0: u32, y1: u32) -> u64 {
    if x0 >= x1 || y0 >= y1 {
        return 0;
    }
    let row = (0xff >> (BLOCKS - (x1 - x0))) << x0;
    let rows = (!0 >> (BLOCKS * (BLOCKS - (y1 - y0)))) << (BLOCKS * y0);
    (row * 0x0101_0101_0101_0101) & rows
}

#[inline(always)]
fn body<L: Lanes>(tile: &mut Tile, keys: &[u64], next: &[u64], all: &[Ellipse]) {
    prefetch(all, next);
    for turn in keys.chunks(SPLATS) {
        for (i, some) in turn.chunks(L::COUNT).enumerate() {
            tile.lay_out::<L>(i * L::COUNT, some, all);
        }
        tile.work_off::<L>();
        if tile.open == 0 {
            return;
        }
    }
}

/// Asks for the ellipses that the lower halves of `keys` number.
#[inline(always)]
fn prefetch(all: &[Ellipse], keys: &[u64]) {
    #[cfg(target_arch = "x86_64")]
    for &key in keys {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let ellipse = all.as_ptr().wrapping_add(key as u32 as usize);
        // SAFETY: a hint: no address is wrong.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(ellipse.cast()) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (all, keys);
}

/// Numbers in a [`Batch`].
const FORMS: usize = 9;

/// Of several ellipses, one to a lane: the form in the middle of the tile's first block; by how much it changes, at most, from there
/// to the block's outer pixels; how large its square may be, before nothing is drawn; and, as integers, the first column and row of
/// blocks that it may touch, and their ends.
#[repr(C, align(64))]
struct Batch([[f32; AREA]; FORMS]);

impl Batch {
    #[inline(always)]
    fn fill<L: Lanes>(&mut self, fields: [L; 16], [left, top]: [f32; 2]) {
        let [cx, cy, ux, uy, vx, vy, log_opacity, ..] = fields;
        let [.., x0, y0, x1, y1, _, _] = fields;
        let middle = 0.5 * (SIDE - 1) as f32;
        let dx = L::splat(left + 0.5 + middle).sub(cx);
        let dy = L::splat(top + 0.5 + middle).sub(cy);
        let half = L::splat(middle);
        let (zero, side) = (L::splat(0.0), L::splat(TILE as f32));
        let inverse = L::splat(1.0 / SIDE as f32);
        let within = |at: L, corner: f32| {
            let at = at.to_float().sub(L::splat(corner));
            at.max(zero).min(side).mul(inverse)
        };
        let forms = [
            ux.mul_add(dx, uy.mul(dy)),
            vx.mul_add(dx, vy.mul(dy)),
            ux.abs().add(uy.abs()).mul(half),
            vx.abs().add(vy.abs()).mul(half),
            log_opacity.add(L::splat(SLACK - LOG_FLOOR)),
            within(x0, left).floor().to_integer(),
            within(y0, top).floor().to_integer(),
            within(x1, left).ceil().to_integer(),
            within(y1, top).ceil().to_integer(),
        ];
        for (row, form) in self.0.iter_mut().zip(forms) {
            form.store(row);
        }
    }
}

/// What is to be blended: a list of ellipses and blocks. It is laid out and worked off in turns, because in either loop nearly every
/// branch goes the usual way, and in one for both none would.
#[derive(Debug, Clone)]
#[repr(C, align(64))]
struct Work {
    /// The form in the middle of the block.
    u: [f32; ITEMS],
    v: [f32; ITEMS],
    /// The ellipse above, the block in the lowest 8 bits.
    place: [f32; ITEMS],
    items: usize,
    splats: [Splat; SPLATS],
}

/// What all blocks of an ellipse share.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
struct Splat {
    /// The form at the pixels of a block, less what it is in the middle.
    u: [f32; AREA],
    v: [f32; AREA],
    log_opacity: f32,
    colour: [f32; 3],
}

impl Tile {
    /// Adds the blocks of at most as many ellipses as there are lanes to the work; the first is the turn's `first`.
    #[inline(always)]
    fn lay_out<L: Lanes>(&mut self, first: usize, keys: &[u64], all: &[Ellipse]) {
        let fields = L::gather(all, keys);
        let corner = [self.corner[0] as f32, self.corner[1] as f32];
        let mut batch = Batch([[0.0; AREA]; FORMS]);
        batch.fill(fields, corner);
        for (i, &key) in keys.iter().enumerate() {
            let [x0, y0, x1, y1] = four!(k => batch.0[5 + k][i].to_bits());
            let wanted = self.open & rectangle(x0, x1, y0, y1);
            if wanted == 0 {
                continue;
            }
            let number = first + i;
            let ellipse = &all[key as u32 as usize];
            let splat = &mut self.work.splats[number];
            splat.log_opacity = ellipse.log_opacity;
            splat.colour = ellipse.colour;
            let ([ux, uy], [vx, vy]) = (ellipse.u, ellipse.v);
            let lanes_u = [L::splat(ux), L::splat(uy)];
            let lanes_v = [L::splat(vx), L::splat(vy)];
            for part in 0..AREA / L::COUNT {
                let lanes = part * L::COUNT;
                let (column, row) = (L::load(&COLUMNS[lanes..]), L::load(&ROWS[lanes..]));
                let steps = column.mul_add(lanes_u[0], row.mul(lanes_u[1]));
                steps.store(&mut splat.u[lanes..]);
                let steps = column.mul_add(lanes_v[0], row.mul(lanes_v[1]));
                steps.store(&mut splat.v[lanes..]);
            }
            let [u, v, half_u, half_v] = four!(k => batch.0[k][i]);
            let reach = batch.0[4][i];
            let (half_u, half_v) = (L::splat(half_u), L::splat(half_v));
            let reach = L::splat(reach);
            let mut y = y0;
            while y < y1 {
                let mut x = x0;
                while x < x1 {
                    // A window: the form in the middle of each of its blocks …
                    let (px, py) = ((SIDE * x) as i32 as f32, (SIDE * y) as i32 as f32);
                    let at_u = L::splat(u + (ux * px + uy * py));
                    let at_v = L::splat(v + (vx * px + vy * py));
                    let place = y * BLOCKS + x;
                    let wanted = wanted >> place & WINDOW[(BLOCKS - x).min(SIDE) as usize];
                    let wanted = packed(wanted);
                    for part in 0..AREA / L::COUNT {
                        let lanes = part * L::COUNT;
                        let column = L::load(&BLOCK_COLUMNS[lanes..]);
                        let row = L::load(&BLOCK_ROWS[lanes..]);
                        let bu = column.mul_add(lanes_u[0], row.mul_add(lanes_u[1], at_u));
                        let bv = column.mul_add(lanes_v[0], row.mul_add(lanes_v[1], at_v));
                        // … and the least that it can be anywhere in the block.
                        let zero = L::splat(0.0);
                        let least_u = bu.abs().sub(half_u).max(zero);
                        let least_v = bv.abs().sub(half_v).max(zero);
                        let least = least_u.mul_add(least_u, least_v.mul(least_v));
                        let which = least.le(reach).bits() & wanted >> lanes;

                        let work = &mut self.work;
                        let at = work.items;
                        bu.compress(which).store(&mut work.u[at..]);
                        bv.compress(which).store(&mut work.v[at..]);
                        let place = L::splat(f32::from_bits((number as u32) << 8 | place));
                        let place = L::load(&PLACES[lanes..]).add_integer(place);
                        place.compress(which).store(&mut work.place[at..]);
                        work.items += which.count_ones() as usize;
                    }
                    if self.work.items > ITEMS - 2 * AREA {
                        self.work_off::<L>();
                    }
                    x += SIDE;
                }
                y += SIDE;
            }
        }
    }

    /// Blends what has been laid out.
    #[inline(always)]
    fn work_off<L: Lanes>(&mut self) {
        let work = &self.work;
        let items = work.items.min(ITEMS);
        let lists = work.u[..items].iter().zip(&work.v[..items]);
        for ((&u, &v), &place) in lists.zip(&work.place[..items]) {
            let place = place.to_bits() as usize;
            let splat = &work.splats[(place >> 8) % SPLATS];
            let block = &mut self.blocks[place % (BLOCKS * BLOCKS) as usize];
            if !blend::<L>(block, splat, [u, v]) {
                self.open &= !(1 << (place % (BLOCKS * BLOCKS) as usize));
            }
        }
        self.work.items = 0;
    }
}

/// Of the bits of a window, eight a row, four a row.
#[inline(always)]
fn packed(bits: u64) -> u32 {
    let bits = bits as u32;
    let bits = (bits | bits >> 4) & 0x00ff_00ff;
    (bits | bits >> 8) & 0xffff
}

/// `u`, `v`: the form in the middle of the block. False, and nothing done, if every pixel is finished.
#[inline(always)]
fn blend<L: Lanes>(block: &mut Block, splat: &Splat, [u, v]: [f32; 2]) -> bool {
    let mut open = 0;
    for part in 0..AREA / L::COUNT {
        let lanes = part * L::COUNT;
        let through = L::load(&block.through[lanes..]);
        let unfinished = L::splat(FINISHED).le(through);
        open |= unfinished.bits();
        let u = L::load(&splat.u[lanes..]).add(L::splat(u));
        let v = L::load(&splat.v[lanes..]).add(L::splat(v));
        let power = v.neg_mul_add(v, u.neg_mul_add(u, L::splat(splat.log_opacity)));
        let drawn = L::splat(LOG_FLOOR).le(power).and(unfinished);
        let alpha = power.exp2().min(L::splat(ALPHA_CEILING));
        let weight = alpha.mul(through).keep(drawn);
        through.sub(weight).store(&mut block.through[lanes..]);
        for (sums, colour) in block.colour.iter_mut().zip(splat.colour) {
            let sum = L::load(&sums[lanes..]);
            weight
                .mul_add(L::splat(colour), sum)
                .store(&mut sums[lanes..]);
        }
    }
    open != 0
}
