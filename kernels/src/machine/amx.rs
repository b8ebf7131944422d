//! AMX: tiles of 16 rows by 64 bytes, multiplied and summed in 32 bits.
//!
//! Tiles multiply bytes, so numbers of up to 13 bits are cut into two digits, `x = 64·high + low`, each of a signed byte. Three products
//! of digits make one of numbers: `high·high`, `low·low`, and what the two mixed ones add up to. With few input channels, both digits of
//! a row lie in one tile row, and the mixed products are one multiplication; with many, `(high + low)·(high + low)` contains them
//! (Karatsuba). All is added modulo 2³², as everywhere, so sums are equal to the bit.

use std::arch::asm;
use std::arch::x86_64::*;

use crate::plan::{GROUP, PlanTile};
use crate::rows::{Extents, Lanes, PANEL};

/// The largest magnitude whose digits, and their sum, are signed bytes.
const REACH: i16 = 4095;
/// Bytes of a tile row.
const LINE: usize = 64;
/// [`Lanes`] of a tile.
const TILE: usize = 16;
/// Input channels whose two digits fit into a tile row.
const NARROW: usize = 32;

/// A layer's weights in tiles.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    extents: Extents,
    scheme: Scheme,
    /// `[pass][tap][chunk][column]` tiles: four input bytes of one output channel are a word.
    tiles: Vec<Lanes>,
}

/// How products are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scheme {
    /// Both digits in one tile row; three columns of tiles for a panel: high·high, low·low, mixed.
    Together,
    /// High digits, low ones and their sums in three passes of a tile row each 64 channels.
    Apart,
}

impl Scheme {
    /// Passes over a group's rows, each of its own tile rows.
    fn passes(self) -> usize {
        match self {
            Scheme::Together => 1,
            Scheme::Apart => 3,
        }
    }
}

impl Weights {
    /// Cuts the weights, which `weight(tap, input, output)` tells, into digits; nothing, if one is too large for that.
    pub fn new(
        extents: Extents,
        weight: impl Fn(usize, usize, usize) -> i16,
    ) -> Option<Weights> {
        let scheme = match extents.cin {
            ..=NARROW => Scheme::Together,
            _ => Scheme::Apart,
        };
        let mut packed = Weights {
            extents,
            scheme,
            tiles: Vec::new(),
        };
        let panels = extents.panels();
        let (chunks, columns) = (packed.chunks(), packed.columns());
        let tiles = scheme.passes() * extents.volume * chunks * columns;
        packed.tiles.resize(tiles * TILE, Lanes::default());
        for (tap, channel, out) in extents.each() {
            let w = weight(tap, channel, out);
            if w.unsigned_abs() > REACH.unsigned_abs() {
                return None;
            }
            let ((high, low), (panel, lane)) = (digits(w), (out / PANEL, out % PANEL));
            let mut put = |pass: usize, column: usize, place: usize, digit: i8| {
                let (chunk, byte) = (place / LINE, place % LINE);
                let tap = pass * extents.volume + tap;
                let tile = (tap * chunks + chunk) * columns + column;
                let word = &mut packed.tiles[tile * TILE + byte / 4].0[lane];
                *word |= u32::from(digit as u8) << (8 * (byte % 4));
            };
            match scheme {
                Scheme::Together => {
                    let place = channel / 8 * 16 + channel % 8;
                    put(0, panel, place, high);
                    put(0, panels + panel, place + 8, low);
                    put(0, 2 * panels + panel, place, low);
                    put(0, 2 * panels + panel, place + 8, high);
                }
                Scheme::Apart => {
                    let (chunk, channel) = (channel / LINE, channel % LINE);
                    let (half, channel) = (channel / 32, channel % 32);
                    let place = chunk * LINE + channel / 8 * 16 + 8 * half + channel % 8;
                    put(0, panel, place, high);
                    put(1, panel, place, low);
                    put(2, panel, place, high + low);
                }
            }
        }
        Some(packed)
    }

    /// Tile rows that an input row takes in each pass.
    fn chunks(&self) -> usize {
        match self.scheme {
            Scheme::Together => 1,
            Scheme::Apart => self.extents.cin.div_ceil(LINE),
        }
    }

    /// Columns of tiles in each pass.
    fn columns(&self) -> usize {
        match self.scheme {
            Scheme::Together => 3 * self.extents.panels(),
            Scheme::Apart => self.extents.panels(),
        }
    }
}

