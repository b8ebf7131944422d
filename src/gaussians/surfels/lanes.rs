//! Structure-of-arrays values of several voxels, so that the compiler vectorises the loops over them.

/// Voxels per group.
pub const GROUP: usize = b2p_kernels::jacobi::MATRICES;

/// One value per voxel of a group.
pub type Lane = [f32; GROUP];

/// The values of `f` for each voxel of a group.
#[inline(always)]
pub fn lane(f: impl Fn(usize) -> f32) -> Lane {
    // A loop: `from_fn` is not always inlined, and would then be compiled for the baseline of the target.
    let mut lane = [0.0; GROUP];
    for (j, value) in lane.iter_mut().enumerate() {
        *value = f(j);
    }
    lane
}

/// The values of `f` for each axis.
#[inline(always)]
pub fn axes(f: impl Fn(usize) -> Lane) -> [Lane; 3] {
    [f(0), f(1), f(2)]
}

/// Scalar products, summed in the order x, y, z.
#[inline(always)]
pub fn dot(a: &[Lane; 3], b: &[Lane; 3]) -> Lane {
    lane(|j| a[0][j] * b[0][j] + a[1][j] * b[1][j] + a[2][j] * b[2][j])
}
