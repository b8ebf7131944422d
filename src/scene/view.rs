//! What a camera sees of a scene: blocks in its view, front to back, down to where nothing is seen through them.

use std::collections::BTreeMap;

use glam::DVec3;

use super::decoder::{Decoded, DecodedScene, SceneDecoder, VOXEL_BYTES, Wanted, joined};
use super::reader::SceneReader;
use super::source::Source;
use crate::container::Header;
use crate::container::scene::Cube;
use crate::error::{Error, Result};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::morton;
use crate::limits::Limits;
use crate::renderer::camera::{Camera, Extent, Projection};
use crate::renderer::{Background, Channel, Image, Renderer};

/// How far Gaussians may reach out of their block, in voxels of its level.
const MARGIN: f64 = 8.0;
/// Transmittance up to which what is behind may be left out: it changes the picture by less than half a step of eight
/// bits.
const THRESHOLD: f32 = 1.0 / 512.0;
/// The blocks in view are decoded in so many groups, at least: what a group hides of the next ones is known then.
const GROUPS: usize = 16;
/// A group has so many blocks at least.
const GROUP: usize = 4;

/// How much of a scene a picture needs.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct ViewOptions {
    /// Width in pixels that voxels of a coarser level may have where that takes the place of the finest one. 0 for the
    /// finest everywhere.
    pub voxel_pixels: f64,
    /// Whether blocks that are hidden behind others are left out.
    pub occlusion_culling: bool,
}

impl ViewOptions {
    /// The same with another [`ViewOptions::voxel_pixels`].
    pub fn with_voxel_pixels(mut self, pixels: f64) -> Self {
        self.voxel_pixels = pixels;
        self
    }

    /// The same with another [`ViewOptions::occlusion_culling`].
    pub fn with_occlusion_culling(mut self, on: bool) -> Self {
        self.occlusion_culling = on;
        self
    }
}

impl Default for ViewOptions {
    fn default() -> Self {
        ViewOptions {
            voxel_pixels: 0.0,
            occlusion_culling: true,
        }
    }
}

/// A block in view.
#[derive(Debug, Clone, Copy)]
struct VisibleBlock {
    block: usize,
    level: u8,
    /// Columns and rows of the picture that it may reach: first and last. `None` if it comes too near to tell.
    window: Option<[[usize; 2]; 2]>,
}

impl SceneDecoder {
    /// The part of the cube that a scene takes, by the voxels of its coarsest level.
    ///
    /// # Errors
    /// Those of [`SceneDecoder::voxels`].
    pub fn extent<S: Source>(&self, scene: &SceneReader<S>) -> Result<Extent> {
        let coarsest = SceneDecoder::new(self.decoder().clone().with_level(scene.header().base));
        let (voxels, _) = coarsest.voxels(scene, &Wanted::All)?.content;
        let half = f64::from(1u32 << voxels.depth()) / 2.0;
        let spheres = (0..voxels.len()).map(|voxel| {
            let centre = voxels.coordinate(voxel).map(|x| (f64::from(x) + 0.5) / half - 1.0);
            (centre, 0.5 / half)
        });
        Ok(Extent::of(spheres))
    }

    /// The Gaussians that a camera sees. The picture of them is that of the whole scene, but for what is less than a
    /// step of eight bits; where levels are coarser, but for what they lack. `decoder`'s level is the finest one.
    ///
    /// # Errors
    /// Those of [`SceneDecoder::gaussians`] and of drawing.
    pub fn visible<S: Source>(
        &self,
        scene: &SceneReader<S>,
        camera: &Camera,
        options: ViewOptions,
    ) -> Result<DecodedScene<Gaussians>> {
        let in_view = self.in_view(scene, camera, options)?;
        let mut work = Work {
            decoder: self,
            scene,
            camera,
            decoded: BTreeMap::new(),
            lost: Vec::new(),
            drawn: BTreeMap::new(),
            transmittance: options.occlusion_culling.then(|| Transmittance::new(camera)),
        };
        for group in in_view.chunks(GROUP.max(in_view.len().div_ceil(GROUPS))) {
            work.add(group)?;
        }
        work.finish()
    }

