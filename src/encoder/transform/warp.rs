//! The previous frame as the encoder warps it onto a frame (`docs/format.md`, clause 17.10).

use std::sync::Arc;

use b2p_kernels::Isa;

use super::field;
use crate::colour::Truth;
use crate::geometry::{Octree, Voxels};
use crate::motion::{Lattice, Previous, Scattered, Warped};

/// Levels from the lattice of a warped frame to the finest one, and from that to the unit of its vectors.
const LATTICE_DEPTH: u8 = 4;
pub(super) const LATTICE_UNIT: u8 = 2;
/// How many times as many voxels as the frame the warped frame has: too few would have to be coded in each frame.
const MORE_VOXELS: f32 = 1.1;

/// The previous frame as a lattice warps it.
pub(super) struct Warp {
    pub lattice: Lattice,
    /// The weight from which on cells are voxels.
    pub least: u8,
    pub warped: Arc<Warped>,
    /// Its voxels of the finest level, as a frame.
    pub frame: Previous,
}

impl Warp {
    /// Warps the previous frame onto this one. `None` if that cannot be coded.
    pub fn new(isa: Isa, previous: &Previous, octree: &Octree, truth: &Truth, top: u8) -> Option<Self> {
        let source = previous.level(top)?;
        let level = top.checked_sub(LATTICE_DEPTH)?;
        let unit = top + LATTICE_UNIT;
        let keys = source.keys();
        let from = field::Frame {
            keys: &keys,
            values: &source.values,
        };
        let to = field::Frame {
            keys: octree.level(top).keys(),
            values: truth.level(top),
        };
        let lattice = field::estimate(&from, &to, [level, top], unit);
        let scattered = Scattered::new(isa, source, &lattice, [top, unit], true);
        let least = scattered.least((to.keys.len() as f32 * MORE_VOXELS) as usize).ok()?;
        let warped = scattered.warped(least).ok()?;
        let (keys, values) = warped.finest();
        Some(Warp {
            lattice,
            least,
            warped: Arc::new(warped),
            frame: Previous::of_finest(Voxels::from_sorted(top, keys), values),
        })
    }
}
