//! Prediction of a node's children: means of decoded colours nearby, weighted by distance (`docs/format.md`, clause
//! 5.6).
//!
//! Every child has two predictions. The *far* one is the mean of the node and of its six face neighbours. The weight of
//! each is a Gaussian of standard deviation 0.7 children, of the distance from the child's centre to the mean of that
//! node's children: `round(4096·e^(−k/64))` with `k = ⌊(6400·d + 49·n²) / (98·n²)⌋`, where `n` is the number of
//! children of that node and `d / n²` the squared distance in units of children.
//!
//! The *near* prediction adds the children that were coded before in the same slice and touch the child, with the
//! weights 831 (by a face), 113 (by an edge) and 15 (by a corner).
//!
//! A mean is `(sum·⌊2³² / weight⌋ + 2³¹) >> 32`, with the sums of weighted colours and of weights.

use crate::geometry::{AROUND, KernelMap, place};

/// Offsets of the node itself and of its face neighbours, as indices into a 3³ kernel map row.
pub(super) const SELF_AND_FACES: [usize; 7] = [13, 4, 10, 12, 14, 16, 22];
/// Offsets of the face neighbours that precede the node in Morton order: at z − 1, y − 1, x − 1.
pub(super) const EARLIER_FACES: [usize; 3] = [4, 10, 12];

/// Weights of children coded before, by the number of coordinates in which they differ.
const CHILD_WEIGHTS_BY_AXES: [i32; 4] = [0, 831, 113, 15];

/// Offsets in a 3³ row at which children may be coded before: those with a negative component, by the number of
/// coordinates in which they differ.
const BEFORE: (&[usize; 3], &[usize; 9], &[usize; 7]) = (
    &EARLIER_FACES,
    &[1, 3, 5, 7, 9, 11, 15, 19, 21],
    &[0, 2, 6, 8, 18, 20, 24],
);

/// Weights of children coded before, by offset in a 3³ row.
#[cfg(test)]
static CHILD_WEIGHTS: [i32; 27] = {
    let mut weights = [0; 27];
    let mut k = 0;
    while k < 27 {
        let axes = (k % 3 != 1) as usize + (k / 3 % 3 != 1) as usize + (k / 9 != 1) as usize;
        weights[k] = CHILD_WEIGHTS_BY_AXES[axes];
        k += 1;
    }
    weights
};

/// `e^(−1/64)` in units of 2⁻⁶², rounded down.
const DECAY: u128 = 4_540_188_453_729_421_604;
/// Length of [`GAUSSIAN`]. All weights from this `k` on are 0.
const GAUSSIAN_SIZE: usize = 600;

/// `round(4096·e^(−k/64))`, the power in units of 2⁻⁶², rounded down after each factor.
const GAUSSIAN: [u16; GAUSSIAN_SIZE] = {
    let mut table = [0; GAUSSIAN_SIZE];
    let (mut k, mut power) = (0, 1u128 << 62);
    while k < GAUSSIAN_SIZE {
        table[k] = ((power + (1 << 49)) >> 50) as u16;
        power = (power * DECAY) >> 62;
        k += 1;
    }
    table
};

/// Weight of a node by its index in [`SELF_AND_FACES`], its occupancy, and the octant of the predicted child.
pub(super) static NODE_WEIGHTS: [[[u16; 8]; 256]; 7] = {
    let mut table = [[[0; 8]; 256]; 7];
    let mut node = 0;
    while node < 7 {
        let at = SELF_AND_FACES[node] as i64;
        let offset = [at % 3 - 1, at / 3 % 3 - 1, at / 9 - 1];
        let mut mask = 1;
        while mask < 256 {
            let (mut sum, mut count, mut octant) = ([0i64; 3], 0i64, 0);
            while octant < 8 {
                if mask >> octant & 1 == 1 {
                    count += 1;
                    sum[0] += octant & 1;
                    sum[1] += octant >> 1 & 1;
                    sum[2] += octant >> 2;
                }
                octant += 1;
            }
            let mut octant = 0;
            while octant < 8 {
                let child = [octant & 1, octant >> 1 & 1, octant >> 2];
                let (mut square, mut axis) = (0, 0);
                while axis < 3 {
                    let apart = count * (child[axis] - 2 * offset[axis]) - sum[axis];
                    square += apart * apart;
                    axis += 1;
                }
                let k = (6400 * square + 49 * count * count) / (98 * count * count);
                if k < GAUSSIAN_SIZE as i64 {
                    table[node][mask][octant as usize] = GAUSSIAN[k as usize];
                }
                octant += 1;
            }
            mask += 1;
        }
        node += 1;
    }
    table
};

