//! Responses of an edge-preserving filter to the differences between a voxel and its neighbours, eight lanes at a time, in integers.

use crate::work::Instructions;

/// Values of a voxel, a lane each.
pub type Values = [i16; 8];
/// A number for every lane.
pub type Lanes = [i32; 8];

/// Marks a neighbour that is not there.
const ABSENT: u32 = u32::MAX;

/// The sums of the responses to the neighbours whose indices stand at `places` of `row`, and how many of them are there.
///
/// The response to a difference `d` is `(d·(4096 − ((x·x) >> 12))) >> 12` with `x = min(4096, (|d|·inverse) >> 12)`. Inverses are at most 2¹⁶.
///
/// # Panics
/// If an index or a place lies beyond its slice.
#[inline(always)]
pub fn responses<I: Instructions>(
    _: I,
    values: &[Values],
    own: &Values,
    row: &[u32],
    places: &[usize],
    inverses: &Lanes,
) -> (Lanes, i32) {
    #[cfg(target_arch = "x86_64")]
    if I::AVX2 {
        // SAFETY: an `I` that has AVX2 is only made where the processor does.
        return unsafe { avx2::responses(values, own, row, places, inverses) };
    }
    plain(values, own, row, places, inverses)
}

#[inline(always)]
fn plain(values: &[Values], own: &Values, row: &[u32], places: &[usize], inverses: &Lanes) -> (Lanes, i32) {
    let (mut sums, mut count) = ([0; 8], 0);
    for &place in places {
        if row[place] == ABSENT {
            continue;
        }
        let other = &values[row[place] as usize];
        for lane in 0..8 {
            let d = i32::from(other[lane]) - i32::from(own[lane]);
            let x = ((d.unsigned_abs() * inverses[lane] as u32) >> 12).min(4096) as i32;
            sums[lane] += (d * (4096 - ((x * x) >> 12))) >> 12;
        }
        count += 1;
    }
    (sums, count)
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{ABSENT, Lanes, Values};
    use std::arch::x86_64::*;

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load(values: &Values) -> __m256i {
        // SAFETY: eight numbers of 16 bits are read.
        _mm256_cvtepi16_epi32(unsafe { _mm_loadu_si128(values.as_ptr().cast()) })
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    pub fn responses(values: &[Values], own: &Values, row: &[u32], places: &[usize], inverses: &Lanes) -> (Lanes, i32) {
        let own = load(own);
        // SAFETY: eight words are read.
        let inverses = unsafe { _mm256_loadu_si256(inverses.as_ptr().cast()) };
        let one = _mm256_set1_epi32(4096);
        let (mut sums, mut count) = (_mm256_setzero_si256(), 0);
        for &place in places {
            if row[place] == ABSENT {
                continue;
            }
            let d = _mm256_sub_epi32(load(&values[row[place] as usize]), own);
            let x = _mm256_srli_epi32::<12>(_mm256_mullo_epi32(_mm256_abs_epi32(d), inverses));
            let x = _mm256_min_epu32(x, one);
            let square = _mm256_srli_epi32::<12>(_mm256_mullo_epi32(x, x));
            let product = _mm256_mullo_epi32(d, _mm256_sub_epi32(one, square));
            sums = _mm256_add_epi32(sums, _mm256_srai_epi32::<12>(product));
            count += 1;
        }
        let mut lanes = [0; 8];
        // SAFETY: eight words are written.
        unsafe { _mm256_storeu_si256(lanes.as_mut_ptr().cast(), sums) };
        (lanes, count)
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn avx2_responds_as_plain_code_does(
            values in prop::collection::vec(prop::array::uniform8(-16384i16..=16384), 1..9),
            row in prop::array::uniform27(0u32..12),
            inverses in prop::array::uniform8(0i32..=1 << 16),
        ) {
            let Some(avx2) = crate::work::Avx2::here() else {
                return Ok(());
            };
            let known = values.len() as u32;
            let row = row.map(|index| if index < known { index } else { ABSENT });
            let places: Vec<usize> = (0..27).filter(|place| place % 3 != 1).collect();
            prop_assert_eq!(
                responses(avx2, &values, &values[0], &row, &places, &inverses),
                plain(&values, &values[0], &row, &places, &inverses)
            );
        }
    }
}
