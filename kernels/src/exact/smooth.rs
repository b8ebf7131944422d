//! Responses of an edge-preserving filter to the differences between a voxel and its neighbours, eight lanes at a time,
//! in integers.

use crate::simd::{I32Vector, Simd};

/// Values of a voxel, a lane each.
pub type Values = [i16; 8];
/// A number for every lane.
pub type Lanes = [i32; 8];

/// The sums of the responses to the neighbours whose indices stand in `around` where `places` has a bit.
///
/// The response to a difference `d` is `(d·(4096 − ((x·x) >> 12))) >> 12` with `x = min(4096, (|d|·inverse) >> 12)`.
/// Inverses are at most 2¹⁶.
///
/// # Panics
/// If an index lies beyond the values.
#[inline(always)]
pub fn responses<S: Simd>(
    simd: S,
    values: &[Values],
    own: &Values,
    around: &[u32; 64],
    places: u64,
    inverses: &Lanes,
) -> Lanes {
    responses_narrow(simd.narrow(), values, own, around, places, inverses)
}

#[inline(always)]
fn responses_narrow<S: Simd>(
    simd: S,
    values: &[Values],
    own: &Values,
    around: &[u32; 64],
    places: u64,
    inverses: &Lanes,
) -> Lanes {
    let one = S::I32::splat(simd, 4096);
    let mut sums = [0; 8];
    for at in (0..8).step_by(S::LANES) {
        let own = S::I32::load_i16(simd, &own[at..]);
        let inverses = S::I32::load(simd, &inverses[at..]);
        let mut sum = S::I32::splat(simd, 0);
        let mut left = places;
        while left != 0 {
            let neighbour = around[left.trailing_zeros() as usize & 63];
            left &= left - 1;
            let d = S::I32::load_i16(simd, &values[neighbour as usize][at..]) - own;
            let x = (d.abs() * inverses).shr_unsigned(12).min_unsigned(one);
            sum = sum + (d * (one - (x * x).shr_unsigned(12))).shr(12);
        }
        sum.store(&mut sums[at..]);
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    fn plain(values: &[Values], own: &Values, around: &[u32; 64], places: u64, inverses: &Lanes) -> Lanes {
        let mut sums = [0; 8];
        for place in (0..64).filter(|place| places >> place & 1 == 1) {
            let other = &values[around[place] as usize];
            for lane in 0..8 {
                let d = i32::from(other[lane]) - i32::from(own[lane]);
                let x = ((d.unsigned_abs() * inverses[lane] as u32) >> 12).min(4096) as i32;
                sums[lane] += (d * (4096 - ((x * x) >> 12))) >> 12;
            }
        }
        sums
    }

    #[derive(Clone, Copy)]
    struct Responses<'a> {
        values: &'a [Values],
        around: &'a [u32; 64],
        places: u64,
        inverses: &'a Lanes,
    }

    impl Work for Responses<'_> {
        type Output = Lanes;

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            responses(
                simd,
                self.values,
                &self.values[0],
                self.around,
                self.places,
                self.inverses,
            )
        }
    }

    proptest! {
        #[test]
        fn every_instruction_set_responds_as_plain_code_does(
            values in prop::collection::vec(prop::array::uniform8(-16384i16..=16384), 1..9),
            around in prop::collection::vec(0u32..8, 64),
            places in any::<u64>(),
            inverses in prop::array::uniform8(0i32..=1 << 16),
        ) {
            let known = values.len() as u32;
            let around: [u32; 64] = std::array::from_fn(|place| around[place] % known);
            let expected = plain(&values, &values[0], &around, places, &inverses);
            for isa in Isa::available() {
                let work = Responses { values: &values, around: &around, places, inverses: &inverses };
                prop_assert_eq!(isa.run(work), expected, "{}", isa);
            }
        }
    }
}