/// A node and its six face neighbours. One that is absent has the node's own colour, and no weight.
pub(super) struct FaceNeighbours {
    masks: [u8; 7],
    values: [[i16; 3]; 7],
    present: u32,
}

impl FaceNeighbours {
    #[inline(always)]
    pub fn new(row: &[u32], masks: &[u8], values: &[[i16; 3]], node: usize) -> FaceNeighbours {
        let mut around = FaceNeighbours {
            masks: [0; 7],
            values: [[0; 3]; 7],
            present: 0,
        };
        for (i, k) in SELF_AND_FACES.into_iter().enumerate() {
            // Selects instead of branches: the presence of neighbours is unpredictable.
            let present = row[k] != KernelMap::ABSENT;
            let at = if present { row[k] as usize } else { node };
            around.masks[i] = if present { masks[at] } else { 0 };
            around.values[i] = values[at];
            around.present += u32::from(present);
        }
        around
    }

    /// Sums of weighted Y, Co and Cg, and of weights, for a child in each octant.
    #[inline(always)]
    pub fn sums(&self) -> [[i32; 8]; 4] {
        let mut sums = [[0; 8]; 4];
        for (i, weights) in NODE_WEIGHTS.iter().enumerate() {
            let weights = &weights[usize::from(self.masks[i])];
            let [y, co, cg] = self.values[i].map(i32::from);
            for octant in 0..8 {
                let weight = i32::from(weights[octant]);
                sums[0][octant] += y * weight;
                sums[1][octant] += co * weight;
                sums[2][octant] += cg * weight;
                sums[3][octant] += weight;
            }
        }
        sums
    }

    /// The mean absolute difference of the present face neighbours to the node, by channel.
    #[inline(always)]
    pub fn gradient(&self) -> [i32; 3] {
        /// `⌈2²⁰ / n⌉`, for exact quotients of up to six differences below 2¹⁶.
        const INVERSES: [u64; 7] = [0, 1 << 20, 1 << 19, 349_526, 1 << 18, 209_716, 174_763];
        let mut sums = [0u32; 3];
        for value in &self.values[1..] {
            for t in 0..3 {
                sums[t] += u32::from(self.values[0][t].abs_diff(value[t]));
            }
        }
        // The node itself is present.
        let inverse = INVERSES[(self.present as usize).saturating_sub(1).min(6)];
        sums.map(|sum| ((u64::from(sum) * inverse) >> 20) as i32)
    }
}

/// The children of a slice's nodes that were coded so far.
pub(super) struct Coded {
    /// Index of the first child.
    base: usize,
    len: usize,
    /// Y, Co, Cg and 1 of each; zeros from `len` on.
    values: Vec<[i16; 4]>,
}

impl Coded {
    /// None yet of the `count` children from `base` on.
    pub fn new(base: usize, count: usize) -> Coded {
        Coded {
            base,
            len: 0,
            values: vec![[0; 4]; count + 1],
        }
    }

    /// # Panics
    /// If all children were coded.
    #[inline(always)]
    pub fn push(&mut self, [y, co, cg]: [i16; 3]) {
        self.values[self.len] = [y, co, cg, 1];
        self.len += 1;
    }

    /// `sums` of weighted Y, Co and Cg and of weights, plus those of the coded children around a child.
    #[inline(always)]
    pub fn sums(&self, around: &[u32; AROUND], sums: [i32; 4]) -> [i32; 4] {
        let (faces, edges, corners) = BEFORE;
        let [faces, edges, corners] = [
            self.unweighted(around, faces),
            self.unweighted(around, edges),
            self.unweighted(around, corners),
        ];
        let [_, face, edge, corner] = CHILD_WEIGHTS_BY_AXES;
        std::array::from_fn(|i| sums[i] + face * faces[i] + edge * edges[i] + corner * corners[i])
    }

