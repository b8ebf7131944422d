//! From Gaussians and a camera to a picture.
//!
//! ```
//! use b2p::{Camera, Gaussians, Renderer};
//!
//! let mut gaussians = Gaussians::default();
//! gaussians.position.push([0.0; 3]);
//! gaussians.scale.push([0.1; 3]);
//! gaussians.rotation.push([1.0, 0.0, 0.0, 0.0]);
//! gaussians.opacity.push(1.0);
//! gaussians.colour.push([1.0, 0.0, 0.0]);
//! let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 48)?;
//! let image = Renderer::new().render(&gaussians, &camera)?;
//! assert!(image.pixel(32, 24)[1] < 0.1 && image.pixel(0, 0) == [1.0; 4]);
//! # Ok::<(), b2p::Error>(())
//! ```
//!
//! Splats are drawn front to back in the order of their depth along the viewing direction, one order for the whole
//! picture. The picture is the same to the bit for any number of threads: a tile is drawn by one thread, in an order
//! that is a function of the input alone. Work runs on the rayon pool that the caller is in.

pub mod camera;
mod canvas;
mod effects;
mod exr;
mod image;
pub mod projection;
#[doc(hidden)]
pub mod reference;
mod shade;
mod survey;
#[cfg(test)]
mod tests;
pub mod tiles;

use std::sync::Mutex;
use std::time::{Duration, Instant};

use b2p_kernels::Isa;
use b2p_kernels::splat::{Crossing, Loop, Scene};
use rayon::prelude::*;

#[doc(hidden)]
pub use effects::EffectMode as Choice;
pub use effects::{Effect, EffectMode, EffectSet, Effects, Explanation, MOST_SAMPLES, RESOLVED};
pub use image::{Ids, Image, box_half};
pub use shade::Channel;

use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::projection::{Dropped, Ellipse, Ellipses, How, Seen};
use crate::renderer::tiles::{Bins, Count, Grid, TILE, TileBand};
use canvas::{Canvas, Colours, Contents, Desk, Indices, Mixed, Output};

/// What is seen where the Gaussians let light through.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Background {
    /// Nothing: the picture keeps its transparency.
    Transparent,
    /// A colour, red, green and blue in `[0, 1]`: the picture is opaque.
    Colour([f32; 3]),
}

impl Default for Background {
    /// White.
    fn default() -> Self {
        Background::WHITE
    }
}

impl Background {
    /// White.
    pub const WHITE: Background = Background::Colour([1.0; 3]);
    /// Black.
    pub const BLACK: Background = Background::Colour([0.0; 3]);

    /// What each channel takes of the transmittance, beyond what the Gaussians give it, and alpha beyond 1.
    fn behind(self) -> [f32; 4] {
        match self {
            Background::Transparent => [0.0, 0.0, 0.0, -1.0],
            Background::Colour([r, g, b]) => [r, g, b, 0.0],
        }
    }
}

/// How much of splats may be left out. A splat is looked at in all the blocks of 4×4 pixels where its α may reach a
/// floor; what is left out adds up where many tails overlap, as beside the silhouette of a crowd.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[non_exhaustive]
pub enum Quality {
    /// A floor of 1/255, as is usual: beside silhouettes, pictures are off by several steps of eight bits, and by many
    /// where splats are far smaller than pixels.
    Fast,
    /// A floor of 1/16384.
    #[default]
    Fine,
    /// A floor of [`LEAST_FLOOR`].
    Exact,
    /// A floor of one's own, from [`LEAST_FLOOR`] to 1.
    Floor(f32),
}

/// The lowest floor of α.
pub const LEAST_FLOOR: f32 = 1.0 / (1 << 20) as f32;

impl Quality {
    /// The least α that is drawn.
    pub fn floor(self) -> f32 {
        match self {
            Quality::Fast => 1.0 / 255.0,
            Quality::Fine => 1.0 / 16384.0,
            Quality::Exact => LEAST_FLOOR,
            Quality::Floor(floor) => floor.clamp(LEAST_FLOOR, 1.0),
        }
    }
}

impl std::fmt::Display for Quality {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Quality::Fast => f.write_str("fast"),
            Quality::Fine => f.write_str("fine"),
            Quality::Exact => f.write_str("exact"),
            Quality::Floor(_) => write!(f, "floor 1/{:.0}", 1.0 / self.floor()),
        }
    }
}

