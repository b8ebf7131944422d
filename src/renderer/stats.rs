//! Counts and times of a picture.

use std::time::Duration;

use crate::renderer::effects::EffectSet;
use crate::renderer::projection::Dropped;

/// What a picture took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Stats {
    /// Gaussians drawn.
    pub visible: u64,
    /// Gaussians not drawn, and why.
    pub dropped: Dropped,
    /// Gaussians that reach over the near plane: the visible ones if they are evaluated in ray space, else all.
    pub crossing: u64,
    /// Pairs of a Gaussian and a tile of 32×32 pixels that it may touch.
    pub pairs: u64,
    /// Pixels that something was drawn on.
    pub touched: u64,
    /// What it was drawn with.
    pub effects: EffectSet,
    /// Wall time of each stage.
    pub times: Times,
}

/// Wall time by stage.
///
/// The last two run as one, tile by tile: their time is divided in proportion to what the threads spent on each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Times {
    /// From Gaussians to ellipses, and before that to the colours of the view, if that is called for.
    pub project: Duration,
    /// Into the lists of the tiles.
    pub bin: Duration,
    /// Of each tile, by depth.
    pub sort: Duration,
    /// Into pixels.
    pub blend: Duration,
}

impl Times {
    /// All stages.
    pub fn total(&self) -> Duration {
        self.project + self.sort + self.bin + self.blend
    }
}