    #[inline(always)]
    fn unweighted<const N: usize>(&self, around: &[u32; AROUND], offsets: &[usize; N]) -> [i32; 4] {
        let values = &self.values[..=self.len];
        let mut sums = [0; 4];
        for &k in offsets {
            // The children of other slices wrap or lie beyond, as absent ones do: they read the zeros after the last.
            let value = &values[(around[place(k)] as usize).wrapping_sub(self.base).min(self.len)];
            for i in 0..4 {
                sums[i] += i32::from(value[i]);
            }
        }
        sums
    }

    /// Y, Co and Cg of all children.
    pub fn into_values(self) -> Vec<[i16; 3]> {
        let values = self.values[..self.len].iter();
        values.map(|&[y, co, cg, _]| [y, co, cg]).collect()
    }
}

#[allow(clippy::needless_range_loop)] // indices as in the tables' definitions
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_gaussians_of_the_distance() {
        let mut checked = 0;
        for (node, &at) in SELF_AND_FACES.iter().enumerate() {
            let at = at as f64;
            let offset = [at % 3.0 - 1.0, (at / 3.0).floor() % 3.0 - 1.0, (at / 9.0).floor() - 1.0];
            for mask in 1..256usize {
                let children: Vec<usize> = (0..8).filter(|o| mask >> o & 1 == 1).collect();
                for octant in 0..8usize {
                    let place = |o: usize, axis: usize| (o >> axis & 1) as f64;
                    let square: f64 = (0..3)
                        .map(|axis| {
                            let sum: f64 = children.iter().map(|&o| place(o, axis)).sum();
                            let mean = sum / children.len() as f64 + 2.0 * offset[axis];
                            (place(octant, axis) - mean).powi(2)
                        })
                        .sum();
                    let exact = 4096.0 * (-square / 0.98).exp();
                    let weight = f64::from(NODE_WEIGHTS[node][mask][octant]);
                    assert!((weight - exact).abs() <= 0.009 * exact + 0.6, "{node} {mask} {octant}");
                    checked += 1;
                }
            }
        }
        assert_eq!(checked, 7 * 255 * 8);
    }

    #[test]
    fn the_node_itself_always_has_weight_for_its_children() {
        for mask in 1..256 {
            for octant in (0..8).filter(|o| mask >> o & 1 == 1) {
                assert!(NODE_WEIGHTS[0][mask][octant] > 1000);
            }
        }
    }

    #[test]
    fn offsets_before_are_those_with_a_negative_component() {
        let (faces, edges, corners) = BEFORE;
        let mut all = [&faces[..], edges, corners].concat();
        for (offsets, axes) in [(&faces[..], 1), (edges, 2), (corners, 3)] {
            for k in offsets {
                assert_eq!(CHILD_WEIGHTS[*k], CHILD_WEIGHTS_BY_AXES[axes]);
            }
        }
        all.sort();
        let before = (0..27).filter(|k| k % 3 == 0 || k / 3 % 3 == 0 || *k < 9);
        assert!(all.into_iter().eq(before));
    }

    #[test]
    fn gradients_are_quotients_rounded_down() {
        for present in 1..=7u32 {
            for step in [0, 1, 2, 3, 5, 7, 11, 1000, 32_767, 32_768i32] {
                let mut values = [[-16_384; 3]; 7];
                for value in &mut values[1..present as usize] {
                    *value = [(step - 16_384) as i16; 3];
                }
                values[present as usize - 1][1] = -16_384;
                let around = FaceNeighbours {
                    masks: [1; 7],
                    values,
                    present,
                };
                let faces = present as i32 - 1;
                let sums = [faces * step, (faces - 1).max(0) * step, faces * step];
                assert_eq!(around.gradient(), sums.map(|sum| sum / faces.max(1)));
            }
        }
    }

    #[test]
    fn sums_stay_within_32_bits() {
        let parents: i64 = 7 * 4096;
        let children: i64 = CHILD_WEIGHTS.iter().map(|&w| i64::from(w)).sum();
        assert!((parents + children) * (1 << 14) < i64::from(i32::MAX));
    }
}
