//! One hidden layer of [`WIDTH`] rectified units and an output that learns as it goes, in integers of 16 bits: what predicts an octree's occupancies.

use crate::work::Instructions;

/// Hidden units.
pub const WIDTH: usize = 128;

/// A number for each unit.
pub type Row = [i16; WIDTH];

/// A small number for each unit: so rows take half the room in the caches.
pub type Narrow = [i8; WIDTH];

/// The sum of rows, in 16 bits, wrapping.
#[inline(always)]
pub fn add_up<I: Instructions>(_: I, rows: &[&Narrow]) -> Row {
    #[cfg(target_arch = "x86_64")]
    if I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        return unsafe { avx2::add_up(rows) };
    }
    plain_add_up(rows)
}

/// Σ max(a + b, 0)·weight: units add in 16 bits, products in 32, both wrapping.
#[inline(always)]
pub fn sum<I: Instructions>(_: I, a: &Row, b: &Narrow, weights: &Row) -> i32 {
    #[cfg(target_arch = "x86_64")]
    if I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        return unsafe { avx2::sum(a, b, weights) };
    }
    plain_sum(a, b, weights)
}

/// Adds to each weight `((max(a + b, 0)·step >> 16) + 1) >> 1`, saturating.
#[inline(always)]
pub fn learn<I: Instructions>(_: I, a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
    #[cfg(target_arch = "x86_64")]
    if I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        return unsafe { avx2::learn(a, b, step, weights) };
    }
    plain_learn(a, b, step, weights);
}

#[inline(always)]
fn plain_add_up(rows: &[&Narrow]) -> Row {
    let mut sums = [0i16; WIDTH];
    for row in rows {
        for (sum, value) in sums.iter_mut().zip(*row) {
            *sum = sum.wrapping_add((*value).into());
        }
    }
    sums
}

#[inline(always)]
fn unit(a: i16, b: i8) -> i32 {
    a.wrapping_add(b.into()).max(0).into()
}

#[inline(always)]
fn plain_sum(a: &Row, b: &Narrow, weights: &Row) -> i32 {
    let units = a.iter().zip(b).map(|(&a, &b)| unit(a, b));
    units
        .zip(weights)
        .fold(0i32, |sum, (unit, &weight)| sum.wrapping_add(unit * i32::from(weight)))
}

