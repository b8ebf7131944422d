//! Weights of voxels: how much of the surface each holds (`docs/format.md`, clause 5.5.3).
//!
//! A colour's error counts as often as there are voxels of the stream's last level below it. A decoder does not know how
//! many: it decodes a level before the geometry of the next. It counts those of the trunk's last level, and estimates
//! the share of each of them, and of every later voxel, from its face neighbours. A surface that only touches a voxel's
//! corner seldom has neighbours on both sides of it.

use rayon::prelude::*;

use super::transform::{EVEN, Weighting};
use crate::geometry::{Octree, SiblingMap, Window, ones};

/// Weight of a voxel of the last level.
pub(super) const UNIT: u32 = 1024;
/// Maximum weight.
const MAX: u32 = 1 << 14;

/// Weight of a voxel by the number of axes with face neighbours on both sides, and by that of axes with one: means over
/// the surfaces of training objects.
const ESTIMATES: [[u16; 4]; 4] = [
    [360, 360, 370, 460],
    [1170, 920, 920, 0],
    [1110, 1210, 0, 0],
    [1560, 0, 0, 0],
];

/// Weights of the voxels of a level.
#[derive(Debug, Clone, Copy)]
pub(super) enum Weights<'a> {
    /// All are [`UNIT`]: of the stream's last level.
    Even,
    /// To be estimated from face neighbours.
    Estimated,
    /// One for each voxel.
    Given(&'a [u16]),
}

impl Weights<'_> {
    /// Weights of levels that do not belong to the trunk.
    pub fn below_trunk(level: u8, top: u8) -> Self {
        if level >= top {
            Weights::Even
        } else {
            Weights::Estimated
        }
    }

    /// How the children of a node are joined. `first` is the first of them, `window` what lies around them. `own` has room
    /// for what no table holds.
    #[inline(always)]
    pub fn weighting<'w>(self, mask: u8, first: usize, window: &Window, own: &'w mut Weighting) -> &'w Weighting {
        let mut weights = [0; 8];
        for (child, octant) in (first..).zip(ones(mask)) {
            weights[octant] = match self {
                Weights::Even => return &EVEN[usize::from(mask)],
                Weights::Estimated => estimate(window, octant).into(),
                Weights::Given(weights) => weights[child].into(),
            };
        }
        *own = Weighting::new(weights);
        own
    }
}

/// The weight of a voxel in this octant of a window.
#[inline(always)]
fn estimate(window: &Window, octant: usize) -> u16 {
    let (mut both, mut one) = (0, 0);
    for [before, after] in [[12, 14], [10, 16], [4, 22]] {
        let [before, after] = [before, after].map(|k| window.has(octant, k));
        both += usize::from(before & after);
        one += usize::from(before ^ after);
    }
    ESTIMATES[both][one]
}

/// Weights of the levels 0 to K of a trunk whose maps these are, in a stream with the last level `top`.
pub(super) fn of_trunk(octree: &Octree, maps: &[SiblingMap], top: u8) -> Vec<Vec<u16>> {
    let depth = maps.len() - 1;
    let last = match depth >= usize::from(top) {
        true => vec![UNIT as u16; maps[depth].len()],
        false => estimates(octree, depth as u8, &maps[depth]),
    };
    let mut levels = vec![last];
    for level in (0..depth as u8).rev() {
        let mut below = levels[levels.len() - 1].iter();
        let parent = |mask: &u8| {
            let sum: u32 = below
                .by_ref()
                .take(mask.count_ones() as usize)
                .map(|w| u32::from(*w))
                .sum();
            ((sum + 2) >> 2).clamp(1, MAX) as u16
        };
        let parents = octree.occupancy(level).iter().map(parent).collect();
        levels.push(parents);
    }
    levels.reverse();
    levels
}

/// Estimated weights of the voxels of a level, whose map this is.
pub(super) fn estimates(octree: &Octree, level: u8, map: &SiblingMap) -> Vec<u16> {
    let Some(above) = level.checked_sub(1) else {
        return vec![estimate(&map.window(0), 0)];
    };
    let parents = octree.occupancy(above).par_iter().enumerate();
    let weights = parents.flat_map_iter(|(parent, &mask)| {
        let window = map.window(parent);
        ones(mask).map(move |octant| estimate(&window, octant))
    });
    weights.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Voxels;

    /// The weights of the voxels of the last level of these, of depth 3.
    fn estimated(at: &[[u32; 3]]) -> Vec<u16> {
        let keys = at.iter().map(|xyz| crate::geometry::morton::encode(*xyz)).collect();
        let octree = Octree::new(Voxels::new(3, keys)).unwrap();
        estimates(&octree, 3, &octree.sibling_map(3))
    }

    #[test]
    fn voxels_between_neighbours_weigh_most() {
        assert_eq!(estimated(&[[3, 3, 3]]), [360]);
        assert_eq!(estimated(&[[3, 3, 3], [4, 4, 3]]), [360; 2]);
        let row = estimated(&[[2, 3, 3], [3, 3, 3], [4, 3, 3]]);
        assert_eq!(row, [360, 1170, 360]);
        let cube: Vec<_> = (0..27).map(|i| [i % 3, i / 3 % 3, i / 9]).collect();
        let mut weights = estimated(&cube);
        weights.sort();
        assert_eq!(
            weights,
            [vec![460; 8], vec![920; 12], vec![1210; 6], vec![1560]].concat()
        );
    }

    #[test]
    fn a_node_weighs_a_quarter_of_its_children() {
        let octree = Octree::new(Voxels::new(2, (0..24).chain([40]).collect())).unwrap();
        let maps: Vec<_> = (0..=2).map(|level| octree.sibling_map(level)).collect();
        assert_eq!(
            of_trunk(&octree, &maps, 2)[..2],
            [vec![1600], vec![2048, 2048, 2048, 256]]
        );
        let estimated = of_trunk(&octree, &maps, 3);
        assert_eq!(estimated[2], estimates(&octree, 2, &maps[2]));
        let first: u16 = estimated[2][..8].iter().sum();
        assert_eq!(estimated[1][0], (first + 2) >> 2);
    }

    #[test]
    fn weights_stay_in_their_range() {
        let lone = Octree::new(Voxels::new(12, vec![5])).unwrap();
        let maps: Vec<_> = (0..=12).map(|level| lone.sibling_map(level)).collect();
        assert_eq!(of_trunk(&lone, &maps, 12)[..6], vec![vec![1]; 6]);
        let solid = Octree::new(Voxels::new(6, (0..1 << 18).collect())).unwrap();
        let maps: Vec<_> = (0..=6).map(|level| solid.sibling_map(level)).collect();
        assert_eq!(of_trunk(&solid, &maps, 6)[0], [1 << 14]);
    }
}
