//! Per-thread scratch.

use std::cell::RefCell;

use super::planner::Planner;
use super::rows::Words;
use super::tile_taps::TileTaps;

/// Per-thread scratch of any layer, kept from one call to the next.
#[derive(Default)]
pub(crate) struct Scratch {
    pub taps: TileTaps,
    pub planner: Planner,
    pub expanded: Vec<Words>,
    pub sums: Vec<Words>,
}

/// Lends this thread's [`Scratch`].
pub(crate) fn with_scratch(run: impl FnOnce(&mut Scratch)) {
    thread_local!(static SCRATCH: RefCell<Scratch> = RefCell::default());
    SCRATCH.with_borrow_mut(run);
}