/// `(high, low)` with `x = 64·high + low`.
fn digits(x: i16) -> (i8, i8) {
    let high = (x + 32) >> 6;
    (high as i8, (x - (high << 6)) as i8)
}

/// Memory that a thread reuses.
#[derive(Default)]
pub(crate) struct Buffers {
    /// The digits of the input rows that a tile reads, and a row of zeros: `[pass][row][chunk]`.
    rows: Vec<Lanes>,
    /// The tiles that two groups multiply.
    gathered: Vec<Lanes>,
    /// The products of two groups: `[pass][column][group]` tiles.
    products: Vec<Lanes>,
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, overwritten. False, and no sums, if activations are too large for
/// digits.
///
/// # Panics
/// If the processor lacks AMX, or the plan reads beyond the input.
pub(crate) fn accumulate(
    isa: crate::Isa,
    weights: &Weights,
    plan: &PlanTile,
    input: &[i16],
    buffers: &mut Buffers,
    sums: &mut Vec<Lanes>,
) -> bool {
    assert!(isa.has_tiles());
    assert_eq!(plan.volume(), weights.extents.volume, "another kernel's plan");
    let (cin, passes) = (weights.extents.cin, weights.scheme.passes());
    let (end, inputs) = (plan.end(), input.len() / cin);
    assert!(
        end <= inputs,
        "a tap reads row {}, but the input has {inputs}",
        end - 1
    );
    let lines = (plan.inputs().len() + 1) * weights.chunks();
    buffers.rows.resize(passes * lines, Lanes::default());
    // SAFETY: an `Isa` with tiles is only made where the processor has AVX-512. All rows of the plan lie below its end.
    let small = unsafe {
        match weights.scheme {
            Scheme::Together => together(input, cin, plan.inputs(), &mut buffers.rows),
            Scheme::Apart => apart(input, cin, plan.inputs(), &mut buffers.rows),
        }
    };
    if small {
        sums.resize(plan.masks().len() * weights.extents.panels(), Lanes::default());
        // SAFETY: as above, and it has AMX; `rows` has just been filled for this plan and these weights.
        unsafe { multiply(weights, plan, buffers, sums) };
    }
    small
}

/// Writes rows of at most [`NARROW`] channels as a tile row each: by eights, high digits and low ones. Zeros follow. Tells whether all
/// were small enough.
///
/// # Safety
/// The processor must have AVX-512 F, BW and VL; the input must have the rows.
#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
unsafe fn together(input: &[i16], cin: usize, rows: &[u32], to: &mut [Lanes]) -> bool {
    let here = u32::MAX >> (32 - cin);
    let mut largest = _mm512_setzero_si512();
    let (last, to) = to.split_last_mut().expect("room for zeros");
    for (&row, to) in rows.iter().zip(to) {
        // SAFETY: the row's `cin` values are read, and a whole line written.
        unsafe {
            let x = _mm512_maskz_loadu_epi16(here, input.as_ptr().add(row as usize * cin));
            largest = _mm512_max_epu16(largest, _mm512_abs_epi16(x));
            let (high, low) = split(x);
            _mm512_store_si512(std::ptr::from_mut(to).cast(), _mm512_packs_epi16(high, low));
        }
    }
    *last = Lanes::default();
    within_reach(largest)
}

/// Writes rows as tile rows of 64 channels, first the high digits of all rows, then the low ones, then their sums. Zeros follow each
/// time. Tells whether all were small enough.
///
/// # Safety
/// As [`together`].
#[target_feature(enable = "avx512f,avx512bw,avx512vl")]
unsafe fn apart(input: &[i16], cin: usize, rows: &[u32], to: &mut [Lanes]) -> bool {
    let chunks = cin.div_ceil(LINE);
    let (highs, rest) = to.split_at_mut((rows.len() + 1) * chunks);
    let (lows, both) = rest.split_at_mut(highs.len());
    let mut largest = _mm512_setzero_si512();
    for chunk in 0..chunks {
        let there = u64::MAX >> LINE.saturating_sub(cin - chunk * LINE);
        for (i, &row) in rows.iter().enumerate() {
            // SAFETY: of the row's values only those that are there are read, and whole lines written.
            unsafe {
                let from = input.as_ptr().add(row as usize * cin + chunk * LINE);
                let a = _mm512_maskz_loadu_epi16(there as u32, from);
                let b = _mm512_maskz_loadu_epi16((there >> 32) as u32, from.wrapping_add(32));
                largest = _mm512_max_epu16(largest, _mm512_abs_epi16(a));
                largest = _mm512_max_epu16(largest, _mm512_abs_epi16(b));
                let ((high_a, low_a), (high_b, low_b)) = (split(a), split(b));
                let high = _mm512_packs_epi16(high_a, high_b);
                let low = _mm512_packs_epi16(low_a, low_b);
                let at = i * chunks + chunk;
                _mm512_store_si512(std::ptr::from_mut(&mut highs[at]).cast(), high);
                _mm512_store_si512(std::ptr::from_mut(&mut lows[at]).cast(), low);
                let sum = _mm512_add_epi8(high, low);
                _mm512_store_si512(std::ptr::from_mut(&mut both[at]).cast(), sum);
            }
        }
    }
    for zeros in [highs, lows, both] {
        zeros[rows.len() * chunks..].fill(Lanes::default());
    }
    within_reach(largest)
}

/// [`digits`] of 32 numbers.
#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
fn split(x: __m512i) -> (__m512i, __m512i) {
    let high = _mm512_srai_epi16::<6>(_mm512_add_epi16(x, _mm512_set1_epi16(32)));
    (high, _mm512_sub_epi16(x, _mm512_slli_epi16::<6>(high)))
}

#[target_feature(enable = "avx512f,avx512bw")]
#[inline]
fn within_reach(largest: __m512i) -> bool {
    _mm512_cmpgt_epu16_mask(largest, _mm512_set1_epi16(REACH)) == 0
}

/// Two groups' steps: those of both, then those of the first and those of the second alone.
struct Steps {
    /// Steps of each kind.
    counts: [usize; 3],
    /// Where each step's weights lie, in bytes from a pass's first.
    weights: Vec<usize>,
}

/// # Safety
/// The processor must have AMX and AVX-512 F and BW, `buffers.rows` the plan's input rows in tile rows as the weights' scheme has them.
#[target_feature(enable = "avx2,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512vl")]
unsafe fn multiply(weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Lanes]) {
    let Buffers {
        rows,
        gathered,
        products,
    } = buffers;
    let Extents { volume, .. } = weights.extents;
    let (chunks, columns, passes) = (
        weights.chunks(),
        weights.columns(),
        weights.scheme.passes(),
    );
    let (per_pass, lines) = (volume * chunks * columns, rows.len() / passes);
    gathered.resize(2 * volume * chunks * TILE, Lanes::default());
    products.resize(2 * passes * columns * TILE, Lanes::default());
    let mut steps = Steps {
        counts: [0; 3],
        weights: Vec::with_capacity(volume * chunks),
    };
    configure();
    for first in (0..plan.groups()).step_by(2) {
        let groups = [plan.steps(first), plan.steps(first + 1)];
        for pass in 0..passes {
            let rows = &rows[pass * lines..][..lines];
            // SAFETY: as promised; there is room for the tiles of two groups, all taps and chunks.
            unsafe { gather(&mut steps, groups, chunks, columns, rows, gathered) };
            let tiles = &weights.tiles[pass * per_pass * TILE..][..per_pass * TILE];
            let mut column = 0;
            while column < columns {
                let to = &mut products[2 * (pass * columns + column) * TILE..];
                // SAFETY: `gathered` has the steps' tiles, `tiles` those of their weights, this column's and where there is one
                // the next one's; `to` has room for two tiles a column. Tiles are configured.
                unsafe {
                    let (a, b) = (gathered.as_ptr(), tiles[column * TILE..].as_ptr());
                    column += match columns - column {
                        1 => one(&steps, a, b, to.as_mut_ptr()),
                        _ => two(&steps, a, b, to.as_mut_ptr()),
                    };
                }
            }
        }
        for group in first..(first + 2).min(plan.groups()) {
            let products = &products[(group - first) * TILE..];
            combine(weights, plan.rows(group), products, sums);
        }
    }
    release();
}

