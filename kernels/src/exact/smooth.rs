//! Means of the responses of an edge-preserving filter to the differences between a voxel and its neighbours, eight lanes
//! at a time, in integers.

use crate::simd::{I32Vector, Simd};

/// Values of a voxel, a lane each.
pub type Values = [i16; 8];
/// A number for every lane.
pub type Lanes = [i32; 8];

/// The lanes whose third class counts as the second: −1, and 0 for the others.
const JOINED: Lanes = [0, 0, 0, 0, -1, -1, -1, -1];

/// A voxel and its neighbours.
#[derive(Debug, Clone, Copy)]
pub struct Neighbourhood<'a> {
    /// Those of all voxels, within ±2¹⁴.
    pub values: &'a [Values],
    /// Those of the voxel.
    pub own: &'a Values,
    /// The voxels that are around.
    pub around: &'a [u32; 64],
    /// Which of them are neighbours, by class.
    pub places: [u64; 3],
}

/// A filter's response to differences, and how much the classes of neighbours weigh.
///
/// The response to a difference `d` is `(d·(4096 − ((x·x) >> 12))) >> 12` with `x = min(4096, (|d|·inverse) >> 12)`. The
/// mean of a class is `(S·⌊2¹⁶ / W⌋) >> 14`: S is the weighted sum of its responses, W that of all neighbours' weights.
/// In lanes 4 to 7 the third class counts as the second.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Responses {
    inverses: Lanes,
    weights: [i32; 3],
    /// Whether products of sums fit 32 bits.
    small: bool,
}

impl Responses {
    /// Inverses from which on no response exceeds 2¹⁵: it is at most 0.385 · 2²⁴ / inverse, and a little by rounding.
    const SMALL: i32 = 256;

    /// Inverses are 0 to 2¹⁶. Weights are positive, and add up to at most 2¹⁶ over all neighbours of a voxel.
    pub fn new(inverses: Lanes, weights: [i32; 3]) -> Self {
        let small = inverses.iter().all(|inverse| *inverse >= Self::SMALL);
        Responses {
            inverses,
            weights,
            small,
        }
    }

    /// The means of the three classes.
    ///
    /// # Panics
    /// If a neighbour lies beyond the values.
    #[inline(always)]
    pub fn means<S: Simd>(&self, simd: S, near: Neighbourhood<'_>) -> [Lanes; 3] {
        self.exact_means(simd.narrow(), near)
    }

    /// The sum of the means of the three classes, each times its `factors`. It wraps.
    ///
    /// # Panics
    /// If a neighbour lies beyond the values.
    #[inline(always)]
    pub fn weighted<S: Simd>(&self, simd: S, near: Neighbourhood<'_>, factors: &[Lanes; 3]) -> Lanes {
        self.weighted_narrow(simd.narrow(), near, factors)
    }

    #[inline(always)]
    fn weighted_narrow<S: Simd>(&self, simd: S, near: Neighbourhood<'_>, factors: &[Lanes; 3]) -> Lanes {
        let mut total = [0i32; 8];
        if !self.small {
            let means = self.exact_means(simd, near);
            for lane in 0..8 {
                for class in 0..3 {
                    total[lane] = total[lane].wrapping_add(factors[class][lane].wrapping_mul(means[class][lane]));
                }
            }
            return total;
        }
        let share = self.share(near);
        for at in (0..8).step_by(S::LANES) {
            let [faces, edges, corners] = self.small_means(simd, near, share, at);
            let faces = faces * S::I32::load(simd, &factors[0][at..]);
            let edges = edges * S::I32::load(simd, &factors[1][at..]);
            let corners = corners * S::I32::load(simd, &factors[2][at..]);
            (faces + edges + corners).store(&mut total[at..]);
        }
        total
    }

    /// ⌊2¹⁶ / W⌋.
    #[inline(always)]
    fn share(&self, near: Neighbourhood<'_>) -> i32 {
        let mut weight = 0;
        for class in 0..3 {
            weight += self.weights[class] * near.places[class].count_ones() as i32;
        }
        ((1u32 << 16) / weight.max(1) as u32) as i32
    }

    /// The means from lane `at` on, whose products fit 32 bits.
    #[inline(always)]
    fn small_means<S: Simd>(&self, simd: S, near: Neighbourhood<'_>, share: i32, at: usize) -> [S::I32; 3] {
        let [faces, edges, corners] = self.sums(simd, near, at);
        let joined = corners & S::I32::load(simd, &JOINED[at..]);
        let share = S::I32::splat(simd, share);
        [
            (faces * share).shr(14),
            ((edges + joined) * share).shr(14),
            ((corners - joined) * share).shr(14),
        ]
    }

    /// The means, by products of 64 bits.
    #[inline(always)]
    fn exact_means<S: Simd>(&self, simd: S, near: Neighbourhood<'_>) -> [Lanes; 3] {
        let share = i64::from(self.share(near));
        let mut sums = [[0; 8]; 3];
        for at in (0..8).step_by(S::LANES) {
            let [faces, edges, corners] = self.sums(simd, near, at);
            faces.store(&mut sums[0][at..]);
            edges.store(&mut sums[1][at..]);
            corners.store(&mut sums[2][at..]);
        }
        let [_, edges, corners] = &mut sums;
        for (edge, corner) in edges[4..].iter_mut().zip(&mut corners[4..]) {
            *edge += std::mem::take(corner);
        }
        for sum in sums.as_flattened_mut() {
            *sum = ((i64::from(*sum) * share) >> 14) as i32;
        }
        sums
    }

