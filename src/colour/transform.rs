//! The transform of a node's children: up to seven two-point butterflies, as in RAHT (`docs/format.md`, clause 5.5).
//!
//! Children are joined pairwise along z, then y, then x. Let a and b be values of the weights `v` and `w` (`weights`). A
//! join replaces them by their difference `b − a` and their mean `a + ⌊(b − a)·f⌋`, with `f` about `w / (v + w)`. A value
//! without a partner passes through. The mean of all children ends in octant 0. Each join leaves a difference in its
//! *slot*: 0 along x, 1 and 2 along y, 3 to 6 along z. All means are integers of one scale, so the transform is exactly
//! reversible. RAHT (de Queiroz and Chou, doi 10.1109/TIP.2016.2575005) normalises the differences; here [`Scale`] does
//! so in quantisation.

use b2p_kernels::butterflies::Join;

use super::weights::UNIT;

/// All joins in the order of the forward transform.
pub(super) const JOINS: [Join; 7] = [
    (3, 0, 4),
    (4, 1, 5),
    (5, 2, 6),
    (6, 3, 7),
    (1, 0, 2),
    (2, 1, 3),
    (0, 0, 1),
];

/// Axis of every slot: 0 x, 1 y, 2 z.
pub(super) const AXIS: [usize; 7] = [0, 1, 1, 2, 2, 2, 2];

/// Active joins of a node, in the order in which their coefficients are coded: that of the inverse transform.
#[derive(Debug, Clone, Copy)]
pub(super) struct Joins {
    pub count: usize,
    slots: [u8; 7],
}

impl Joins {
    const NONE: Joins = Joins {
        count: 0,
        slots: [0; 7],
    };

    #[inline(always)]
    pub fn slots(&self) -> impl Iterator<Item = usize> + '_ {
        self.slots[..self.count].iter().map(|&slot| usize::from(slot))
    }
}

/// Active joins by occupancy.
pub(super) static JOINS_OF: [Joins; 256] = {
    let mut all = [Joins::NONE; 256];
    let mut mask = 0;
    while mask < 256 {
        let mut occupied = mask;
        let mut joins = Joins::NONE;
        let mut slots = [0u8; 7];
        let mut i = 0;
        while i < 7 {
            let (slot, a, b) = JOINS[i];
            if occupied >> a & 1 == 1 && occupied >> b & 1 == 1 {
                slots[joins.count] = slot as u8;
                joins.count += 1;
            }
            occupied |= (occupied >> b & 1) << a;
            i += 1;
        }
        let mut i = 0;
        while i < joins.count {
            joins.slots[i] = slots[joins.count - 1 - i];
            i += 1;
        }
        all[mask] = joins;
        mask += 1;
    }
    all
};

/// How the children of a node are joined: what their weights make of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighting {
    /// Fraction of the difference that each join of [`JOINS`] adds to its first value, in units of 2⁻¹⁴: that of the
    /// second value's weight, and 0 where no child is joined. A second value without a first replaces it.
    pub fractions: [i32; 7],
    /// Scale of the difference in each slot.
    pub scales: [Scale; 7],
}

impl Weighting {
    /// Of children of these weights, 1 to 2¹⁴; 0 in octants without a child.
    #[inline(always)]
    pub const fn new(mut weights: [u32; 8]) -> Weighting {
        let mut weighting = Weighting {
            fractions: [0; 7],
            scales: [UNSCALED; 7],
        };
        let mut i = 0;
        while i < 7 {
            let (slot, a, b) = JOINS[i];
            let [v, w] = [weights[a], weights[b]];
            if w > 0 {
                weighting.fractions[i] = (((w << 14) + (v + w) / 2) / (v + w)) as i32;
                if v > 0 {
                    weighting.scales[slot] = Scale::new(v, w);
                }
            }
            weights[a] += w;
            i += 1;
        }
        weighting
    }
}

/// Of children of weight [`UNIT`], by occupancy.
pub(super) static EVEN: [Weighting; 256] = {
    let mut all = [Weighting::new([0; 8]); 256];
    let mut mask = 0;
    while mask < 256 {
        let mut weights = [0; 8];
        let mut octant = 0;
        while octant < 8 {
            weights[octant] = (mask as u32 >> octant & 1) * UNIT;
            octant += 1;
        }
        all[mask] = Weighting::new(weights);
        mask += 1;
    }
    all
};

