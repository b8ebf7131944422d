//! Where surfels take the place of learned Gaussians: the encoder's choice, block by block (`docs/format.md`, clause
//! 7.5).
//!
//! The encoder draws a level in both ways and compares the pictures with the cloud. A block is a voxel three levels
//! above. Nothing that is decoded depends on the map, so a decoder may ignore it.

use crate::coding::binary::{Coder, Decoder};
use crate::geometry::Octree;

/// Levels between a block and its voxels.
const BLOCK: u8 = 3;
/// A size of surfels that is the usual one.
const USUAL: f32 = 64.0;
/// Greatest thickness, in 128ths of a voxel.
const THICKEST: u8 = 127;
/// Shift of the adaptation of probabilities.
const RATE: u32 = 4;

/// The choice for a level.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HeadMap {
    /// Factors of the surfels' radii, in 64ths, not 0: among learned Gaussians, and where all voxels are surfels.
    sizes: [u8; 2],
    /// What is added to the least variance of learned Gaussians and of surfels, as a standard deviation in 128ths of a
    /// voxel.
    thickness: [u8; 2],
    blocks: Blocks,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Blocks {
    Learned,
    Surfels,
    Each(Vec<bool>),
}

/// Adaptive probabilities in the contexts of the two decisions before.
struct Contexts {
    one: [u32; 4],
    last: usize,
}

impl Contexts {
    fn new() -> Self {
        Contexts {
            one: [0x8000; 4],
            last: 0,
        }
    }

    fn code(&mut self, coder: &mut impl Coder, bit: bool) -> bool {
        let one = &mut self.one[self.last];
        let bit = coder.code(bit, (*one).clamp(64, 65_472));
        match bit {
            true => *one += (65_536 - *one) >> RATE,
            false => *one -= *one >> RATE,
        }
        self.last = (2 * self.last + usize::from(bit)) & 3;
        bit
    }
}

impl HeadMap {
    /// Number of blocks of a level.
    pub fn block_count(octree: &Octree, level: u8) -> usize {
        octree.level(block_level(level)).len()
    }

    /// The block of every voxel of a level.
    pub fn block_of(octree: &Octree, level: u8) -> Vec<u32> {
        let first = block_level(level);
        let mut blocks: Vec<u32> = (0..octree.level(first).len() as u32).collect();
        for above in first..level {
            let mut next = Vec::with_capacity(octree.level(above + 1).len());
            for (block, mask) in blocks.iter().zip(octree.occupancy(above)) {
                next.extend(std::iter::repeat_n(*block, mask.count_ones() as usize));
            }
            blocks = next;
        }
        blocks
    }

    /// A map with surfels in these blocks, of `mixed` 64ths of the usual radius, and of `alone` 64ths where a decoder
    /// makes nothing but surfels.
    ///
    /// # Panics
    /// If a size is 0.
    #[cfg(feature = "encoder")]
    pub fn new(mixed: u8, alone: u8, surfels: Vec<bool>) -> Self {
        assert!(mixed > 0 && alone > 0, "a surfel has a size");
        let blocks = match surfels.iter().filter(|&&on| on).count() {
            0 => Blocks::Learned,
            on if on == surfels.len() => Blocks::Surfels,
            _ => Blocks::Each(surfels),
        };
        HeadMap {
            sizes: [mixed, alone],
            thickness: [0; 2],
            blocks,
        }
    }

    /// The same with learned Gaussians and surfels that are thicker by so many 128ths of a voxel, at most 127.
    #[must_use]
    pub fn with_thickness(self, thickness: [u8; 2]) -> Self {
        let thickness = thickness.map(|thickness| thickness.min(THICKEST));
        HeadMap { thickness, ..self }
    }

    /// The thickness that a chunk states in place of a number of voxels.
    pub(crate) fn thickness_of(count: u32) -> [u8; 2] {
        let base = u32::from(THICKEST) + 1;
        [count % base, (count / base).min(THICKEST.into())].map(|thickness| thickness as u8)
    }

    /// Parses the payload of a level with so many blocks. `None` if it is none: a map is only advice.
    pub fn parse(bytes: &[u8], blocks: usize) -> Option<Self> {
        let (&[mixed, alone, how], code) = bytes.split_first_chunk()?;
        let blocks = match how {
            0 if code.is_empty() => Blocks::Learned,
            1 if code.is_empty() => Blocks::Surfels,
            2 => {
                let mut decoder = Decoder::new(code);
                let mut contexts = Contexts::new();
                let each = (0..blocks).map(|_| contexts.code(&mut decoder, false)).collect();
                decoder.finish("the head map").ok()?;
                Blocks::Each(each)
            }
            _ => return None,
        };
        let sizes = [mixed, alone];
        (!sizes.contains(&0)).then_some(HeadMap {
            sizes,
            thickness: [0; 2],
            blocks,
        })
    }

