//! Eigenvectors of symmetric 3×3 matrices by Jacobi rotations in IEEE f32: without trigonometry or branches, and with a
//! fixed number of sweeps (`docs/format.md`, clause 6.4).

use super::lanes::{GROUP, Lane, lane};

/// Sweeps over the three off-diagonal entries. Convergence is cubic: after four sweeps the entries are below the
/// resolution of f32 relative to the trace.
const SWEEPS: usize = 4;

/// The smallest eigenvalue with its eigenvector, and the middle eigenvalue.
pub struct Normals {
    /// Unit eigenvector of the smallest eigenvalue, with z ≥ 0.
    pub normal: [Lane; 3],
    /// Smallest eigenvalue.
    pub least: Lane,
    /// Middle eigenvalue.
    pub middle: Lane,
}

/// Cosine, sine and tangent of the rotation that zeroes the off-diagonal entry `off`; the identity if it is zero
/// already.
#[inline(always)]
fn rotation(p: f32, q: f32, off: f32) -> [f32; 3] {
    let difference = q - p;
    let double = 2.0 * off;
    // tan θ = 2b / (d ± √(d² + 4b²)), the smaller of the two angles. TINY prevents 0 / 0.
    let root = (difference * difference + double * double).sqrt();
    let tangent = double / (difference + root.copysign(difference) + TINY.copysign(difference));
    let cosine = 1.0 / (tangent * tangent + 1.0).sqrt();
    [cosine, tangent * cosine, tangent]
}

/// Far below the difference of any two unequal variances, which are fractions of counts.
const TINY: f32 = 1e-20;

/// Decomposes covariances xx, yy, zz, xy, xz, yz.
#[inline(always)]
pub fn normals(covariance: [Lane; 6]) -> Normals {
    let [xx, yy, zz, xy, xz, yz] = covariance;
    let mut diagonal = [xx, yy, zz];
    let mut off = [xy, xz, yz];
    // Indexed by component, then by axis.
    let mut axes = [[[0.0; GROUP]; 3]; 3];
    for (k, component) in axes.iter_mut().enumerate() {
        component[k] = [1.0; GROUP];
    }
    for _ in 0..SWEEPS {
        // Each entry with its axes p, q, and the entries of p and q with the third axis.
        for (entry, p, q, with_p, with_q) in [(0, 0, 1, 1, 2), (1, 0, 2, 0, 2), (2, 1, 2, 0, 1)] {
            for j in 0..GROUP {
                let [c, s, t] = rotation(diagonal[p][j], diagonal[q][j], off[entry][j]);
                let shift = t * off[entry][j];
                diagonal[p][j] -= shift;
                diagonal[q][j] += shift;
                off[entry][j] = 0.0;
                let (x, y) = (off[with_p][j], off[with_q][j]);
                off[with_p][j] = c * x - s * y;
                off[with_q][j] = s * x + c * y;
                for component in &mut axes {
                    let (x, y) = (component[p][j], component[q][j]);
                    component[p][j] = c * x - s * y;
                    component[q][j] = s * x + c * y;
                }
            }
        }
    }
    least(&diagonal, &axes)
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
