//! The loops that are compiled for every instruction set.

use b2p_kernels::{Instructions, Work};

use super::discs::{Disc, discs};
use super::lanes::GROUP;
use super::moments::{Moments, around};

/// Sums of moments over neighbours.
pub struct Sum<'a> {
    /// One of each voxel, and zeros at the end for neighbours that are not there.
    pub from: &'a [Moments],
    /// 27 indices for each row of `to`.
    pub rows: &'a [u32],
    pub to: &'a mut [Moments],
}

impl Work for Sum<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let nothing = self.from.len() - 1;
        for (to, row) in self.to.iter_mut().zip(self.rows.chunks_exact(27)) {
            let mut sum = [0u16; 16];
            for &q in row {
                // No branch: which neighbours are there cannot be predicted.
                let from = &self.from[nothing.min(q as usize)];
                for (sum, value) in sum.iter_mut().zip(from) {
                    *sum = sum.wrapping_add(*value);
                }
            }
            *to = sum;
        }
    }
}

/// The discs of consecutive voxels.
pub struct Fit<'a> {
    pub coordinates: &'a [[u32; 3]],
    /// Moments after one step.
    pub near: &'a [Moments],
    /// Moments after all steps.
    pub far: &'a [Moments],
}

impl Work for Fit<'_> {
    type Output = Vec<Disc>;

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) -> Vec<Disc> {
        let mut out = Vec::with_capacity(self.coordinates.len().next_multiple_of(GROUP));
        let groups = self.near.chunks(GROUP).zip(self.far.chunks(GROUP));
        for (coordinates, (near, far)) in self.coordinates.chunks(GROUP).zip(groups) {
            out.extend(discs(&around(near, coordinates), &around(far, coordinates)));
        }
        out.truncate(self.coordinates.len());
        out
    }
}
