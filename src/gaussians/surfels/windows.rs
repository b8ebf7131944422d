//! Windows: cubes around voxels that have few connected neighbours, because the grid is finer than the points are close
//! (`docs/format.md`, clause 6.3.3).
//!
//! Windows reach 2, 4 and 8 voxels far. A voxel takes the first that holds at least [`LEAST`] voxels, itself included.
//! Their moments replace those of the walks (`moments.rs`), which need neighbours that touch. A surface of which an
//! eighth of the voxels is there still closes.

use std::ops::Range;

use super::lanes::{GROUP, Lane};
use super::moments::{CentredMoments, PAIRS};
use crate::geometry::{Voxels, morton};

/// Voxels that a window must hold.
const LEAST: u16 = 16;
/// The widest window reaches 2³ voxels far.
const WIDEST: usize = 3;
/// Voxels are searched for in cells of up to 2⁷ voxels: those of the next voxel are mostly the same.
const COARSEST: usize = 7;

/// Moments of the voxels in a window relative to the voxel in its middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// Voxels.
    pub count: u16,
    /// Σx, Σy, Σz.
    pub sum: [i32; 3],
    /// Σxx, Σyy, Σzz, Σxy, Σxz, Σyz.
    pub square: [i32; 6],
    /// The window has the voxels whose coordinates differ by at most `reach`.
    pub reach: u8,
}

/// Finds windows of voxels that are visited in Morton order.
pub struct Windows<'a> {
    voxels: &'a Voxels,
    /// For cells of 2, 4 … 2⁷ voxels: that of the last voxel, and the voxels of the 27 cells around it.
    cells: [Option<Cells>; COARSEST],
}

/// The 27 cells around one, x fastest.
#[derive(Clone)]
struct Cells {
    middle: [u32; 3],
    /// Voxels in each.
    ranges: [Range<usize>; 27],
}

impl<'a> Windows<'a> {
    pub fn new(voxels: &'a Voxels) -> Self {
        Windows {
            voxels,
            cells: [const { None }; COARSEST],
        }
    }

    /// The smallest window around a voxel with enough voxels.
    pub fn around(&mut self, coordinate: [u32; 3]) -> Option<Window> {
        let depth = usize::from(self.voxels.depth());
        let widest = WIDEST.min(depth);
        for scale in (widest.max(1)..=COARSEST.min(depth)).rev() {
            self.find_cells(coordinate, scale);
        }
        // No window holds more voxels than the cells of the widest one.
        if self.cells[widest.checked_sub(1)?].as_ref()?.voxels() < usize::from(LEAST) {
            return None;
        }
        for scale in (1..widest).rev() {
            self.find_cells(coordinate, scale);
        }
        (1..=widest)
            .map(|scale| self.window(coordinate, scale))
            .find(|window| window.count >= LEAST)
    }

    /// Finds the cells of edge 2^`scale` around a voxel, unless they are those of the last one. The cells of twice the
    /// edge, if there are any, are up to date.
    fn find_cells(&mut self, coordinate: [u32; 3], scale: usize) {
        let middle = coordinate.map(|v| v >> scale);
        if self.cells[scale - 1]
            .as_ref()
            .is_some_and(|cells| cells.middle == middle)
        {
            return;
        }
        let keys = self.voxels.keys();
        let end = 1u32 << (usize::from(self.voxels.depth()) - scale);
        let coarse = self.cells.get(scale).and_then(Option::as_ref);
        let ranges = std::array::from_fn(|k| {
            let steps = [k % 3, k / 3 % 3, k / 9];
            let cell = [0, 1, 2].map(|axis| (middle[axis] + steps[axis] as u32).wrapping_sub(1));
            if cell.iter().any(|&v| v >= end) {
                return 0..0;
            }
            let within = coarse.map_or(0..keys.len(), |coarse| coarse.of(cell.map(|v| v >> 1)));
            let first = morton::encode(cell) << (3 * scale);
            let last = first + (1 << (3 * scale));
            let inside = &keys[within.clone()];
            let from = inside.partition_point(|&key| key < first);
            let count = inside[from..].partition_point(|&key| key < last);
            within.start + from..within.start + from + count
        });
        self.cells[scale - 1] = Some(Cells { middle, ranges });
    }

    fn window(&self, coordinate: [u32; 3], scale: usize) -> Window {
        let reach = 1i32 << scale;
        let mut window = Window {
            count: 0,
            sum: [0; 3],
            square: [0; 6],
            reach: reach as u8,
        };
        let cells = self.cells[scale - 1].as_ref();
        for i in cells.iter().flat_map(|cells| cells.ranges.iter().cloned().flatten()) {
            let at = self.voxels.coordinate(i);
            let d = [0, 1, 2].map(|axis| at[axis] as i32 - coordinate[axis] as i32);
            if d.iter().any(|v| v.abs() > reach) {
                continue;
            }
            window.count += 1;
            for (sum, v) in window.sum.iter_mut().zip(d) {
                *sum += v;
            }
            for (square, (a, b)) in window.square.iter_mut().zip(PAIRS) {
                *square += d[a] * d[b];
            }
        }
        window
    }
}

impl Cells {
    /// How many voxels they hold.
    fn voxels(&self) -> usize {
        self.ranges.iter().map(Range::len).sum()
    }

    /// The voxels of a cell that is one of the 27.
    fn of(&self, cell: [u32; 3]) -> Range<usize> {
        let step = [0, 1, 2].map(|axis| (cell[axis] + 1 - self.middle[axis]) as usize);
        self.ranges[step[0] + 3 * step[1] + 9 * step[2]].clone()
    }
}

/// The moments of up to [`GROUP`] windows, and their reaches. Missing ones get those of a single voxel.
#[inline(always)]
pub fn gathered(windows: &[Window]) -> (CentredMoments, Lane) {
    let mut lanes = CentredMoments::single();
    let mut reach = [1.0; GROUP];
    for (j, window) in windows.iter().enumerate() {
        lanes.count[j] = f32::from(window.count);
        for (lane, &sum) in lanes.sum.iter_mut().zip(&window.sum) {
            lane[j] = sum as f32;
        }
        for (lane, &square) in lanes.square.iter_mut().zip(&window.square) {
            lane[j] = square as f32;
        }
        reach[j] = f32::from(window.reach);
    }
    (lanes, reach)
}
