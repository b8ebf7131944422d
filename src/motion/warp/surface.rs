//! Where a surface is between the voxels that show it (`docs/format.md`, clause 17.10.9).
//!
//! A surface may be up to half a voxel away from the middle of a voxel that it passes through. The mean of the voxels
//! around is nearer to it. Only the part of the step there that is across the surface is taken: along it, the mean is as
//! far away as the voxels around are irregular.

/// Sums over the cells of a layer of 3², as bytes: 1, and for steps x and y in −1 to 1: x, y, x², y², xy. Those that can be
/// negative are [`BIAS`] more.
type Sums = u64;

const BIAS: i32 = 8;

/// The sums of each layer, which is a mask by `x + 3y`: looked up, since not all processors count bits.
const LAYERS: [Sums; 512] = {
    let mut layers = [0; 512];
    let mut layer = 0;
    while layer < 512 {
        let (mut sums, mut cell) = ([0, BIAS, BIAS, 0, 0, BIAS], 0);
        while cell < 9 {
            if layer >> cell & 1 == 1 {
                let (x, y) = (cell % 3 - 1, cell / 3 - 1);
                let own = [1, x, y, x * x, y * y, x * y];
                let mut i = 0;
                while i < 6 {
                    sums[i] += own[i];
                    i += 1;
                }
            }
            cell += 1;
        }
        let mut i = 0;
        while i < 6 {
            layers[layer] |= (sums[i] as Sums) << (8 * i);
            i += 1;
        }
        layer += 1;
    }
    layers
};

/// The sums of the layer z of a window.
#[inline]
fn layer(window: u64, z: u32) -> Sums {
    let rows = (window >> (16 * z)) as usize;
    LAYERS[rows & 7 | rows >> 1 & 0o70 | rows >> 2 & 0o700]
}

/// One of sums that were added up, less the bias of so many layers.
#[inline]
fn sum(sums: Sums, which: u32, biases: i32) -> i32 {
    ((sums >> (8 * which)) & 0xff) as i32 - biases * BIAS
}

/// The step from a voxel to the surface around it, in sixteenths of a voxel, less than one voxel along each axis.
/// `window` has the cells from one before it on along each axis, as a mask by `x + 4y + 16z`.
///
/// The step to the mean is weighted by the adjugate of the covariance over its trace: along a principal axis, by how
/// small the variance is there beside those along the other two.
pub fn offset(window: u64) -> [i32; 3] {
    let layers = [0, 1, 2].map(|z| layer(window, z));
    let sums = layers[0] + layers[1] + layers[2];
    let all = sum(sums, 0, 0);
    let of_layers = |which: u32| [sum(layers[0], which, 0), sum(layers[2], which, 0)];
    let [[n0, n2], [x0, x2], [y0, y2]] = [of_layers(0), of_layers(1), of_layers(2)];
    let [x, y, z] = [sum(sums, 1, 3), sum(sums, 2, 3), n2 - n0];
    let squares = [sum(sums, 3, 0), sum(sums, 4, 0), n0 + n2];
    let [xx, yy, zz] = [
        all * squares[0] - x * x,
        all * squares[1] - y * y,
        all * squares[2] - z * z,
    ];
    let [xy, xz, yz] = [
        all * sum(sums, 5, 3) - x * y,
        all * (x2 - x0) - x * z,
        all * (y2 - y0) - y * z,
    ];
    // The adjugate.
    let [axx, ayy, azz] = [yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy];
    let [axy, axz, ayz] = [xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx];
    let trace = axx + ayy + azz;
    if trace == 0 {
        return [0; 3];
    }
    let steps = [
        axx * x + axy * y + axz * z,
        axy * x + ayy * y + ayz * z,
        axz * x + ayz * y + azz * z,
    ];
    // Whole numbers and a half over one of less than 2³¹ are farther from whole numbers than 2⁻³³: floats round them down
    // correctly.
    let whole = f64::from(2 * all) * f64::from(trace);
    let inverse = 1.0 / whole;
    steps.map(|step| ((32.0 * f64::from(step) + 16.5 * whole + 0.5) * inverse) as i32 - 16)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The cells of a window that are within half a voxel of a surface; `height` says how far a place is above it.
    fn window(height: impl Fn([f64; 3]) -> f64) -> u64 {
        let cells = (0..64).filter(|cell| {
            let at = [cell & 3, cell >> 2 & 3, cell >> 4].map(|x| f64::from(x) - 1.0);
            height(at).abs() <= 0.5
        });
        cells.fold(0, |window, cell| window | 1 << cell)
    }

    /// The clause, with numbers of any size.
    fn plain(window: u64) -> [i32; 3] {
        let cells = (0..64i128).filter(|cell| window >> cell & 1 == 1);
        let cells = cells.map(|cell| [cell & 3, cell >> 2 & 3, cell >> 4]);
        let near: Vec<[i128; 3]> = cells
            .filter(|at| at.iter().all(|x| *x < 3))
            .map(|at| at.map(|x| x - 1))
            .collect();
        let n = near.len() as i128;
        let sum: [i128; 3] = [0, 1, 2].map(|a| near.iter().map(|d| d[a]).sum());
        let s = |a: usize, b: usize| n * near.iter().map(|d| d[a] * d[b]).sum::<i128>() - sum[a] * sum[b];
        let cofactor = |a: usize, b: usize| {
            let [a1, a2, b1, b2] = [(a + 1) % 3, (a + 2) % 3, (b + 1) % 3, (b + 2) % 3];
            s(a1, b1) * s(a2, b2) - s(a1, b2) * s(a2, b1)
        };
        let t: i128 = (0..3).map(|a| cofactor(a, a)).sum();
        [0, 1, 2].map(|a| {
            let v: i128 = (0..3).map(|b| cofactor(a, b) * sum[b]).sum();
            if t == 0 {
                0
            } else {
                (32 * v + n * t).div_euclid(2 * n * t) as i32
            }
        })
    }

    proptest! {
        #[test]
        fn steps_are_those_of_the_clause(window: u64, other: u64) {
            for window in [window, window & other, window | other] {
                let window = window | 1 << 21;
                prop_assert_eq!(offset(window), plain(window));
                prop_assert!(offset(window).iter().all(|x| x.abs() < 16));
            }
        }
    }

    #[test]
    fn a_voxel_in_a_flat_layer_alone_or_in_a_line_stays_where_it_is() {
        for axis in 0..3 {
            assert_eq!(offset(window(|at| at[axis])), [0; 3]);
            assert_eq!(offset(window(|at| at[axis].abs() + at[(axis + 1) % 3].abs())), [0; 3]);
        }
        assert_eq!(offset(1 << 21), [0; 3]);
        assert_eq!(offset(u64::MAX), [0; 3]);
    }

    #[test]
    fn steps_lead_to_a_slanted_surface() {
        let (mut before, mut after) = (0.0, 0.0);
        for i in 0..40 {
            let [a, b, c] = [
                0.3 + 0.01 * f64::from(i),
                0.7 - 0.02 * f64::from(i),
                0.024 * f64::from(i) - 0.48,
            ];
            let height = |at: [f64; 3]| a * at[0] + b * at[1] + at[2] - c;
            let step = offset(window(height)).map(|x| f64::from(x) / 16.0);
            before += height([0.0; 3]).powi(2);
            after += height(step).powi(2);
        }
        assert!(after < before / 3.0, "{after} of {before}");
    }
}
