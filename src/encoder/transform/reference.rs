//! Pictures of the cloud itself, which those of streams are compared with.
//!
//! Levels far above the cloud's own are compared with its voxels as surfels, which are closer to the mesh than any
//! Gaussians of theirs. The two finest levels are nearly as close, so that they are compared with what the best heads make of
//! the cloud; without a model of heads, with surfels, too.

use b2p_kernels::Isa;

use crate::cloud::ColouredVoxels;
use crate::decoder::Decoder;
use crate::error::Result;
use crate::gaussians::learned::{HeadsModel, LevelInput};
use crate::gaussians::surfels::{PerVoxel, SurfelSelection, closing_size, surfels};
use crate::gaussians::{Frame, Gaussians, Heads};
use crate::geometry::{KernelMap, Octree};
use crate::layers::Precision;
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::{Background, Image, Renderer};

/// Azimuth and elevation of the views, in degrees.
pub const VIEWS: [(f64, f64); 4] = [(25.0, 20.0), (115.0, -10.0), (205.0, 20.0), (295.0, -10.0)];
/// Distance of the views from the cube's centre, and field of view in degrees.
const DISTANCE: f64 = 3.0;
const FIELD: f64 = 45.0;
/// Pixels along a side of a picture of level 8 or finer, before it is averaged to half.
const SIDE: u32 = 1024;
/// Size of the cloud's own surfels, which closes them where a voxel is less than a pixel.
const SIZE: f32 = 1.12;
/// Rows that heads work on at a time.
const ROWS: usize = 1 << 16;

/// Squared errors over whole pictures and over the foreground.
pub type Errors = [f64; 2];

/// Pictures of the cloud. Nothing else of it is kept: Gaussians take much more memory.
pub struct Reference {
    isa: Isa,
    depth: u8,
    sparse: bool,
    pictures: Vec<Pictures>,
}

/// The views that some levels are compared with.
struct Pictures {
    near: bool,
    side: u32,
    views: Vec<Image>,
}

impl Reference {
    /// Draws the cloud's voxels, whose depth is at least 1, as these levels need it. Those of a `sparse` cloud are surfels,
    /// wide enough to close.
    pub fn new(
        isa: Isa,
        cloud: &ColouredVoxels,
        sparse: bool,
        heads: Option<&HeadsModel>,
        levels: impl Iterator<Item = u8>,
    ) -> Result<Self> {
        let depth = cloud.voxels.depth();
        let mut reference = Reference {
            isa,
            depth,
            sparse,
            pictures: Vec::new(),
        };
        let mut wanted: Vec<(bool, u32)> = levels.map(|level| (reference.is_near(level), side(level))).collect();
        wanted.sort_unstable();
        wanted.dedup();
        for near in [false, true] {
            let mut sides = wanted
                .iter()
                .filter(|wanted| wanted.0 == near)
                .map(|wanted| wanted.1)
                .peekable();
            if sides.peek().is_none() {
                continue;
            }
            let gaussians = match heads.filter(|_| near) {
                Some(heads) => learned(isa, cloud, heads)?,
                None => closed(isa, cloud, sparse)?,
            };
            for side in sides {
                let mut views = Views::new(isa, side);
                let drawn = VIEWS.map(|view| views.half(&gaussians, view));
                reference.pictures.push(Pictures {
                    near,
                    side,
                    views: drawn.into_iter().collect::<Result<_>>()?,
                });
            }
        }
        Ok(reference)
    }

    /// Whether a level is nearly as close to the mesh as the cloud's surfels.
    pub fn is_near(&self, level: u8) -> bool {
        !self.sparse && level + 1 >= self.depth
    }

    /// The pictures that a level is compared with, by [`VIEWS`].
    pub fn pictures(&self, level: u8) -> &[Image] {
        let wanted = (self.is_near(level), side(level));
        let known = self.pictures.iter().find(|known| (known.near, known.side) == wanted);
        known.map_or(&[], |known| &known.views)
    }