    /// Bytes of memory that what a camera sees takes at most when it is decoded: blocks that are hidden behind others,
    /// which [`SceneDecoder::visible`] leaves out, count as if they were seen.
    ///
    /// # Errors
    /// [`Error::Usage`] for a level that the scene has not or a camera that makes no sense, [`Error::Unsupported`] for
    /// heads that there are not.
    pub fn visible_memory<S: Source>(
        &self,
        scene: &SceneReader<S>,
        camera: &Camera,
        options: ViewOptions,
    ) -> Result<u64> {
        let mut bytes: u64 = 0;
        for VisibleBlock { block, level, .. } in self.in_view(scene, camera, options)? {
            let entry = &scene.blocks()[block];
            let voxels = u64::from(entry.header(scene.header()).voxels(level - entry.cube.level)?);
            let drawn = self.gaussian_bytes(scene, &[block], level)?;
            bytes = bytes.saturating_add(drawn).saturating_add(voxels * VOXEL_BYTES);
        }
        Ok(bytes)
    }

    /// The blocks in a camera's view, front to back.
    fn in_view<S: Source>(
        &self,
        scene: &SceneReader<S>,
        camera: &Camera,
        options: ViewOptions,
    ) -> Result<Vec<VisibleBlock>> {
        camera.check()?;
        let header = scene.header();
        let finest = self.level(header)?;
        let order = front_to_back(scene, camera);
        self.decoder().check_drawable(header, finest)?;
        let levels = self.levels(scene)?;
        let in_view = order.into_iter().filter_map(|block| {
            let cube = scene.blocks()[block].cube;
            let level = level_for(cube, header, camera, options, &levels);
            let window = window(cube, level, camera)?;
            Some(VisibleBlock { block, level, window })
        });
        Ok(in_view.collect())
    }
}

/// What has been decoded and drawn so far.
struct Work<'a, S> {
    decoder: &'a SceneDecoder,
    scene: &'a SceneReader<S>,
    camera: &'a Camera,
    /// By level.
    decoded: BTreeMap<u8, Decoded>,
    lost: Vec<Error>,
    /// By block: where Gaussians are equally far away, their order decides.
    drawn: BTreeMap<usize, Gaussians>,
    /// Nothing, if hidden blocks are drawn, too.
    transmittance: Option<Transmittance>,
}

impl<S: Source> Work<'_, S> {
    /// Decodes the blocks of a group that are not hidden, and draws them over what is behind.
    fn add(&mut self, group: &[VisibleBlock]) -> Result<()> {
        let in_front = self.transmittance.as_ref();
        let is_visible = |seen: &&VisibleBlock| in_front.is_none_or(|in_front| !in_front.hides(seen));
        let visible: Vec<VisibleBlock> = group.iter().filter(is_visible).copied().collect();
        let mut levels: Vec<u8> = visible.iter().map(|seen| seen.level).collect();
        levels.sort_unstable();
        levels.dedup();
        let mut own: Vec<(usize, Gaussians)> = Vec::new();
        for level in levels {
            let of_level = visible.iter().filter(|seen| seen.level == level);
            let blocks: Vec<usize> = of_level.map(|seen| seen.block).collect();
            let held = self.held_bytes(&own);
            let decoded = self.decoded.entry(level).or_default();
            let mut take = |block, gaussians| own.push((block, gaussians));
            let wanted = (level, &blocks[..], None);
            self.decoder
                .draw_blocks(self.scene, wanted, held, decoded, &mut self.lost, &mut take)?;
        }
        if let Some(transmittance) = &mut self.transmittance {
            let copies = own.iter().map(|(_, gaussians)| gaussians.clone()).collect();
            let together = with_one_blur(copies, self.scene.frame());
            transmittance.draw(&together, self.camera, self.decoder.decoder().limits())?;
        }
        self.drawn.extend(own);
        Ok(())
    }

    /// Bytes that are held of what was decoded and drawn, of the group at hand twice.
    fn held_bytes(&self, own: &[(usize, Gaussians)]) -> u64 {
        let decoded = self
            .decoded
            .values()
            .flat_map(|decoded| decoded.blocks.values().flatten());
        let voxels: u64 = decoded.map(|voxels| voxels.keys.len() as u64).sum();
        let drawn: u64 = self.drawn.values().map(|gaussians| gaussians.len() as u64).sum();
        let own: u64 = own.iter().map(|(_, gaussians)| gaussians.len() as u64).sum();
        voxels * VOXEL_BYTES + (drawn + 2 * own) * size_of::<[f32; 14]>() as u64
    }

    fn finish(mut self) -> Result<DecodedScene<Gaussians>> {
        if self.drawn.is_empty() && !self.lost.is_empty() {
            return Err(self.lost.swap_remove(0));
        }
        drop(self.decoded);
        let blocks = self.drawn.len();
        let parts = self.drawn.into_values().collect();
        Ok(DecodedScene {
            content: with_one_blur(parts, self.scene.frame()),
            blocks,
            lost: self.lost,
        })
    }
}

