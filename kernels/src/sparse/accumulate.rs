//! The sums of a tile: its groups of rows by all taps and panels, as long as weights stay in the first cache.

use super::microkernel::{Block, MIN_GROUP, WIDE};
use super::plan::{Places, PlanTile};
use super::rows::{Extents, PANEL, TILE, Words};
use crate::simd::Isa;

/// [`Words`] of weights that the first cache holds besides rows and sums.
const CACHED: usize = 256;

/// Output rows of a layer of `cout` channels that are multiplied by the same taps: those of a matrix tile, or as many
/// as keep the registers busy. A multiple of [`MIN_GROUP`].
pub(crate) fn group(isa: Isa, cout: usize) -> usize {
    if isa.has_tiles() {
        16
    } else if isa.lanes() == 16 && !cout.is_multiple_of(WIDE * PANEL) {
        8
    } else {
        MIN_GROUP
    }
}

/// Multiplies the panels of a block, of which so many whole ones are left, or none and a half one: as many as [`width`]
/// says.
pub(crate) type Multiply = fn(Isa, &mut Block<'_>, usize);

/// Writes rows of the input, of so many values each, as words.
pub(crate) type Expand<T> = fn(Isa, &[T], &[u32], usize, &mut [u32]);

/// The sums over all taps of a tile, `sums[row · panels + panel]`, rows in the plan's order; others may follow.
///
/// `weights` are ordered `[tap][panel][step]`; an input row has `cin` values, which `expand` writes into a word for
/// each step.
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
                let mut block = Block {
                    group,
                    taps,
                    places: places.all(),
                    most: places.most(),
                    inputs: rows,
                    steps,
                    weights: &weights[panel * steps..],
                    volume,
                    tap: panels * steps,
                    sums: &mut sums[panel..],
                    stride: panels,
                    more: tap > 0,
                };
                multiply(isa, &mut block, whole);
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
        let (whole, places) = (whole(cout, panel), Places::in_order(count));
        let mut block = Block {
            group: count,
            taps: &[0],
            places: places.all(),
            most: places.most(),
            inputs: rows,
            steps,
            weights: &weights[panel * steps..],
            volume: 1,
            tap: panels * steps,
            sums: &mut products[panel..],
            stride: panels,
            more: false,
        };
        multiply(isa, &mut block, whole);
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
    match isa.lanes() {
        16 if whole >= WIDE => WIDE,
        16 => whole.clamp(1, 2),
        _ => 1,
    }
}