/// Octants of the two values of each slot.
#[cfg(test)]
const OCTANTS: [[usize; 2]; 7] = {
    let mut octants = [[0; 2]; 7];
    let mut i = 0;
    while i < 7 {
        let (slot, a, b) = JOINS[i];
        octants[slot] = [a, b];
        i += 1;
    }
    octants
};

/// Transforms the values of the children in `mask`, indexed by octant. Returns the mean and the difference of each
/// slot.
#[cfg(any(test, feature = "encoder"))]
pub(super) fn forward(mask: u8, weighting: &Weighting, mut values: [[i32; 3]; 8]) -> ([i32; 3], [[i32; 3]; 7]) {
    let mut differences = [[0; 3]; 7];
    let mut occupied = mask;
    for ((slot, a, b), fraction) in JOINS.into_iter().zip(weighting.fractions) {
        match (occupied >> a & 1, occupied >> b & 1) {
            (1, 1) => {
                for k in 0..3 {
                    let difference = values[b][k] - values[a][k];
                    differences[slot][k] = difference;
                    values[a][k] += share(difference, fraction);
                }
            }
            (0, 1) => values[a] = values[b],
            _ => (),
        }
        occupied |= (occupied >> b & 1) << a;
    }
    (values[0], differences)
}

/// Inverse of [`forward`]: values of the children by octant.
#[cfg(test)]
pub(super) fn inverse(mask: u8, weighting: &Weighting, mean: [i32; 3], differences: &[[i32; 3]; 7]) -> [[i32; 3]; 8] {
    let mut values = [[0; 3]; 8];
    values[0] = mean;
    let active: Vec<usize> = JOINS_OF[usize::from(mask)].slots().collect();
    for ((slot, a, b), fraction) in JOINS.into_iter().zip(weighting.fractions).rev() {
        if active.contains(&slot) {
            for k in 0..3 {
                values[a][k] -= share(differences[slot][k], fraction);
                values[b][k] = values[a][k] + differences[slot][k];
            }
        } else if mask & REACH[b] != 0 {
            values[b] = values[a];
        }
    }
    values
}

/// For the second octant of every join, the children that its value can represent at that join.
#[cfg(test)]
const REACH: [u8; 8] = [
    0xff,
    0b1010_1010,
    0b0100_0100,
    0b1000_1000,
    1 << 4,
    1 << 5,
    1 << 6,
    1 << 7,
];

/// Difference of the mean to the first of two values.
#[cfg(any(test, feature = "encoder"))]
#[inline(always)]
fn share(difference: i32, fraction: i32) -> i32 {
    (difference * fraction) >> 14
}

/// Factor that makes a difference orthonormal, `√(vw / (v + w))` in units of weight, and its inverse, in units of 2⁻¹².
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    pub forward: i32,
    pub inverse: i32,
}

impl Scale {
    /// Of a difference between values of the weights `v` and `w`, each 1 to 2¹⁶.
    #[inline(always)]
    const fn new(v: u32, w: u32) -> Scale {
        // ⌊√(4·square)⌋ = ⌊2·√square⌋: halving it, rounded up, rounds the root to the nearest integer.
        let square = ((v as u64 * w as u64) << 16) / (v as u64 + w as u64);
        let forward = (square as u32).isqrt().div_ceil(2);
        Scale {
            forward: forward as i32,
            inverse: (((1 << 24) + forward / 2) / forward) as i32,
        }
    }
}

/// Scale of lossless colours, whose differences are not scaled.
pub(super) const UNSCALED: Scale = Scale {
    forward: 1 << 12,
    inverse: 1 << 12,
};

/// Octants of the first and the second value of a slot.
#[cfg(test)]
pub(super) const fn octants(slot: usize) -> [usize; 2] {
    OCTANTS[slot]
}

#[allow(clippy::needless_range_loop)] // indices as in the tables' definitions
#[cfg(test)]
mod tests {
    use super::*;
    use b2p_kernels::{Instructions, Isa, Work, butterflies};
    use proptest::prelude::*;

    /// Children of any weights, in the octants of any occupancy.
    fn some_children() -> impl Strategy<Value = (u8, Weighting, [[i32; 3]; 8])> {
        let weight = prop_oneof![Just(UNIT), 1u32..=1 << 14, Just(1), Just(1 << 14)];
        let values = prop::array::uniform8(prop::array::uniform3(-16384i32..=16384));
        (1u8..=255, prop::array::uniform8(weight), values).prop_map(|(mask, mut weights, mut values)| {
            for octant in (0..8).filter(|o| mask >> o & 1 == 0) {
                weights[octant] = 0;
                values[octant] = [0; 3];
            }
            (mask, Weighting::new(weights), values)
        })
    }