/// Copies what two groups multiply into tiles, in the order of [`Steps`].
///
/// # Safety
/// The processor must have AVX-512 F; `rows` must have as many rows as the places say, of so many chunks, and `to` room for all tiles.
#[target_feature(enable = "avx512f")]
#[inline]
unsafe fn gather(
    steps: &mut Steps,
    groups: [(&[u8], &[[u16; GROUP]]); 2],
    chunks: usize,
    columns: usize,
    rows: &[Lanes],
    to: &mut [Lanes],
) {
    let mut to = to.as_mut_ptr();
    let mut copy = |places: &[u16; GROUP], chunk: usize| {
        for &place in places {
            // SAFETY: the caller's promise.
            unsafe {
                let line = rows.as_ptr().add(usize::from(place) * chunks + chunk);
                _mm512_store_si512(to.cast(), _mm512_load_si512(line.cast()));
                to = to.add(1);
            }
        }
    };
    steps.weights.clear();
    let [(taps, places), (other_taps, other_places)] = groups;
    for kind in 0..3 {
        let before = steps.weights.len();
        let mut note = |tap: u8, chunk: usize| {
            let tile = (usize::from(tap) * chunks + chunk) * columns;
            steps.weights.push(tile * TILE * LINE);
        };
        let (mut i, mut j) = (0, 0);
        while i < taps.len() || j < other_taps.len() {
            let (a, b) = (taps.get(i), other_taps.get(j));
            let tap = *a.unwrap_or(&u8::MAX).min(b.unwrap_or(&u8::MAX));
            let (mine, others) = (a == Some(&tap), b == Some(&tap));
            for chunk in 0..chunks {
                match (kind, mine, others) {
                    (0, true, true) => {
                        copy(&places[i], chunk);
                        copy(&other_places[j], chunk);
                        note(tap, chunk);
                    }
                    (1, true, false) => {
                        copy(&places[i], chunk);
                        note(tap, chunk);
                    }
                    (2, false, true) => {
                        copy(&other_places[j], chunk);
                        note(tap, chunk);
                    }
                    _ => {}
                }
            }
            i += usize::from(mine);
            j += usize::from(others);
        }
        steps.counts[kind] = steps.weights.len() - before;
    }
}

