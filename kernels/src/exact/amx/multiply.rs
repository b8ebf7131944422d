//! Multiplies a plan's groups by tiles of weights.

use std::arch::asm;

use super::tiles::{LINE, TILE, configure, release};
use super::weights::{Buffers, Scheme, Weights};
use crate::simd::amx::Amx;
use crate::simd::avx512::with_avx512;
use crate::sparse::plan::PlanTile;
use crate::sparse::rows::{Extents, Words};

/// Room for a plan's input rows, once it is known that they are there.
///
/// # Panics
/// If the plan is another kernel's, or it reads beyond the input of so many rows.
pub(crate) fn prepare(weights: &Weights, plan: &PlanTile, inputs: usize, buffers: &mut Buffers) {
    plan.check(weights.extents.volume, inputs);
    let lines = (plan.inputs().len() + 1) * weights.chunks();
    buffers.rows.resize(weights.passes() * lines, Words::default());
}

/// The sums of all groups, of `buffers.rows`: the plan's input rows in tile rows as the weights' scheme has them, and
/// then one of zeros.
///
/// Weights of all taps are more than the first cache holds: for as many taps as do fit, all groups are multiplied by
/// them, and their sums stored and loaded again with the next taps.
///
/// # Panics
/// If there are fewer rows.
pub(crate) fn multiply(_: Amx, weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Words]) {
    // SAFETY: the token proves AMX and AVX-512.
    unsafe { multiply_groups(weights, plan, buffers, sums) }
}

with_avx512! {
    fn multiply_groups(weights: &Weights, plan: &PlanTile, buffers: &mut Buffers, sums: &mut [Words]) {
        let Buffers {
            rows,
            gathered,
            products,
            ..
        } = buffers;
        let Extents { volume, .. } = weights.extents;
        let (chunks, columns, passes) = (weights.chunks(), weights.columns(), weights.passes());
        let panels = weights.extents.panels();
        let (per_tap, lines) = (chunks * columns * TILE, rows.len() / passes);
        assert!(lines >= (plan.inputs().len() + 1) * chunks, "a tile row of zeros after the plan's");
        let (width, groups) = (weights.width(), plan.groups());
        gathered.resize(2 * TILE, Words::default());
        products.resize(passes * columns * groups * TILE, Words::default());
        configure();
        for pass in 0..passes {
            for column in (0..columns).step_by(width) {
                let width = width.min(columns - column);
                let first = (pass * columns + column) * groups * TILE;
                let products = &mut products[first..][..width * groups * TILE];
                let taps = weights.taps(width);
                for (tap, chunk) in (0..volume)
                    .step_by(taps)
                    .flat_map(|tap| (0..chunks).map(move |chunk| (tap, chunk)))
                {
                    let tile = (pass * volume * chunks + chunk) * columns + column;
                    for (group, to) in products.chunks_exact_mut(width * TILE).enumerate() {
                        let (taps, places) = plan.steps(group, tap..(tap + taps).min(volume));
                        let block = Block {
                            steps: taps.len(),
                            taps: taps.as_ptr(),
                            places: places.all().as_ptr(),
                            rows: rows[pass * lines + chunk..].as_ptr(),
                            row: chunks * LINE,
                            gathered: gathered.as_mut_ptr(),
                            weights: weights.tiles[tile * TILE..].as_ptr(),
                            tap: per_tap * LINE,
                            to: to.as_mut_ptr(),
                            more: usize::from(tap + chunk > 0),
                        };
                        // SAFETY: all rows that the places name are there, and one of zeros; so are the weights of all
                        // taps from this chunk and column on, room for two tiles and for the products. Tiles are
                        // configured.
                        unsafe { block.run(width, weights.scheme) };
                    }
                }
            }
        }
        release();
        for group in 0..groups {
            let first = group * TILE * panels;
            let sums = &mut sums[first..][..TILE * panels];
            combine(weights, [group, groups], products, sums);
        }
    }
}

/// Some steps of one group by some columns of tiles.
struct Block {
    /// Steps.
    steps: usize,
    /// Each step's tap.
    taps: *const u8,
    /// For each step, and one more, which sixteen of the rows to multiply.
    places: *const u16,
    /// Input rows.
    rows: *const Words,
    /// Bytes from one to the next.
    row: usize,
    /// Room for two tiles.
    gathered: *mut Words,
    /// Tiles of weights of the first tap.
    weights: *const Words,
    /// Bytes from one tap's to the next's.
    tap: usize,
    /// The products, a tile for each column.
    to: *mut Words,
    /// Whether there already are some to add to, or 0.
    more: usize,
}

