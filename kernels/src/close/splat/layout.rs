//! Which blocks of a tile each ellipse reaches.

use super::block::{
    ALL_BLOCKS, AREA, BLOCKS, Block, CLEAR, COLUMNS, EffectData, IDS, ORDER, PLAIN, ROWS, SHARES, SIDE, Scene, Share,
    Splat, TILE, lane_places, rectangle,
};
use super::ellipse::Ellipse;
use super::pixels::{self, Best, Pending};
use crate::simd::{F32Vector, I32Vector, MaskVector, Simd, four, prefetch};

/// Ellipses whose blocks are laid out before they are blended, and the most blocks.
const SPLATS: usize = 32;
const ITEMS: usize = 512;
/// By so much, in powers of two, a block may be beyond an ellipse and still be looked at, for the sake of rounding.
const SLACK: f32 = 1e-3;

/// Column and row, in pixels, of the blocks of a window, counted from its first.
const BLOCK_COLUMNS: [f32; AREA] = lane_places(false, SIDE as f32, 0.0);
const BLOCK_ROWS: [f32; AREA] = lane_places(true, SIDE as f32, 0.0);
/// The number in the tile of each block of a window, less the first's.
const PLACES: [i32; AREA] = {
    let mut places = [0; AREA];
    let mut i = 0;
    while i < AREA {
        places[i] = (i as u32 / SIDE * BLOCKS + i as u32 % SIDE) as i32;
        i += 1;
    }
    places
};
/// The bits of a window of so many columns.
const WINDOW: [u64; 5] = [0, 0x0101_0101, 0x0303_0303, 0x0707_0707, 0x0f0f_0f0f];

/// Numbers in a [`Batch`].
const FORMS: usize = 9;

/// Of several ellipses, one to a lane: the form in the middle of the tile's first block; by how much it changes, at
/// most, from there to the block's outer pixels; how large its square may be, before nothing is drawn; and, as
/// integers, the first column and row of blocks that it may touch, and their ends.
#[repr(C, align(64))]
struct Batch([[f32; AREA]; FORMS]);

impl Batch {
    #[inline(always)]
    fn fill<S: Simd>(&mut self, simd: S, fields: [S::F32; 16], [left, top]: [f32; 2], floor: f32) {
        let [cx, cy, ux, uy, vx, vy, log_opacity, ..] = fields;
        let [.., x0, y0, x1, y1, _, _] = fields;
        let middle = 0.5 * (SIDE - 1) as f32;
        let dx = S::F32::splat(simd, left + 0.5 + middle) - cx;
        let dy = S::F32::splat(simd, top + 0.5 + middle) - cy;
        let half = S::F32::splat(simd, middle);
        let (zero, side) = (S::F32::splat(simd, 0.0), S::F32::splat(simd, TILE as f32));
        let inverse = S::F32::splat(simd, 1.0 / SIDE as f32);
        let within = |at: S::F32, corner: f32| {
            let at = at.to_bits().to_f32() - S::F32::splat(simd, corner);
            at.max(zero).min(side) * inverse
        };
        let forms = [
            ux.mul_add(dx, uy * dy),
            vx.mul_add(dx, vy * dy),
            (ux.abs() + uy.abs()) * half,
            (vx.abs() + vy.abs()) * half,
            log_opacity + S::F32::splat(simd, SLACK - floor),
            within(x0, left).floor().truncate_to_i32().as_f32(),
            within(y0, top).floor().truncate_to_i32().as_f32(),
            within(x1, left).ceil().truncate_to_i32().as_f32(),
            within(y1, top).ceil().truncate_to_i32().as_f32(),
        ];
        for (row, form) in self.0.iter_mut().zip(forms) {
            form.store(row);
        }
    }
}

/// What is to be blended: a list of ellipses and blocks. It is laid out and worked off in turns, because in either loop
/// nearly every branch goes the usual way, and in one for both none would.
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
    /// For loops of effects only.
    effect_data: [EffectData; SPLATS],
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
        effect_data: [EffectData {
            crossing: usize::MAX,
            depth: [0.0; 3],
            index: 0,
        }; SPLATS],
    };
}

