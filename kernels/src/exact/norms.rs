//! The factors of geometry-invariant layers: they depend on which taps read something, and on nothing else of the
//! input.

use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::{must_cast_mut, must_cast_ref};

use crate::simd::{I32Vector, Simd};
use crate::sparse::rows::PANEL;

/// Sets of taps that are remembered at once.
const SLOTS: usize = 1024;
/// No set of taps: kernels have fewer than 64.
const NONE: u64 = u64::MAX;

/// A layer's gains and the squares of its weights.
#[derive(Debug, Clone)]
pub(crate) struct Gains<E> {
    /// Tells it from all others but its clones.
    id: u64,
    /// `Σ weight²` over the input channels of some of [`PART`] taps, by which of them: `[panel][taps / PART][1 <<
    /// PART]`.
    energy: Vec<[E; PANEL]>,
    gain: Vec<[f32; PANEL]>,
}

/// Taps whose weights are summed ahead, in all combinations.
const PART: usize = 4;

impl<E: Energy> Gains<E> {
    /// `taps` holds `Σ weight²` over the input channels, `[tap][panel]`.
    pub fn new(taps: Vec<[E; PANEL]>, gain: Vec<[f32; PANEL]>) -> Self {
        static LAST: AtomicU64 = AtomicU64::new(0);
        let panels = gain.len();
        let mut energy = Vec::with_capacity(taps.len().div_ceil(PART) << PART);
        for panel in 0..panels {
            for taps in taps.chunks(PART * panels) {
                for some in 0..1 << PART {
                    let mut sum = [E::default(); PANEL];
                    let taps = taps.iter().skip(panel).step_by(panels).enumerate();
                    for (_, tap) in taps.filter(|(tap, _)| some >> tap & 1 == 1) {
                        add(&mut sum, tap);
                    }
                    energy.push(sum);
                }
            }
        }
        Gains {
            id: LAST.fetch_add(1, Ordering::Relaxed) + 1,
            energy,
            gain,
        }
    }

    /// The gains over the norms of the weights of some taps.
    #[inline(always)]
    fn factors<S: Simd>(&self, simd: S, mask: u64, to: &mut [[f32; PANEL]]) {
        let panels = self.energy.chunks_exact(self.energy.len() / self.gain.len());
        for ((to, gain), parts) in to.iter_mut().zip(&self.gain).zip(panels) {
            let chosen = parts.as_chunks::<{ 1 << PART }>().0.iter().enumerate();
            let chosen = chosen.map(|(part, energy)| {
                let some = (mask >> (part * PART)) as usize % (1 << PART);
                &energy[some]
            });
            let sum = E::sum(simd, chosen);
            *to = std::array::from_fn(|lane| sum[lane].factor(gain[lane]));
        }
    }
}

fn add<E: Energy>(sum: &mut [E; PANEL], other: &[E; PANEL]) {
    for (sum, &other) in sum.iter_mut().zip(other) {
        *sum = sum.add(other);
    }
}

/// What a sum of squared weights is counted in, and what becomes of it.
pub(crate) trait Energy: Copy + Default + 'static {
    fn add(self, other: Self) -> Self;
    /// Of some panels.
    fn sum<'a, S: Simd>(simd: S, panels: impl Iterator<Item = &'a [Self; PANEL]> + Clone) -> [Self; PANEL];
    /// `gain` over the norm.
    fn factor(self, gain: f32) -> f32;
}

impl Energy for u32 {
    #[inline(always)]
    fn add(self, other: u32) -> u32 {
        self.wrapping_add(other)
    }

    #[inline(always)]
    fn sum<'a, S: Simd>(simd: S, panels: impl Iterator<Item = &'a [u32; PANEL]> + Clone) -> [u32; PANEL] {
        let mut sum = [0; PANEL];
        // Of its own accord the compiler adds one by one.
        for at in (0..PANEL).step_by(S::LANES) {
            let load = |panel: &[u32; PANEL]| S::I32::load(simd, &must_cast_ref::<_, [i32; PANEL]>(panel)[at..]);
            let all = panels
                .clone()
                .fold(S::I32::splat(simd, 0), |sum, panel| sum + load(panel));
            all.store(&mut must_cast_mut::<_, [i32; PANEL]>(&mut sum)[at..]);
        }
        sum
    }

    #[inline(always)]
    fn factor(self, gain: f32) -> f32 {
        gain / (self.max(1) as f32).sqrt()
    }
}

impl Energy for f32 {
    #[inline(always)]
    fn add(self, other: f32) -> f32 {
        self + other
    }

    #[inline(always)]
    fn sum<'a, S: Simd>(_: S, panels: impl Iterator<Item = &'a [f32; PANEL]> + Clone) -> [f32; PANEL] {
        panels.fold([0.0; PANEL], |sum, panel| {
            std::array::from_fn(|lane| sum[lane] + panel[lane])
        })
    }

    #[inline(always)]
    fn factor(self, gain: f32) -> f32 {
        gain / (self + 1e-8).sqrt()
    }
}

/// The factors that a thread computed last for its present layer.
#[derive(Default)]
pub(crate) struct Norms {
    /// The layer's id, or 0.
    layer: u64,
    masks: Vec<u64>,
    /// A row of panels for each slot.
    factors: Vec<[f32; PANEL]>,
}

impl Norms {
    /// The layer's factors for a set of taps.
    #[inline(always)]
    pub fn of<S: Simd, E: Energy>(&mut self, simd: S, gains: &Gains<E>, mask: u64) -> &[[f32; PANEL]] {
        let panels = gains.gain.len();
        if self.layer != gains.id {
            self.layer = gains.id;
            self.masks.clear();
            self.masks.resize(SLOTS, NONE);
            self.factors.resize(SLOTS * panels, [0.0; PANEL]);
        }
        let slot = (mask.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) as usize % SLOTS;
        let factors = &mut self.factors[slot * panels..][..panels];
        if self.masks[slot] != mask {
            gains.factors(simd, mask, factors);
            self.masks[slot] = mask;
        }
        factors
    }
}
