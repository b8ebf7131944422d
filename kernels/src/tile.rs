//! The loop at the heart of both convolutions: a tile's sums, tap by tap, in blocks of rows and channels that fill the registers.

use crate::isa::{Isa, Level};
use crate::machine;
use crate::rows::{Extents, Lanes, PANEL};
use crate::taps::TileTaps;

/// Rows that are prepared together: what the widest blocks of any machine divide.
const GROUP: usize = 24;

/// Panels from which on it pays to fetch input rows ahead: with fewer, a block is done before what it fetches has come.
const FETCH: usize = 4;

/// A vector of 32-bit sums, and what multiplies and adds one step: an f32, or a pair of i16 or bf16.
///
/// # Safety
/// Its functions may use instructions that not every processor has, and read and write `LANES` words at the pointers they get
/// (`factor`: one). They must only be called where the processor has them and the words are there.
pub(crate) unsafe trait Machine {
    /// Sums.
    type Sum: Copy;
    /// The weights of as many channels, for one step.
    type Weight: Copy;
    /// An input row's values of one step, for all channels.
    type Factor: Copy;
    /// Words in a vector; divides [`PANEL`].
    const LANES: usize;

    /// Zeros.
    unsafe fn zero() -> Self::Sum;
    /// Reads sums, aligned.
    unsafe fn load(at: *const u32) -> Self::Sum;
    /// Writes sums, aligned.
    unsafe fn store(at: *mut u32, sum: Self::Sum);
    /// Reads weights, aligned.
    unsafe fn weight(at: *const u32) -> Self::Weight;
    /// Reads a row's values of one step, not aligned.
    unsafe fn factor(at: *const u32) -> Self::Factor;
    /// `sum + weight · factor`.
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum;
}

/// Some rows and some panels of one tap.
#[derive(Clone, Copy)]
pub(crate) struct Block {
    /// The first panel's weights, `steps` [`Lanes`] a panel.
    pub weights: *const u32,
    /// Steps.
    pub steps: usize,
    /// Rows.
    pub rows: usize,
    /// For each row, which of `inputs` it reads.
    pub reads: *const u32,
    /// Input rows, `steps` words each.
    pub inputs: *const u32,
    /// For each row, which of `sums` it adds to.
    pub writes: *const u32,
    /// The first panel's sums, each row's `stride` words after the last's; those of the next panel follow.
    pub sums: *mut u32,
    /// Words.
    pub stride: usize,
    /// Whether input rows are to be fetched before they are read.
    pub fetch: bool,
}

/// Adds a block's products to its sums, for `V` vectors of channels from the first panel on, at most `R` rows at once.
///
/// # Safety
/// The processor must have `M`'s instructions, and the block's pointers what they promise, for `V` vectors' panels.
#[inline(always)]
pub(crate) unsafe fn columns<M: Machine, const R: usize, const V: usize>(block: &Block) {
    let mut first = 0;
    while first < block.rows {
        // The last two parts are of even size: few rows at once would wait for each other's sums.
        let rows = match block.rows - first {
            rest if rest >= 2 * R || rest == R => R,
            rest if rest > R => rest.div_ceil(2),
            rest => rest,
        };
        macro_rules! of_size {
            ($($n:literal)*) => {
                match rows {
                    // SAFETY: the caller's promise, for some of the block's rows.
                    $($n if $n <= R => unsafe { multiply::<M, $n, V>(block, first) },)*
                    _ => unreachable!("{rows} rows"),
                }
            };
        }
        of_size!(1 2 3 4 5 6 7 8 9 10 11 12);
        first += rows;
    }
}

/// Adds the products of `R` rows from `first` on: their sums stay in registers throughout.
///
/// # Safety
/// As [`columns`], and the block must have these rows.
#[inline(always)]
#[expect(
    clippy::needless_range_loop,
    reason = "rows and vectors are counted alike"
)]
unsafe fn multiply<M: Machine, const R: usize, const V: usize>(block: &Block, first: usize) {
    // SAFETY: the caller's promise: vector v of a row lies in its panel v · LANES / PANEL, each row has `steps` words, and so
    // many lanes each panel.
    unsafe {
        let mut inputs = [block.inputs; R];
        let mut outputs = [block.sums; R];
        for r in 0..R {
            inputs[r] = inputs[r].add(*block.reads.add(first + r) as usize * block.steps);
            outputs[r] = outputs[r].add(*block.writes.add(first + r) as usize * block.stride);
        }
        let mut sums = [[M::zero(); V]; R];
        for r in 0..R {
            for v in 0..V {
                sums[r][v] = M::load(outputs[r].add(v * M::LANES));
            }
        }
        if block.fetch {
            for r in first + R..(first + 2 * R).min(block.rows) {
                let row = block.inputs.add(*block.reads.add(r) as usize * block.steps);
                machine::fetch(row, block.steps);
            }
        }
        let mut weights = block.weights;
        let stride = block.steps * PANEL;
        for s in 0..block.steps {
            let mut weight = [M::weight(weights); V];
            for v in 1..V {
                let (panel, lane) = (v * M::LANES / PANEL, v * M::LANES % PANEL);
                weight[v] = M::weight(weights.add(panel * stride + lane));
            }
            for r in 0..R {
                let factor = M::factor(inputs[r].add(s));
                for v in 0..V {
                    sums[r][v] = M::mul_add(sums[r][v], weight[v], factor);
                }
            }
            weights = weights.add(PANEL);
        }
        for r in 0..R {
            for v in 0..V {
                M::store(outputs[r].add(v * M::LANES), sums[r][v]);
            }
        }
    }
}

