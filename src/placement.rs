//! Where the voxel cube lies in the world.

/// Maps continuous voxel coordinates of the finest level, in `[0, 2^N]`, to world units:
/// `world = origin + voxel_size · coordinate`. Voxel `v` covers `[v, v + 1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// World position of the cube's lowest corner.
    pub origin: [f64; 3],
    /// Edge of a finest-level voxel in world units. Positive and finite.
    pub voxel_size: f64,
}

impl Placement {
    /// The placement under which a voxel's centre has its integer coordinate.
    pub const VOXEL_GRID: Placement = Placement {
        origin: [-0.5; 3],
        voxel_size: 1.0,
    };

    /// World position of a point of the cube frame, in which the cube of `2^bits` voxels a side is `[−1, 1]³`.
    pub fn from_cube(&self, bits: u8, position: [f32; 3]) -> [f64; 3] {
        let half = f64::from(1u32 << (bits - 1)) * self.voxel_size;
        std::array::from_fn(|i| self.origin[i] + (f64::from(position[i]) + 1.0) * half)
    }

    /// The inverse of [`Placement::from_cube`].
    pub fn to_cube(&self, bits: u8, world: [f64; 3]) -> [f32; 3] {
        let half = f64::from(1u32 << (bits - 1)) * self.voxel_size;
        std::array::from_fn(|i| ((world[i] - self.origin[i]) / half - 1.0) as f32)
    }

    /// Whether every number is finite and the voxel size positive.
    pub fn is_valid(&self) -> bool {
        self.origin.iter().all(|x| x.is_finite()) && self.voxel_size.is_finite() && self.voxel_size > 0.0
    }
}