impl Block {
    /// # Safety
    /// Tiles must be configured, and the pointers hold what they promise for so many columns.
    unsafe fn run(&self, columns: usize, scheme: Scheme) {
        // SAFETY: the caller's promise.
        unsafe {
            match (columns, scheme) {
                (1, Scheme::Bf16) => one_bf16(self),
                (2, Scheme::Bf16) => two_bf16(self),
                (3, Scheme::Bf16) => three_bf16(self),
                (_, Scheme::Bf16) => four_bf16(self),
                (1, _) => one(self),
                (2, _) => two(self),
                (3, _) => three(self),
                (4, _) => four(self),
                (5, _) => five(self),
                _ => six(self),
            }
        }
    }
}

/// Copies the rows of one step into a tile: one instruction after the other, for they are to fill what time
/// multiplications leave.
macro_rules! gather {
    () => {
        concat!(
            "movzx {at:e}, word ptr [{places} + 0]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm16, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 0], zmm16\n",
            "movzx {at:e}, word ptr [{places} + 2]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm17, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 64], zmm17\n",
            "movzx {at:e}, word ptr [{places} + 4]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm18, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 128], zmm18\n",
            "movzx {at:e}, word ptr [{places} + 6]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm19, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 192], zmm19\n",
            "movzx {at:e}, word ptr [{places} + 8]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm20, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 256], zmm20\n",
            "movzx {at:e}, word ptr [{places} + 10]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm21, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 320], zmm21\n",
            "movzx {at:e}, word ptr [{places} + 12]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm22, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 384], zmm22\n",
            "movzx {at:e}, word ptr [{places} + 14]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm23, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 448], zmm23\n",
            "movzx {at:e}, word ptr [{places} + 16]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm16, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 512], zmm16\n",
            "movzx {at:e}, word ptr [{places} + 18]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm17, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 576], zmm17\n",
            "movzx {at:e}, word ptr [{places} + 20]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm18, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 640], zmm18\n",
            "movzx {at:e}, word ptr [{places} + 22]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm19, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 704], zmm19\n",
            "movzx {at:e}, word ptr [{places} + 24]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm20, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 768], zmm20\n",
            "movzx {at:e}, word ptr [{places} + 26]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm21, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 832], zmm21\n",
            "movzx {at:e}, word ptr [{places} + 28]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm22, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 896], zmm22\n",
            "movzx {at:e}, word ptr [{places} + 30]\n",
            "imul {at}, {row}\n",
            "vmovdqa64 zmm23, [{rows} + {at}]\n",
            "vmovdqa64 [{next} + 960], zmm23\n",
        )
    };
}

