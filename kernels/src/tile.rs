//! The loop at the heart of both convolutions: the sums of a group's rows stay in registers while its taps go by.

use crate::machine;
use crate::plan::PlanTile;
use crate::rows::{Extents, IN_ORDER, Lanes, PANEL, TILE};
use crate::simd::{Isa, Level};

/// The smallest [`group`].
pub(crate) const MIN_GROUP: usize = 4;
/// Panels that AVX-512 multiplies at once, by the rows of the smallest group, where a layer has so many.
#[cfg(target_arch = "x86_64")]
pub(crate) const WIDE: usize = 4;

/// Output rows of a layer of `cout` channels that are multiplied by the same taps: those of a matrix tile, or as many as keep the
/// registers busy. A multiple of [`MIN_GROUP`].
pub(crate) fn group(isa: Isa, cout: usize) -> usize {
    match isa.level() {
        #[cfg(target_arch = "x86_64")]
        Level::Amx(..) => 16,
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(_) if !cout.is_multiple_of(WIDE * PANEL) => 8,
        _ => {
            let _ = cout;
            MIN_GROUP
        }
    }
}

/// [`Lanes`] of weights that the first cache holds besides rows and sums.
const CACHED: usize = 256;

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
    /// `a + b`.
    unsafe fn add(a: Self::Sum, b: Self::Sum) -> Self::Sum;
    /// `sum + weight · factor`.
    unsafe fn mul_add(sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum;
}

/// A group's rows, some taps and some panels.
#[derive(Clone, Copy)]
pub(crate) struct Block {
    /// Rows of the group.
    pub group: usize,
    /// Its taps.
    pub taps: *const u8,
    /// Their number.
    pub count: usize,
    /// For each tap and row, which of `inputs` it reads.
    pub places: *const u16,
    /// Input rows, `steps` words each.
    pub inputs: *const u32,
    /// Steps.
    pub steps: usize,
    /// The first panel's weights of tap 0, `steps` [`Lanes`] a panel.
    pub weights: *const u32,
    /// Words from one tap's weights to the next's.
    pub tap: usize,
    /// The first panel's sums of the group's rows, each `stride` words after the last's; those of the next panel follow.
    pub sums: *mut u32,
    /// Words.
    pub stride: usize,
    /// Whether there are sums to add to.
    pub more: bool,
}

/// Sums a block's products, for `V` vectors of channels from the first panel on, `R` rows at once, which divide the group. Each sum is
/// computed in `P` parts, of every `P`th step, where there would be too few to keep the machine from waiting for one.
///
/// # Safety
/// The processor must have `M`'s instructions, and the block's pointers what they promise, for `V` vectors' panels.
#[inline(always)]
pub(crate) unsafe fn columns<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block) {
    for first in (0..block.group).step_by(R) {
        // SAFETY: the caller's promise, for some of the group's rows.
        unsafe { multiply::<M, R, V, P>(block, first) };
    }
}

