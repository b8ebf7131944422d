//! Where surfels draw a level better than learned heads.
//!
//! Both are drawn from a few views and compared with the cloud itself, drawn as surfels at its full depth: a level's
//! Gaussians are farther from the mesh than those are. A pixel's error goes to the block whose surfel covers it.

use b2p_kernels::Isa;

use crate::cloud::ColouredVoxels;
use crate::error::Result;
use crate::gaussians::surfels::{PerVoxel, SurfelSelection, surfels};
use crate::gaussians::{Frame, Gaussians, HeadMap};
use crate::geometry::Octree;
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::{Background, Ids, Image, Renderer};

/// Azimuth and elevation of the views, in degrees.
const VIEWS: [(f64, f64); 4] = [(25.0, 20.0), (115.0, -10.0), (205.0, 20.0), (295.0, -10.0)];
/// Distance of the views from the cube's centre, and field of view in degrees.
const DISTANCE: f64 = 3.0;
const FIELD: f64 = 45.0;
/// Pixels along a side of a picture of level 8 or finer, before it is averaged to half.
const SIDE: u32 = 1024;
/// Sizes of surfels to choose from, in 64ths of the usual radius.
const SIZES: [u8; 3] = [54, 64, 74];
/// Size of the cloud's own surfels: between 0.85 and 1, which chose about alike.
const REFERENCE: f32 = 0.92;
/// Factor of the surfels that decide which block a pixel belongs to, so that some lie beside the silhouette.
const WIDER: f32 = 1.3;
/// A block becomes surfels if they have less than this part of the learned Gaussians' error.
const MARGIN: f64 = 0.9;

/// Squared errors over whole pictures and over the foreground.
type Errors = [f64; 2];

/// The pictures that levels are compared with.
pub struct Reference {
    isa: Isa,
    gaussians: Gaussians,
}

/// What draws a level.
pub struct Candidates<'a> {
    pub octree: &'a Octree,
    pub level: u8,
    pub learned: Gaussians,
    /// All voxels as surfels of the usual size.
    pub surfels: Gaussians,
}

impl Reference {
    /// Draws the cloud's voxels, whose depth is at least 1.
    pub fn new(isa: Isa, cloud: &ColouredVoxels) -> Result<Self> {
        let octree = Octree::new(cloud.voxels.clone())?;
        let mut map = octree.kernel_map(0);
        for level in 0..octree.depth() {
            map = octree.child_map(level, &map);
        }
        let choice = SurfelSelection {
            size: REFERENCE,
            ..SurfelSelection::ALL
        };
        let frame = Frame {
            bits: cloud.voxels.depth(),
            placement: cloud.placement,
        };
        let (voxels, colours) = (&cloud.voxels, &cloud.colours);
        let gaussians = surfels(isa, voxels, &map, colours, PerVoxel::One, choice, frame);
        Ok(Reference { isa, gaussians })
    }

    /// The map of a level.
    pub fn head_map(&self, level: &Candidates<'_>) -> Result<HeadMap> {
        let blocks = HeadMap::block_of(level.octree, level.level);
        let per_voxel = level.surfels.len() / blocks.len();
        let mut sums = Sums {
            blocks: vec![Default::default(); HeadMap::block_count(level.octree, level.level)],
            all: Default::default(),
        };
        let sized = SIZES.map(|size| scaled(&level.surfels, f32::from(size) / 64.0));
        let candidates = [&level.learned, &sized[0], &sized[1], &sized[2]];
        let wide = scaled(&level.surfels, WIDER);
        let mut views = Views {
            renderer: Renderer::new()
                .with_isa(self.isa)
                .with_background(Background::Transparent)
                .with_limits(Limits::unlimited()),
            side: (SIDE >> 8u8.saturating_sub(level.level)).max(64),
            ids: Ids::default(),
        };
        for (azimuth, elevation) in VIEWS {
            let half = views.camera(azimuth, elevation, 1)?;
            views
                .renderer
                .ids_into(&wide, &half, &Limits::unlimited(), &mut views.ids)?;
            let camera = views.camera(azimuth, elevation, 2)?;
            let truth = views.half(&self.gaussians, &camera)?;
            for (which, candidate) in candidates.into_iter().enumerate() {
                let seen = views.half(candidate, &camera)?;
                let pixels = truth.pixels.iter().zip(&seen.pixels).zip(&views.ids.indices);
                for ((truth, seen), id) in pixels {
                    let block = blocks.get(*id as usize / per_voxel).map(|&block| block as usize);
                    sums.add(which, block, error(truth, seen), truth[3] > 0.5);
                }
            }
        }
        Ok(sums.choose())
    }
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
    ids: Ids,
}

impl Views {
    /// A camera of `times` half the side.
    fn camera(&self, azimuth: f64, elevation: f64, times: u32) -> Result<Camera> {
        let side = self.side / 2 * times;
        Camera::orbit(azimuth, elevation, DISTANCE, FIELD, side, side)
    }

    /// A picture averaged to half its size.
    fn half(&mut self, gaussians: &Gaussians, camera: &Camera) -> Result<Image> {
        let image = self.renderer.render(gaussians, camera)?;
        Ok(image.box_half())
    }
}

/// Squared difference over white.
fn error(a: &[f32; 4], b: &[f32; 4]) -> f64 {
    let behind = b[3] - a[3];
    let channels = (0..3).map(|c| f64::from(a[c] - b[c] + behind));
    channels.map(|d| d * d).sum()
}

/// Surfels with other radii.
fn scaled(surfels: &Gaussians, factor: f32) -> Gaussians {
    let mut scaled = surfels.clone();
    for scale in &mut scaled.scale {
        scale[0] *= factor;
        scale[1] *= factor;
    }
    scaled
}
