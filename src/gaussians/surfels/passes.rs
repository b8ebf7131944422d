//! The loops over voxels, compiled once per instruction set.

use b2p_kernels::{Instructions, Work};

use super::discs::{Disc, discs};
use super::lanes::GROUP;
use super::moments::{Moments, absolute, centred, near};
use super::windows::{Window, gathered};
use crate::geometry::{KernelMap, SiblingMap};

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
        for (to, row) in self.to.iter_mut().zip(self.rows.as_chunks::<27>().0) {
            *to = sum(self.from, row.iter().map(|&q| q.into()));
        }
    }
}

/// Sums the moments of all neighbours of consecutive voxels of a level.
pub struct SumOfLevel<'a> {
    /// Moments of each voxel of the level, then zeros for absent neighbours.
    pub from: &'a [Moments],
    pub map: &'a SiblingMap,
    /// The first voxel of `to`.
    pub first: usize,
    pub to: &'a mut [Moments],
}

impl Work for SumOfLevel<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let mut windows = self.map.windows(self.first);
        for to in self.to {
            let Some((window, corner)) = windows.next() else {
                return;
            };
            let around = window.from(corner);
            let mut total = [0; 16];
            for z in 0..3 {
                for y in 0..3 {
                    for q in &around[4 * y + 16 * z..][..3] {
                        add(&mut total, self.from, *q as usize);
                    }
                }
            }
            *to = total;
        }
    }
}

/// The sum of the moments of a row. Absent neighbours lie beyond the zeros that end the moments.
#[inline(always)]
fn sum(moments: &[Moments], row: impl Iterator<Item = usize>) -> Moments {
    let mut total = [0; 16];
    for q in row {
        add(&mut total, moments, q);
    }
    total
}

#[inline(always)]
fn add(total: &mut Moments, moments: &[Moments], q: usize) {
    // No branch: the presence of neighbours is unpredictable.
    let q = q.min(moments.len() - 1);
    for (total, value) in total.iter_mut().zip(&moments[q]) {
        *total = total.wrapping_add(*value);
    }
}

/// Makes places in a range of rows of neighbours.
pub struct Locate<'a> {
    /// The rows of voxels, as a map has them.
    pub rows: &'a [u32],
    /// The first voxel of the range, and how many it has.
    pub range: (u32, u32),
    /// Gets the places of neighbours in the range, [`Locate::ABSENT`] for others.
    pub to: &'a mut [u16],
    /// Gets the numbers of the rows that have neighbours beyond the range.
    pub edge: &'a mut Vec<u32>,
}

impl Locate<'_> {
    /// The place of a neighbour that is not in the range.
    pub const ABSENT: u16 = u16::MAX;
}

impl Work for Locate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let (first, count) = self.range;
        let (rows, to) = (self.rows.as_chunks::<27>().0, self.to.as_chunks_mut::<27>().0);
        for (number, (row, to)) in (0..).zip(rows.iter().zip(to)) {
            let mut beyond = 0u32;
            // No branch: the presence of neighbours is unpredictable.
            for (to, &q) in to.iter_mut().zip(row) {
                let place = q.wrapping_sub(first);
                let inside = place < count;
                *to = if inside { place as u16 } else { Self::ABSENT };
                beyond |= u32::from(!inside & (q != KernelMap::ABSENT));
            }
            if beyond != 0 {
                self.edge.push(number);
            }
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
    fn run<I: Instructions>(self, instructions: I) -> Vec<Disc> {
        let mut out = Vec::with_capacity(self.coordinates.len().next_multiple_of(GROUP));
        let groups = self.masks.chunks(GROUP).zip(self.far.chunks(GROUP));
        for (coordinates, (masks, far)) in self.coordinates.chunks(GROUP).zip(groups) {
            out.extend(discs(instructions, &near(masks), &centred(far, coordinates), None));
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
    fn run<I: Instructions>(self, instructions: I) -> Vec<Disc> {
        let mut out = Vec::with_capacity(self.masks.len().next_multiple_of(GROUP));
        for (masks, windows) in self.masks.chunks(GROUP).zip(self.windows.chunks(GROUP)) {
            let (far, reach) = gathered(windows);
            out.extend(discs(instructions, &near(masks), &far, Some(&reach)));
        }
        out.truncate(self.masks.len());
        out
    }
}