#[inline(always)]
fn plain_learn(a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
    let units = a.iter().zip(b).map(|(&a, &b)| unit(a, b));
    for (unit, weight) in units.zip(weights) {
        let step = ((unit * i32::from(step)) >> 16) as i16;
        *weight = weight.saturating_add((step + 1) >> 1);
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Narrow, Row};
    use std::arch::x86_64::*;

    /// The 16 units from `at` on.
    ///
    /// # Safety
    /// `at` must be within the rows, 16 before their end.
    #[inline]
    #[target_feature(enable = "avx2")]
    unsafe fn units(a: &Row, b: &Narrow, at: usize) -> __m256i {
        // SAFETY: the caller's promise.
        let (a, b) = unsafe { (load(a, at), widen(b, at)) };
        _mm256_max_epi16(_mm256_add_epi16(a, b), _mm256_setzero_si256())
    }

    /// # Safety
    /// As [`units`].
    #[inline]
    #[target_feature(enable = "avx2")]
    unsafe fn widen(row: &Narrow, at: usize) -> __m256i {
        // SAFETY: the caller's promise.
        _mm256_cvtepi8_epi16(unsafe { _mm_loadu_si128(row.as_ptr().add(at).cast()) })
    }

    /// # Safety
    /// As [`units`].
    #[inline]
    #[target_feature(enable = "avx2")]
    unsafe fn load(row: &Row, at: usize) -> __m256i {
        // SAFETY: the caller's promise.
        unsafe { _mm256_loadu_si256(row.as_ptr().add(at).cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn add_up(rows: &[&Narrow]) -> Row {
        const VECTORS: usize = super::WIDTH / 16;
        let mut sums = [_mm256_setzero_si256(); VECTORS];
        for row in rows {
            for (i, sum) in sums.iter_mut().enumerate() {
                // SAFETY: 16 divide the width.
                *sum = _mm256_add_epi16(*sum, unsafe { widen(row, 16 * i) });
            }
        }
        let mut all = [0; super::WIDTH];
        for (sum, to) in sums.into_iter().zip(all.chunks_exact_mut(16)) {
            // SAFETY: 16 values are written.
            unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), sum) };
        }
        all
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn sum(a: &Row, b: &Narrow, weights: &Row) -> i32 {
        // Two sums at once, so that neither waits for the other.
        let mut sums = [_mm256_setzero_si256(); 2];
        for at in (0..super::WIDTH).step_by(32) {
            for (i, sum) in sums.iter_mut().enumerate() {
                let at = at + 16 * i;
                // SAFETY: 32 divide the width.
                let (units, weights) = unsafe { (units(a, b, at), load(weights, at)) };
                *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(units, weights));
            }
        }
        let sum = _mm256_add_epi32(sums[0], sums[1]);
        let sum = _mm_add_epi32(_mm256_castsi256_si128(sum), _mm256_extracti128_si256::<1>(sum));
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b1110>(sum));
        let sum = _mm_add_epi32(sum, _mm_shuffle_epi32::<0b01>(sum));
        _mm_cvtsi128_si32(sum)
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn learn(a: &Row, b: &Narrow, step: i16, weights: &mut Row) {
        let (step, one) = (_mm256_set1_epi16(step), _mm256_set1_epi16(1));
        for at in (0..super::WIDTH).step_by(16) {
            // SAFETY: 16 divide the width.
            let (units, before) = unsafe { (units(a, b, at), load(weights, at)) };
            let steps = _mm256_add_epi16(_mm256_mulhi_epi16(units, step), one);
            let after = _mm256_adds_epi16(before, _mm256_srai_epi16::<1>(steps));
            // SAFETY: as above.
            unsafe { _mm256_storeu_si256(weights.as_mut_ptr().add(at).cast(), after) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::work::Baseline;
    #[cfg(target_arch = "x86_64")]
    use proptest::prelude::*;

    #[cfg(target_arch = "x86_64")]
    fn a_row() -> impl Strategy<Value = Row> {
        let value = prop_oneof![any::<i16>(), Just(i16::MIN), Just(i16::MAX), -300i16..300];
        prop::collection::vec(value, WIDTH).prop_map(|row| row.try_into().expect("as many"))
    }

    #[cfg(target_arch = "x86_64")]
    fn a_narrow_row() -> impl Strategy<Value = Narrow> {
        let row = prop::collection::vec(any::<i8>(), WIDTH);
        row.prop_map(|row| row.try_into().expect("as many"))
    }

    #[cfg(target_arch = "x86_64")]
    proptest! {
        #[test]
        fn avx2_computes_what_plain_code_does(
            a in a_row(), b in a_narrow_row(), step in any::<i16>(), weights in a_row(),
            rows in prop::collection::vec(a_narrow_row(), 0..6),
        ) {
            let Some(avx2) = crate::work::Avx2::here() else {
                return Ok(());
            };
            let rows: Vec<&Narrow> = rows.iter().collect();
            prop_assert_eq!(add_up(avx2, &rows), add_up(Baseline, &rows));
            prop_assert_eq!(sum(avx2, &a, &b, &weights), sum(Baseline, &a, &b, &weights));
            let (mut learned, mut expected) = (weights, weights);
            learn(avx2, &a, &b, step, &mut learned);
            learn(Baseline, &a, &b, step, &mut expected);
            prop_assert_eq!(learned, expected);
        }
    }

    #[test]
    fn units_are_rectified_and_weights_saturate() {
        let (mut a, mut b, mut weights) = ([0; WIDTH], [0; WIDTH], [0; WIDTH]);
        (a[0], b[0], weights[0]) = (300, -100, 7);
        (a[1], b[1], weights[1]) = (-300, 100, 7);
        (a[2], b[2], weights[2]) = (i16::MAX, 0, i16::MAX);
        let wanted = 200 * 7 + i32::from(i16::MAX).pow(2);
        assert_eq!(sum(Baseline, &a, &b, &weights), wanted);
        learn(Baseline, &a, &b, 1000, &mut weights);
        assert_eq!(weights[..4], [7 + 2, 7, i16::MAX, 0]);
    }
}
