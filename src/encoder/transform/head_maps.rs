//! Where surfels draw a level better than learned heads.
//!
//! Both are drawn from a few views and compared with the cloud itself, drawn as surfels at its full depth: a level's
//! Gaussians are farther from the mesh than those are. A pixel's error goes to the block whose surfel covers it.

use b2p_kernels::Isa;

use crate::cloud::ColouredVoxels;
use crate::decoder::Decoding;
use crate::error::Result;
use crate::gaussians::surfels::{PerVoxel, SurfelSelection, closing_size, is_for_surfels, surfels};
use crate::gaussians::{Frame, Gaussians, HeadMap, HeadSet};
use crate::geometry::{KernelMap, Octree};
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::{Background, Ids, Image, Renderer};

use super::EncoderInput;

/// Azimuth and elevation of the views, in degrees.
const VIEWS: [(f64, f64); 4] = [(25.0, 20.0), (115.0, -10.0), (205.0, 20.0), (295.0, -10.0)];
/// Distance of the views from the cube's centre, and field of view in degrees.
const DISTANCE: f64 = 3.0;
const FIELD: f64 = 45.0;
/// Pixels along a side of a picture of level 8 or finer, before it is averaged to half.
const SIDE: u32 = 1024;
/// Sizes of surfels to choose from, in 64ths of the usual radius.
const SIZES: [u8; 3] = [54, 64, 74];
/// Size of the cloud's own surfels, which closes them where a voxel is less than a pixel.
const REFERENCE: f32 = 1.12;
/// Factor of the surfels that decide which block a pixel belongs to, so that some lie beside the silhouette.
const WIDER: f32 = 1.3;
/// With more children than this for each voxel above, a cloud is not sparse.
const DENSE: usize = 3;
/// A block becomes surfels if they have less than this part of the learned Gaussians' error.
const MARGIN: f64 = 0.9;

/// Squared errors over whole pictures and over the foreground.
pub type Errors = [f64; 2];

/// Pictures of the cloud, which levels are compared with. Nothing else of it is kept: Gaussians take much more memory.
pub struct Reference {
    isa: Isa,
    /// Of each side in use the views.
    pictures: Vec<(u32, Vec<Image>)>,
}

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
    /// Draws the cloud's voxels, whose depth is at least 1, as these levels need it. Those of a `sparse` cloud are wide
    /// enough to close.
    pub fn new(isa: Isa, cloud: &ColouredVoxels, sparse: bool, levels: impl Iterator<Item = u8>) -> Result<Self> {
        let gaussians = Self::gaussians(isa, cloud, sparse)?;
        let mut pictures: Vec<(u32, Vec<Image>)> = Vec::new();
        for side in levels.map(side) {
            if pictures.iter().all(|(known, _)| *known != side) {
                let mut views = Views::new(isa, side);
                let drawn = VIEWS.map(|view| views.half(&gaussians, view));
                pictures.push((side, drawn.into_iter().collect::<Result<_>>()?));
            }
        }
        Ok(Reference { isa, pictures })
    }

    fn gaussians(isa: Isa, cloud: &ColouredVoxels, sparse: bool) -> Result<Gaussians> {
        let map = kernel_map(cloud)?;
        let choice = SurfelSelection {
            size: if sparse {
                f32::from(closing_size(&map)) / 64.0
            } else {
                REFERENCE
            },
            ..SurfelSelection::ALL
        };
        let frame = Frame {
            bits: cloud.voxels.depth(),
            placement: cloud.placement,
        };
        let (voxels, colours) = (&cloud.voxels, &cloud.colours);
        Ok(surfels(isa, voxels, &map, colours, PerVoxel::One, choice, frame))
    }

    fn pictures(&self, side: u32) -> &[Image] {
        let known = self.pictures.iter().find(|(known, _)| *known == side);
        known.map_or(&[], |(_, pictures)| pictures)
    }

    /// Squared errors of pictures of these Gaussians of a level, over whole pictures and over the foreground.
    pub fn errors(&self, level: u8, gaussians: &Gaussians) -> Result<Errors> {
        let mut views = Views::new(self.isa, side(level));
        let mut errors = [0.0; 2];
        for (view, truth) in VIEWS.into_iter().zip(self.pictures(side(level))) {
            let seen = views.half(gaussians, view)?;
            for (truth, seen) in truth.pixels.iter().zip(&seen.pixels) {
                let error = error(truth, seen);
                errors[0] += error;
                errors[1] += if truth[3] > 0.5 { error } else { 0.0 };
            }
        }
        Ok(errors)
    }

    /// Compares all voxels of a level as surfels, of the usual size.
    pub fn compare_surfels(&self, octree: &Octree, level: u8, mut surfels: Gaussians) -> Result<Comparison<'_>> {
        let blocks = HeadMap::block_of(octree, level);
        let per_voxel = surfels.len() / blocks.len();
        let usual = surfels.scale.clone();
        let mut views = Views::new(self.isa, side(level));
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
        let pictures = self.reference.pictures(side(self.level));
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
    pub(super) fn closing_map(&self, octree: &Octree, level: u8, map: &KernelMap) -> Option<Vec<u8>> {
        let applies = self.options.has_head_maps() && level > 0 && is_for_surfels(map, 0..map.len());
        let size = applies.then(|| closing_size(map)).filter(|size| *size > 64)?;
        let surfels = vec![true; HeadMap::block_count(octree, level)];
        Some(HeadMap::new(size, size, surfels).to_bytes())
    }

    /// Whether a level has a head map: heads read the level above, and only of a level that is at least two above its
    /// own does the cloud tell more than the best heads, or one above if the cloud is sparse, which heads never saw.
    pub(super) fn has_head_map(&self, level: u8) -> bool {
        let above = if self.sparse { 0 } else { 1 };
        (1..self.cloud.voxels.depth().saturating_sub(above)).contains(&level)
    }

    pub(super) fn has_head_maps(&self, top: u8) -> bool {
        (*self.levels.start().min(&top)..=top).any(|level| self.has_head_map(level))
    }

    /// Bytes to set aside for the head maps of a stream whose last level is `top`.
    pub(super) fn head_map_bytes(&self, top: u8) -> usize {
        /// Of a chunk without its payload.
        const CHUNK: usize = 12;
        let levels = *self.levels.start().min(&top)..=top;
        let mapped = levels.filter(|level| self.has_head_map(*level));
        let bytes = |level| CHUNK + HeadMap::usual_bytes(HeadMap::block_count(&self.octree, level));
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
    let map = kernel_map(cloud)?;
    Ok(is_for_surfels(&map, 0..map.len()))
}

