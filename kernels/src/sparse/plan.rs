//! Kernel maps as layers read them: few input rows, each known by a short number, and output rows of like neighbours
//! together.

use std::ops::Range;
use std::sync::OnceLock;

use super::rows::{IN_ORDER, TILE};

/// A kernel map arranged for the layers that read it, part by part as they first do, in the smallest groups and in
/// larger ones. It pays where a map serves several layers; results are the same without.
#[derive(Debug, Clone)]
pub struct Plan(pub(super) Vec<[OnceLock<PlanTile>; 2]>);

impl Plan {
    /// For a map of so many output rows.
    pub fn new(rows: usize) -> Self {
        Plan(vec![Default::default(); rows.div_ceil(TILE)])
    }
}

/// Up to [`TILE`] rows of a kernel map, arranged.
///
/// Rows are sorted by which taps they use, and cut into groups of [`super::accumulate::group`]: what a group multiplies
/// is the taps that any of its rows uses.
#[derive(Debug, Clone, Default)]
pub(crate) struct PlanTile {
    /// Rows of a group.
    pub(super) group: usize,
    /// Taps of the kernel.
    pub(super) volume: usize,
    /// The input rows that are read, each once.
    pub(super) inputs: Vec<u32>,
    /// One more than the last of them.
    pub(super) end: usize,
    /// For each row, which taps read something.
    pub(super) masks: Vec<u64>,
    /// The rows in the order of the groups.
    pub(super) order: Vec<u16>,
    /// Where each row is in that order.
    pub(super) positions: Vec<u16>,
    /// For each group, the taps that any of its rows uses.
    pub(super) unions: Vec<u64>,
    /// Where each group's steps begin.
    pub(super) starts: Vec<u32>,
    /// Each step's tap; they ascend within a group.
    pub(super) taps: Vec<u8>,
    /// For each step and row of its group, which of `inputs` it reads; their number for nothing. One more step, of
    /// nothing, comes last.
    pub(super) places: Clamped,
}

/// Numbers of rows that are there: the greatest is known.
#[derive(Debug, Clone, Default)]
pub(super) struct Clamped {
    places: Vec<u16>,
    most: u16,
}

impl Clamped {
    /// The least of each place and `most`.
    pub fn new(mut places: Vec<u16>, most: u16) -> Self {
        for place in &mut places {
            *place = (*place).min(most);
        }
        Clamped { places, most }
    }

    /// The memory of places, to be used again.
    pub fn take(&mut self) -> Vec<u16> {
        std::mem::take(&mut self.places)
    }
}

/// Some numbers of rows, with a bound of them.
#[derive(Clone, Copy)]
pub(crate) struct Places<'a> {
    places: &'a [u16],
    most: u16,
}

impl<'a> Places<'a> {
    /// The first rows in order, at most [`TILE`].
    pub fn in_order(rows: usize) -> Places<'static> {
        let places = &IN_ORDER[..rows];
        let most = places.last().copied().unwrap_or(0);
        Places { places, most }
    }

    /// All of them.
    #[inline(always)]
    pub fn all(self) -> &'a [u16] {
        self.places
    }

    /// None is above.
    #[inline(always)]
    pub fn most(self) -> usize {
        self.most.into()
    }
}

impl PlanTile {
    /// The first step of a group whose tap is `k` or beyond.
    pub(super) fn step(&self, group: usize, k: usize) -> usize {
        let before = self.unions[group] & ((1 << k) - 1);
        self.starts[group] as usize + before.count_ones() as usize
    }

    /// Checks that it is the plan of a kernel of so many taps, and reads nothing beyond so many input rows.
    pub(crate) fn check(&self, volume: usize, inputs: usize) {
        assert_eq!(self.volume, volume, "another kernel's plan");
        assert!(
            self.end <= inputs,
            "a tap reads row {}, but the input has {inputs}",
            self.end - 1
        );
    }

    /// The input rows that are read, each once. [`PlanTile::places`] counts them.
    pub(crate) fn inputs(&self) -> &[u32] {
        &self.inputs
    }

    /// For each row, bit k tells whether tap `k` reads something.
    pub(crate) fn masks(&self) -> &[u64] {
        &self.masks
    }

    /// Groups.
    pub(crate) fn groups(&self) -> usize {
        self.unions.len()
    }

    /// Rows of a group.
    pub(crate) fn group(&self) -> usize {
        self.group
    }

    /// For each of the tile's rows, its place in the order of the groups.
    pub(crate) fn positions(&self) -> &[u16] {
        &self.positions
    }

    /// What a group multiplies of some taps, ascending: the taps it uses, and for each of them the places of the input
    /// rows, followed by one more.
    pub(crate) fn steps(&self, group: usize, taps: Range<usize>) -> (&[u8], Places<'_>) {
        let (start, end) = (self.step(group, taps.start), self.step(group, taps.end));
        let places = start * self.group..(end + 1) * self.group;
        let places = Places {
            places: &self.places.places[places],
            most: self.places.most,
        };
        (&self.taps[start..end], places)
    }
}
