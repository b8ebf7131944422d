//! The factors of geometry-invariant layers: they depend on which taps read something, and on nothing else of the input.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::rows::PANEL;

/// Sets of taps that are remembered at once.
const SLOTS: usize = 1024;
/// No set of taps: kernels have at most 63.
const NONE: u64 = u64::MAX;

/// A layer's gains and the squares of its weights.
#[derive(Debug, Clone)]
pub(crate) struct Gains<E> {
    /// Tells it from all others but its clones.
    id: u64,
    /// `Σ weight²` over the input channels, `[tap][panel]`.
    energy: Vec<[E; PANEL]>,
    gain: Vec<[f32; PANEL]>,
}

impl<E: Energy> Gains<E> {
    pub fn new(energy: Vec<[E; PANEL]>, gain: Vec<[f32; PANEL]>) -> Self {
        static LAST: AtomicU64 = AtomicU64::new(0);
        Gains {
            id: LAST.fetch_add(1, Ordering::Relaxed) + 1,
            energy,
            gain,
        }
    }

    /// The gains over the norms of the weights of some taps.
    #[inline(always)]
    fn factors(&self, mask: u64, to: &mut [[f32; PANEL]]) {
        let panels = self.gain.len();
        for (panel, (to, gain)) in to.iter_mut().zip(&self.gain).enumerate() {
            let mut sum = [E::default(); PANEL];
            let mut rest = mask;
            while rest != 0 {
                let tap = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                let energy = &self.energy[tap * panels + panel];
                for (sum, &energy) in sum.iter_mut().zip(energy) {
                    *sum = sum.add(energy);
                }
            }
            *to = std::array::from_fn(|lane| sum[lane].factor(gain[lane]));
        }
    }
}

/// What a sum of squared weights is counted in, and what becomes of it.
pub(crate) trait Energy: Copy + Default {
    fn add(self, other: Self) -> Self;
    /// `gain` over the norm.
    fn factor(self, gain: f32) -> f32;
}

impl Energy for u32 {
    #[inline(always)]
    fn add(self, other: u32) -> u32 {
        self.wrapping_add(other)
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
    pub fn of<E: Energy>(&mut self, gains: &Gains<E>, mask: u64) -> &[[f32; PANEL]] {
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
            gains.factors(mask, factors);
            self.masks[slot] = mask;
        }
        factors
    }
}