impl std::str::FromStr for Quality {
    type Err = String;

    fn from_str(name: &str) -> std::result::Result<Self, String> {
        match name {
            "fast" => Ok(Quality::Fast),
            "fine" => Ok(Quality::Fine),
            "exact" => Ok(Quality::Exact),
            _ => Err(format!("no quality `{name}`, but fast, fine and exact")),
        }
    }
}

/// What a picture took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Stats {
    /// Gaussians drawn.
    pub visible: u64,
    /// Gaussians not drawn, and why.
    pub dropped: Dropped,
    /// Gaussians that reach over the near plane: of those drawn with care for it the visible ones, else all.
    pub crossing: u64,
    /// Pairs of a Gaussian and a tile of 32×32 pixels that it may touch.
    pub pairs: u64,
    /// Pixels that something was drawn on.
    pub touched: u64,
    /// What it was drawn with.
    pub effects: EffectSet,
    /// Wall time of each stage.
    pub times: Times,
}

/// Wall time by stage.
///
/// The last two run as one, tile by tile: their time is divided in proportion to what the threads spent on each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Times {
    /// From Gaussians to ellipses, and before that to the colours of the view, if that is called for.
    pub project: Duration,
    /// Into the lists of the tiles.
    pub bin: Duration,
    /// Of each tile, by depth.
    pub sort: Duration,
    /// Into pixels.
    pub blend: Duration,
}

impl Times {
    /// All stages.
    pub fn total(&self) -> Duration {
        self.project + self.sort + self.bin + self.blend
    }
}

/// Draws pictures of Gaussians, one after the other, and reuses its memory.
///
/// The order of splats is that of their depths along the viewing direction, one order for the whole picture. For one
/// instruction set, pictures are equal to the bit for any number of threads. Work runs in the rayon pool of the caller.
///
/// ```
/// use b2p::{Camera, Gaussians, Renderer};
///
/// let mut gaussians = Gaussians::default();
/// gaussians.position.push([0.0; 3]);
/// gaussians.scale.push([0.1; 3]);
/// gaussians.rotation.push([1.0, 0.0, 0.0, 0.0]);
/// gaussians.opacity.push(1.0);
/// gaussians.colour.push([1.0, 0.0, 0.0]);
/// let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 48)?;
/// let image = Renderer::new().render(&gaussians, &camera)?;
/// assert!(image.pixel(32, 24)[1] < 0.1 && image.pixel(0, 0) == [1.0; 4]);
/// # Ok::<(), b2p::Error>(())
/// ```
#[derive(Debug)]
pub struct Renderer {
    isa: Isa,
    quality: Quality,
    effects: Effects,
    background: Background,
    channel: Channel,
    limits: Limits,
    shades: Vec<[f32; 3]>,
    ellipses: Ellipses,
    counts: Vec<Count>,
    bins: Bins,
    /// One for each thread.
    desks: Vec<Mutex<Desk>>,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer::new()
    }
}

/// One picture; [`Renderer::render`] for many.
///
/// # Errors
/// As [`Renderer::render`].
#[doc(hidden)]
pub fn render(
    gaussians: &Gaussians,
    camera: &Camera,
    background: Background,
    limits: &Limits,
) -> Result<(Image, Stats)> {
    let mut renderer = Renderer::new().with_background(background).with_limits(limits.clone());
    let mut image = Image::default();
    let stats = renderer.render_into(gaussians, camera, &mut image)?;
    Ok((image, stats))
}

impl Renderer {
    /// A renderer of colours on white, with default quality, effects and limits, and the best instruction set of the
    /// machine.
    pub fn new() -> Self {
        Renderer {
            isa: Isa::detect(),
            quality: Quality::default(),
            effects: Effects::default(),
            background: Background::default(),
            channel: Channel::default(),
            limits: Limits::default(),
            shades: Vec::new(),
            ellipses: Ellipses::default(),
            counts: Vec::new(),
            bins: Bins::default(),
            desks: Vec::new(),
        }
    }

    /// The same renderer with kernels of this instruction set.
    pub fn with_isa(mut self, isa: Isa) -> Self {
        self.isa = isa;
        self
    }

