//! Numbers of several voxels side by side, so that loops over them become vector instructions.

/// Voxels whose numbers are computed side by side.
pub const GROUP: usize = 16;

/// One number of each.
pub type Lane = [f32; GROUP];

/// A lane of what `f` makes of each voxel's number.
#[inline(always)]
pub fn lane(f: impl Fn(usize) -> f32) -> Lane {
    std::array::from_fn(f)
}

/// Scalar products of two vectors, summed x first.
#[inline(always)]
pub fn dot(a: &[Lane; 3], b: &[Lane; 3]) -> Lane {
    lane(|j| a[0][j] * b[0][j] + a[1][j] * b[1][j] + a[2][j] * b[2][j])
}
