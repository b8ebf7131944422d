//! What the codec knows and codes, voxel by voxel.

use b2p::geometry::codec::network::features;
use b2p::geometry::{KernelMap, Octree, Voxels};

use crate::error::Result;

/// Parents per slice, as in a stream.
const SLICE: usize = 16_384;

/// For every voxel of an octree's levels but the deepest: the features known when its children are coded, and which
/// children it has.
#[derive(Debug, Default)]
pub struct Samples {
    features: Vec<u8>,
    ends: Vec<usize>,
    occupancy: Vec<u8>,
}

impl Samples {
    /// Those of the octree of `voxels`.
    ///
    /// # Errors
    /// If there are no voxels.
    pub fn new(voxels: Voxels) -> Result<Self> {
        let octree = Octree::new(voxels)?;
        let mut samples = Samples::default();
        let mut map = KernelMap::root();
        for level in 0..octree.depth() {
            let occupancy = octree.occupancy(level);
            for (i, masks) in occupancy.chunks(SLICE).enumerate() {
                let slice = i * SLICE..i * SLICE + masks.len();
                for here in slice.clone() {
                    features(&map, &slice, here, masks, |feature| {
                        samples.features.push(feature as u8)
                    });
                    samples.ends.push(samples.features.len());
                }
            }
            samples.occupancy.extend(occupancy);
            map = octree.child_map(level, &map);
        }
        Ok(samples)
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.occupancy.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.occupancy.is_empty()
    }

    /// The features of sample `i` and its occupancy.
    pub fn get(&self, i: usize) -> (&[u8], u8) {
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        (&self.features[start..self.ends[i]], self.occupancy[i])
    }
}