/// A function that multiplies a block by some columns of tiles, summing in tile registers: that of the rows, for each
/// column that of its sums, one for its weights, and where these lie. Each step's rows are gathered while the one
/// before is multiplied.
macro_rules! columns {
    ($(#[$doc:meta])* $name:ident, $multiply:literal, $rows:literal, $(($sum:literal, $weight:literal, $at:literal)),*) => {
        $(#[$doc])*
        ///
        /// # Safety
        /// Tiles must be configured, and the block's pointers hold what they promise for these columns.
        unsafe fn $name(block: &Block) {
            // SAFETY: the caller's promise. All registers that are written are named.
            unsafe {
                asm!(
                    "test {at}, {at}",
                    "jnz 2f",
                    $(concat!("tilezero tmm", $sum),)*
                    "jmp 3f",
                    "2:",
                    "test {steps}, {steps}",
                    "jz 5f",
                    $(concat!("tileloadd tmm", $sum, ", [{to} + {line} + ", $at, "]"),)*
                    "3:",
                    "test {steps}, {steps}",
                    "jz 6f",
                    gather!(),
                    "4:",
                    "xchg {now}, {next}",
                    "add {places}, 32",
                    gather!(),
                    "movzx {at:e}, byte ptr [{taps}]",
                    "imul {at}, {tap}",
                    "add {at}, {weights}",
                    concat!("tileloadd tmm", $rows, ", [{now} + {line}]"),
                    $(
                        concat!("tileloadd tmm", $weight, ", [{at} + {line} + ", $at, "]"),
                        concat!($multiply, " tmm", $sum, ", tmm", $rows, ", tmm", $weight),
                    )*
                    "inc {taps}",
                    "dec {steps}",
                    "jnz 4b",
                    "6:",
                    $(concat!("tilestored [{to} + {line} + ", $at, "], tmm", $sum),)*
                    "5:",
                    steps = inout(reg) block.steps => _,
                    taps = inout(reg) block.taps => _,
                    places = inout(reg) block.places => _,
                    rows = in(reg) block.rows,
                    row = in(reg) block.row,
                    next = inout(reg) block.gathered => _,
                    now = inout(reg) block.gathered.add(TILE) => _,
                    weights = in(reg) block.weights,
                    tap = in(reg) block.tap,
                    to = in(reg) block.to,
                    at = inout(reg) block.more => _,
                    line = in(reg) LINE,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    out("zmm16") _, out("zmm17") _, out("zmm18") _, out("zmm19") _,
                    out("zmm20") _, out("zmm21") _, out("zmm22") _, out("zmm23") _,
                    options(nostack),
                );
            }
        }
    };
}

columns!(
    /// One column.
    one, "tdpbssd", "4", ("0", "5", "0")
);
columns!(
    /// Two columns.
    two, "tdpbssd", "4", ("0", "5", "0"), ("1", "6", "1024")
);
columns!(
    /// Three columns.
    three, "tdpbssd", "4", ("0", "5", "0"), ("1", "6", "1024"), ("2", "7", "2048")
);
columns!(
    /// Four columns.
    four, "tdpbssd", "4", ("0", "5", "0"), ("1", "6", "1024"), ("2", "7", "2048"), ("3", "5", "3072")
);
columns!(
    /// Five columns.
    five, "tdpbssd", "6", ("0", "7", "0"), ("1", "7", "1024"), ("2", "7", "2048"), ("3", "7", "3072"), ("4", "7", "4096")
);
columns!(
    /// Six columns.
    six, "tdpbssd", "6", ("0", "7", "0"), ("1", "7", "1024"), ("2", "7", "2048"), ("3", "7", "3072"), ("4", "7", "4096"), ("5", "7", "5120")
);
columns!(
    /// One column of bf16.
    one_bf16, "tdpbf16ps", "4", ("0", "5", "0")
);
columns!(
    /// Two columns of bf16.
    two_bf16, "tdpbf16ps", "4", ("0", "5", "0"), ("1", "6", "1024")
);
columns!(
    /// Three columns of bf16.
    three_bf16, "tdpbf16ps", "4", ("0", "5", "0"), ("1", "6", "1024"), ("2", "7", "2048")
);
columns!(
    /// Four columns of bf16.
    four_bf16, "tdpbf16ps", "4", ("0", "5", "0"), ("1", "6", "1024"), ("2", "7", "2048"), ("3", "5", "3072")
);

with_avx512! {
    /// Puts together the products of a group.
    #[inline]
    fn combine(weights: &Weights, [group, groups]: [usize; 2], products: &[Words], sums: &mut [Words]) {
        let panels = weights.extents.panels();
        let (columns, block) = (weights.columns(), weights.width());
        // The tile of a pass's column: blocks of columns, then groups, then the block's columns.
        let tile = |pass: usize, column: usize| {
            let first = column - column % block;
            let width = block.min(columns - first);
            let tile = (pass * columns + first) * groups + group * width + column - first;
            &products[tile * TILE..][..TILE]
        };
        for panel in 0..panels {
            let [high, low, mixed] = match weights.scheme {
                Scheme::Digits => [0, 1, 2].map(|pass| tile(pass, panel)),
                Scheme::Both => [0, 2, 1].map(|digit| tile(0, digit * panels + panel)),
                Scheme::Bf16 => [tile(0, panel); 3],
                Scheme::Pairs => unreachable!("`pairs` puts its own together"),
            };
            for (at, sums) in sums.chunks_exact_mut(panels).enumerate() {
                let (high, low, mixed) = (high[at].0, low[at].0, mixed[at].0);
                let sum = &mut sums[panel];
                sum.0 = std::array::from_fn(|lane: usize| {
                    let (high, low) = (high[lane], low[lane]);
                    if weights.scheme == Scheme::Bf16 {
                        return high;
                    }
                    let mut mixed = mixed[lane];
                    if weights.scheme == Scheme::Digits {
                        mixed = mixed.wrapping_sub(high).wrapping_sub(low);
                    }
                    (high << 12).wrapping_add(mixed << 6).wrapping_add(low)
                });
            }
        }
    }
}