    /// What draws a level as the pictures are drawn.
    pub fn views(&self, level: u8) -> Views {
        Views::new(self.isa, side(level))
    }

    /// Squared errors of pictures of these Gaussians of a level, over whole pictures and over the foreground.
    pub fn errors(&self, level: u8, gaussians: &Gaussians) -> Result<Errors> {
        let mut views = self.views(level);
        let mut errors = [0.0; 2];
        for (view, truth) in VIEWS.into_iter().zip(self.pictures(level)) {
            let seen = views.half(gaussians, view)?;
            for (truth, seen) in truth.pixels.iter().zip(&seen.pixels) {
                let error = error(truth, seen);
                errors[0] += error;
                errors[1] += if truth[3] > 0.5 { error } else { 0.0 };
            }
        }
        Ok(errors)
    }
}

/// The cloud's voxels as surfels.
fn closed(isa: Isa, cloud: &ColouredVoxels, sparse: bool) -> Result<Gaussians> {
    let (_, [_, map]) = maps(cloud)?;
    let choice = SurfelSelection {
        size: if sparse {
            f32::from(closing_size(&map)) / 64.0
        } else {
            SIZE
        },
        ..SurfelSelection::ALL
    };
    let (voxels, colours) = (&cloud.voxels, &cloud.colours);
    Ok(surfels(isa, voxels, &map, colours, PerVoxel::One, choice, frame(cloud)))
}

/// The cloud's voxels as the best heads draw them.
fn learned(isa: Isa, cloud: &ColouredVoxels, heads: &HeadsModel) -> Result<Gaussians> {
    let (octree, [above, map]) = maps(cloud)?;
    let level = octree.depth();
    let input = LevelInput {
        octree: &octree,
        level,
        map: &map,
        above: &above,
        colours: &cloud.colours,
        colours_above: &Decoder::colours_above(&octree, level, &cloud.colours),
        luma_step: 1.0,
        without: None,
        range: None,
    };
    let best = heads.sets().filter(|set| set.0 == Heads::Best).min_by_key(|set| set.1);
    let Some(best) = best else {
        return closed(isa, cloud, false);
    };
    let rows = (ROWS, true);
    heads.generate_in_parts(isa, Precision::default(), best, input, frame(cloud), rows, &mut |_| {
        Ok(())
    })
}

fn frame(cloud: &ColouredVoxels) -> Frame {
    Frame {
        bits: cloud.voxels.depth(),
        placement: cloud.placement,
    }
}

/// The octree of the cloud, whose depth is at least 1, and the 3³ kernel maps of its last two levels.
pub fn maps(cloud: &ColouredVoxels) -> Result<(Octree, [KernelMap; 2])> {
    let octree = Octree::new(cloud.voxels.clone())?;
    let mut above = octree.kernel_map(0);
    let last = octree.depth() - 1;
    for level in 0..last {
        above = octree.child_map(level, &above);
    }
    let map = octree.child_map(last, &above);
    Ok((octree, [above, map]))
}

/// Pixels along a side of the pictures of a level.
fn side(level: u8) -> u32 {
    (SIDE >> 8u8.saturating_sub(level)).max(64)
}

/// Draws pictures from [`VIEWS`].
pub struct Views {
    pub renderer: Renderer,
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
    pub fn camera(&self, (azimuth, elevation): (f64, f64), times: u32) -> Result<Camera> {
        let side = self.side / 2 * times;
        Camera::orbit(azimuth, elevation, DISTANCE, FIELD, side, side)
    }

    /// A picture averaged to half its size.
    pub fn half(&mut self, gaussians: &Gaussians, view: (f64, f64)) -> Result<Image> {
        let camera = self.camera(view, 2)?;
        let image = self.renderer.render(gaussians, &camera)?;
        Ok(image.box_half())
    }
}

/// Squared difference over white.
pub fn error(a: &[f32; 4], b: &[f32; 4]) -> f64 {
    let behind = b[3] - a[3];
    let channels = (0..3).map(|c| f64::from(a[c] - b[c] + behind));
    channels.map(|d| d * d).sum()
}
