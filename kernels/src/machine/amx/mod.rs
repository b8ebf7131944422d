//! AMX: tiles of 16 rows by 64 bytes, multiplied and summed in 32 bits.
//!
//! Here is what multiplies a plan's groups by tiles of weights; [`integers`] and [`brain`] cut numbers into what tiles hold.

pub(crate) mod brain;
pub(crate) mod integers;

use std::arch::asm;
use std::arch::x86_64::*;

use crate::plan::{GROUP, PlanTile, Steps};
use crate::rows::{Extents, Lanes, PANEL};

/// Bytes of a tile row.
const LINE: usize = 64;
/// [`Lanes`] of a tile.
const TILE: usize = 16;

/// What is in the tiles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scheme {
    /// Both digits of 32 channels in a tile row; three columns of tiles for a panel: high·high, low·low, mixed.
    Together,
    /// High digits, low ones and their sums in three passes of a tile row each 64 channels.
    Apart,
    /// 32 channels in bf16.
    Brain,
}

/// A layer's weights in tiles.
#[derive(Debug, Clone)]
pub(crate) struct Weights {
    extents: Extents,
    scheme: Scheme,
    /// `[pass][tap][chunk][column]` tiles: four input bytes of one output channel are a word.
    tiles: Vec<Lanes>,
}

impl Weights {
    fn new(extents: Extents, scheme: Scheme) -> Weights {
        let mut weights = Weights {
            extents,
            scheme,
            tiles: Vec::new(),
        };
        let tiles = weights.passes() * extents.volume * weights.chunks() * weights.columns();
        weights.tiles.resize(tiles * TILE, Lanes::default());
        weights
    }

    /// Passes over a group's rows, each of its own tile rows.
    fn passes(&self) -> usize {
        match self.scheme {
            Scheme::Together | Scheme::Brain => 1,
            Scheme::Apart => 3,
        }
    }

    /// Tile rows that an input row takes in each pass.
    fn chunks(&self) -> usize {
        match self.scheme {
            Scheme::Together => 1,
            Scheme::Apart => self.extents.cin.div_ceil(LINE),
            Scheme::Brain => self.extents.cin.div_ceil(LINE / 2),
        }
    }

    /// Columns of tiles in each pass.
    fn columns(&self) -> usize {
        match self.scheme {
            Scheme::Together => 3 * self.extents.panels(),
            Scheme::Apart | Scheme::Brain => self.extents.panels(),
        }
    }

    /// The word that multiplies the bytes from `byte` on of a tap's tile rows.
    fn word(
        &mut self,
        pass: usize,
        tap: usize,
        byte: usize,
        column: usize,
        lane: usize,
    ) -> &mut u32 {
        let (chunk, byte) = (byte / LINE, byte % LINE);
        let tap = pass * self.extents.volume + tap;
        let tile = (tap * self.chunks() + chunk) * self.columns() + column;
        &mut self.tiles[tile * TILE + byte / 4].0[lane]
    }
}

/// Memory that a thread reuses.
#[derive(Default)]
pub(crate) struct Buffers {
    /// The input rows that a tile reads, as tile rows, and a row of zeros: `[pass][row][chunk]`.
    rows: Vec<Lanes>,
    /// The tiles that two groups multiply.
    gathered: Vec<Lanes>,
    /// The products of two groups: `[pass][column][group]` tiles.
    products: Vec<Lanes>,
    /// Where the weights lie that two groups multiply.
    offsets: Vec<usize>,
}

/// Room for a plan's input rows, once it is known that they are there.
///
/// # Panics
/// If the processor lacks AMX, the plan is another kernel's, or it reads beyond the input of so many rows.
fn prepare(
    isa: crate::Isa,
    weights: &Weights,
    plan: &PlanTile,
    inputs: usize,
    buffers: &mut Buffers,
) {
    assert!(isa.has_tiles());
    let volume = weights.extents.volume;
    assert_eq!(plan.volume(), volume, "another kernel's plan");
    let end = plan.end();
    assert!(
        end <= inputs,
        "a tap reads row {}, but the input has {inputs}",
        end - 1
    );
    let lines = (plan.inputs().len() + 1) * weights.chunks();
    buffers
        .rows
        .resize(weights.passes() * lines, Lanes::default());
}

/// # Safety
/// The processor must have AMX and AVX-512 F and BW, `buffers.rows` the plan's input rows in tile rows as the weights' scheme has them.
#[target_feature(enable = "avx2,bmi1,bmi2,popcnt,lzcnt,avx512f,avx512bw,avx512vl")]
unsafe fn multiply(weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Lanes]) {
    let Buffers {
        rows,
        gathered,
        products,
        offsets,
    } = buffers;
    let Extents { volume, .. } = weights.extents;
    let (chunks, columns, passes) = (weights.chunks(), weights.columns(), weights.passes());
    let (per_pass, lines) = (volume * chunks * columns, rows.len() / passes);
    gathered.resize(2 * volume * chunks * TILE, Lanes::default());
    products.resize(2 * passes * columns * TILE, Lanes::default());
    configure();
    for pair in 0..plan.pairs() {
        let steps = plan.steps(pair);
        offsets.clear();
        for &tap in steps.taps {
            let first = usize::from(tap) * chunks;
            offsets.extend((first..first + chunks).map(|tile| tile * columns * TILE * LINE));
        }
        for pass in 0..passes {
            let rows = &rows[pass * lines..][..lines];
            // SAFETY: as promised; there is room for the tiles of two groups, all taps and chunks.
            unsafe { gather(&steps, chunks, rows, gathered) };
            let tiles = &weights.tiles[pass * per_pass * TILE..][..per_pass * TILE];
            let mut column = 0;
            while column < columns {
                let to = &mut products[2 * (pass * columns + column) * TILE..];
                let block = Block {
                    counts: steps.counts.map(|count| count * chunks),
                    offsets: offsets.as_ptr(),
                    a: gathered.as_ptr(),
                    b: tiles[column * TILE..].as_ptr(),
                    to: to.as_mut_ptr(),
                };
                // SAFETY: `gathered` has the steps' tiles, `tiles` those of their weights, this column's and where there is one the
                // next one's; `to` has room for two tiles a column. Tiles are configured.
                unsafe {
                    column += match (columns - column, weights.scheme) {
                        (1, Scheme::Brain) => one_brain(&block),
                        (_, Scheme::Brain) => two_brain(&block),
                        (1, _) => one(&block),
                        _ => two(&block),
                    };
                }
            }
        }
        for (group, rows) in plan.rows(pair).enumerate() {
            combine(weights, rows, &products[group * TILE..], sums);
        }
    }
    release();
}