    /// The same renderer on another background.
    pub fn with_background(mut self, background: Background) -> Self {
        self.background = background;
        self
    }

    /// The same renderer of another channel: depth or normals in place of colours.
    pub fn with_channel(mut self, channel: Channel) -> Self {
        self.channel = channel;
        self
    }

    /// The same renderer with another quality.
    pub fn with_quality(mut self, quality: Quality) -> Self {
        self.quality = quality;
        self
    }

    /// The same renderer with effects forced on or off.
    pub fn with_effects(mut self, effects: Effects) -> Self {
        self.effects = effects;
        self
    }

    /// The same renderer under other limits.
    pub fn with_limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }

    /// Sets the quality of the pictures that follow.
    #[doc(hidden)]
    pub fn set_quality(&mut self, quality: Quality) {
        self.quality = quality;
    }

    /// Forces effects on or off in the pictures that follow.
    #[doc(hidden)]
    pub fn set_effects(&mut self, effects: Effects) {
        self.effects = effects;
    }

    /// Draws a picture.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    pub fn render(&mut self, gaussians: &Gaussians, camera: &Camera) -> Result<Image> {
        let mut image = Image::default();
        self.render_into(gaussians, camera, &mut image)?;
        Ok(image)
    }

    /// Draws a picture into `image`, whose size becomes the camera's, and returns counts and times. The memory of
    /// `image` is reused. After an error its content is unspecified.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] if the camera is none, the background is not finite, or the arrays of `gaussians` differ
    /// in length; [`crate::Error::LimitExceeded`] if the picture, the memory or the work to draw it is over the
    /// `limits`; [`crate::Error::OutOfMemory`].
    pub fn render_into(&mut self, gaussians: &Gaussians, camera: &Camera, image: &mut Image) -> Result<Stats> {
        let (channel, background) = (self.channel, self.background);
        let limits = self.limits.clone();
        self.draw_into(gaussians, camera, channel, background, &limits, image)
    }

    /// Finds which Gaussian each pixel shows most of: one sample per pixel, whatever the effects.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    pub fn ids(&mut self, gaussians: &Gaussians, camera: &Camera) -> Result<Ids> {
        let (mut ids, limits) = (Ids::default(), self.limits.clone());
        self.ids_into(gaussians, camera, &limits, &mut ids)?;
        Ok(ids)
    }

    /// As [`Renderer::render_into`], with channel, background and limits given one by one.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    #[doc(hidden)]
    pub fn draw_into(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        channel: Channel,
        background: Background,
        limits: &Limits,
        image: &mut Image,
    ) -> Result<Stats> {
        let wanted = Wanted { channel, background };
        let pixels = &mut image.pixels;
        let stats = self.frame(gaussians, camera, wanted, &Colours, limits, pixels)?;
        [image.width, image.height] = camera.size();
        Ok(stats)
    }

    /// Which Gaussian each pixel shows most of; one sample a pixel, whatever the effects. Otherwise as
    /// [`Renderer::render_into`].
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    #[doc(hidden)]
    pub fn ids_into(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        limits: &Limits,
        ids: &mut Ids,
    ) -> Result<Stats> {
        let (wanted, indices) = (Wanted::default(), &mut ids.indices);
        let stats = self.frame(gaussians, camera, wanted, &Indices, limits, indices)?;
        [ids.width, ids.height] = camera.size();
        Ok(stats)
    }

    /// A picture of any `numbers` that each Gaussian, by its index, has `N` of, mixed as colours are: in each of
    /// `pixels`, row by row, the sum over the Gaussians there of what they contribute, of which a 1 makes the opacity.
    /// One sample a pixel, whatever the effects.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    #[doc(hidden)]
    pub fn mix_into<const N: usize>(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        numbers: impl Fn(usize) -> [f32; N] + Sync,
        limits: &Limits,
        pixels: &mut Vec<[f32; N]>,
    ) -> Result<()> {
        let (wanted, mixed) = (Wanted::default(), Mixed(numbers));
        self.frame(gaussians, camera, wanted, &mixed, limits, pixels)?;
        Ok(())
    }

    fn frame<O: Output>(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        wanted: Wanted,
        output: &O,
        limits: &Limits,
        pixels: &mut Vec<O::Pixel>,
    ) -> Result<Stats> {
        let mut plan = self.plan::<O>(gaussians, camera, &wanted, limits)?;
        let (mut times, mut laps) = (Times::default(), Laps(Instant::now()));
        let seen = self.project(gaussians, camera, wanted.channel, &mut plan, limits)?;
        times.project = laps.lap();
        let pairs = self.bins.plan(plan.grid, &mut self.counts, plan.bytes, limits)?;
        times.bin = laps.lap();
        if pixels.capacity() < plan.pixels {
            // What is outgrown goes first, and zeros come as tiles are drawn, from the threads that draw them.
            *pixels = Vec::new();
            *pixels = bytemuck::try_zeroed_vec(plan.pixels).map_err(|()| crate::Error::OutOfMemory {
                what: "the pixels of the picture",
                bytes: (plan.pixels * size_of::<O::Pixel>()) as u64,
            })?;
        }
        pixels.resize(plan.pixels, bytemuck::Zeroable::zeroed());
        let canvas = Canvas {
            grid: plan.grid,
            window: camera.window(),
            shrink: plan.effects.supersample,
            background: wanted.background,
        };
        self.draw_parts(&plan, &canvas, output, pixels, &mut times, &mut laps)?;
        let samples = u64::from(plan.effects.supersample).pow(2);
        Ok(Stats {
            touched: self.take_touched() / samples,
            visible: self.ellipses.len() as u64,
            dropped: seen.dropped,
            crossing: seen.crossing,
            pairs,
            effects: plan.effects,
            times,
        })
    }

    /// Checks all that is asked for, and derives how to draw it.
    fn plan<O: Output>(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        wanted: &Wanted,
        limits: &Limits,
    ) -> Result<Plan> {
        camera.check()?;
        gaussians.check_lengths()?;
        if let Background::Colour(c) = wanted.background
            && !c.iter().all(|x| x.is_finite())
        {
            let what = format!("the background {c:?} is not a colour");
            return Err(crate::Error::Usage(what));
        }
        let [width, height] = camera.size();
        let count = u64::from(width) * u64::from(height);
        limits.check_pixels("pixels of the picture", count)?;
        let mut effects = self.effects.derive(gaussians, camera);
        if O::LOOP.is_some() {
            effects.supersample = 1;
            effects.order = false;
        }
        let fine = camera.magnified(effects.supersample);
        let grid = Grid::new(fine.window());
        let shaded = effects.shades() || wanted.channel != Channel::Colour;
        let each = Ellipses::BYTES
            + Count::BYTES
            + u64::from(shaded) * size_of::<[f32; 3]>() as u64
            + u64::from(effects.order) * size_of::<[f32; 2]>() as u64;
        let bytes = count * size_of::<O::Pixel>() as u64
            + gaussians.len() as u64 * each
            + grid.bytes(Ellipses::runs_of(gaussians.len()));
        limits.check_bytes(BYTES, bytes)?;
        Ok(Plan {
            effects,
            fine,
            grid,
            shaded,
            pixels: count as usize,
            bytes,
        })
    }

    /// Finds the ellipses and counts them by tile. Completes the plan: whether any cross the near plane, and their
    /// bytes.
    fn project(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        channel: Channel,
        plan: &mut Plan,
        limits: &Limits,
    ) -> Result<Seen> {
        if plan.shaded {
            shade::fill(gaussians, camera, channel, &plan.effects, &mut self.shades);
        }
        let how = How {
            isa: self.isa,
            compensated: plan.effects.antialias,
            floor: self.quality.floor(),
            near_care: self.effects.near != EffectMode::Off,
            slopes: plan.effects.order,
            colours: plan.shaded.then_some(&self.shades),
        };
        let grid = plan.grid;
        let start = |count: &mut Count, length| count.start(grid, length);
        let look = |count: &mut Count, ellipses: &[Ellipse]| count.count(grid, ellipses);
        let counts = &mut self.counts;
        let seen = self.ellipses.project(gaussians, &plan.fine, how, counts, start, look)?;
        plan.effects.near = how.near_care && seen.crossing > 0;
        if plan.effects.near {
            plan.bytes += seen.crossing * size_of::<Crossing>() as u64;
        }
        limits.check_bytes(BYTES, plan.bytes)?;
        self.ellipses.look_closer(gaussians, &plan.fine, how);
        Ok(seen)
    }

    /// Draws the picture in as many parts as its limits call for.
    fn draw_parts<O: Output>(
        &mut self,
        plan: &Plan,
        canvas: &Canvas,
        output: &O,
        pixels: &mut [O::Pixel],
        times: &mut Times,
        laps: &mut Laps,
    ) -> Result<()> {
        self.desks.resize_with(rayon::current_num_threads(), Mutex::default);
        let what = O::LOOP.unwrap_or(match (plan.effects.order, plan.effects.near) {
            (true, _) => Loop::Order,
            (_, true) => Loop::Care,
            _ => Loop::Plain,
        });
        let mut part = self.bins.next(None);
        while let Some(now) = part {
            self.bins.fill(now.clone(), &self.ellipses, &mut self.counts)?;
            times.bin += laps.lap();
            let [sorting, blending] = self.draw_part(&now, canvas, self.quality.floor(), what, output, pixels);
            let drawn = laps.lap();
            let share = sorting.as_secs_f64() / (sorting + blending).as_secs_f64().max(1e-9);
            times.sort += drawn.mul_f64(share);
            times.blend += drawn.mul_f64(1.0 - share);
            part = self.bins.next(Some(&now));
        }
        Ok(())
    }

    /// Blocks that all threads have touched since this was asked last.
    fn take_touched(&mut self) -> u64 {
        let touched = |desk: &mut Mutex<Desk>| {
            let desk = desk.get_mut().unwrap_or_else(|e| e.into_inner());
            std::mem::take(&mut desk.touched)
        };
        self.desks.iter_mut().map(touched).sum()
    }

    /// Draws a part of the picture; returns the threads' time for sorting and for the pixels.
    fn draw_part<O: Output>(
        &self,
        part: &TileBand,
        canvas: &Canvas,
        floor: f32,
        what: Loop,
        output: &O,
        pixels: &mut [O::Pixel],
    ) -> [Duration; 2] {
        let contents = Contents {
            isa: self.isa,
            bins: &self.bins,
            scene: Scene {
                all: self.ellipses.all(),
                crossing: self.ellipses.crossing(),
                slopes: self.ellipses.slopes(),
            },
            floor,
            what,
        };
        let width = canvas.width();
        let start = canvas.rows(part.rows.start).start * width;
        let end = canvas.rows(part.rows.end - 1).end * width;
        // A window may begin within a row of tiles.
        let first = canvas.rows(part.rows.start).len() * width;
        let (first, rest) = pixels[start..end].split_at_mut(first);
        rayon::iter::once(first)
            .chain(rest.par_chunks_mut((TILE / canvas.shrink) as usize * width))
            .zip(part.rows.clone())
            .with_max_len(1)
            .for_each(|(band, row)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                // Only this thread uses this desk, and a panic would have ended the drawing.
                let mut desk = self.desks[thread].lock().unwrap_or_else(|e| e.into_inner());
                for column in part.columns.clone() {
                    desk.draw([column, row], canvas, &contents, output, band);
                }
            });
        self.desks.iter().fold(Default::default(), |sum, desk| {
            let desk = &mut *desk.lock().unwrap_or_else(|e| e.into_inner());
            let times = [&mut desk.sorting, &mut desk.blending].map(std::mem::take);
            [sum[0] + times[0], sum[1] + times[1]]
        })
    }
}

/// What errors call the memory that a picture takes.
const BYTES: &str = "bytes to draw the picture";

/// How a picture is drawn.
struct Plan {
    effects: EffectSet,
    /// The camera, with as many pixels as there are samples.
    fine: Camera,
    grid: Grid,
    /// Whether the Gaussians' colours are not what is drawn.
    shaded: bool,
    pixels: usize,
    /// Bytes of memory that drawing takes, but for what lists of tiles take.
    bytes: u64,
}

/// A clock that tells the time since it was asked last.
struct Laps(Instant);

impl Laps {
    fn lap(&mut self) -> Duration {
        std::mem::replace(&mut self.0, Instant::now()).elapsed()
    }
}

/// What a picture is to show.
struct Wanted {
    channel: Channel,
    background: Background,
}

impl Default for Wanted {
    fn default() -> Self {
        Wanted {
            channel: Channel::Colour,
            background: Background::Transparent,
        }
    }
}
