//! Structure-of-arrays values of several voxels, so that the compiler vectorises the loops over them.

/// Voxels per group.
pub const GROUP: usize = 16;

/// One value per voxel of a group.
pub type Lane = [f32; GROUP];

/// The values of `f` for each voxel of a group.
#[inline(always)]
pub fn lane(f: impl Fn(usize) -> f32) -> Lane {
    std::array::from_fn(f)
}

/// Scalar products, summed in the order x, y, z.
#[inline(always)]
pub fn dot(a: &[Lane; 3], b: &[Lane; 3]) -> Lane {
    lane(|j| a[0][j] * b[0][j] + a[1][j] * b[1][j] + a[2][j] * b[2][j])
}
