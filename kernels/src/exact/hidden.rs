//! One hidden layer of [`WIDTH`] rectified units and an output that learns as it goes, in integers of 16 bits: what
//! predicts an octree's occupancies.

use crate::simd::{I16Vector, I32Vector, Simd};

/// Hidden units.
pub const WIDTH: usize = 128;

/// A number for each unit.
pub type Row = [i16; WIDTH];

/// A small number for each unit: so rows take half the room in the caches.
pub type Narrow = [i8; WIDTH];

/// The sum of rows, in 16 bits, wrapping.
#[inline(always)]
pub fn add_up<S: Simd>(simd: S, rows: &[&Narrow]) -> Row {
    add_up_narrow(simd.narrow(), rows)
}

/// Σ max(a + b, 0)·weight: units add in 16 bits, products in 32, both wrapping.
#[inline(always)]
pub fn sum<S: Simd>(simd: S, a: &Row, b: &Narrow, weights: &Row) -> i32 {
    sum_narrow(simd.narrow(), a, b, weights)
}

/// Adds to each weight `((max(a + b, 0)·step >> 16) + 1) >> 1`, saturating.
#[inline(always)]
pub fn learn<S: Simd>(simd: S, a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
    learn_narrow(simd.narrow(), a, b, step, weights);
}

#[inline(always)]
fn add_up_narrow<S: Simd>(simd: S, rows: &[&Narrow]) -> Row {
    /// Sums that stay in registers while the rows go by.
    const VECTORS: usize = 8;
    let lanes = 2 * S::LANES;
    let mut all = [0; WIDTH];
    for first in (0..WIDTH).step_by(VECTORS * lanes) {
        let mut sums = [S::I16::splat(simd, 0); VECTORS];
        for row in rows {
            for (i, sum) in sums.iter_mut().enumerate() {
                *sum = *sum + S::I16::load_i8(simd, &row[first + i * lanes..]);
            }
        }
        for (i, sum) in sums.into_iter().enumerate() {
            sum.store(&mut all[first + i * lanes..]);
        }
    }
    all
}

/// The units from `at` on.
#[inline(always)]
fn units<S: Simd>(simd: S, a: &Row, b: &Narrow, at: usize) -> S::I16 {
    let sum = S::I16::load(simd, &a[at..]) + S::I16::load_i8(simd, &b[at..]);
    sum.max(S::I16::splat(simd, 0))
}

#[inline(always)]
fn sum_narrow<S: Simd>(simd: S, a: &Row, b: &Narrow, weights: &Row) -> i32 {
    // Two sums at once, so that neither waits for the other.
    let mut sums = [S::I32::splat(simd, 0); 2];
    for at in (0..WIDTH).step_by(4 * S::LANES) {
        for (i, sum) in sums.iter_mut().enumerate() {
            let at = at + i * 2 * S::LANES;
            let weights = S::I16::load(simd, &weights[at..]);
            *sum = sum.dot_pairs(units(simd, a, b, at), weights);
        }
    }
    (sums[0] + sums[1]).sum()
}

#[inline(always)]
fn learn_narrow<S: Simd>(simd: S, a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
    let (step, one) = (S::I16::splat(simd, step), S::I16::splat(simd, 1));
    for at in (0..WIDTH).step_by(2 * S::LANES) {
        let steps = (units(simd, a, b, at).mul_high(step) + one).shr(1);
        let before = S::I16::load(simd, &weights[at..]);
        before.saturating_add(steps).store(&mut weights[at..]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Scalar, Work};
    use proptest::prelude::*;

    fn plain_add_up(rows: &[&Narrow]) -> Row {
        let mut sums = [0i16; WIDTH];
        for row in rows {
            for (sum, value) in sums.iter_mut().zip(*row) {
                *sum = sum.wrapping_add((*value).into());
            }
        }
        sums
    }

    fn unit(a: i16, b: i8) -> i32 {
        a.wrapping_add(b.into()).max(0).into()
    }

    fn plain_sum(a: &Row, b: &Narrow, weights: &Row) -> i32 {
        let units = a.iter().zip(b).map(|(&a, &b)| unit(a, b));
        units
            .zip(weights)
            .fold(0i32, |sum, (unit, &weight)| sum.wrapping_add(unit * i32::from(weight)))
    }

    fn plain_learn(a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
        let units = a.iter().zip(b).map(|(&a, &b)| unit(a, b));
        for (unit, weight) in units.zip(weights) {
            let step = ((unit * i32::from(step)) >> 16) as i16;
            *weight = weight.saturating_add((step + 1) >> 1);
        }
    }

    /// All three functions of the same arguments.
    #[derive(Clone, Copy)]
    struct All<'a> {
        a: &'a Row,
        b: &'a Narrow,
        step: i16,
        weights: &'a Row,
        rows: &'a [&'a Narrow],
    }

    impl Work for All<'_> {
        type Output = (Row, i32, Row);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            let mut learned = *self.weights;
            learn(simd, self.a, self.b, self.step, &mut learned);
            (
                add_up(simd, self.rows),
                sum(simd, self.a, self.b, self.weights),
                learned,
            )
        }
    }

    fn a_row() -> impl Strategy<Value = Row> {
        let value = prop_oneof![any::<i16>(), Just(i16::MIN), Just(i16::MAX), -300i16..300];
        prop::collection::vec(value, WIDTH).prop_map(|row| row.try_into().expect("as many"))
    }

    fn a_narrow_row() -> impl Strategy<Value = Narrow> {
        let row = prop::collection::vec(any::<i8>(), WIDTH);
        row.prop_map(|row| row.try_into().expect("as many"))
    }

    proptest! {
        #[test]
        fn every_instruction_set_computes_what_plain_code_does(
            a in a_row(), b in a_narrow_row(), step in any::<i16>(), weights in a_row(),
            rows in prop::collection::vec(a_narrow_row(), 0..6),
        ) {
            let rows: Vec<&Narrow> = rows.iter().collect();
            let mut learned = weights;
            plain_learn(&a, &b, step, &mut learned);
            let expected = (plain_add_up(&rows), plain_sum(&a, &b, &weights), learned);
            for isa in Isa::available() {
                let all = All { a: &a, b: &b, step, weights: &weights, rows: &rows };
                prop_assert_eq!(isa.run(all), expected, "{}", isa);
            }
        }
    }

    #[test]
    fn units_are_rectified_and_weights_saturate() {
        let (mut a, mut b, mut weights) = ([0; WIDTH], [0; WIDTH], [0; WIDTH]);
        (a[0], b[0], weights[0]) = (300, -100, 7);
        (a[1], b[1], weights[1]) = (-300, 100, 7);
        (a[2], b[2], weights[2]) = (i16::MAX, 0, i16::MAX);
        let wanted = 200 * 7 + i32::from(i16::MAX).pow(2);
        assert_eq!(sum(Scalar::TOKEN, &a, &b, &weights), wanted);
        learn(Scalar::TOKEN, &a, &b, 1000, &mut weights);
        assert_eq!(weights[..4], [7 + 2, 7, i16::MAX, 0]);
    }
}
