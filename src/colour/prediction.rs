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

/// Offsets of the node itself and of its face neighbours, as indices into a 3³ kernel map row.
pub(super) const SELF_AND_FACES: [usize; 7] = [13, 4, 10, 12, 14, 16, 22];
/// Offsets of the face neighbours that precede the node in Morton order: at z − 1, y − 1, x − 1.
pub(super) const EARLIER_FACES: [usize; 3] = [4, 10, 12];

/// Weights of children coded before, by the number of coordinates in which they differ.
const CHILD_WEIGHTS_BY_AXES: [i32; 4] = [0, 831, 113, 15];

/// Weights of children coded before, by offset in a 3³ row.
pub(super) static CHILD_WEIGHTS: [i32; 27] = {
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

/// Accumulator of a weighted mean of colours.
#[derive(Clone, Copy, Default)]
pub(super) struct WeightedMean {
    sums: [i32; 3],
    weight: i32,
}

impl WeightedMean {
    #[inline(always)]
    pub fn add(&mut self, value: [i16; 3], weight: i32) {
        for (sum, x) in self.sums.iter_mut().zip(value) {
            *sum += i32::from(x) * weight;
        }
        self.weight += weight;
    }

    /// The mean. At least one value of non-zero weight must have been added.
    #[inline(always)]
    pub fn value(self) -> [i32; 3] {
        let inverse = (1i64 << 32) / i64::from(self.weight.max(1));
        self.sums
            .map(|sum| ((i64::from(sum) * inverse + (1 << 31)) >> 32) as i32)
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
    fn sums_stay_within_32_bits() {
        let parents: i64 = 7 * 4096;
        let children: i64 = CHILD_WEIGHTS.iter().map(|&w| i64::from(w)).sum();
        assert!((parents + children) * (1 << 14) < i64::from(i32::MAX));
    }
}
