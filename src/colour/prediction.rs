//! What a node's children are likely to look like: means of decoded colours nearby, weighted by distance.
//!
//! Two predictions are made of every child. The first is the mean of the node and of its six face neighbours, each with the weight
//! `round(4096·e^(−k/64))`, where `k = ⌊(6400·d + 49·n²) / (98·n²)⌋`: `n` is how many children that node has, and `d / n²` the squared distance, in children,
//! from the child's centre to the mean of theirs. (So the weight is a Gaussian of standard deviation 0.7.) The second adds to these the children that were coded before in the same slice and touch the
//! child, with weights of 831 (by a face), 113 (by an edge) and 15 (by a corner). A mean is `(sum·⌊2³² / weight⌋ + 2³¹) >> 32`, with the sums of weighted colours and of weights.

/// The place in a 3³ kernel map row of the node itself and of its face neighbours.
pub(super) const NEAR: [usize; 7] = [13, 4, 10, 12, 14, 16, 22];
/// Face neighbours that come before the node in Morton order: at z − 1, y − 1, x − 1.
pub(super) const BEFORE: [usize; 3] = [4, 10, 12];

/// Weights of children that were coded before, by how many coordinates differ.
const TOUCHING: [i32; 4] = [0, 831, 113, 15];

/// By place in a 3³ row.
pub(super) static TOUCHING_AT: [i32; 27] = {
    let mut weights = [0; 27];
    let mut k = 0;
    while k < 27 {
        let off = (k % 3 != 1) as usize + (k / 3 % 3 != 1) as usize + (k / 9 != 1) as usize;
        weights[k] = TOUCHING[off];
        k += 1;
    }
    weights
};

/// `e^(−1/64)` in units of 2⁻⁶², rounded down.
const DECAY: u128 = 4_540_188_453_729_421_604;
/// Beyond this distance all weights are 0.
const FAR: usize = 600;

/// `round(4096·e^(−k/64))`, the power in units of 2⁻⁶², rounded down after each factor.
const GAUSSIAN: [u16; FAR] = {
    let mut table = [0; FAR];
    let (mut k, mut power) = (0, 1u128 << 62);
    while k < FAR {
        table[k] = ((power + (1 << 49)) >> 50) as u16;
        power = (power * DECAY) >> 62;
        k += 1;
    }
    table
};

/// The weight of a node, by its place in [`NEAR`], its occupancy, and the octant of the child that is predicted.
pub(super) static WEIGHTS: [[[u16; 8]; 256]; 7] = {
    let mut table = [[[0; 8]; 256]; 7];
    let mut near = 0;
    while near < 7 {
        let at = NEAR[near] as i64;
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
                if k < FAR as i64 {
                    table[near][mask][octant as usize] = GAUSSIAN[k as usize];
                }
                octant += 1;
            }
            mask += 1;
        }
        near += 1;
    }
    table
};

/// A weighted mean in the making.
#[derive(Clone, Copy, Default)]
pub(super) struct Mean {
    sums: [i32; 3],
    weight: i32,
}

impl Mean {
    #[inline(always)]
    pub fn add(&mut self, value: [i16; 3], weight: i32) {
        for (sum, x) in self.sums.iter_mut().zip(value) {
            *sum += i32::from(x) * weight;
        }
        self.weight += weight;
    }

    /// The mean. Something must have been added whose weight is not 0.
    #[inline(always)]
    pub fn value(self) -> [i32; 3] {
        let inverse = (1i64 << 32) / i64::from(self.weight.max(1));
        self.sums
            .map(|sum| ((i64::from(sum) * inverse + (1 << 31)) >> 32) as i32)
    }
}

#[allow(clippy::needless_range_loop)] // tables are indexed as their definitions are
#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_gaussians_of_the_distance() {
        let mut checked = 0;
        for (near, &at) in NEAR.iter().enumerate() {
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
                    let weight = f64::from(WEIGHTS[near][mask][octant]);
                    assert!((weight - exact).abs() <= 0.009 * exact + 0.6, "{near} {mask} {octant}");
                    checked += 1;
                }
            }
        }
        assert_eq!(checked, 7 * 255 * 8);
    }

    #[test]
    fn a_node_always_has_a_say_about_its_own_children() {
        for mask in 1..256 {
            for octant in (0..8).filter(|o| mask >> o & 1 == 1) {
                assert!(WEIGHTS[0][mask][octant] > 1000);
            }
        }
    }

    #[test]
    fn sums_stay_within_32_bits() {
        let parents: i64 = 7 * 4096;
        let children: i64 = TOUCHING_AT.iter().map(|&w| i64::from(w)).sum();
        assert!((parents + children) * (1 << 14) < i64::from(i32::MAX));
    }
}
