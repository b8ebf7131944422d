//! The transform of a node's children: up to seven two-point butterflies, as in RAHT (`docs/format.md`, clause 5.5).
//!
//! Children are joined pairwise along z, then y, then x. Let a and b be values that represent `v` and `w` children. A
//! join replaces them by their difference `b − a` and their mean `a + ⌊(b − a)·w / (v + w)⌋`. A value without a partner
//! passes through. The mean of all children ends in octant 0. Each join leaves a difference in its *slot*: 0 along x, 1
//! and 2 along y, 3 to 6 along z. All means are integers of one scale, so the transform is exactly reversible. RAHT (de
//! Queiroz and Chou, doi 10.1109/TIP.2016.2575005) normalises the differences; here [`SCALE`] does so in quantisation.

use b2p_kernels::butterflies::Join;

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
    /// Number of children that the two values of each slot represent; 0 for an inactive slot.
    weights: [[u8; 2]; 7],
}

impl Joins {
    const NONE: Joins = Joins {
        count: 0,
        slots: [0; 7],
        weights: [[0; 2]; 7],
    };

    #[inline(always)]
    pub fn slots(&self) -> impl Iterator<Item = usize> + '_ {
        self.slots[..self.count].iter().map(|&slot| usize::from(slot))
    }

    /// Number of children that the two values of a slot represent.
    #[inline(always)]
    pub fn weights(&self, slot: usize) -> [usize; 2] {
        self.weights[slot].map(usize::from)
    }
}