    /// The weighted sums of the responses of each class, from lane `at` on.
    #[inline(always)]
    fn sums<S: Simd>(&self, simd: S, near: Neighbourhood<'_>, at: usize) -> [S::I32; 3] {
        let own = S::I32::load_i16(simd, &near.own[at..]);
        [
            self.sum(simd, near, own, 0, at),
            self.sum(simd, near, own, 1, at),
            self.sum(simd, near, own, 2, at),
        ]
    }

    /// That of one class.
    #[inline(always)]
    fn sum<S: Simd>(&self, simd: S, near: Neighbourhood<'_>, own: S::I32, class: usize, at: usize) -> S::I32 {
        let one = S::I32::splat(simd, 4096);
        let inverses = S::I32::load(simd, &self.inverses[at..]);
        let mut sum = S::I32::splat(simd, 0);
        let mut left = near.places[class];
        while left != 0 {
            let neighbour = near.around[left.trailing_zeros() as usize & 63];
            left &= left - 1;
            let d = S::I32::load_i16(simd, &near.values[neighbour as usize][at..]) - own;
            let x = (d.abs() * inverses).shr_unsigned(12).min_unsigned(one);
            sum = sum + (d * (one - (x * x).shr_unsigned(12))).shr(12);
        }
        sum * S::I32::splat(simd, self.weights[class])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Isa, Work};
    use proptest::prelude::*;

    fn plain(responses: &Responses, near: Neighbourhood<'_>) -> [Lanes; 3] {
        let (mut sums, mut weight) = ([[0i64; 8]; 3], 0);
        for class in 0..3 {
            for place in (0..64).filter(|place| near.places[class] >> place & 1 == 1) {
                weight += i64::from(responses.weights[class]);
                let other = &near.values[near.around[place] as usize];
                for lane in 0..8 {
                    let d = i64::from(other[lane]) - i64::from(near.own[lane]);
                    let x = ((d.abs() * i64::from(responses.inverses[lane])) >> 12).min(4096);
                    let counts_as = if class == 2 && lane >= 4 { 1 } else { class };
                    let response = (d * (4096 - ((x * x) >> 12))) >> 12;
                    sums[counts_as][lane] += i64::from(responses.weights[class]) * response;
                }
            }
        }
        sums.map(|sums| sums.map(|sum| ((sum * (65536 / weight.max(1))) >> 14) as i32))
    }

    #[derive(Clone, Copy)]
    struct Run<'a> {
        responses: &'a Responses,
        near: Neighbourhood<'a>,
        factors: &'a [Lanes; 3],
    }

    impl Work for Run<'_> {
        type Output = ([Lanes; 3], Lanes);

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) -> Self::Output {
            let means = self.responses.means(simd, self.near);
            (means, self.responses.weighted(simd, self.near, self.factors))
        }
    }

    #[test]
    fn the_largest_responses_fit_32_bits() {
        let values = [[-16384; 8], [16384; 8]];
        let responses = Responses::new([Responses::SMALL; 8], [20, 12, 7]);
        for places in [
            [!0, 0, 0],
            [0, !0, 0],
            [0, 0, !0],
            [1, 0, 0],
            [0, 0, 1],
            [63, 4095 << 6, 255 << 18],
        ] {
            let (around, factors) = ([1; 64], [[127; 8]; 3]);
            let near = Neighbourhood {
                values: &values,
                own: &values[0],
                around: &around,
                places,
            };
            let means = plain(&responses, near);
            let weighted = std::array::from_fn(|lane| (0..3).map(|class| 127 * means[class][lane]).sum());
            for isa in Isa::available() {
                let work = Run {
                    responses: &responses,
                    near,
                    factors: &factors,
                };
                assert_eq!(isa.run(work), (means, weighted), "{isa}");
            }
        }
    }

    proptest! {
        /// With products that fit 32 bits, and with inverses whose products do not.
        #[test]
        fn every_instruction_set_has_the_means_of_plain_code(
            values in prop::collection::vec(prop::array::uniform8(-16384i16..=16384), 1..9),
            around in prop::collection::vec(0u32..8, 64),
            classes in prop::collection::vec(0usize..4, 64),
            inverses in prop::array::uniform8(prop_oneof![0i32..512, Responses::SMALL..=1 << 16]),
            small in any::<bool>(),
            factors in prop::array::uniform3(prop::array::uniform8(-127i32..=127)),
        ) {
            let known = values.len() as u32;
            let around: [u32; 64] = std::array::from_fn(|place| around[place] % known);
            let mut places = [0; 3];
            for (place, class) in classes.into_iter().enumerate().filter(|(_, class)| *class < 3) {
                places[class] |= 1 << place;
            }
            let least = if small { Responses::SMALL } else { 0 };
            let responses = Responses::new(inverses.map(|inverse| inverse.max(least)), [20, 12, 7]);
            prop_assert!(responses.small || !small);
            let near = Neighbourhood { values: &values, own: &values[0], around: &around, places };
            let means = plain(&responses, near);
            let weighted = std::array::from_fn(|lane| (0..3).map(|class| factors[class][lane] * means[class][lane]).sum());
            for isa in Isa::available() {
                let work = Run { responses: &responses, near, factors: &factors };
                prop_assert_eq!(isa.run(work), (means, weighted), "{}", isa);
            }
        }
    }
}
