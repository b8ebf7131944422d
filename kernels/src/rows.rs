//! The loop that both convolutions share: tiles of output rows, tap by tap, in blocks that stay in registers.

use std::num::Wrapping;
use std::ops::AddAssign;

use crate::isa::{Isa, dispatch};
use crate::taps::TileTaps;

/// Channels of one weight panel, and of one accumulator.
pub(crate) const PANEL: usize = 16;
/// Output rows of a tile: enough that every tap finds full blocks, few enough that their accumulators stay in the cache.
pub(crate) const TILE: usize = 128;
/// Rows multiplied together, sharing each weight that is loaded.
const BLOCK: usize = 4;

/// Where a layer writes, and what it adds on the way.
pub struct Output<'a, T, R = T> {
    /// Whole rows of `stride` values, one after the other.
    pub rows: &'a mut [T],
    /// Values per row.
    pub stride: usize,
    /// The first value of each row that the layer writes.
    pub column: usize,
    /// Laid out as `rows`: added to what is written.
    pub residual: Option<&'a [R]>,
    /// Whether negative results become zero, after the addition.
    pub relu: bool,
}

/// The arithmetic of one multiply-add over [`PANEL`] output channels.
pub(crate) trait Arithmetic {
    /// An activation in memory.
    type Value: Copy;
    /// What one step multiplies the panel's weights by.
    type Factor: Copy + Default;
    /// A panel's weights of one step.
    type Weights: Copy + Default;
    /// A panel's sums.
    type Sums: Copy + Default;

    /// Steps for `cin` input channels.
    fn steps(cin: usize) -> usize;
    /// Prepares a row of input channels: one factor a step.
    fn expand(row: &[Self::Value], factors: &mut [Self::Factor]);
    /// `sums + weights · factor`.
    fn step(sums: Self::Sums, weights: &Self::Weights, factor: &Self::Factor) -> Self::Sums;
}

/// The extents of a layer's weights.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extents {
    pub volume: usize,
    pub cin: usize,
    pub cout: usize,
}

impl Extents {
    pub fn panels(&self) -> usize {
        self.cout.div_ceil(PANEL)
    }

    /// Checks that `len` weights fill the extents.
    pub fn check(&self, len: usize) {
        assert!(
            self.volume > 0 && self.cin > 0 && self.cout > 0,
            "a layer has no extent"
        );
        assert_eq!(
            len,
            self.volume * self.cin * self.cout,
            "weights must fill [volume, cin, cout]"
        );
    }
}

/// Sums over all taps of the tile: `sums[row · panels + panel]`, overwritten.
///
/// `weights` are ordered `[tap][panel][step]`.
pub(crate) fn accumulate<A: Arithmetic>(
    isa: Isa,
    extents: Extents,
    weights: &[A::Weights],
    taps: &TileTaps,
    input: &[A::Value],
    factors: &mut Vec<A::Factor>,
    sums: &mut [A::Sums],
) {
    let (cin, panels, steps) = (extents.cin, extents.panels(), A::steps(extents.cin));
    sums.fill(A::Sums::default());
    factors.resize(BLOCK * steps, A::Factor::default());
    for k in 0..extents.volume {
        let weights = &weights[k * panels * steps..(k + 1) * panels * steps];
        for block in taps.of(k).chunks(BLOCK) {
            for (pair, factors) in block.iter().zip(factors.chunks_exact_mut(steps)) {
                expand::<A>(isa, &input[pair.input as usize * cin..][..cin], factors);
            }
            for (panel, weights) in weights.chunks_exact(steps).enumerate() {
                let at = |slot: usize| block[slot].row as usize * panels + panel;
                match block.len() {
                    4 => {
                        multiply::<A, 4>(isa, weights, factors, sums, [at(0), at(1), at(2), at(3)])
                    }
                    3 => multiply::<A, 3>(isa, weights, factors, sums, [at(0), at(1), at(2)]),
                    2 => multiply::<A, 2>(isa, weights, factors, sums, [at(0), at(1)]),
                    _ => multiply::<A, 1>(isa, weights, factors, sums, [at(0)]),
                }
            }
        }
    }
}

fn expand<A: Arithmetic>(isa: Isa, row: &[A::Value], factors: &mut [A::Factor]) {
    #[inline(always)]
    fn body<A: Arithmetic>(row: &[A::Value], factors: &mut [A::Factor]) {
        A::expand(row, factors);
    }
    dispatch!(isa, fn body<A: Arithmetic>(row: &[A::Value], factors: &mut [A::Factor]));
}

/// Adds one panel's products to the sums `at[0]`, `at[1]`, …, which stay in registers throughout.
fn multiply<A: Arithmetic, const ROWS: usize>(
    isa: Isa,
    weights: &[A::Weights],
    factors: &[A::Factor],
    sums: &mut [A::Sums],
    at: [usize; ROWS],
) {
    #[inline(always)]
    fn body<A: Arithmetic, const ROWS: usize>(
        weights: &[A::Weights],
        factors: &[A::Factor],
        sums: &mut [A::Sums],
        at: [usize; ROWS],
    ) {
        let steps = weights.len();
        let mut local: [A::Sums; ROWS] = at.map(|i| sums[i]);
        let factors: [&[A::Factor]; ROWS] = std::array::from_fn(|r| &factors[r * steps..][..steps]);
        for (s, weights) in weights.iter().enumerate() {
            for r in 0..ROWS {
                local[r] = A::step(local[r], weights, &factors[r][s]);
            }
        }
        for (i, sum) in at.into_iter().zip(local) {
            sums[i] = sum;
        }
    }
    dispatch!(isa, fn body<A: Arithmetic; const ROWS>(
        weights: &[A::Weights], factors: &[A::Factor], sums: &mut [A::Sums], at: [usize; ROWS],
    ));
}

/// For every row of the tile the sum of `energy[tap][channel]` over its taps: what a geometry-invariant layer divides by.
pub(crate) fn energies<E: Energy>(
    isa: Isa,
    cout: usize,
    energy: &[E],
    taps: &TileTaps,
    sums: &mut [E],
) {
    dispatch!(isa, fn add_energies<E: Energy>(cout: usize, energy: &[E], taps: &TileTaps, sums: &mut [E]));
}

/// A sum of squared weights.
pub(crate) trait Energy: Copy + Default + AddAssign {}

impl Energy for f32 {}
impl Energy for Wrapping<u32> {}

#[inline(always)]
fn add_energies<E: Energy>(cout: usize, energy: &[E], taps: &TileTaps, sums: &mut [E]) {
    sums.fill(E::default());
    for (k, energy) in energy.chunks_exact(cout).enumerate() {
        for pair in taps.of(k) {
            for (sum, &e) in sums[pair.row as usize * cout..][..cout]
                .iter_mut()
                .zip(energy)
            {
                *sum += e;
            }
        }
    }
}
