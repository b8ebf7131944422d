//! Up to 32 channels of two taps in a tile row: the multiplication fills its tiles, and a step of two taps takes the
//! time of one.

use std::arch::asm;

use super::pairing::{PRODUCTS, Step, Steps, WIDTH, tile};
use super::tiles::{LINE, TILE, configure, release};
use super::weights::{Buffers, Weights};
use crate::simd::amx::Amx;
use crate::simd::avx512::with_avx512;
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{MOST_TAPS, Words};

/// [`Words`] of a group's products.
const STORED: usize = WIDTH * PRODUCTS * TILE;

/// One group's products of one block of panels.
struct Block {
    /// Steps, and two more of which the rows are there.
    steps: *const Step,
    count: usize,
    /// Input rows, high digits and low ones.
    rows: *const Words,
    /// Room for three tiles each: the rows of the first step, those of the second, and nothing yet.
    gathered: [*mut Words; 3],
    /// Where the products go.
    to: *mut Words,
}

/// The sums of all groups: `sums[row · panels + panel]`, of `buffers.rows`: the plan's input rows, high digits and low
/// ones, and then one of zeros.
///
/// What a step multiplies is gathered two steps before, in whatever group they are: what has just been written to
/// memory takes long to come back as a tile.
///
/// # Panics
/// If there are fewer rows.
pub(super) fn multiply(_: Amx, weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Words]) {
    // SAFETY: the token proves AMX and AVX-512.
    unsafe { multiply_groups(weights, plan, buffers, sums) }
}

with_avx512! {
    fn multiply_groups(weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Words]) {
        let Buffers {
            rows,
            gathered,
            products,
            steps: Steps { all: steps, counts },
        } = buffers;
        let extents = weights.extents;
        let panels = extents.panels();
        let nothing = [plan.inputs().len() as u16; TILE];
        gathered.resize(3 * PRODUCTS * TILE, Words::default());
        products.resize(2 * STORED, Words::default());
        assert!(rows.len() > plan.inputs().len(), "a tile row of zeros after the plan's");
        let rows = rows.as_ptr();
        let mut gathered = [0, 1, 2].map(|i| gathered[i * PRODUCTS * TILE..].as_mut_ptr());
        configure();
        // Each group's products are put together while the next one's are made.
        let mut made: Option<[usize; 2]> = None;
        let mut turn = 0;
        for panel in (0..panels).step_by(WIDTH) {
            steps.clear();
            counts.clear();
            for group in 0..plan.groups() {
                let (taps, places) = plan.steps(group, 0..extents.volume);
                let mut halves = [[nothing.as_ptr(); 2]; MOST_TAPS.div_ceil(2)];
                let mut used = 0u32;
                for (&tap, places) in taps.iter().zip(places.all().chunks_exact(TILE)) {
                    let [pair, half] = weights.homes[usize::from(tap)];
                    halves[pair][half] = places.as_ptr();
                    used |= 1 << pair;
                }
                counts.push(used.count_ones() as usize);
                while used != 0 {
                    let pair = used.trailing_zeros() as usize;
                    steps.push(Step {
                        places: halves[pair],
                        weights: weights.tiles[tile(extents, pair, 0, panel) * TILE..].as_ptr(),
                    });
                    used &= used - 1;
                }
            }
            let end = Step {
                places: [nothing.as_ptr(); 2],
                weights: weights.tiles.as_ptr(),
            };
            steps.extend([end; 2]);
            for (step, to) in steps.iter().zip(gathered).take(2) {
                // SAFETY: the places name rows that are there, and the tiles are there.
                unsafe { gather(step, rows, to) };
            }
            let mut first = 0;
            for (group, &count) in counts.iter().enumerate() {
                let mut block = Block {
                    steps: steps[first..].as_ptr(),
                    count,
                    rows,
                    gathered,
                    to: products[turn * STORED..].as_mut_ptr(),
                };
                // SAFETY: the places name rows that are there, the weights are those of whole pairs, there is room for
                // the tiles, and they are configured; the first two steps' rows are gathered.
                unsafe {
                    match panels - panel {
                        1 => one(&mut block),
                        _ => two(&mut block),
                    }
                }
                gathered = block.gathered;
                first += count;
                if let Some(of) = made.replace([group, panel]) {
                    combine(panels, of, &products[(1 - turn) * STORED..], sums);
                }
                turn = 1 - turn;
            }
        }
        release();
        if let Some(of) = made {
            combine(panels, of, &products[(1 - turn) * STORED..], sums);
        }
        // They point into the plan.
        steps.clear();
    }
}

with_avx512! {
    /// Puts a group's products of a block of panels together.
    #[inline]
    fn combine(panels: usize, [group, panel]: [usize; 2], products: &[Words], sums: &mut [Words]) {
        let width = WIDTH.min(panels - panel);
        let sums = &mut sums[group * TILE * panels..][..TILE * panels];
        for at in 0..width {
            let [high, low, both] = [0, 1, 2].map(|product| {
                let tile = &products[(product * width + at) * TILE..];
                &tile[..TILE]
            });
            for (row, sums) in sums.chunks_exact_mut(panels).enumerate() {
                let (high, low, both) = (&high[row].0, &low[row].0, &both[row].0);
                sums[panel + at].0 = std::array::from_fn(|lane: usize| {
                    let (high, low) = (high[lane], low[lane]);
                    let mixed = both[lane].wrapping_sub(high).wrapping_sub(low);
                    (high << 12).wrapping_add(mixed << 6).wrapping_add(low)
                });
            }
        }
    }
}

