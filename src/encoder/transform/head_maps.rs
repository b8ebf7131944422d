//! Where surfels draw a level better than learned heads, and how wide surfels should be there.
//!
//! Both are drawn from a few views and compared with pictures of the cloud itself ([`Reference`]). A pixel's error goes to
//! the block whose surfel covers it.

use crate::cloud::ColouredVoxels;
use crate::decoder::Decoding;
use crate::error::Result;
use crate::gaussians::surfels::{closing_size, is_for_surfels};
use crate::gaussians::{Gaussians, HeadMap, HeadSet};
use crate::geometry::{Octree, SiblingMap};
use crate::limits::Limits;
use crate::renderer::Ids;

use super::EncoderInput;
use super::reference::{Errors, Reference, VIEWS, Views, error, maps};
use super::surfel_size::{SIZES, scale};

/// Factor of the surfels that decide which block a pixel belongs to, so that some lie beside the silhouette.
const WIDER: f32 = 1.3;
/// With more children than this for each voxel above, a cloud is not sparse.
const DENSE: usize = 3;

/// A block becomes surfels if they have less than this part of the learned Gaussians' error.
const MARGIN: f64 = 0.9;

/// What a level has, besides its Gaussians.
pub struct Comparison<'a> {
    reference: &'a Reference,
    level: u8,
    views: Views,
    /// Of each view the block that its pixels show.
    shown: Vec<Vec<Option<u32>>>,
    sums: Sums,
}

impl Reference {
    /// Compares all voxels of a level as surfels, of the usual size.
    pub fn compare_surfels(&self, octree: &Octree, level: u8, mut surfels: Gaussians) -> Result<Comparison<'_>> {
        let blocks = HeadMap::block_of(octree, level);
        let per_voxel = surfels.len() / blocks.len();
        let usual = surfels.scale.clone();
        let mut views = self.views(level);
        scale(&mut surfels, &usual, WIDER);
        let mut ids = Ids::default();
        let mut shown = Vec::new();
        for view in VIEWS {
            let camera = views.camera(view, 1)?;
            views
                .renderer
                .ids_into(&surfels, &camera, &Limits::unlimited(), &mut ids)?;
            let block = |id: &u32| blocks.get(*id as usize / per_voxel).copied();
            shown.push(ids.indices.iter().map(block).collect());
        }
        let mut comparison = Comparison {
            reference: self,
            level,
            views,
            shown,
            sums: Sums {
                blocks: vec![Default::default(); HeadMap::block_count(octree, level)],
                all: Default::default(),
            },
        };
        for (which, size) in SIZES.into_iter().enumerate() {
            scale(&mut surfels, &usual, f32::from(size) / 64.0);
            comparison.add(1 + which, &surfels)?;
        }
        Ok(comparison)
    }
}

impl Comparison<'_> {
    /// The map of the level, once it has been compared with these Gaussians of the learned heads, too.
    pub fn with_learned(mut self, learned: &Gaussians) -> Result<HeadMap> {
        self.add(0, learned)?;
        Ok(self.sums.choose())
    }

    fn add(&mut self, which: usize, candidate: &Gaussians) -> Result<()> {
        let pictures = self.reference.pictures(self.level);
        for ((view, truth), shown) in VIEWS.into_iter().zip(pictures).zip(&self.shown) {
            let seen = self.views.half(candidate, view)?;
            for ((truth, seen), block) in truth.pixels.iter().zip(&seen.pixels).zip(shown) {
                let block = block.map(|block| block as usize);
                self.sums.add(which, block, error(truth, seen), truth[3] > 0.5);
            }
        }
        Ok(())
    }
}