/// Lays out eight tiles of 16 rows by 64 bytes.
fn configure() {
    let mut layout = [0u8; 64];
    layout[0] = 1;
    for tile in 0..8 {
        layout[16 + 2 * tile] = LINE as u8;
        layout[48 + tile] = TILE as u8;
    }
    // SAFETY: reads the 64 bytes of a valid layout. Compilers never use tile registers of their own accord.
    unsafe { asm!("ldtilecfg [{}]", in(reg) &layout, options(nostack, preserves_flags, readonly)) };
}

/// Gives the tiles back, which spares the system from saving them.
fn release() {
    // SAFETY: no tile is in use any more.
    unsafe { asm!("tilerelease", options(nostack, preserves_flags, nomem)) };
}

/// A function that multiplies two groups by some columns of tiles, summing in tile registers over all steps, and gives the number of
/// columns.
///
/// `$column($sums, $others, $weight, $at)`: for each column the registers of its sums for the first and second group, that of its
/// weights, and where these lie.
macro_rules! columns {
    ($(#[$doc:meta])* $name:ident, $count:literal, $multiply:literal, $(($first:literal, $second:literal, $weight:literal, $at:literal, $to:literal)),*) => {
        $(#[$doc])*
        ///
        /// # Safety
        /// Tiles must be configured; `a` and `b` must have the steps' tiles, `b` from this column on, and `to` room for two tiles a
        /// column.
        unsafe fn $name(steps: &Steps, a: *const Lanes, b: *const Lanes, to: *mut Lanes) -> usize {
            // SAFETY: the caller's promise. All registers that are written are named.
            unsafe {
                asm!(
                    $(concat!("tilezero tmm", $first), concat!("tilezero tmm", $second),)*
                    "test {both}, {both}",
                    "jz 3f",
                    "2:",
                    "mov {at}, qword ptr [{weights}]",
                    "tileloadd tmm4, [{a} + {line}]",
                    "tileloadd tmm5, [{a} + {line} + 1024]",
                    "add {at}, {b}",
                    $(
                        concat!("tileloadd tmm", $weight, ", [{at} + {line} + ", $at, "]"),
                        concat!($multiply, " tmm", $first, ", tmm4, tmm", $weight),
                        concat!($multiply, " tmm", $second, ", tmm5, tmm", $weight),
                    )*
                    "add {a}, 2048",
                    "add {weights}, 8",
                    "dec {both}",
                    "jnz 2b",
                    "3:",
                    "test {mine}, {mine}",
                    "jz 5f",
                    "4:",
                    "mov {at}, qword ptr [{weights}]",
                    "tileloadd tmm4, [{a} + {line}]",
                    "add {at}, {b}",
                    $(
                        concat!("tileloadd tmm", $weight, ", [{at} + {line} + ", $at, "]"),
                        concat!($multiply, " tmm", $first, ", tmm4, tmm", $weight),
                    )*
                    "add {a}, 1024",
                    "add {weights}, 8",
                    "dec {mine}",
                    "jnz 4b",
                    "5:",
                    "test {others}, {others}",
                    "jz 7f",
                    "6:",
                    "mov {at}, qword ptr [{weights}]",
                    "tileloadd tmm5, [{a} + {line}]",
                    "add {at}, {b}",
                    $(
                        concat!("tileloadd tmm", $weight, ", [{at} + {line} + ", $at, "]"),
                        concat!($multiply, " tmm", $second, ", tmm5, tmm", $weight),
                    )*
                    "add {a}, 1024",
                    "add {weights}, 8",
                    "dec {others}",
                    "jnz 6b",
                    "7:",
                    $(
                        concat!("tilestored [{to} + {line} + 2*", $at, "], tmm", $first),
                        concat!("tilestored [{to} + {line} + 2*", $at, " + 1024], tmm", $second),
                    )*
                    a = inout(reg) a => _,
                    b = in(reg) b,
                    to = in(reg) to,
                    at = out(reg) _,
                    weights = inout(reg) steps.weights.as_ptr() => _,
                    both = inout(reg) steps.counts[0] => _,
                    mine = inout(reg) steps.counts[1] => _,
                    others = inout(reg) steps.counts[2] => _,
                    line = in(reg) LINE,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    options(nostack),
                );
            }
            $count
        }
    };
}

columns!(
    /// One column.
    one, 1, "tdpbssd", ("0", "1", "6", "0", "0")
);
columns!(
    /// Two columns.
    two, 2, "tdpbssd", ("0", "1", "6", "0", "0"), ("2", "3", "7", "1024", "2048")
);

/// Adds up the products of digits for the rows of a group. `products` begins with the group's first tile.
#[target_feature(enable = "avx512f")]
#[inline]
fn combine(weights: &Weights, rows: &[u16], products: &[Lanes], sums: &mut [Lanes]) {
    let panels = weights.extents.panels();
    for (at, &row) in rows.iter().enumerate() {
        let sums = &mut sums[usize::from(row) * panels..][..panels];
        for (panel, sum) in sums.iter_mut().enumerate() {
            let product = |which: usize| products[2 * (which * panels + panel) * TILE + at].0;
            let (high, low, mixed) = (product(0), product(1), product(2));
            sum.0 = std::array::from_fn(|lane: usize| {
                let (high, low) = (high[lane], low[lane]);
                let mixed = match weights.scheme {
                    Scheme::Together => mixed[lane],
                    Scheme::Apart => mixed[lane].wrapping_sub(high).wrapping_sub(low),
                };
                (high << 12).wrapping_add(mixed << 6).wrapping_add(low)
            });
        }
    }
}

/// Multiplies tiles `4 · rounds` times, and gives the number of products of bytes: see [`crate::ceiling`].
///
/// # Panics
/// If the processor lacks AMX.
pub(crate) fn spin(isa: crate::Isa, rounds: usize) -> usize {
    assert!(isa.has_tiles());
    configure();
    // SAFETY: tiles are configured; the registers that are written are named.
    unsafe {
        asm!(
            "2:",
            "tdpbssd tmm0, tmm4, tmm6",
            "tdpbssd tmm1, tmm5, tmm6",
            "tdpbssd tmm2, tmm4, tmm7",
            "tdpbssd tmm3, tmm5, tmm7",
            "dec {rounds}",
            "jnz 2b",
            rounds = inout(reg) rounds.max(1) => _,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            options(nostack, nomem),
        );
    }
    release();
    rounds.max(1) * 4 * GROUP * PANEL * LINE
}