/// Puts one row of both taps into the tiles of high digits, low ones and sums.
macro_rules! row {
    ($($place:literal: $line:literal),*) => {
        concat!($(
            "movzx {a:e}, word ptr [{first} + ", $place, "]\n",
            "movzx {b:e}, word ptr [{second} + ", $place, "]\n",
            "shl {a:e}, 6\n",
            "shl {b:e}, 6\n",
            "vmovdqa64 zmm16, [{rows} + {a}]\n",
            "vmovdqa64 zmm17, [{rows} + {b}]\n",
            "vinserti64x4 zmm18, zmm16, ymm17, 1\n",
            "vshufi64x2 zmm19, zmm16, zmm17, 0xEE\n",
            "vpaddb zmm20, zmm18, zmm19\n",
            "vmovdqa64 [{next} + ", $line, "], zmm18\n",
            "vmovdqa64 [{next} + ", $line, " + 1024], zmm19\n",
            "vmovdqa64 [{next} + ", $line, " + 2048], zmm20\n",
        )*)
    };
}

/// Gathers the rows of one step.
macro_rules! gather {
    () => {
        row!(
            "0": "0", "2": "64", "4": "128", "6": "192", "8": "256", "10": "320", "12": "384", "14": "448",
            "16": "512", "18": "576", "20": "640", "22": "704", "24": "768", "26": "832", "28": "896", "30": "960"
        )
    };
}

/// Gathers the rows of a step.
///
/// # Safety
/// The processor must have AVX-512 F and BW, the places name rows that are there, and `to` have room for three tiles.
unsafe fn gather(step: &Step, rows: *const Words, to: *mut Words) {
    // SAFETY: the caller's promise. All registers that are written are named.
    unsafe {
        asm!(
            gather!(),
            rows = in(reg) rows,
            next = in(reg) to,
            first = in(reg) step.places[0],
            second = in(reg) step.places[1],
            a = out(reg) _,
            b = out(reg) _,
            out("zmm16") _, out("zmm17") _, out("zmm18") _, out("zmm19") _, out("zmm20") _,
            options(nostack),
        );
    }
}

/// A function that multiplies a block of some panels: where their tiles lie, for each product.
macro_rules! panels {
    ($(#[$doc:meta])* $name:ident, $($rows:literal: $(($sum:literal, $at:literal)),*);*) => {
        $(#[$doc])*
        ///
        /// # Safety
        /// Tiles must be configured, and the block's pointers hold what they promise for these panels.
        unsafe fn $name(block: &mut Block) {
            let [now, soon, next] = &mut block.gathered;
            // SAFETY: the caller's promise. All registers that are written are named.
            unsafe {
                asm!(
                    $($(concat!("tilezero tmm", $sum),)*)*
                    "test {count}, {count}",
                    "jz 6f",
                    "4:",
                    "mov {first}, [{steps} + 48]",
                    "mov {second}, [{steps} + 56]",
                    gather!(),
                    "mov {a}, [{steps} + 16]",
                    $(
                        concat!("tileloadd tmm6, [{now} + {line} + ", $rows, "]"),
                        $(
                            concat!("tileloadd tmm7, [{a} + {line} + ", $at, "]"),
                            concat!("tdpbssd tmm", $sum, ", tmm6, tmm7"),
                        )*
                    )*
                    "mov {a}, {now}",
                    "mov {now}, {soon}",
                    "mov {soon}, {next}",
                    "mov {next}, {a}",
                    "add {steps}, 24",
                    "dec {count}",
                    "jnz 4b",
                    "6:",
                    $($(concat!("tilestored [{to} + {line} + ", $at, "], tmm", $sum),)*)*
                    steps = inout(reg) block.steps => _,
                    count = inout(reg) block.count => _,
                    rows = in(reg) block.rows,
                    now = inout(reg) *now,
                    soon = inout(reg) *soon,
                    next = inout(reg) *next,
                    to = in(reg) block.to,
                    line = in(reg) LINE,
                    first = out(reg) _,
                    second = out(reg) _,
                    a = out(reg) _,
                    b = out(reg) _,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    out("zmm16") _, out("zmm17") _, out("zmm18") _, out("zmm19") _, out("zmm20") _,
                    options(nostack),
                );
            }
        }
    };
}

panels!(
    /// One panel.
    one, "0": ("0", "0"); "1024": ("1", "1024"); "2048": ("2", "2048")
);
panels!(
    /// Two panels.
    two, "0": ("0", "0"), ("1", "1024"); "1024": ("2", "2048"), ("3", "3072"); "2048": ("4", "4096"), ("5", "5120")
);