impl EncoderInput<'_> {
    /// The head map of a sparse level, which surfels draw: it says how wide they must be to close. `None` of other
    /// levels, and where the usual size does.
    pub(super) fn closing_map(&self, octree: &Octree, level: u8, map: &SiblingMap) -> Option<HeadMap> {
        let applies = self.options.has_head_maps() && level > 0 && is_for_surfels(map, 0..map.len());
        let size = applies.then(|| closing_size(map)).filter(|size| *size > 64)?;
        let surfels = vec![true; HeadMap::block_count(octree, level)];
        Some(HeadMap::new(size, size, surfels))
    }

    /// The head map of a level that no picture chooses: that of a sparse level, or one that says how thick Gaussians are;
    /// `None` if there is nothing to say.
    pub(super) fn unseen_map(&self, octree: &Octree, level: u8, map: &SiblingMap) -> Option<HeadMap> {
        let closing = self.closing_map(octree, level, map);
        let thickness = self.options.thickness.iter().find(|(of, _)| *of == level);
        let Some((_, thickness)) = thickness else {
            return closing;
        };
        let usual = || HeadMap::new(64, 64, vec![false; HeadMap::block_count(octree, level)]);
        Some(closing.unwrap_or_else(usual).with_thickness(*thickness))
    }

    /// Whether a level has a head map: heads read the level above, and sparse clouds tell nothing of their own level.
    pub(super) fn has_head_map(&self, level: u8) -> bool {
        let most = self.cloud.voxels.depth().saturating_sub(self.sparse.into());
        (1..=most).contains(&level)
    }

    pub(super) fn has_head_maps(&self, top: u8) -> bool {
        (*self.levels.start().min(&top)..=top).any(|level| self.has_head_map(level))
    }

    /// Whether the head map of a level tells of each block what draws it; else it tells the size of surfels only, as that of
    /// a level so close to the cloud's own that no picture of the cloud tells which is nearer to the surface.
    pub(super) fn maps_blocks(&self, level: u8) -> bool {
        let depth = self.cloud.voxels.depth();
        level < depth && (self.sparse || level + 1 < depth)
    }

    /// Bytes to set aside for the head maps of a stream whose last level is `top`.
    pub(super) fn head_map_bytes(&self, top: u8) -> usize {
        /// Of a chunk without its payload.
        const CHUNK: usize = 13;
        let levels = *self.levels.start().min(&top)..=top;
        let mapped = levels.filter(|level| self.has_head_map(*level));
        let bytes = |level| match self.maps_blocks(level) {
            true => CHUNK + HeadMap::usual_bytes(HeadMap::block_count(&self.octree, level)),
            false => CHUNK + HeadMap::UNIFORM_BYTES,
        };
        mapped.map(bytes).sum()
    }
}

/// Compares the ways to draw the level that was decoded.
pub fn of_level(octree: &Octree, reference: &Reference, decoding: &mut Decoding<'_>, level: u8) -> Result<HeadMap> {
    decoding.set_heads(HeadSet::Surfels)?;
    let surfels = decoding.gaussians()?;
    let comparison = reference.compare_surfels(octree, level, surfels)?;
    decoding.set_heads(HeadSet::Best)?;
    comparison.with_learned(&decoding.gaussians()?)
}

/// Whether a cloud is sparse at its own level, as captures are.
pub fn is_sparse(cloud: &ColouredVoxels) -> Result<bool> {
    let voxels = cloud.voxels.keys();
    if cloud.voxels.depth() == 0 {
        return Ok(false);
    }
    // Voxels of a closed surface have about four children each: few clouds need a kernel map to be told from captures.
    let parents = 1 + voxels.windows(2).filter(|pair| pair[0] >> 3 != pair[1] >> 3).count();
    if voxels.len() > DENSE * parents {
        return Ok(false);
    }
    let (_, _, map) = maps(cloud)?;
    Ok(is_for_surfels(&map, 0..map.len()))
}

/// Errors of each candidate: the learned Gaussians, then surfels by [`SIZES`].
struct Sums {
    blocks: Vec<[Errors; 1 + SIZES.len()]>,
    all: [Errors; 1 + SIZES.len()],
}

impl Sums {
    fn add(&mut self, which: usize, block: Option<usize>, error: f64, foreground: bool) {
        let block = block.map(|block| &mut self.blocks[block][which]);
        for sum in block.into_iter().chain([&mut self.all[which]]) {
            sum[0] += error;
            sum[1] += if foreground { error } else { 0.0 };
        }
    }

    /// The candidate of surfels with the smallest sum of errors.
    fn best(total: impl Fn(usize) -> f64) -> usize {
        let sizes = 1..=SIZES.len();
        sizes.min_by(|a, b| total(*a).total_cmp(&total(*b))).unwrap_or(1)
    }

    /// Errors relative to those of a candidate: whole pictures and the foreground count alike.
    fn relative_to(&self, which: usize) -> impl Fn(&Errors) -> f64 {
        let [whole, foreground] = self.all[which].map(|sum| sum.max(1e-12));
        move |errors| errors[0] / whole + errors[1] / foreground
    }

    /// The candidate that is best where a decoder makes nothing but surfels.
    fn best_alone(&self) -> usize {
        let relative = self.relative_to(1);
        Self::best(|which| relative(&self.all[which]))
    }

    fn choose(&self) -> HeadMap {
        let relative = self.relative_to(0);
        let mixed = Self::best(|which| {
            let of_block = |block: &[Errors; 1 + SIZES.len()]| relative(&block[which]).min(relative(&block[0]));
            self.blocks.iter().map(of_block).sum()
        });
        let surfels = self
            .blocks
            .iter()
            .map(|block| relative(&block[mixed]) < MARGIN * relative(&block[0]));
        HeadMap::new(SIZES[mixed - 1], SIZES[self.best_alone() - 1], surfels.collect())
    }
}
