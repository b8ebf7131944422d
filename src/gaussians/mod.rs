//! 3D Gaussians in memory.

mod heads;

pub use heads::activate;

use crate::placement::Placement;

/// Renderable Gaussians, one array per parameter, all of the same length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gaussians {
    /// Centres in the cube frame: the voxel cube is `[−1, 1]³`.
    pub position: Vec<[f32; 3]>,
    /// Standard deviations along the Gaussian's own axes, in cube-frame units, linear (no logarithm).
    pub scale: Vec<[f32; 3]>,
    /// Unit quaternions w, x, y, z from the Gaussian's axes to the cube frame's.
    pub rotation: Vec<[f32; 4]>,
    /// Opacity at the centre, linear, in `[0, 1]`.
    pub opacity: Vec<f32>,
    /// Display-referred (sRGB) colour in `[0, 1]`.
    pub colour: Vec<[f32; 3]>,
    /// Where the cube lies in the world.
    pub frame: Frame,
}

/// The cube that the Gaussians' coordinates refer to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Bit depth: the cube is `2^bits` finest voxels a side.
    pub bits: u8,
    /// Its place in the world.
    pub placement: Placement,
}

impl Default for Frame {
    fn default() -> Self {
        Frame {
            bits: 10,
            placement: Placement::VOXEL_GRID,
        }
    }
}

impl Gaussians {
    /// How many Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.position.is_empty()
    }
}
