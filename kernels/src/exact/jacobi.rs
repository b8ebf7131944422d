//! Eigenvectors of symmetric 3×3 matrices by Jacobi rotations, a matrix in every lane: without trigonometry or branches,
//! and with a fixed number of sweeps (`docs/format.md`, clause 6.4). Every operation is one of IEEE f32, in an order that
//! is written down, so that the bits are the same in all instruction sets.

use crate::simd::{F32Vector, Simd};

/// Matrices that are decomposed together.
pub const MATRICES: usize = 32;
/// A number of each of them.
pub type Lanes = [f32; MATRICES];

/// Sweeps over the three off-diagonal entries. Convergence is cubic: after four sweeps the entries are below the
/// resolution of f32 relative to the trace.
const SWEEPS: usize = 4;
/// Far below the difference of any two unequal variances, which are fractions of counts.
const TINY: f32 = 1e-20;

/// What rotations leave of the matrices.
#[derive(Debug, Clone)]
pub struct Decomposed {
    /// The eigenvalues.
    pub values: [Lanes; 3],
    /// Their unit eigenvectors, by component, then by eigenvalue.
    pub axes: [[Lanes; 3]; 3],
}

/// Decomposes the matrices with the entries xx, yy, zz, xy, xz, yz. Those of finite numbers give finite ones, unless their
/// squares are too large for f32.
#[inline(always)]
pub fn decompose<S: Simd>(simd: S, entries: &[Lanes; 6]) -> Decomposed {
    let mut decomposed = Decomposed {
        values: [[0.0; MATRICES]; 3],
        axes: [[[0.0; MATRICES]; 3]; 3],
    };
    for at in (0..MATRICES).step_by(2 * S::LANES) {
        // A rotation is a chain of long operations, which leaves time for those of other matrices.
        let mut one = System::load(simd, entries, at);
        let mut other = System::load(simd, entries, at + S::LANES);
        for _ in 0..SWEEPS {
            one.rotate_xy(simd);
            other.rotate_xy(simd);
            one.rotate_xz(simd);
            other.rotate_xz(simd);
            one.rotate_yz(simd);
            other.rotate_yz(simd);
        }
        one.store(&mut decomposed, at);
        other.store(&mut decomposed, at + S::LANES);
    }
    decomposed
}

/// Matrices in the lanes of a vector, rotated so far.
#[derive(Clone, Copy)]
struct System<S: Simd> {
    diagonal: [S::F32; 3],
    /// xy, xz and yz.
    off: [S::F32; 3],
    axes: [[S::F32; 3]; 3],
}

impl<S: Simd> System<S> {
    #[inline(always)]
    fn load(simd: S, [xx, yy, zz, xy, xz, yz]: &[Lanes; 6], at: usize) -> Self {
        let load = |entry: &Lanes| S::F32::load(simd, &entry[at..]);
        let (zero, one) = (S::F32::splat(simd, 0.0), S::F32::splat(simd, 1.0));
        System {
            diagonal: [load(xx), load(yy), load(zz)],
            off: [load(xy), load(xz), load(yz)],
            axes: [[one, zero, zero], [zero, one, zero], [zero, zero, one]],
        }
    }

    #[inline(always)]
    fn store(&self, to: &mut Decomposed, at: usize) {
        for axis in 0..3 {
            self.diagonal[axis].store(&mut to.values[axis][at..]);
            for component in 0..3 {
                self.axes[component][axis].store(&mut to.axes[component][axis][at..]);
            }
        }
    }

    // Each rotation with its two axes, and the entries of the third axis with them.

    #[inline(always)]
    fn rotate_xy(&mut self, simd: S) {
        let [p, q, _] = &mut self.diagonal;
        let [entry, with_p, with_q] = &mut self.off;
        let turn = Rotation::new(simd, p, q, entry);
        turn.apply(with_p, with_q);
        for [p, q, _] in &mut self.axes {
            turn.apply(p, q);
        }
    }

    #[inline(always)]
    fn rotate_xz(&mut self, simd: S) {
        let [p, _, q] = &mut self.diagonal;
        let [with_p, entry, with_q] = &mut self.off;
        let turn = Rotation::new(simd, p, q, entry);
        turn.apply(with_p, with_q);
        for [p, _, q] in &mut self.axes {
            turn.apply(p, q);
        }
    }

    #[inline(always)]
    fn rotate_yz(&mut self, simd: S) {
        let [_, p, q] = &mut self.diagonal;
        let [with_p, with_q, entry] = &mut self.off;
        let turn = Rotation::new(simd, p, q, entry);
        turn.apply(with_p, with_q);
        for [_, p, q] in &mut self.axes {
            turn.apply(p, q);
        }
    }
}

/// Cosine and sine of the rotation that zeroes an off-diagonal entry.
#[derive(Clone, Copy)]
struct Rotation<S: Simd> {
    cosine: S::F32,
    sine: S::F32,
}