/// What steps multiply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arithmetic {
    /// f32.
    Float,
    /// Pairs of i16.
    Integer,
    /// Pairs of bf16: only where [`Isa::has_bf16`].
    Brain,
}

/// Where a tile's input rows are.
pub(crate) enum Input<'a, T> {
    /// Words as the machine multiplies them, `steps` a row.
    Ready(&'a [T]),
    /// To be written into `steps` words a row first, by a function of the input, the rows to write, and the values of each.
    Expand(&'a [T], fn(Isa, &[T], &[u32], usize, &mut [u32])),
}

/// The sums over all taps of a tile: `sums[row · panels + panel]`, overwritten.
///
/// `weights` are ordered `[tap][panel][step]`; an input row has `cin` values.
///
/// # Panics
/// If the taps read beyond the input, or a row that is ready is not of whole words.
pub(crate) fn accumulate<T>(
    isa: Isa,
    arithmetic: Arithmetic,
    extents: Extents,
    weights: &[Lanes],
    taps: &TileTaps,
    input: Input<'_, T>,
    expanded: &mut Vec<Lanes>,
    sums: &mut Vec<Lanes>,
) {
    assert!(arithmetic != Arithmetic::Brain || isa.has_bf16());
    let (cin, panels) = (extents.cin, extents.panels());
    let steps = weights.len() / (extents.volume * panels);
    sums.clear();
    sums.resize(taps.masks().len() * panels, Lanes::default());
    let values = match input {
        Input::Ready(values) => {
            assert_eq!(cin * size_of::<T>(), steps * 4, "a row is {steps} words");
            values
        }
        Input::Expand(values, _) => values,
    };
    assert!(taps.end() <= values.len() / cin, "taps of another input");
    expanded.resize((GROUP * steps).div_ceil(PANEL), Lanes::default());
    let fetch = panels >= FETCH && matches!(input, Input::Ready(_));
    let half = usize::from((1..=PANEL / 2).contains(&(extents.cout % PANEL)));
    for (k, weights) in weights.chunks_exact(panels * steps).enumerate() {
        let mut rest = taps.of(k);
        while rest.len() > 0 {
            let group;
            let (reads, inputs) = match input {
                Input::Ready(values) => {
                    (group, rest) = rest.split_at(rest.len());
                    (group.inputs, values.as_ptr().cast())
                }
                Input::Expand(values, expand) => {
                    let parts = rest.len().div_ceil(GROUP);
                    (group, rest) = rest.split_at(rest.len().div_ceil(parts));
                    let to = machine::words_mut(expanded);
                    expand(isa, values, group.inputs, cin, to);
                    (&IN_ORDER[..group.len()], to.as_ptr())
                }
            };
            let mut panel = 0;
            while panel < panels {
                let block = Block {
                    weights: weights[panel * steps..].as_ptr().cast(),
                    steps,
                    rows: group.len(),
                    reads: reads.as_ptr(),
                    inputs,
                    writes: group.rows.as_ptr(),
                    sums: sums[panel..].as_mut_ptr().cast(),
                    stride: panels * PANEL,
                    fetch: fetch && panel == 0,
                };
                // SAFETY: all rows that are read lie below the taps' end, so in the input, or else below `GROUP`, where they were
                // expanded to; all that are written lie below the tile's number, so in `sums`; the weights are those of the
                // panels from here on, with no more than `whole` and a half of them left.
                panel += unsafe { run(isa, arithmetic, &block, panels - panel - half) };
            }
        }
    }
}

/// The places of expanded rows.
static IN_ORDER: [u32; GROUP] = {
    let mut places = [0; GROUP];
    let mut i = 0;
    while i < GROUP {
        places[i] = i as u32;
        i += 1;
    }
    places
};

/// Multiplies as many of the `whole` panels as fit, or, if there is none, the half panel that is left; gives their number.
///
/// # Safety
/// The block's pointers must hold what they promise for these panels, and bf16 must be asked for only where the machine has it.
unsafe fn run(isa: Isa, arithmetic: Arithmetic, block: &Block, whole: usize) -> usize {
    // SAFETY: an `Isa` is only made where the processor has its instructions; the rest is the caller's promise.
    unsafe {
        match isa.level() {
            Level::Scalar => machine::scalar::run(arithmetic, block, whole),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => machine::avx2::run(arithmetic, block, whole),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 | Level::Amx => machine::avx512::run(arithmetic, block, whole),
            #[cfg(target_arch = "aarch64")]
            Level::Neon => machine::neon::run(arithmetic, block, whole),
        }
    }
}

/// Multiplies for as long as `rounds` say, and gives the number of products: see [`crate::ceiling`].
///
/// # Panics
/// If the machine has no bf16 and is asked for it.
pub(crate) fn spin(isa: Isa, arithmetic: Arithmetic, rounds: usize) -> usize {
    assert!(arithmetic != Arithmetic::Brain || isa.has_bf16());
    // SAFETY: an `Isa` is only made where the processor has its instructions; bf16 has just been asked about.
    let words = unsafe {
        match isa.level() {
            Level::Scalar => machine::scalar::spin(arithmetic, rounds),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => machine::avx2::spin(arithmetic, rounds),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 | Level::Amx => machine::avx512::spin(arithmetic, rounds),
            #[cfg(target_arch = "aarch64")]
            Level::Neon => machine::neon::spin(arithmetic, rounds),
        }
    };
    match arithmetic {
        Arithmetic::Float => words,
        Arithmetic::Integer | Arithmetic::Brain => 2 * words,
    }
}