/// The blocks of a tile, and what the loops over its splats keep.
#[derive(Debug, Clone)]
pub(super) struct Canvas {
    pub blocks: [Block; ALL_BLOCKS],
    /// The blocks, row by row, that are in the picture and still let light through.
    pub open: u64,
    pub corner: [u32; 2],
    /// `log₂` of the least α that is drawn, and it itself.
    pub floor: f32,
    pub least: f32,
    pub work: Work,
    /// For each block, with [`super::Loop::Order`].
    pub pending: Vec<Pending>,
    /// For each block, with [`super::Loop::Ids`].
    pub best: Vec<Best>,
    /// Of what was blended last, with [`super::Loop::Shares`].
    pub shares: Vec<Share>,
}

impl Canvas {
    pub const CLEAR: Canvas = Canvas {
        blocks: [CLEAR; ALL_BLOCKS],
        open: 0,
        corner: [0; 2],
        floor: 0.0,
        least: 1.0,
        work: Work::NONE,
        pending: Vec::new(),
        best: Vec::new(),
        shares: Vec::new(),
    };

    /// Blends ellipses, nearest first.
    #[inline(always)]
    pub(super) fn work_through<S: Simd, const WHAT: u8>(&mut self, simd: S, keys: &[u64], next: &[u64], scene: Scene) {
        for &key in next {
            if let Some(ellipse) = scene.all.get(numbered(key)) {
                prefetch(std::slice::from_ref(ellipse));
            }
        }
        for turn in keys.chunks(SPLATS) {
            for (i, some) in turn.chunks(S::LANES).enumerate() {
                self.lay_out::<_, WHAT>(simd, i * S::LANES, some, scene);
            }
            self.work_off::<_, WHAT>(simd, scene);
            if self.open == 0 {
                return;
            }
        }
    }

    /// Adds the blocks of at most as many ellipses as there are lanes to the work; the first is the turn's `first`.
    #[inline(always)]
    fn lay_out<S: Simd, const WHAT: u8>(&mut self, simd: S, first: usize, keys: &[u64], scene: Scene) {
        let fields = gather(simd, scene.all, keys);
        let corner = [self.corner[0] as f32, self.corner[1] as f32];
        let mut batch = Batch([[0.0; AREA]; FORMS]);
        batch.fill(simd, fields, corner, self.floor);
        for (i, &key) in keys.iter().enumerate() {
            let [x0, y0, x1, y1] = four!(k => batch.0[5 + k][i].to_bits());
            let wanted = self.open & rectangle(x0, x1, y0, y1);
            if wanted == 0 {
                continue;
            }
            let number = first + i;
            let place = numbered(key);
            let ellipse = &scene.all[place];
            let splat = &mut self.work.splats[number];
            splat.log_opacity = ellipse.log_opacity;
            splat.colour = ellipse.colour;
            if WHAT != PLAIN {
                self.work.effect_data[number] = effect_data::<WHAT>(ellipse, place, corner, scene);
            }
            let ([ux, uy], [vx, vy]) = (ellipse.u, ellipse.v);
            let lanes_u = [S::F32::splat(simd, ux), S::F32::splat(simd, uy)];
            let lanes_v = [S::F32::splat(simd, vx), S::F32::splat(simd, vy)];
            for part in 0..AREA / S::LANES {
                let lanes = part * S::LANES;
                let (column, row) = (
                    S::F32::load(simd, &COLUMNS[lanes..]),
                    S::F32::load(simd, &ROWS[lanes..]),
                );
                let steps = column.mul_add(lanes_u[0], row * lanes_u[1]);
                steps.store(&mut splat.u[lanes..]);
                let steps = column.mul_add(lanes_v[0], row * lanes_v[1]);
                steps.store(&mut splat.v[lanes..]);
            }
            let [u, v, half_u, half_v] = four!(k => batch.0[k][i]);
            let reach = batch.0[4][i];
            let (half_u, half_v) = (S::F32::splat(simd, half_u), S::F32::splat(simd, half_v));
            let reach = S::F32::splat(simd, reach);
            let mut y = y0;
            while y < y1 {
                let mut x = x0;
                while x < x1 {
                    // A window: the form in the middle of each of its blocks …
                    let (px, py) = ((SIDE * x) as i32 as f32, (SIDE * y) as i32 as f32);
                    let at_u = S::F32::splat(simd, u + (ux * px + uy * py));
                    let at_v = S::F32::splat(simd, v + (vx * px + vy * py));
                    let place = y * BLOCKS + x;
                    let wanted = wanted >> place & WINDOW[(BLOCKS - x).min(SIDE) as usize];
                    let wanted = packed(wanted);
                    for part in 0..AREA / S::LANES {
                        let lanes = part * S::LANES;
                        let column = S::F32::load(simd, &BLOCK_COLUMNS[lanes..]);
                        let row = S::F32::load(simd, &BLOCK_ROWS[lanes..]);
                        let bu = column.mul_add(lanes_u[0], row.mul_add(lanes_u[1], at_u));
                        let bv = column.mul_add(lanes_v[0], row.mul_add(lanes_v[1], at_v));
                        // … and the least that it can be anywhere in the block.
                        let zero = S::F32::splat(simd, 0.0);
                        let least_u = (bu.abs() - half_u).max(zero);
                        let least_v = (bv.abs() - half_v).max(zero);
                        let least = least_u.mul_add(least_u, least_v * least_v);
                        let which = least.le(reach).bits() & wanted >> lanes;

                        let work = &mut self.work;
                        let at = work.items;
                        bu.compress(which).store(&mut work.u[at..]);
                        bv.compress(which).store(&mut work.v[at..]);
                        let place = S::I32::splat(simd, ((number as u32) << 8 | place) as i32);
                        let place = (S::I32::load(simd, &PLACES[lanes..]) + place).as_f32();
                        place.compress(which).store(&mut work.place[at..]);
                        work.items += which.count_ones() as usize;
                    }
                    if self.work.items > ITEMS - 2 * AREA {
                        self.work_off::<_, WHAT>(simd, scene);
                    }
                    x += SIDE;
                }
                y += SIDE;
            }
        }
    }