impl<S: Simd> Rotation<S> {
    /// Zeroes the entry of the axes with the diagonal entries `p` and `q`. It is the identity if the entry is zero already.
    #[inline(always)]
    fn new(simd: S, p: &mut S::F32, q: &mut S::F32, entry: &mut S::F32) -> Self {
        let (zero, one, tiny) = (
            S::F32::splat(simd, 0.0),
            S::F32::splat(simd, 1.0),
            S::F32::splat(simd, TINY),
        );
        let difference = *q - *p;
        let double = *entry + *entry;
        // tan θ = 2b / (d ± √(d² + 4b²)), the smaller of the two angles. TINY prevents 0 / 0.
        let root = (difference * difference + double * double).sqrt();
        let below = difference.lt(zero);
        let signed = |x: S::F32| S::F32::select(below, zero - x, x);
        let tangent = double / (difference + signed(root) + signed(tiny));
        let cosine = one / (tangent * tangent + one).sqrt();
        let shift = tangent * *entry;
        *p = *p - shift;
        *q = *q + shift;
        *entry = zero;
        Rotation {
            cosine,
            sine: tangent * cosine,
        }
    }

    #[inline(always)]
    fn apply(self, p: &mut S::F32, q: &mut S::F32) {
        let (x, y) = (*p, *q);
        *p = self.cosine * x - self.sine * y;
        *q = self.sine * x + self.cosine * y;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    /// One matrix, as the definition reads: eigenvalues, and eigenvectors by component.
    fn plain([xx, yy, zz, xy, xz, yz]: [f32; 6]) -> ([f32; 3], [[f32; 3]; 3]) {
        let mut diagonal = [xx, yy, zz];
        let mut off = [xy, xz, yz];
        let mut axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        for _ in 0..SWEEPS {
            for (entry, p, q, with_p, with_q) in [(0, 0, 1, 1, 2), (1, 0, 2, 0, 2), (2, 1, 2, 0, 1)] {
                let difference: f32 = diagonal[q] - diagonal[p];
                let double = 2.0 * off[entry];
                let root = (difference * difference + double * double).sqrt();
                let t = double / (difference + root.copysign(difference) + TINY.copysign(difference));
                let c = 1.0 / (t * t + 1.0).sqrt();
                let s = t * c;
                let shift = t * off[entry];
                diagonal[p] -= shift;
                diagonal[q] += shift;
                off[entry] = 0.0;
                (off[with_p], off[with_q]) = (c * off[with_p] - s * off[with_q], s * off[with_p] + c * off[with_q]);
                for component in &mut axes {
                    (component[p], component[q]) =
                        (c * component[p] - s * component[q], s * component[p] + c * component[q]);
                }
            }
        }
        (diagonal, axes)
    }

    #[derive(Clone, Copy)]
    struct Decompose<'a>(&'a [Lanes; 6]);

    impl Work for Decompose<'_> {
        type Output = Decomposed;

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Decomposed {
            decompose(simd, self.0)
        }
    }

    /// Entries as covariances have them: fractions of counts, many of them 0 or equal.
    fn entry() -> impl Strategy<Value = f32> {
        prop_oneof![
            Just(0.0f32),
            (-900i16..900, 1u16..343).prop_map(|(sum, count)| f32::from(sum) / f32::from(count)),
            (-4i8..4).prop_map(f32::from),
            (-1e-12f32..1e-12),
        ]
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_bits_of_plain_code(
            matrices in prop::collection::vec(prop::array::uniform6(entry()), MATRICES),
        ) {
            let entries: [Lanes; 6] =
                std::array::from_fn(|entry| std::array::from_fn(|lane| matrices[lane][entry]));
            for isa in Isa::available() {
                let found = isa.run(Decompose(&entries));
                for (lane, matrix) in matrices.iter().enumerate() {
                    let (values, axes) = plain(*matrix);
                    let values_there = found.values.map(|value| value[lane].to_bits());
                    prop_assert_eq!(values_there, values.map(f32::to_bits), "{} {:?}", isa, matrix);
                    let axes_there = found.axes.map(|axes| axes.map(|axis| axis[lane].to_bits()));
                    prop_assert_eq!(axes_there, axes.map(|axes| axes.map(f32::to_bits)), "{} {:?}", isa, matrix);
                }
            }
        }

        #[test]
        fn a_matrix_is_what_its_eigenvectors_and_eigenvalues_make(
            [a, b, c, d, e, f] in prop::array::uniform6(-3.0f32..3.0),
        ) {
            let (values, axes) = plain([a, b, c, d, e, f]);
            let matrix = [[a, d, e], [d, b, f], [e, f, c]];
            for i in 0..3 {
                for j in 0..3 {
                    let made: f32 = (0..3).map(|k| axes[i][k] * values[k] * axes[j][k]).sum();
                    prop_assert!((made - matrix[i][j]).abs() < 1e-4);
                }
            }
        }
    }
}