/// The 3³ kernel map of the cloud's voxels.
fn kernel_map(cloud: &ColouredVoxels) -> Result<KernelMap> {
    let octree = Octree::new(cloud.voxels.clone())?;
    let mut map = octree.kernel_map(0);
    for level in 0..octree.depth() {
        map = octree.child_map(level, &map);
    }
    Ok(map)
}

/// Pixels along a side of the pictures of a level.
fn side(level: u8) -> u32 {
    (SIDE >> 8u8.saturating_sub(level)).max(64)
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

    fn choose(&self) -> HeadMap {
        // Relative to the learned Gaussians' errors, whole pictures and the foreground count alike.
        let [whole, foreground] = self.all[0].map(|sum| sum.max(1e-12));
        let relative = |errors: &Errors| errors[0] / whole + errors[1] / foreground;
        let best = |total: &dyn Fn(usize) -> f64| {
            let sizes = 1..=SIZES.len();
            sizes.min_by(|a, b| total(*a).total_cmp(&total(*b))).unwrap_or(1)
        };
        let alone = best(&|which| relative(&self.all[which]));
        let mixed = best(&|which| {
            let of_block = |block: &[Errors; 1 + SIZES.len()]| relative(&block[which]).min(relative(&block[0]));
            self.blocks.iter().map(of_block).sum()
        });
        let surfels = self
            .blocks
            .iter()
            .map(|block| relative(&block[mixed]) < MARGIN * relative(&block[0]));
        HeadMap::new(SIZES[mixed - 1], SIZES[alone - 1], surfels.collect())
    }
}

/// Draws pictures from the views.
struct Views {
    renderer: Renderer,
    side: u32,
}

impl Views {
    fn new(isa: Isa, side: u32) -> Self {
        let renderer = Renderer::new()
            .with_isa(isa)
            .with_background(Background::Transparent)
            .with_limits(Limits::unlimited());
        Views { renderer, side }
    }

    /// A camera of `times` half the side, at this azimuth and elevation.
    fn camera(&self, (azimuth, elevation): (f64, f64), times: u32) -> Result<Camera> {
        let side = self.side / 2 * times;
        Camera::orbit(azimuth, elevation, DISTANCE, FIELD, side, side)
    }

    /// A picture averaged to half its size.
    fn half(&mut self, gaussians: &Gaussians, view: (f64, f64)) -> Result<Image> {
        let camera = self.camera(view, 2)?;
        let image = self.renderer.render(gaussians, &camera)?;
        Ok(image.box_half())
    }
}

/// Squared difference over white.
fn error(a: &[f32; 4], b: &[f32; 4]) -> f64 {
    let behind = b[3] - a[3];
    let channels = (0..3).map(|c| f64::from(a[c] - b[c] + behind));
    channels.map(|d| d * d).sum()
}

/// Sets the radii of surfels to a multiple of the usual ones.
fn scale(surfels: &mut Gaussians, usual: &[[f32; 3]], factor: f32) {
    for (scale, [a, b, c]) in surfels.scale.iter_mut().zip(usual) {
        *scale = [a * factor, b * factor, *c];
    }
}