/// Gaussians of blocks, which may have different levels, as one. A variance that is added to all is the same as larger
/// scales.
fn with_one_blur(mut parts: Vec<Gaussians>, frame: Frame) -> Gaussians {
    let least = parts.iter().map(|part| part.blur).reduce(f32::min).unwrap_or(0.0);
    for part in &mut parts {
        widen(&mut part.scale, part.blur - least);
        part.blur = least;
    }
    joined(parts, frame)
}

/// Adds a variance to Gaussians with these scales.
fn widen(scales: &mut [[f32; 3]], more: f32) {
    if more > 0.0 {
        let widen = |scale: &mut f32| *scale = (*scale * *scale + more).sqrt();
        scales.iter_mut().flatten().for_each(widen);
    }
}

/// How much of what is behind is seen in each pixel.
struct Transmittance {
    renderer: Renderer,
    image: Image,
    width: usize,
    /// Row by row, 1 where nothing is in front.
    through: Vec<f32>,
}

impl Transmittance {
    fn new(camera: &Camera) -> Self {
        let [width, height] = camera.size().map(|side| side as usize);
        Transmittance {
            renderer: Renderer::new(),
            image: Image::default(),
            width,
            through: vec![1.0; width * height],
        }
    }

    fn draw(&mut self, gaussians: &Gaussians, camera: &Camera, limits: &Limits) -> Result<()> {
        if gaussians.is_empty() {
            return Ok(());
        }
        let (nothing, image) = (Background::Transparent, &mut self.image);
        self.renderer
            .draw_into(gaussians, camera, Channel::Colour, nothing, limits, image)?;
        for (through, pixel) in self.through.iter_mut().zip(&self.image.pixels) {
            *through *= (1.0 - pixel[3]).clamp(0.0, 1.0);
        }
        Ok(())
    }

    /// Whether nothing of a block is seen through what is in front.
    fn hides(&self, seen: &VisibleBlock) -> bool {
        let Some([columns, rows]) = seen.window else {
            return false;
        };
        (rows[0]..=rows[1]).all(|row| {
            let row = &self.through[row * self.width..][..self.width];
            row[columns[0]..=columns[1]].iter().all(|through| *through <= THRESHOLD)
        })
    }
}

/// The lowest and the highest corner of a cube in the cube frame.
fn corners(cube: Cube) -> [DVec3; 2] {
    let edge = 2.0 / f64::from(1u32 << cube.level);
    let low = morton::decode(cube.key).map(|x| f64::from(x) * edge - 1.0);
    [DVec3::from(low), DVec3::from(low) + edge]
}

/// The blocks in an order in which none hides one before it. Of eight neighbouring cubes, those are in front that lie
/// on the camera's side of more of the planes between them.
fn front_to_back<S: Source>(scene: &SceneReader<S>, camera: &Camera) -> Vec<usize> {
    let inverse = camera.pose.inverse();
    let (eye, forward) = (inverse.translation, inverse.matrix3 * DVec3::Z);
    let mut order = Vec::new();
    let blocks: Vec<(usize, Cube)> = scene.blocks().iter().map(|block| block.cube).enumerate().collect();
    sort(
        &blocks,
        Cube { level: 0, key: 0 },
        &|middle| match camera.projection {
            Projection::Pinhole => eye - middle,
            Projection::Orthographic => -forward,
        },
        &mut order,
    );
    order
}