/// Copies the rows that two groups multiply into tiles: for each tap and chunk the first group's, if it uses the tap, then the second's.
///
/// # Safety
/// The processor must have AVX-512 F; `rows` must have as many rows as the places say, of so many chunks, and `to` room for all tiles.
#[target_feature(enable = "avx512f")]
#[inline]
unsafe fn gather(steps: &Steps, chunks: usize, rows: &[Lanes], to: &mut [Lanes]) {
    let (both, one) = steps.places.split_at(2 * steps.counts[0]);
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
    for places in both.chunks_exact(2).chain(one.chunks_exact(1)) {
        for chunk in 0..chunks {
            places.iter().for_each(|places| copy(places, chunk));
        }
    }
}

/// Two groups' steps by some columns of tiles.
struct Block {
    /// Steps of both groups, of the first alone, of the second alone.
    counts: [usize; 3],
    /// Where each step's weights lie, in bytes from `b`.
    offsets: *const usize,
    /// The steps' tiles of input rows.
    a: *const Lanes,
    /// Weights.
    b: *const Lanes,
    /// Two tiles of products for each column.
    to: *mut Lanes,
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
        /// Tiles must be configured, and the block's pointers hold what they promise for these columns.
        unsafe fn $name(block: &Block) -> usize {
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
                    a = inout(reg) block.a => _,
                    b = in(reg) block.b,
                    to = in(reg) block.to,
                    at = out(reg) _,
                    weights = inout(reg) block.offsets => _,
                    both = inout(reg) block.counts[0] => _,
                    mine = inout(reg) block.counts[1] => _,
                    others = inout(reg) block.counts[2] => _,
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
    /// One column of bf16.
    one_brain, 1, "tdpbf16ps", ("0", "1", "6", "0", "0")
);
columns!(
    /// Two columns of bf16.
    two_brain, 2, "tdpbf16ps", ("0", "1", "6", "0", "0"), ("2", "3", "7", "1024", "2048")
);
columns!(
    /// One column.
    one, 1, "tdpbssd", ("0", "1", "6", "0", "0")
);
columns!(
    /// Two columns.
    two, 2, "tdpbssd", ("0", "1", "6", "0", "0"), ("2", "3", "7", "1024", "2048")
);

/// Puts together the products for the rows of a group. `products` begins with the group's first tile.
#[target_feature(enable = "avx512f")]
#[inline]
fn combine(weights: &Weights, rows: &[u16], products: &[Lanes], sums: &mut [Lanes]) {
    let panels = weights.extents.panels();
    for (at, &row) in rows.iter().enumerate() {
        let sums = &mut sums[usize::from(row) * panels..][..panels];
        for (panel, sum) in sums.iter_mut().enumerate() {
            let product = |which: usize| products[2 * (which * panels + panel) * TILE + at].0;
            if weights.scheme == Scheme::Brain {
                sum.0 = product(0);
                continue;
            }
            let (high, low, mixed) = (product(0), product(1), product(2));
            sum.0 = std::array::from_fn(|lane: usize| {
                let (high, low) = (high[lane], low[lane]);
                let mixed = match weights.scheme {
                    Scheme::Apart => mixed[lane].wrapping_sub(high).wrapping_sub(low),
                    _ => mixed[lane],
                };
                (high << 12).wrapping_add(mixed << 6).wrapping_add(low)
            });
        }
    }
}

/// A function that multiplies tiles `4 · rounds` times, and gives the number of products of `$bytes` bytes: see [`crate::ceiling`].
macro_rules! spin {
    ($name:ident, $multiply:literal, $bytes:literal) => {
        pub(crate) fn $name(isa: crate::Isa, rounds: usize) -> usize {
            assert!(isa.has_tiles());
            configure();
            // SAFETY: tiles are configured, and zero; the registers that are written are named.
            unsafe {
                asm!(
                    "2:",
                    concat!($multiply, " tmm0, tmm4, tmm6"),
                    concat!($multiply, " tmm1, tmm5, tmm6"),
                    concat!($multiply, " tmm2, tmm4, tmm7"),
                    concat!($multiply, " tmm3, tmm5, tmm7"),
                    "dec {rounds}",
                    "jnz 2b",
                    rounds = inout(reg) rounds.max(1) => _,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    options(nostack, nomem),
                );
            }
            release();
            rounds.max(1) * 4 * GROUP * PANEL * LINE / $bytes
        }
    };
}
spin!(spin, "tdpbssd", 1);
spin!(spin_brain, "tdpbf16ps", 2);
