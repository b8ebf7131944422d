//! Responses of an edge-preserving filter to the differences between a voxel and its neighbours, eight lanes at a time,
//! in integers.

use crate::simd::{I32Vector, Simd};

/// Values of a voxel, a lane each.
pub type Values = [i16; 8];
/// A number for every lane.
pub type Lanes = [i32; 8];

/// Marks a neighbour that is not there.
const ABSENT: u32 = u32::MAX;

/// The sums of the responses to the neighbours whose indices stand at `places` of `row`, and how many of them are
/// there.
///
/// The response to a difference `d` is `(d·(4096 − ((x·x) >> 12))) >> 12` with `x = min(4096, (|d|·inverse) >> 12)`.
/// Inverses are at most 2¹⁶.
///
/// # Panics
/// If an index or a place lies beyond its slice.
#[inline(always)]
pub fn responses<S: Simd>(
    simd: S,
    values: &[Values],
    own: &Values,
    row: &[u32],
    places: &[usize],
    inverses: &Lanes,
) -> (Lanes, i32) {
    responses_narrow(simd.narrow(), values, own, row, places, inverses)
}

#[inline(always)]
fn responses_narrow<S: Simd>(
    simd: S,
    values: &[Values],
    own: &Values,
    row: &[u32],
    places: &[usize],
    inverses: &Lanes,
) -> (Lanes, i32) {
    let one = S::I32::splat(simd, 4096);
    let (mut sums, mut count) = ([0; 8], 0);
    for at in (0..8).step_by(S::LANES) {
        let own = S::I32::load_i16(simd, &own[at..]);
        let inverses = S::I32::load(simd, &inverses[at..]);
        let mut sum = S::I32::splat(simd, 0);
        count = 0;
        for &place in places {
            if row[place] == ABSENT {
                continue;
            }
            let d = S::I32::load_i16(simd, &values[row[place] as usize][at..]) - own;
            let x = (d.abs() * inverses).shr_unsigned(12).min_unsigned(one);
            sum = sum + (d * (one - (x * x).shr_unsigned(12))).shr(12);
            count += 1;
        }
        sum.store(&mut sums[at..]);
    }
    (sums, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

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

    #[derive(Clone, Copy)]
    struct Responses<'a> {
        values: &'a [Values],
        row: &'a [u32],
        places: &'a [usize],
        inverses: &'a Lanes,
    }

    impl Work for Responses<'_> {
        type Output = (Lanes, i32);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            responses(simd, self.values, &self.values[0], self.row, self.places, self.inverses)
        }
    }

    proptest! {
        #[test]
        fn every_instruction_set_responds_as_plain_code_does(
            values in prop::collection::vec(prop::array::uniform8(-16384i16..=16384), 1..9),
            row in prop::array::uniform27(0u32..12),
            inverses in prop::array::uniform8(0i32..=1 << 16),
        ) {
            let known = values.len() as u32;
            let row = row.map(|index| if index < known { index } else { ABSENT });
            let places: Vec<usize> = (0..27).filter(|place| place % 3 != 1).collect();
            let expected = plain(&values, &values[0], &row, &places, &inverses);
            for isa in Isa::available() {
                let work = Responses { values: &values, row: &row, places: &places, inverses: &inverses };
                prop_assert_eq!(isa.run(work), expected, "{}", isa);
            }
        }
    }
}
