//! Errors that count differently from voxel to voxel: what is seen less is coded with fewer bits.

use crate::geometry::Octree;

/// The factor of λ is the mean weight over that of the node, in these limits.
const FACTORS: [f32; 2] = [0.25, 32.0];

/// By how much the Lagrangian λ is multiplied in each node of the levels above the last.
#[derive(Debug, Clone, PartialEq)]
pub struct Importance {
    levels: Vec<Vec<f32>>,
}

impl Importance {
    /// Squared errors of the voxels of level `top` count by `weights`, whose sum is below 2⁶⁴; a difference of colours of a
    /// level above it is one of all voxels below.
    ///
    /// # Panics
    /// If the octree is less deep than `top`, or there is not one weight per voxel of it.
    pub fn new(octree: &Octree, top: u8, weights: &[u64]) -> Importance {
        assert_eq!(weights.len(), octree.level(top).len(), "one weight per voxel");
        let total: u64 = weights.iter().sum();
        let mean = total as f32 / weights.len().max(1) as f32;
        let factor = |(sum, count): &(u64, u64)| match total {
            0 => 1.0,
            _ => (mean * *count as f32 / *sum as f32).clamp(FACTORS[0], FACTORS[1]),
        };
        let mut sums: Vec<(u64, u64)> = weights.iter().map(|weight| (*weight, 1)).collect();
        let mut levels = Vec::new();
        for level in (0..top).rev() {
            let first = octree.first_child(level).iter().map(|first| *first as usize);
            let children = first.zip(octree.occupancy(level));
            let sum = |(first, mask): (usize, &u8)| {
                let children = &sums[first..][..mask.count_ones() as usize];
                let add = |a: (u64, u64), b: &(u64, u64)| (a.0 + b.0, a.1 + b.1);
                children.iter().fold((0, 0), add)
            };
            sums = children.map(sum).collect();
            levels.push(sums.iter().map(factor).collect());
        }
        levels.reverse();
        Importance { levels }
    }

    /// The factors of the nodes of a level.
    pub(super) fn factors(&self, level: u8) -> &[f32] {
        &self.levels[usize::from(level)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Voxels;

    #[test]
    fn factors_are_means_over_what_lies_below_within_limits() {
        // Two nodes of level 1 with one and two voxels.
        let octree = Octree::new(Voxels::new(2, vec![0, 8, 9])).unwrap();
        let importance = Importance::new(&octree, 2, &[1, 4, 4]);
        assert_eq!(importance.factors(0), [1.0]);
        assert_eq!(importance.factors(1), [3.0, 0.75]);
        let hidden = Importance::new(&octree, 2, &[0, 4, 5]);
        assert_eq!(hidden.factors(1)[0], FACTORS[1]);
        assert_eq!(Importance::new(&octree, 2, &[0; 3]).factors(1), [1.0; 2]);
    }
}