    proptest! {
        #[test]
        fn the_inverse_undoes_the_transform((mask, weighting, values) in some_children()) {
            let (mean, differences) = forward(mask, &weighting, values);
            let back = inverse(mask, &weighting, mean, &differences);
            for octant in (0..8).filter(|o| mask >> o & 1 == 1) {
                prop_assert_eq!(back[octant], values[octant]);
            }
        }

        #[test]
        fn the_mean_is_that_of_the_children_by_their_weights(
            mask in 1u8..=255,
            weights in prop::array::uniform8(1u32..=1 << 14),
            values in prop::array::uniform8(prop::array::uniform3(-16384i32..16384)),
        ) {
            let there = |o: usize| u32::from(mask >> o & 1);
            let weights: [u32; 8] = std::array::from_fn(|o| weights[o] * there(o));
            let (mean, _) = forward(mask, &Weighting::new(weights), values);
            let total = f64::from(weights.iter().sum::<u32>());
            for k in 0..3 {
                let sum: f64 = (0..8).map(|o| f64::from(weights[o]) * f64::from(values[o][k])).sum();
                // A join is off by a unit at most, and by half a unit of its fraction.
                prop_assert!((f64::from(mean[k]) - sum / total).abs() < 6.1);
            }
        }
    }

    struct There<'a>(&'a Weighting, [[i32; 8]; 8]);

    impl Work for There<'_> {
        type Output = [[i32; 8]; 7];

        #[inline(always)]
        fn run<I: Instructions>(self, simd: I) -> [[i32; 8]; 7] {
            butterflies::forward(simd, &JOINS, &self.0.fractions, self.1)
        }
    }

    struct Back<'a>(&'a Weighting, [i32; 8], &'a [[i32; 8]; 7]);

    impl Work for Back<'_> {
        type Output = [[i32; 8]; 8];

        #[inline(always)]
        fn run<I: Instructions>(self, simd: I) -> [[i32; 8]; 8] {
            butterflies::inverse(simd, &JOINS, &self.0.fractions, self.1, self.2)
        }
    }

    proptest! {
        #[test]
        fn kernels_transform_every_occupancy_as_plain_code_does(
            (mask, weighting, values) in some_children(),
            chosen in prop::array::uniform7(prop::array::uniform3(-65536i32..=65536)),
        ) {
            let wide = |[y, co, cg]: [i32; 3]| [y, co, cg, 0, y, co, cg, 0];
            let joins = &JOINS_OF[usize::from(mask)];
            let mut differences = [[0; 3]; 7];
            for slot in joins.slots() {
                differences[slot] = chosen[slot];
            }
            let (mean, expected) = forward(mask, &weighting, values);
            let undone = inverse(mask, &weighting, mean, &differences);
            for isa in Isa::available() {
                let there = isa.run(There(&weighting, values.map(wide)));
                for slot in joins.slots() {
                    prop_assert_eq!(there[slot], wide(expected[slot]), "{}", isa);
                }
                let back = isa.run(Back(&weighting, wide(mean), &differences.map(wide)));
                for octant in (0..8).filter(|o| mask >> o & 1 == 1) {
                    prop_assert_eq!(back[octant], wide(undone[octant]), "{}", isa);
                }
            }
        }
    }

    #[test]
    fn a_node_has_one_coefficient_fewer_than_children() {
        for mask in 1..=255u8 {
            let joins = &JOINS_OF[usize::from(mask)];
            assert_eq!(joins.count, mask.count_ones() as usize - 1);
            for slot in joins.slots() {
                let [a, b] = octants(slot);
                assert!(a < b);
            }
        }
    }

    #[test]
    fn the_scale_makes_a_rotation() {
        for v in [1, 2, 7, 360, 1024, 4096, 16_384, 65_536] {
            for w in [1, 3, 920, 1024, 2048, 3072, 50_000, 65_536] {
                let Scale { forward, inverse } = Scale::new(v, w);
                let [v, w] = [v, w].map(f64::from);
                let exact = 4096.0 * (v * w / (v + w) / f64::from(UNIT)).sqrt();
                assert!((f64::from(forward) - exact).abs() < 0.51, "{v} {w}");
                assert!(
                    (f64::from(inverse) * exact / f64::from(1 << 24) - 1.0).abs() < 0.006,
                    "{v} {w}"
                );
            }
        }
    }
}
