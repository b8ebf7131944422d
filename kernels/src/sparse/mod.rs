//! Sparse convolution, as far as integers and floats have it in common: which input rows a tile of output rows reads, and the
//! register-blocked loop that multiplies them by weights.

pub(crate) mod children;
#[cfg(target_arch = "x86_64")]
mod lists;
pub(crate) mod peak;
pub(crate) mod plan;
pub(crate) mod rows;
pub(crate) mod taps;

use crate::simd::Isa;
#[cfg(target_arch = "x86_64")]
use crate::simd::Level;
use plan::PlanTile;
use rows::{Extents, IN_ORDER, PANEL, TILE, Words};

/// The smallest [`group`].
pub(crate) const MIN_GROUP: usize = 4;
/// Panels that AVX-512 multiplies at once, by the rows of the smallest group, where a layer has so many.
pub(crate) const WIDE: usize = 4;
/// [`Words`] of weights that the first cache holds besides rows and sums.
const CACHED: usize = 256;

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

/// A micro-kernel: vectors of 32-bit sums, and what multiplies and adds one step, which is an f32 or a pair of i16 or bf16.
pub(crate) trait Microkernel: Copy {
    /// Sums.
    type Sum: Copy;
    /// The weights of as many channels, for one step.
    type Weight: Copy;
    /// An input row's values of one step, for all channels.
    type Factor: Copy;
    /// Words in a vector; divides [`PANEL`].
    const LANES: usize;

    /// Zeros.
    fn zero(self) -> Self::Sum;
    /// The first sums of `from`.
    fn load(self, from: &[u32]) -> Self::Sum;
    /// Writes the first sums of `to`.
    fn store(self, sum: Self::Sum, to: &mut [u32]);
    /// The first weights of `from`.
    fn weight(self, from: &[u32]) -> Self::Weight;
    /// A row's values of one step.
    fn factor(self, word: u32) -> Self::Factor;
    /// `a + b`.
    fn add(self, a: Self::Sum, b: Self::Sum) -> Self::Sum;
    /// `sum + weight · factor`.
    fn mul_add(self, sum: Self::Sum, weight: Self::Weight, factor: Self::Factor) -> Self::Sum;
}

/// A group's rows, some taps and some panels.
pub(crate) struct Block<'a> {
    /// Rows of the group.
    pub group: usize,
    /// Its taps.
    pub taps: &'a [u8],
    /// For each tap and row, which of `inputs` it reads.
    pub places: &'a [u16],
    /// Input rows, `steps` words each.
    pub inputs: &'a [u32],
    /// Steps.
    pub steps: usize,
    /// The first panel's weights of tap 0, `steps` [`Words`] a panel; those of the next panel follow.
    pub weights: &'a [Words],
    /// [`Words`] from one tap's weights to the next's.
    pub tap: usize,
    /// The first panel's sums of the group's rows, each `stride` [`Words`] after the last's; those of the next panel follow.
    pub sums: &'a mut [Words],
    /// [`Words`] from one row's sums to the next's.
    pub stride: usize,
    /// Whether there are sums to add to.
    pub more: bool,
}

/// Sums a block's products, for `V` vectors of channels from the first panel on, `R` rows at once, which divide the group. Each sum is
/// computed in `P` parts, of every `P`th step, where there would be too few to hide the latency of an addition.
///
/// # Panics
/// If the block reads or writes beyond its slices.
#[inline(always)]
pub(crate) fn columns<K: Microkernel, const R: usize, const V: usize, const P: usize>(
    kernel: K,
    block: &mut Block<'_>,
) {
    for first in (0..block.group).step_by(R) {
        multiply::<K, R, V, P>(kernel, block, first);
    }
}