    /// Blends what has been laid out.
    #[inline(always)]
    fn work_off<S: Simd, const WHAT: u8>(&mut self, simd: S, scene: Scene) {
        let work = &self.work;
        let items = work.items.min(ITEMS);
        let lists = work.u[..items].iter().zip(&work.v[..items]);
        for ((&u, &v), &place) in lists.zip(&work.place[..items]) {
            let place = place.to_bits() as usize;
            let number = (place >> 8) % SPLATS;
            let place = place % ALL_BLOCKS;
            let (splat, block) = (&work.splats[number], &mut self.blocks[place]);
            let open = if WHAT == PLAIN {
                pixels::blend(simd, block, splat, [u, v])
            } else {
                let data = &work.effect_data[number];
                let (x, y) = (SIDE * (place as u32 % BLOCKS), SIDE * (place as u32 / BLOCKS));
                let at = [x, y];
                let crossing = scene.crossing.get(data.crossing);
                match WHAT {
                    ORDER => {
                        let pending = &mut self.pending[place];
                        let corner = self.corner;
                        pending.add(simd, block, splat, [u, v], data, at, corner, crossing, self.least)
                    }
                    IDS | SHARES => {
                        let form = [u, v];
                        let weights = pixels::weigh(simd, block, splat, form, at, self.corner, crossing);
                        let index = data.index;
                        match weights {
                            Some(weights) if WHAT == IDS => {
                                self.best[place].note(simd, &weights, index);
                            }
                            Some(weights) => self.shares.push(Share { index, at, weights }),
                            None => {}
                        }
                        weights.is_some()
                    }
                    _ => match crossing {
                        Some(crossing) => pixels::cross(simd, block, splat, at, self.corner, crossing),
                        None => pixels::blend(simd, block, splat, [u, v]),
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

/// The ellipse that a key numbers.
#[inline(always)]
fn numbered(key: u64) -> usize {
    key as u32 as usize
}

/// Field `k` of the ellipse that key `i` numbers in lane `i` of vector `k`. Where there are fewer keys than lanes,
/// those of the last.
#[inline(always)]
fn gather<S: Simd>(simd: S, all: &[Ellipse], keys: &[u64]) -> [S::F32; 16] {
    let mut records = [&[0.0; 16]; 16];
    let mut lane = 0;
    while lane < S::LANES {
        records[lane] = all[numbered(keys[lane.min(keys.len() - 1)])].fields();
        lane += 1;
    }
    S::F32::load_records(simd, &records)
}

/// What the loop needs to know of an ellipse besides.
#[inline(always)]
fn effect_data<const WHAT: u8>(ellipse: &Ellipse, place: usize, corner: [f32; 2], scene: Scene) -> EffectData {
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
    EffectData {
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
