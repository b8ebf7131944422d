//! The factors of geometry-invariant layers: they depend on which taps read something, and on nothing else of the input.

use crate::isa::{Isa, dispatch};
use crate::rows::PANEL;

/// Distinct sets of taps that are remembered at once.
const KEPT: usize = 512;
/// Places of the hash table: twice as many, so that it is never more than half full.
const SLOTS: usize = 2 * KEPT;

/// The factors of every set of taps met so far.
pub(crate) struct Norms {
    /// One more than the place in `masks`, or 0.
    slots: Box<[u16; SLOTS]>,
    masks: Vec<u64>,
    /// `panels` for each mask.
    factors: Vec<[f32; PANEL]>,
    /// For each row of the tile, the place of its mask.
    of_row: Vec<u32>,
}

impl Default for Norms {
    fn default() -> Self {
        Norms {
            slots: Box::new([0; SLOTS]),
            masks: Vec::new(),
            factors: Vec::new(),
            of_row: Vec::new(),
        }
    }
}

/// What a sum of squared weights is counted in, and what becomes of it.
pub(crate) trait Energy: Copy + Default + Send + Sync {
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

impl Norms {
    /// Forgets everything: another layer follows.
    pub fn clear(&mut self) {
        self.slots.fill(0);
        self.masks.clear();
        self.factors.clear();
    }

    /// Looks up, or computes, the factors of a tile's rows from `energy[tap · panels + panel]`.
    pub fn fill<E: Energy>(
        &mut self,
        isa: Isa,
        masks: &[u64],
        energy: &[[E; PANEL]],
        gain: &[[f32; PANEL]],
    ) {
        if self.masks.len() + masks.len() > KEPT {
            self.clear();
        }
        self.of_row.clear();
        for &mask in masks {
            let at = self.place(isa, mask, energy, gain);
            self.of_row.push(at);
        }
    }

    fn place<E: Energy>(
        &mut self,
        isa: Isa,
        mask: u64,
        energy: &[[E; PANEL]],
        gain: &[[f32; PANEL]],
    ) -> u32 {
        let mut slot = (mask.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 48) as usize % SLOTS;
        loop {
            match self.slots[slot] {
                0 => break,
                at if self.masks[usize::from(at) - 1] == mask => return u32::from(at) - 1,
                _ => slot = (slot + 1) % SLOTS,
            }
        }
        let at = self.masks.len();
        self.masks.push(mask);
        self.slots[slot] = at as u16 + 1;
        self.factors.resize((at + 1) * gain.len(), [0.0; PANEL]);
        let to = &mut self.factors[at * gain.len()..];
        dispatch!(isa, fn factors<E: Energy>(mask: u64, energy: &[[E; PANEL]], gain: &[[f32; PANEL]], to: &mut [[f32; PANEL]]));
        at as u32
    }

    /// The factors of the tile's row `row`.
    #[inline(always)]
    pub fn of(&self, row: usize, panels: usize) -> &[[f32; PANEL]] {
        &self.factors[self.of_row[row] as usize * panels..][..panels]
    }
}

#[inline(always)]
fn factors<E: Energy>(
    mask: u64,
    energy: &[[E; PANEL]],
    gain: &[[f32; PANEL]],
    to: &mut [[f32; PANEL]],
) {
    let panels = gain.len();
    for (panel, (to, gain)) in to.iter_mut().zip(gain).enumerate() {
        let mut sum = [E::default(); PANEL];
        let mut rest = mask;
        while rest != 0 {
            let tap = rest.trailing_zeros() as usize;
            rest &= rest - 1;
            let energy = &energy[tap * panels + panel];
            for (sum, &energy) in sum.iter_mut().zip(energy) {
                *sum = sum.add(energy);
            }
        }
        for ((to, sum), &gain) in to.iter_mut().zip(sum).zip(gain) {
            *to = sum.factor(gain);
        }
    }
}
