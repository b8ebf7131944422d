//! The factors of geometry-invariant layers: they depend on which taps read something, and on nothing else of the input.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::rows::PANEL;
use crate::winograd::Registers;

/// Sets of taps that are remembered at once.
const SLOTS: usize = 1024;
/// No set of taps: kernels have fewer than 64.
const NONE: u64 = u64::MAX;

/// A layer's gains and the squares of its weights.
#[derive(Debug, Clone)]
pub(crate) struct Gains<E> {
    /// Tells it from all others but its clones.
    id: u64,
    /// `Σ weight²` over the input channels of some of [`PART`] taps, by which of them: `[panel][taps / PART][1 << PART]`.
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
    ///
    /// # Safety
    /// The processor must have `R`'s instructions.
    #[inline(always)]
    unsafe fn factors<R: Registers>(&self, mask: u64, to: &mut [[f32; PANEL]]) {
        let panels = self.energy.chunks_exact(self.energy.len() / self.gain.len());
        for ((to, gain), parts) in to.iter_mut().zip(&self.gain).zip(panels) {
            let chosen = parts.as_chunks::<{ 1 << PART }>().0.iter().enumerate();
            let chosen = chosen.map(|(part, energy)| {
                let some = (mask >> (part * PART)) as usize % (1 << PART);
                &energy[some]
            });
            // SAFETY: the caller's promise.
            let sum = unsafe { E::sum::<R>(chosen) };
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
    ///
    /// # Safety
    /// The processor must have `R`'s instructions.
    unsafe fn sum<'a, R: Registers>(panels: impl Iterator<Item = &'a [Self; PANEL]> + Clone) -> [Self; PANEL];
    /// `gain` over the norm.
    fn factor(self, gain: f32) -> f32;
}

impl Energy for u32 {
    #[inline(always)]
    fn add(self, other: u32) -> u32 {
        self.wrapping_add(other)
    }

    #[inline(always)]
    unsafe fn sum<'a, R: Registers>(panels: impl Iterator<Item = &'a [u32; PANEL]> + Clone) -> [u32; PANEL] {
        let mut sum = [0; PANEL];
        // Of its own accord the compiler adds one by one.
        for at in (0..size_of_val(&sum)).step_by(R::BYTES) {
            let mut panels = panels.clone().map(|panel| panel.as_ptr().cast::<u8>());
            let Some(first) = panels.next() else {
                break;
            };
            // SAFETY: the caller's promise, and a panel holds a whole number of registers.
            unsafe {
                let first = R::read(first.add(at));
                let sum_of = panels.fold(first, |sum, panel| R::add32(sum, R::read(panel.add(at))));
                R::write(sum.as_mut_ptr().cast::<u8>().add(at), sum_of);
            }
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
    unsafe fn sum<'a, R: Registers>(panels: impl Iterator<Item = &'a [f32; PANEL]> + Clone) -> [f32; PANEL] {
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
    ///
    /// # Safety
    /// The processor must have `R`'s instructions.
    #[inline(always)]
    pub unsafe fn of<R: Registers, E: Energy>(&mut self, gains: &Gains<E>, mask: u64) -> &[[f32; PANEL]] {
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
            // SAFETY: the caller's promise.
            unsafe { gains.factors::<R>(mask, factors) };
            self.masks[slot] = mask;
        }
        factors
    }
}