/// Sums the products of `R` rows from `first` on.
///
/// # Safety
/// As [`columns`], and the block must have these rows.
#[inline(always)]
#[expect(clippy::needless_range_loop, reason = "rows, vectors and parts are counted alike")]
unsafe fn multiply<M: Machine, const R: usize, const V: usize, const P: usize>(block: &Block, first: usize) {
    // SAFETY: the caller's promise: vector v of a row lies in its panel v · LANES / PANEL, each row has `steps` words, and so
    // many lanes each panel.
    unsafe {
        let mut outputs = [block.sums; R];
        for r in 0..R {
            outputs[r] = outputs[r].add((first + r) * block.stride);
        }
        let mut sums = [[[M::zero(); V]; R]; P];
        if block.more {
            for r in 0..R {
                for v in 0..V {
                    sums[0][r][v] = M::load(outputs[r].add(v * M::LANES));
                }
            }
        }
        let panel = block.steps * PANEL;
        for t in 0..block.count {
            let mut inputs = [block.inputs; R];
            for r in 0..R {
                let place = usize::from(*block.places.add(t * block.group + first + r));
                inputs[r] = inputs[r].add(place * block.steps);
            }
            let mut weights = block.weights.add(usize::from(*block.taps.add(t)) * block.tap);
            let mut step = |part: usize, s: usize, weights: *const u32| {
                let mut weight = [M::weight(weights); V];
                for v in 1..V {
                    let (at, lane) = (v * M::LANES / PANEL, v * M::LANES % PANEL);
                    weight[v] = M::weight(weights.add(at * panel + lane));
                }
                for r in 0..R {
                    let factor = M::factor(inputs[r].add(s));
                    for v in 0..V {
                        sums[part][r][v] = M::mul_add(sums[part][r][v], weight[v], factor);
                    }
                }
            };
            let whole = block.steps - block.steps % P;
            let mut s = 0;
            while s < whole {
                for part in 0..P {
                    step(part, s + part, weights.add(part * PANEL));
                }
                s += P;
                weights = weights.add(P * PANEL);
            }
            for part in 0..block.steps - whole {
                step(part, whole + part, weights.add(part * PANEL));
            }
        }
        for r in 0..R {
            for v in 0..V {
                let mut sum = sums[0][r][v];
                for part in 1..P {
                    sum = M::add(sum, sums[part][r][v]);
                }
                M::store(outputs[r].add(v * M::LANES), sum);
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
    /// Pairs of f16, one after the other: only where [`Isa::has_half`].
    #[cfg(target_arch = "aarch64")]
    Half,
}

impl Arithmetic {
    fn is_in(self, isa: Isa) -> bool {
        match self {
            Arithmetic::Float | Arithmetic::Integer => true,
            Arithmetic::Brain => isa.has_bf16(),
            #[cfg(target_arch = "aarch64")]
            Arithmetic::Half => isa.has_half(),
        }
    }
}

/// Writes rows of the input, of so many values each, as words.
pub(crate) type Expand<T> = fn(Isa, &[T], &[u32], usize, &mut [u32]);

/// The sums over all taps of a tile, `sums[row · panels + panel]`, rows in the plan's order; others may follow.
///
/// `weights` are ordered `[tap][panel][step]`; an input row has `cin` values, which `expand` writes into a word for each step.
///
/// # Panics
/// If the plan reads beyond the input.
#[expect(clippy::too_many_arguments, reason = "all that a layer and a tile are")]
pub(crate) fn accumulate<T>(
    isa: Isa,
    arithmetic: Arithmetic,
    extents: Extents,
    weights: &[Lanes],
    plan: &PlanTile,
    (input, expand): (&[T], Expand<T>),
    expanded: &mut Vec<Lanes>,
    sums: &mut Vec<Lanes>,
) {
    assert!(arithmetic.is_in(isa));
    let Extents { volume, cin, .. } = extents;
    let panels = extents.panels();
    let steps = weights.len() / (volume * panels);
    plan.check(volume, input.len() / cin);
    let words = plan.inputs().len() * steps;
    expanded.resize((words + steps).div_ceil(PANEL), Lanes::default());
    let rows = machine::words_mut(expanded);
    expand(isa, input, plan.inputs(), cin, &mut rows[..words]);
    rows[words..words + steps].fill(0);

    let group = plan.group();
    sums.resize(plan.groups() * group * panels, Lanes::default());
    let half = usize::from((1..=PANEL / 2).contains(&(extents.cout % PANEL)));
    let mut panel = 0;
    while panel < panels {
        let whole = panels - panel - half;
        let width = width(isa, whole);
        let taps = (CACHED / (width * steps)).max(1);
        for tap in (0..volume).step_by(taps) {
            for (number, sums) in sums.chunks_exact_mut(group * panels).enumerate() {
                let (taps, places) = plan.steps(number, tap..(tap + taps).min(volume));
                if tap > 0 && taps.is_empty() {
                    continue;
                }
                let block = Block {
                    group,
                    taps: taps.as_ptr(),
                    count: taps.len(),
                    places: places.as_ptr(),
                    inputs: rows.as_ptr(),
                    steps,
                    weights: weights[panel * steps..].as_ptr().cast(),
                    tap: panels * steps * PANEL,
                    sums: sums[panel..].as_mut_ptr().cast(),
                    stride: panels * PANEL,
                    more: tap > 0,
                };
                // SAFETY: all places are those of an expanded row, or of the zeros that follow; `sums` are those of the group's rows; the
                // weights are those of the panels from here on, with `whole` and, if there is none, half of one left.
                unsafe { run(isa, arithmetic, &block, whole) };
            }
        }
        panel += width;
    }
}

/// The products of rows of words by the weights `[panel][step]` of one tap: `products[row · panels + panel]`.
///
/// # Panics
/// If there are more than [`TILE`] rows, or not whole groups.
pub(crate) fn multiply_rows(isa: Isa, cout: usize, weights: &[Lanes], rows: &[u32], products: &mut [Lanes]) {
    let panels = cout.div_ceil(PANEL);
    let (steps, count) = (weights.len() / panels, products.len() / panels);
    assert!(count <= TILE && count.is_multiple_of(group(isa, cout)));
    assert_eq!(rows.len(), count * steps, "a row of words for each of products");
    let half = usize::from((1..=PANEL / 2).contains(&(cout % PANEL)));
    let mut panel = 0;
    while panel < panels {
        let whole = panels - panel - half;
        let block = Block {
            group: count,
            taps: FIRST.as_ptr(),
            count: 1,
            places: IN_ORDER.as_ptr(),
            inputs: rows.as_ptr(),
            steps,
            weights: weights[panel * steps..].as_ptr().cast(),
            tap: panels * steps * PANEL,
            sums: products[panel..].as_mut_ptr().cast(),
            stride: panels * PANEL,
            more: false,
        };
        // SAFETY: there are as many places as rows, each of `steps` words, and `products` for all of them; the weights are those of the panels
        // from here on, with `whole` and, if there is none, half of one left.
        unsafe { run(isa, Arithmetic::Integer, &block, whole) };
        panel += width(isa, whole);
    }
}

/// The only tap.
static FIRST: [u8; 1] = [0];

/// Of `whole` panels, or the half that is left, as many as are multiplied at once.
fn width(isa: Isa, whole: usize) -> usize {
    match isa.level() {
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(_) | Level::Amx(..) => match whole {
            WIDE.. => WIDE,
            _ => whole.clamp(1, 2),
        },
        _ => {
            let _ = whole;
            1
        }
    }
}

/// Multiplies [`width`] panels.
///
/// # Safety
/// The block's pointers must hold what they promise for these panels, and the machine must have the arithmetic.
unsafe fn run(isa: Isa, arithmetic: Arithmetic, block: &Block, whole: usize) {
    // SAFETY: an `Isa` is only made where the processor has its instructions, and its group is what blocks of its rows divide; the
    // rest is the caller's promise.
    unsafe {
        match isa.level() {
            Level::Scalar(_) => machine::scalar::run(arithmetic, block, whole),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => machine::avx2::run(arithmetic, block, whole),
            #[cfg(target_arch = "x86_64")]
            Level::AvxVnni(..) => machine::avx2::run_vnni(arithmetic, block, whole),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) | Level::Amx(..) => machine::avx512::run(arithmetic, block, whole),
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) | Level::NeonDot(..) => machine::neon::run(arithmetic, block, whole),
        }
    }
}

/// Multiplies for as long as `rounds` say, and gives the number of products: see [`crate::ceiling`].
///
/// # Panics
/// If the machine lacks what it is asked for.
pub(crate) fn spin(isa: Isa, arithmetic: Arithmetic, rounds: usize) -> usize {
    assert!(arithmetic.is_in(isa));
    // SAFETY: an `Isa` is only made where the processor has its instructions; what it may lack has just been asked about.
    let words = unsafe {
        match isa.level() {
            Level::Scalar(_) => machine::scalar::spin(arithmetic, rounds),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => machine::avx2::spin(arithmetic, rounds),
            #[cfg(target_arch = "x86_64")]
            Level::AvxVnni(..) => machine::avx2::spin_vnni(arithmetic, rounds),
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) | Level::Amx(..) => machine::avx512::spin(arithmetic, rounds),
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) | Level::NeonDot(..) => machine::neon::spin(arithmetic, rounds),
        }
    };
    match arithmetic {
        Arithmetic::Float => words,
        Arithmetic::Integer | Arithmetic::Brain => 2 * words,
        #[cfg(target_arch = "aarch64")]
        Arithmetic::Half => 2 * words,
    }
}
