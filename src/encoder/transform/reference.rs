//! Pictures of the cloud itself, as surfels at its full depth, which those of levels are compared with: a level's Gaussians
//! are farther from the mesh than those are.

use std::collections::BTreeSet;

use b2p_kernels::Isa;

use crate::cloud::ColouredVoxels;
use crate::error::Result;
use crate::gaussians::surfels::{PerVoxel, SurfelSelection, closing_size, surfels};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::{Octree, SiblingMap};
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

/// Squared errors over whole pictures and over the foreground.
pub type Errors = [f64; 2];

/// Pictures of the cloud. Nothing else of it is kept: Gaussians take much more memory.
pub struct Reference {
    isa: Isa,
    /// Of each side in use the views.
    pictures: Vec<(u32, Vec<Image>)>,
}

impl Reference {
    /// Draws the cloud's voxels, whose depth is at least 1, as these levels need it. Those of a `sparse` cloud are wide
    /// enough to close.
    pub fn new(isa: Isa, cloud: &ColouredVoxels, sparse: bool, levels: impl Iterator<Item = u8>) -> Result<Self> {
        let mut pictures: Vec<(u32, Vec<Image>)> = Vec::new();
        let sides: BTreeSet<u32> = levels.map(side).collect();
        let Some(&largest) = sides.last() else {
            return Ok(Reference { isa, pictures });
        };
        let mut views = Views::new(isa, largest).first(VIEWS.len(), &closed(isa, cloud, sparse)?)?;
        // Each side is half of the next one.
        let mut at = largest;
        for &side in sides.iter().rev() {
            while at > side {
                views.iter_mut().for_each(|view| *view = view.box_half());
                at /= 2;
            }
            pictures.push((side, views.clone()));
        }
        Ok(Reference { isa, pictures })
    }

    /// The pictures that a level is compared with, by [`VIEWS`].
    pub fn pictures(&self, level: u8) -> &[Image] {
        let known = self.pictures.iter().find(|(known, _)| *known == side(level));
        known.map_or(&[], |(_, pictures)| pictures)
    }

    /// What draws a level as the pictures are drawn.
    pub fn views(&self, level: u8) -> Views {
        Views::of_level(self.isa, level)
    }

    /// Squared errors of pictures of these Gaussians of a level, over whole pictures and over the foreground.
    pub fn errors(&self, level: u8, gaussians: &Gaussians) -> Result<Errors> {
        self.views(level).errors(self.pictures(level), gaussians)
    }
}

/// The cloud's voxels as surfels; those of a `sparse` cloud are wide enough to close.
pub fn closed(isa: Isa, cloud: &ColouredVoxels, sparse: bool) -> Result<Gaussians> {
    let (_, _, map) = maps(cloud)?;
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

/// The frame of the cloud's Gaussians.
pub fn frame(cloud: &ColouredVoxels) -> Frame {
    Frame {
        bits: cloud.voxels.depth(),
        placement: cloud.placement,
    }
}

/// The octree of the cloud, and the maps of its last level but one, if it has several, and of its last.
pub fn maps(cloud: &ColouredVoxels) -> Result<(Octree, Option<SiblingMap>, SiblingMap)> {
    let octree = Octree::new(cloud.voxels.clone())?;
    let (above, map) = octree.last_sibling_maps(octree.depth());
    Ok((octree, above, map))
}

/// Pixels along a side of the pictures of a level.
fn side(level: u8) -> u32 {
    (SIDE >> 8u8.saturating_sub(level)).max(64)
}

/// Draws pictures from [`VIEWS`].
pub struct Views {
    pub renderer: Renderer,
    side: u32,
    /// The memory of the last picture of the whole side.
    large: Image,
}

impl Views {
    /// For pictures that a level is compared with.
    pub fn of_level(isa: Isa, level: u8) -> Self {
        Self::new(isa, side(level))
    }

    fn new(isa: Isa, side: u32) -> Self {
        let renderer = Renderer::new()
            .with_isa(isa)
            .with_background(Background::Transparent)
            .with_limits(Limits::unlimited());
        Views {
            renderer,
            side,
            large: Image::default(),
        }
    }

    /// A camera of `times` half the side, at this azimuth and elevation.
    pub fn camera(&self, (azimuth, elevation): (f64, f64), times: u32) -> Result<Camera> {
        let side = self.side / 2 * times;
        Camera::orbit(azimuth, elevation, DISTANCE, FIELD, side, side)
    }

    /// A picture of the whole side.
    pub fn large(&mut self, gaussians: &Gaussians, view: (f64, f64)) -> Result<Image> {
        let camera = self.camera(view, 2)?;
        self.renderer.render(gaussians, &camera)
    }

    /// A picture averaged to half its size.
    pub fn half(&mut self, gaussians: &Gaussians, view: (f64, f64)) -> Result<Image> {
        let camera = self.camera(view, 2)?;
        self.renderer.render_into(gaussians, &camera, &mut self.large)?;
        Ok(self.large.box_half())
    }

    /// Pictures of the first `count` views.
    pub fn first(&mut self, count: usize, gaussians: &Gaussians) -> Result<Vec<Image>> {
        VIEWS[..count].iter().map(|view| self.half(gaussians, *view)).collect()
    }

    /// Squared errors of pictures of these Gaussians over whole pictures, and where the `truth` has something: pictures
    /// of the first views.
    pub fn errors(&mut self, truth: &[Image], gaussians: &Gaussians) -> Result<Errors> {
        let mut errors = [0.0; 2];
        for (view, truth) in VIEWS.into_iter().zip(truth) {
            let seen = self.half(gaussians, view)?;
            for (truth, seen) in truth.pixels.iter().zip(&seen.pixels) {
                let error = error(truth, seen);
                errors[0] += error;
                errors[1] += if truth[3] > 0.5 { error } else { 0.0 };
            }
        }
        Ok(errors)
    }
}

/// Squared difference over white.
pub fn error(a: &[f32; 4], b: &[f32; 4]) -> f64 {
    let behind = b[3] - a[3];
    let channels = (0..3).map(|c| f64::from(a[c] - b[c] + behind));
    channels.map(|d| d * d).sum()
}
