//! Which blocks of a tile each ellipse reaches.

use super::Ellipse;
use super::blend::{ALL_BLOCKS, AREA, BLOCKS, IDS, ORDER, PLAIN, SHARES, SIDE, Scene, Share, TILE, Tile, rectangle};
use super::lanes::{Lanes, Mask, four};
use super::pixels;

/// Ellipses whose blocks are laid out before they are blended, and the most blocks.
const SPLATS: usize = 32;
const ITEMS: usize = 512;
/// By so much, in powers of two, a block may be beyond an ellipse and still be looked at, for the sake of rounding.
const SLACK: f32 = 1e-3;

/// Column and row of the pixels of a block, counted from its middle.
pub(super) const COLUMNS: [f32; AREA] = lane_places(false, 1.0, 1.5);
pub(super) const ROWS: [f32; AREA] = lane_places(true, 1.0, 1.5);
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
        let place = if row { i / SIDE as usize } else { i % SIDE as usize };
        places[i] = place as f32 * step - middle;
        i += 1;
    }
    places
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
    fn fill<L: Lanes>(&mut self, fields: [L; 16], [left, top]: [f32; 2], floor: f32) {
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
            log_opacity.add(L::splat(SLACK - floor)),
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
pub(super) struct Work {
    /// The form in the middle of the block.
    u: [f32; ITEMS],
    v: [f32; ITEMS],
    /// The ellipse above, the block in the lowest 8 bits.
    place: [f32; ITEMS],
    pub items: usize,
    splats: [Splat; SPLATS],
    /// Where effects call for more of a splat.
    more: [More; SPLATS],
}

/// What all blocks of an ellipse share.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(super) struct Splat {
    /// The form at the pixels of a block, less what it is in the middle.
    pub u: [f32; AREA],
    pub v: [f32; AREA],
    pub log_opacity: f32,
    pub colour: [f32; 3],
}

/// What the loops of effects know of an ellipse besides.
#[derive(Debug, Clone, Copy)]
pub(super) struct More {
    /// Its place among the [`super::Crossing`], or [`usize::MAX`].
    pub crossing: usize,
    /// Depth at the tile's first pixel's corner, and its change by pixel to the right and down.
    pub depth: [f32; 3],
    /// The Gaussian's index in the input.
    pub index: u32,
}

impl Work {
    pub const NONE: Work = Work {
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
        more: [More {
            crossing: usize::MAX,
            depth: [0.0; 3],
            index: 0,
        }; SPLATS],
    };
}

impl Tile {
    /// Blends ellipses, nearest first.
    #[inline(always)]
    pub(super) fn work_through<L: Lanes, const WHAT: u8>(&mut self, keys: &[u64], next: &[u64], scene: Scene) {
        prefetch(scene.all, next);
        for turn in keys.chunks(SPLATS) {
            for (i, some) in turn.chunks(L::COUNT).enumerate() {
                self.lay_out::<L, WHAT>(i * L::COUNT, some, scene);
            }
            self.work_off::<L, WHAT>(scene);
            if self.open == 0 {
                return;
            }
        }
    }

    /// Adds the blocks of at most as many ellipses as there are lanes to the work; the first is the turn's `first`.
    #[inline(always)]
    fn lay_out<L: Lanes, const WHAT: u8>(&mut self, first: usize, keys: &[u64], scene: Scene) {
        let fields = L::gather(scene.all, keys);
        let corner = [self.corner[0] as f32, self.corner[1] as f32];
        let mut batch = Batch([[0.0; AREA]; FORMS]);
        batch.fill(fields, corner, self.floor);
        for (i, &key) in keys.iter().enumerate() {
            let [x0, y0, x1, y1] = four!(k => batch.0[5 + k][i].to_bits());
            let wanted = self.open & rectangle(x0, x1, y0, y1);
            if wanted == 0 {
                continue;
            }
            let number = first + i;
            let place = key as u32 as usize;
            let ellipse = &scene.all[place];
            let splat = &mut self.work.splats[number];
            splat.log_opacity = ellipse.log_opacity;
            splat.colour = ellipse.colour;
            if WHAT != PLAIN {
                self.work.more[number] = more::<WHAT>(ellipse, place, corner, scene);
            }
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
                        self.work_off::<L, WHAT>(scene);
                    }
                    x += SIDE;
                }
                y += SIDE;
            }
        }
    }

    /// Blends what has been laid out.
    #[inline(always)]
    fn work_off<L: Lanes, const WHAT: u8>(&mut self, scene: Scene) {
        let work = &self.work;
        let items = work.items.min(ITEMS);
        let lists = work.u[..items].iter().zip(&work.v[..items]);
        for ((&u, &v), &place) in lists.zip(&work.place[..items]) {
            let place = place.to_bits() as usize;
            let number = (place >> 8) % SPLATS;
            let place = place % ALL_BLOCKS;
            let (splat, block) = (&work.splats[number], &mut self.blocks[place]);
            let open = if WHAT == PLAIN {
                pixels::blend::<L>(block, splat, [u, v])
            } else {
                let more = &work.more[number];
                let (x, y) = (SIDE * (place as u32 % BLOCKS), SIDE * (place as u32 / BLOCKS));
                let at = [x, y];
                let crossing = scene.crossing.get(more.crossing);
                match WHAT {
                    ORDER => {
                        let pending = &mut self.pending[place];
                        let corner = self.corner;
                        pending.add::<L>(block, splat, [u, v], more, at, corner, crossing, self.least)
                    }
                    IDS | SHARES => {
                        let form = [u, v];
                        let weights = pixels::weigh::<L>(block, splat, form, at, self.corner, crossing);
                        let index = more.index;
                        match weights {
                            Some(weights) if WHAT == IDS => {
                                self.best[place].note::<L>(&weights, index);
                            }
                            Some(weights) => self.shares.push(Share { index, at, weights }),
                            None => {}
                        }
                        weights.is_some()
                    }
                    _ => match crossing {
                        Some(crossing) => pixels::cross::<L>(block, splat, at, self.corner, crossing),
                        None => pixels::blend::<L>(block, splat, [u, v]),
                    },
                }
            };
            if !open {
                self.open &= !(1 << place);
            }
        }
        self.work.items = 0;
    }
}

/// What the loop needs to know of an ellipse besides.
#[inline(always)]
fn more<const WHAT: u8>(ellipse: &Ellipse, place: usize, corner: [f32; 2], scene: Scene) -> More {
    let mut crossing = usize::MAX;
    if ellipse.crosses() {
        let found = scene.crossing.binary_search_by_key(&ellipse.index, |c| c.index);
        crossing = found.unwrap_or(usize::MAX);
    }
    let depth = if WHAT == ORDER {
        let [right, down] = scene.slopes[place];
        let [x, y] = ellipse.centre;
        let at = ellipse.depth + right * (corner[0] - x) + down * (corner[1] - y);
        [at, right, down]
    } else {
        [0.0; 3]
    };
    More {
        crossing,
        depth,
        index: ellipse.index,
    }
}

/// Of the bits of a window, eight a row, four a row.
#[inline(always)]
fn packed(bits: u64) -> u32 {
    let bits = bits as u32;
    let bits = (bits | bits >> 4) & 0x00ff_00ff;
    (bits | bits >> 8) & 0xffff
}