    /// The payload.
    #[cfg(feature = "encoder")]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut encoder = crate::coding::binary::Encoder::default();
        let how = match &self.blocks {
            Blocks::Learned => 0,
            Blocks::Surfels => 1,
            Blocks::Each(each) => {
                let mut contexts = Contexts::new();
                for &on in each {
                    contexts.code(&mut encoder, on);
                }
                2
            }
        };
        let code = match how {
            2 => encoder.finish(),
            _ => Vec::new(),
        };
        [&self.sizes[..], &[how], &code].concat()
    }

    /// Factors of the surfels' radii: among learned Gaussians, and where all voxels are surfels.
    pub fn sizes(&self) -> [f32; 2] {
        self.sizes.map(|size| f32::from(size) / USUAL)
    }

    /// How much thicker learned Gaussians and surfels are, in 128ths of a voxel.
    pub fn thickness(&self) -> [u8; 2] {
        self.thickness
    }

    /// The same as lengths in the cube frame, of a map of this level.
    pub fn thickness_at(&self, level: u8) -> [f32; 2] {
        let voxel = 2.0 / (1u32 << level) as f32;
        self.thickness.map(|thickness| f32::from(thickness) / 128.0 * voxel)
    }

    /// Bytes of a map that is the same for all blocks.
    #[cfg(feature = "encoder")]
    pub const UNIFORM_BYTES: usize = 3;

    /// Upper bound of [`HeadMap::to_bytes`] that is seldom exceeded.
    #[cfg(feature = "encoder")]
    pub fn usual_bytes(blocks: usize) -> usize {
        16 + blocks / 8
    }

    /// For every voxel of the level whether a surfel takes the place of its learned Gaussians; `None` if nowhere.
    pub fn surfels(&self, octree: &Octree, level: u8) -> Option<Vec<bool>> {
        match &self.blocks {
            Blocks::Learned => None,
            Blocks::Surfels => Some(vec![true; octree.level(level).len()]),
            Blocks::Each(each) => {
                let blocks = Self::block_of(octree, level);
                Some(blocks.iter().map(|&block| each[block as usize]).collect())
            }
        }
    }

    /// Whether every voxel is a surfel.
    pub fn is_all_surfels(&self) -> bool {
        self.blocks == Blocks::Surfels
    }
}

/// The level whose voxels are the blocks of `level`.
fn block_level(level: u8) -> u8 {
    level.saturating_sub(BLOCK)
}

#[cfg(all(test, feature = "encoder"))]
mod tests {
    use super::*;
    use crate::geometry::{Voxels, morton};
    use proptest::prelude::*;

    #[test]
    fn the_count_of_the_chunk_tells_how_thick_learned_gaussians_and_surfels_are() {
        let map = HeadMap::new(54, 64, vec![true; 9]);
        assert_eq!(map.clone().with_thickness(HeadMap::thickness_of(0)), map);
        for thickness in [[0, 1], [3, 0], [127, 127]] {
            let [learned, surfels] = thickness.map(u32::from);
            assert_eq!(HeadMap::thickness_of(learned + 128 * surfels), thickness);
        }
        assert_eq!(HeadMap::thickness_of(u32::MAX), [127, 127]);
        assert_eq!(
            map.with_thickness([64, 200]).thickness_at(7),
            [1.0 / 128.0, 127.0 / 8192.0]
        );
    }

    #[test]
    fn a_block_holds_the_voxels_below_a_voxel_three_levels_above() {
        let keys = (0..4000).map(|i: u32| morton::encode([i % 40, i / 40 % 50, (i * 7 / 40) % 60]));
        let octree = Octree::new(Voxels::new(6, keys.collect())).unwrap();
        for level in 0..=6u8 {
            let above = octree.level(level.saturating_sub(3));
            let blocks = HeadMap::block_of(&octree, level);
            assert_eq!(blocks.len(), octree.level(level).len());
            for (voxel, &block) in blocks.iter().enumerate() {
                let coordinate = octree.level(level).coordinate(voxel);
                let shift = level.min(3);
                assert_eq!(coordinate.map(|v| v >> shift), above.coordinate(block as usize));
            }
        }
    }

    #[test]
    fn a_uniform_map_takes_three_bytes() {
        for on in [false, true] {
            let map = HeadMap::new(54, 64, vec![on; 1000]);
            assert_eq!(map.to_bytes(), [54, 64, u8::from(on)]);
            assert_eq!(map.to_bytes().len(), HeadMap::UNIFORM_BYTES);
            assert_eq!(HeadMap::parse(&map.to_bytes(), 1000), Some(map));
        }
    }

    proptest! {
        #[test]
        fn a_map_survives_its_bytes(blocks in prop::collection::vec(any::<bool>(), 1..300)) {
            let map = HeadMap::new(54, 74, blocks.clone());
            prop_assert_eq!(map.sizes(), [54.0 / 64.0, 74.0 / 64.0]);
            prop_assert_eq!(HeadMap::parse(&map.to_bytes(), blocks.len()), Some(map));
        }

        #[test]
        fn any_bytes_are_a_map_or_none(bytes in prop::collection::vec(any::<u8>(), 0..80), blocks in 1usize..300) {
            if let Some(HeadMap { blocks: Blocks::Each(each), .. }) = HeadMap::parse(&bytes, blocks) {
                prop_assert_eq!(each.len(), blocks);
            }
        }
    }
}