/// Sums the products of `R` rows from `first` on.
#[inline(always)]
#[expect(clippy::needless_range_loop, reason = "rows, vectors and parts are counted alike")]
fn multiply<K: Microkernel, const R: usize, const V: usize, const P: usize>(k: K, block: &mut Block<'_>, first: usize) {
    let steps = block.steps;
    let mut sums = [[[k.zero(); V]; R]; P];
    if block.more {
        for r in 0..R {
            for v in 0..V {
                let at = v * K::LANES;
                let panel = &block.sums[(first + r) * block.stride + at / PANEL];
                sums[0][r][v] = k.load(&panel.0[at % PANEL..]);
            }
        }
    }
    for (t, &tap) in block.taps.iter().enumerate() {
        let places = &block.places[t * block.group + first..][..R];
        let mut inputs = [(&[][..], &[][..]); R];
        for r in 0..R {
            let row = &block.inputs[usize::from(places[r]) * steps..][..steps];
            inputs[r] = row.as_chunks::<P>();
        }
        let tap = &block.weights[usize::from(tap) * block.tap..];
        let mut weights = [(&[][..], &[][..]); V];
        for v in 0..V {
            weights[v] = tap[v * K::LANES / PANEL * steps..][..steps].as_chunks::<P>();
        }
        for s in 0..steps / P {
            for part in 0..P {
                let mut weight = [k.weight(&weights[0].0[s][part].0); V];
                for v in 1..V {
                    weight[v] = k.weight(&weights[v].0[s][part].0[v * K::LANES % PANEL..]);
                }
                for r in 0..R {
                    let factor = k.factor(inputs[r].0[s][part]);
                    for v in 0..V {
                        sums[part][r][v] = k.mul_add(sums[part][r][v], weight[v], factor);
                    }
                }
            }
        }
        if P == 1 {
            continue;
        }
        for s in 0..steps % P {
            for r in 0..R {
                let factor = k.factor(inputs[r].1[s]);
                for v in 0..V {
                    let weight = k.weight(&weights[v].1[s].0[v * K::LANES % PANEL..]);
                    sums[0][r][v] = k.mul_add(sums[0][r][v], weight, factor);
                }
            }
        }
    }
    for r in 0..R {
        for v in 0..V {
            let mut sum = sums[0][r][v];
            for part in 1..P {
                sum = k.add(sum, sums[part][r][v]);
            }
            let at = v * K::LANES;
            let panel = &mut block.sums[(first + r) * block.stride + at / PANEL];
            k.store(sum, &mut panel.0[at % PANEL..]);
        }
    }
}

/// Multiplies the panels of a block, of which so many whole ones are left, or none and a half one: as many as [`width`] says.
pub(crate) type Multiply = fn(Isa, Block<'_>, usize);

/// Writes rows of the input, of so many values each, as words.
pub(crate) type Expand<T> = fn(Isa, &[T], &[u32], usize, &mut [u32]);

/// The sums over all taps of a tile, `sums[row · panels + panel]`, rows in the plan's order; others may follow.
///
/// `weights` are ordered `[tap][panel][step]`; an input row has `cin` values, which `expand` writes into a word for each step.
///
/// # Panics
/// If the plan reads beyond the input.
pub(crate) fn accumulate<T>(
    isa: Isa,
    multiply: Multiply,
    extents: Extents,
    weights: &[Words],
    plan: &PlanTile,
    (input, expand): (&[T], Expand<T>),
    expanded: &mut Vec<Words>,
    sums: &mut Vec<Words>,
) {
    let Extents { volume, cin, .. } = extents;
    let panels = extents.panels();
    let steps = weights.len() / (volume * panels);
    plan.check(volume, input.len() / cin);
    let words = plan.inputs().len() * steps;
    expanded.resize((words + steps).div_ceil(PANEL), Words::default());
    let rows: &mut [u32] = bytemuck::must_cast_slice_mut(expanded);
    expand(isa, input, plan.inputs(), cin, &mut rows[..words]);
    // What a tap reads that reads nothing.
    rows[words..words + steps].fill(0);

    let group = plan.group();
    sums.resize(plan.groups() * group * panels, Words::default());
    let mut panel = 0;
    while panel < panels {
        let whole = whole(extents.cout, panel);
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
                    taps,
                    places,
                    inputs: rows,
                    steps,
                    weights: &weights[panel * steps..],
                    tap: panels * steps,
                    sums: &mut sums[panel..],
                    stride: panels,
                    more: tap > 0,
                };
                multiply(isa, block, whole);
            }
        }
        panel += width;
    }
}

/// The products of rows of words by the weights `[panel][step]` of one tap: `products[row · panels + panel]`.
///
/// # Panics
/// If there are more than [`TILE`] rows, or not whole groups.
pub(crate) fn multiply_rows(
    isa: Isa,
    multiply: Multiply,
    cout: usize,
    weights: &[Words],
    rows: &[u32],
    products: &mut [Words],
) {
    let panels = cout.div_ceil(PANEL);
    let (steps, count) = (weights.len() / panels, products.len() / panels);
    assert!(count <= TILE && count.is_multiple_of(group(isa, cout)));
    assert_eq!(rows.len(), count * steps, "a row of words for each of products");
    let mut panel = 0;
    while panel < panels {
        let whole = whole(cout, panel);
        let block = Block {
            group: count,
            taps: &[0],
            places: &IN_ORDER[..count],
            inputs: rows,
            steps,
            weights: &weights[panel * steps..],
            tap: panels * steps,
            sums: &mut products[panel..],
            stride: panels,
            more: false,
        };
        multiply(isa, block, whole);
        panel += width(isa, whole);
    }
}

/// Whole panels of `cout` channels from a panel on. If at most half of the last one is used, it is none.
fn whole(cout: usize, panel: usize) -> usize {
    let half = usize::from((1..=PANEL / 2).contains(&(cout % PANEL)));
    cout.div_ceil(PANEL) - panel - half
}

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