/// Appends the blocks in a cube, those in front first. `towards` is the direction from a point to the camera.
fn sort(blocks: &[(usize, Cube)], cube: Cube, towards: &impl Fn(DVec3) -> DVec3, order: &mut Vec<usize>) {
    if let [(block, _)] = blocks {
        return order.push(*block);
    }
    if blocks.is_empty() {
        return;
    }
    let [low, high] = corners(cube);
    let side = towards((low + high) / 2.0);
    let near = (0..3).map(|axis| u64::from(side[axis] >= 0.0) << axis).sum::<u64>();
    let mut octants = [0, 1, 2, 3, 4, 5, 6, 7];
    octants.sort_by_key(|octant: &u64| (octant ^ near).count_ones());
    for octant in octants {
        let child = Cube {
            level: cube.level + 1,
            key: cube.key << 3 | octant,
        };
        let is_in =
            |other: &Cube| other.level >= child.level && other.key >> (3 * (other.level - child.level)) == child.key;
        let first = blocks.iter().position(|(_, other)| is_in(other)).unwrap_or(0);
        let count = blocks[first..].iter().take_while(|(_, other)| is_in(other)).count();
        sort(&blocks[first..first + count], child, towards, order);
    }
}

/// The level of a block: the coarsest whose voxels are nowhere too wide.
fn level_for(cube: Cube, header: &Header, camera: &Camera, options: ViewOptions, levels: &[u8]) -> u8 {
    let finest = levels.last().copied().unwrap_or(header.top);
    let [low, high] = corners(cube);
    let points = (0..8).map(|corner| camera.pose.transform_point3(pick(low, high, corner)).z);
    let nearest = points.fold(f64::INFINITY, f64::min).max(camera.near);
    let focal = camera.fx.max(camera.fy);
    let per_unit = match camera.projection {
        Projection::Pinhole => focal / nearest,
        Projection::Orthographic => focal,
    };
    let is_fine = |level: &&u8| 2.0 / f64::from(1u32 << **level) * per_unit <= options.voxel_pixels;
    levels.iter().find(is_fine).copied().unwrap_or(finest)
}

/// A corner of a box.
fn pick(low: DVec3, high: DVec3, corner: u32) -> DVec3 {
    let of = |axis: usize| if corner >> axis & 1 == 1 { high[axis] } else { low[axis] };
    DVec3::new(of(0), of(1), of(2))
}

/// The part of the picture that a block may reach: `None` if it is out of view, `Some(None)` if it comes too near to
/// tell.
#[allow(clippy::option_option)]
fn window(cube: Cube, level: u8, camera: &Camera) -> Option<Option<[[usize; 2]; 2]>> {
    let margin = MARGIN * 2.0 / f64::from(1u32 << level);
    let [low, high] = corners(cube);
    let (low, high) = (low - margin, high + margin);
    let points = (0..8).map(|corner| camera.pose.transform_point3(pick(low, high, corner)));
    let points: Vec<DVec3> = points.collect();
    if points.iter().all(|point| point.z <= camera.near) {
        return None;
    }
    let view = camera.window();
    let sides = [
        (camera.fx, camera.cx, view.x0, view.x1),
        (camera.fy, camera.cy, view.y0, view.y1),
    ];
    let depth = |point: &DVec3| match camera.projection {
        Projection::Pinhole => point.z,
        Projection::Orthographic => 1.0,
    };
    // Of a point in front of the camera: how far it lies inside each side of the picture. What is outside one side with
    // all its corners is out of view, also behind the camera.
    for (axis, (focal, centre, first, end)) in sides.into_iter().enumerate() {
        let inside = |point: &DVec3, edge: f64| focal * point[axis] + (centre - edge) * depth(point);
        if points.iter().all(|point| inside(point, first.into()) < 0.0)
            || points.iter().all(|point| inside(point, end.into()) > 0.0)
        {
            return None;
        }
    }
    if points.iter().any(|point| point.z <= camera.near) {
        return Some(None);
    }
    let range = |axis: usize| {
        let (focal, centre, first, end) = sides[axis];
        let places = points
            .iter()
            .map(|point| focal * point[axis] / depth(point) + centre - f64::from(first));
        let (low, high) = places.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), at| {
            (low.min(at), high.max(at))
        });
        let last = f64::from(end - first) - 1.0;
        // A pixel more on each side, for filters.
        [
            (low - 1.0).clamp(0.0, last) as usize,
            (high + 1.0).clamp(0.0, last) as usize,
        ]
    };
    Some(Some([range(0), range(1)]))
}