/// Active joins by occupancy.
pub(super) static JOINS_OF: [Joins; 256] = {
    let mut all = [Joins::NONE; 256];
    let mut mask = 0;
    while mask < 256 {
        let mut weights = [0u8; 8];
        let mut octant = 0;
        while octant < 8 {
            weights[octant] = (mask >> octant & 1) as u8;
            octant += 1;
        }
        let mut joins = Joins::NONE;
        let mut slots = [0u8; 7];
        let mut i = 0;
        while i < 7 {
            let (slot, a, b) = JOINS[i];
            if weights[a] > 0 && weights[b] > 0 {
                joins.weights[slot] = [weights[a], weights[b]];
                slots[joins.count] = slot as u8;
                joins.count += 1;
            }
            weights[a] += weights[b];
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

/// Fraction of the difference that each join of [`JOINS`] adds to its first value, by occupancy: `w / (v + w)`, and 0
/// where no child is joined. A second value without a first replaces it.
pub(super) static FRACTIONS: [[f32; 7]; 256] = {
    let mut all = [[0.0; 7]; 256];
    let mut mask = 0;
    while mask < 256 {
        let mut weights = [0u8; 8];
        let mut octant = 0;
        while octant < 8 {
            weights[octant] = (mask >> octant & 1) as u8;
            octant += 1;
        }
        let mut i = 0;
        while i < 7 {
            let (_, a, b) = JOINS[i];
            if weights[b] > 0 {
                all[mask][i] = weights[b] as f32 / (weights[a] + weights[b]) as f32;
            }
            weights[a] += weights[b];
            i += 1;
        }
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
#[inline(always)]
pub(super) fn forward(mask: u8, mut values: [[i32; 3]; 8]) -> ([i32; 3], [[i32; 3]; 7]) {
    let mut differences = [[0; 3]; 7];
    let mut occupied = mask;
    for (slot, a, b) in JOINS {
        match (occupied >> a & 1, occupied >> b & 1) {
            (1, 1) => {
                let [v, w] = JOINS_OF[usize::from(mask)].weights(slot).map(|w| w as i32);
                for k in 0..3 {
                    let difference = values[b][k] - values[a][k];
                    differences[slot][k] = difference;
                    values[a][k] += share(difference, v, w);
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
pub(super) fn inverse(mask: u8, mean: [i32; 3], differences: &[[i32; 3]; 7]) -> [[i32; 3]; 8] {
    let mut values = [[0; 3]; 8];
    values[0] = mean;
    let joins = &JOINS_OF[usize::from(mask)];
    for (slot, a, b) in JOINS.into_iter().rev() {
        let [v, w] = joins.weights(slot).map(|w| w as i32);
        if v > 0 {
            for k in 0..3 {
                values[a][k] -= share(differences[slot][k], v, w);
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
#[inline(always)]
fn share(difference: i32, v: i32, w: i32) -> i32 {
    // The compiler turns a division by a constant into a multiplication. `v + w` is at most 8.
    let product = difference * w;
    match v + w {
        2 => product >> 1,
        3 => product.div_euclid(3),
        4 => product >> 2,
        5 => product.div_euclid(5),
        6 => product.div_euclid(6),
        7 => product.div_euclid(7),
        _ => product >> 3,
    }
}

/// Factor that makes a difference orthonormal, `√(vw / (v + w))`, and its inverse, in units of 2⁻¹².
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    pub forward: i32,
    pub inverse: i32,
}

/// [`Scale`] by the numbers of children `v` and `w`, each 1 to 4.
pub(super) static SCALE: [[Scale; 5]; 5] = {
    let mut table = [[Scale {
        forward: 1 << 12,
        inverse: 1 << 12,
    }; 5]; 5];
    let mut v = 1;
    while v < 5 {
        let mut w = 1;
        while w < 5 {
            let (product, sum) = (v as u64 * w as u64, v as u64 + w as u64);
            table[v][w] = Scale {
                forward: nearest_root(product, sum) as i32,
                inverse: nearest_root(sum, product) as i32,
            };
            w += 1;
        }
        v += 1;
    }
    table
};

/// `round(2¹²·√(numerator / denominator))`.
const fn nearest_root(numerator: u64, denominator: u64) -> u64 {
    // ⌊√(4·square)⌋ = ⌊2·√square⌋: halving it, rounded up, rounds the root to the nearest integer.
    let square = (numerator << 26) / denominator;
    let twice = square.isqrt();
    twice.div_ceil(2)
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

    proptest! {
        #[test]
        fn the_inverse_undoes_the_transform(mask in 1u8..=255, values in prop::array::uniform8(prop::array::uniform3(-16384i32..16384))) {
            let (mean, differences) = forward(mask, values);
            let back = inverse(mask, mean, &differences);
            for octant in 0..8 {
                if mask >> octant & 1 == 1 {
                    prop_assert_eq!(back[octant], values[octant]);
                }
            }
        }

        #[test]
        fn the_mean_is_that_of_the_children_within_a_unit_a_join(mask in 1u8..=255, values in prop::array::uniform8(prop::array::uniform3(-16384i32..16384))) {
            let (mean, _) = forward(mask, values);
            let children: Vec<_> = (0..8).filter(|o| mask >> o & 1 == 1).collect();
            for k in 0..3 {
                let sum: i32 = children.iter().map(|&o| values[o][k]).sum();
                let exact = f64::from(sum) / children.len() as f64;
                prop_assert!((f64::from(mean[k]) - exact).abs() < 3.0);
            }
        }
    }

    struct There(u8, [[i32; 8]; 8]);

    impl Work for There {
        type Output = [[i32; 8]; 7];

        #[inline(always)]
        fn run<I: Instructions>(self, simd: I) -> [[i32; 8]; 7] {
            butterflies::forward(simd, &JOINS, &FRACTIONS[usize::from(self.0)], self.1)
        }
    }

    struct Back<'a>(u8, [i32; 8], &'a [[i32; 8]; 7]);

    impl Work for Back<'_> {
        type Output = [[i32; 8]; 8];

        #[inline(always)]
        fn run<I: Instructions>(self, simd: I) -> [[i32; 8]; 8] {
            butterflies::inverse(simd, &JOINS, &FRACTIONS[usize::from(self.0)], self.1, self.2)
        }
    }

    proptest! {
        #[test]
        fn kernels_transform_every_occupancy_as_plain_code_does(
            values in prop::array::uniform8(prop::array::uniform3(-16384i32..=16384)),
            chosen in prop::array::uniform7(prop::array::uniform3(-65536i32..=65536)),
        ) {
            let wide = |[y, co, cg]: [i32; 3]| [y, co, cg, 0, y, co, cg, 0];
            for (mask, isa) in (1..=255u8).flat_map(|mask| Isa::available().into_iter().map(move |isa| (mask, isa))) {
                let joins = &JOINS_OF[usize::from(mask)];
                let mut children = values;
                let mut differences = [[0; 3]; 7];
                for octant in (0..8).filter(|o| mask >> o & 1 == 0) {
                    children[octant] = [0; 3];
                }
                for slot in joins.slots() {
                    differences[slot] = chosen[slot];
                }
                let (_, expected) = forward(mask, children);
                let there = isa.run(There(mask, children.map(wide)));
                for slot in joins.slots() {
                    prop_assert_eq!(there[slot], wide(expected[slot]), "{}", isa);
                }
                let expected = inverse(mask, values[0], &differences);
                let back = isa.run(Back(mask, wide(values[0]), &differences.map(wide)));
                for octant in (0..8).filter(|o| mask >> o & 1 == 1) {
                    prop_assert_eq!(back[octant], wide(expected[octant]), "{}", isa);
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
                assert!(a < b && joins.weights(slot).iter().all(|w| (1..=4).contains(w)));
            }
        }
    }

    #[test]
    fn the_scale_makes_a_rotation() {
        for v in 1..5 {
            for w in 1..5 {
                let Scale { forward, inverse } = SCALE[v][w];
                let exact = (v as f64 * w as f64 / (v + w) as f64).sqrt();
                assert!((f64::from(forward) / 4096.0 - exact).abs() < 1.3e-4, "{v} {w}");
                assert!((f64::from(inverse) / 4096.0 - 1.0 / exact).abs() < 1.3e-4, "{v} {w}");
            }
        }
    }
}
