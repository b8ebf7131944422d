//! The loops over voxels, compiled once per instruction set.

use b2p_kernels::{Instructions, Work};

use super::discs::{Disc, discs};
use super::lanes::GROUP;
use super::moments::{Moments, absolute, centred, near};
use super::windows::{Window, gathered};

/// Sums the moments of all neighbours.
pub struct Sum<'a> {
    /// Moments of each voxel, then zeros for absent neighbours.
    pub from: &'a [Moments],
    /// 27 indices into `from` for each of `to`; those beyond it are of absent neighbours.
    pub rows: &'a [u16],
    pub to: &'a mut [Moments],
}

impl Work for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let absent = self.from.len() - 1;
        for (to, row) in self.to.iter_mut().zip(self.rows.chunks_exact(27)) {
            let mut sum = [0u16; 16];
            for &q in row {
                // No branch: the presence of neighbours is unpredictable.
                let from = &self.from[absent.min(q.into())];
                for (sum, value) in sum.iter_mut().zip(from) {
                    *sum = sum.wrapping_add(*value);
                }
            }
            *to = sum;
        }
    }
}

/// The moments of voxels after one step.
pub struct FirstStep<'a> {
    /// The occupied places of each voxel's row.
    pub masks: &'a [u32],
    pub coordinates: &'a [[u32; 3]],
    pub to: &'a mut [Moments],
}

impl Work for FirstStep<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        for ((&mask, &coordinate), to) in self.masks.iter().zip(self.coordinates).zip(self.to) {
            *to = absolute(mask, coordinate);
        }
    }
}

/// Fits the discs of consecutive voxels.
pub struct Fit<'a> {
    pub coordinates: &'a [[u32; 3]],
    /// The occupied places of each voxel's row.
    pub masks: &'a [u32],
    /// Moments after all steps.
    pub far: &'a [Moments],
}

impl Work for Fit<'_> {
    type Output = Vec<Disc>;

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> Vec<Disc> {
        let mut out = Vec::with_capacity(self.coordinates.len().next_multiple_of(GROUP));
        let groups = self.masks.chunks(GROUP).zip(self.far.chunks(GROUP));
        for (coordinates, (masks, far)) in self.coordinates.chunks(GROUP).zip(groups) {
            out.extend(discs(&near(masks), &centred(far, coordinates), None));
        }
        out.truncate(self.coordinates.len());
        out
    }
}

/// Fits the discs of voxels to windows.
pub struct FitWindows<'a> {
    /// The occupied places of each voxel's row.
    pub masks: &'a [u32],
    pub windows: &'a [Window],
}

impl Work for FitWindows<'_> {
    type Output = Vec<Disc>;

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> Vec<Disc> {
        let mut out = Vec::with_capacity(self.masks.len().next_multiple_of(GROUP));
        for (masks, windows) in self.masks.chunks(GROUP).zip(self.windows.chunks(GROUP)) {
            let (far, reach) = gathered(windows);
            out.extend(discs(&near(masks), &far, Some(&reach)));
        }
        out.truncate(self.masks.len());
        out
    }
}
