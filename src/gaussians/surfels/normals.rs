//! The normals of surfaces: eigenvectors of covariances (`docs/format.md`, clause 6.4).

use b2p_kernels::Instructions;
use b2p_kernels::jacobi::{Decomposed, decompose};

use super::lanes::{GROUP, Lane, lane};

/// The smallest eigenvalue with its eigenvector, and the middle eigenvalue.
pub struct Normals {
    /// Unit eigenvector of the smallest eigenvalue, with z ≥ 0.
    pub normal: [Lane; 3],
    /// Smallest eigenvalue.
    pub least: Lane,
    /// Middle eigenvalue.
    pub middle: Lane,
}

/// Decomposes covariances xx, yy, zz, xy, xz, yz.
#[inline(always)]
pub fn normals<I: Instructions>(instructions: I, covariance: &[Lane; 6]) -> Normals {
    let Decomposed { values, axes } = decompose(instructions, covariance);
    least(&values, &axes)
}

/// Selects the axis of the smallest variance: of equal ones z, then y.
#[inline(always)]
fn least(variance: &[Lane; 3], axes: &[[Lane; 3]; 3]) -> Normals {
    let [x, y, z] = variance;
    let mut normal = [[0.0; GROUP]; 3];
    for j in 0..GROUP {
        let of_z = z[j] <= x[j] && z[j] <= y[j];
        let of_y = y[j] <= x[j];
        let pick = |k: usize| {
            let other = if of_y { axes[k][1][j] } else { axes[k][0][j] };
            if of_z { axes[k][2][j] } else { other }
        };
        let up = 1.0f32.copysign(pick(2));
        for (k, normal) in normal.iter_mut().enumerate() {
            normal[j] = pick(k) * up;
        }
    }
    let middle = lane(|j| {
        let (low, high) = (x[j].min(y[j]), x[j].max(y[j]));
        low.max(high.min(z[j]))
    });
    Normals {
        normal,
        least: lane(|j| x[j].min(y[j]).min(z[j])),
        middle,
    }
}
