//! From Gaussians and a camera to a picture.
//!
//! ```
//! use b2p::gaussians::Gaussians;
//! use b2p::pixels::{Background, render};
//! use b2p::projection::Camera;
//!
//! let mut gaussians = Gaussians::default();
//! gaussians.position.push([0.0; 3]);
//! gaussians.scale.push([0.1; 3]);
//! gaussians.rotation.push([1.0, 0.0, 0.0, 0.0]);
//! gaussians.opacity.push(1.0);
//! gaussians.colour.push([1.0, 0.0, 0.0]);
//! let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 48)?;
//! let (image, stats) = render(&gaussians, &camera, Background::WHITE, &Default::default())?;
//! assert_eq!(stats.visible, 1);
//! assert!(image.pixel(32, 24)[1] < 0.1 && image.pixel(0, 0) == [1.0; 4]);
//! # Ok::<(), b2p::Error>(())
//! ```
//!
//! Splats are drawn front to back in the order of their depth along the viewing direction, one order for the whole picture. The
//! picture is the same to the bit for any number of threads: a tile is drawn by one thread, in an order that is a function of the
//! input alone. Work runs on the rayon pool that the caller is in.

mod effects;
mod image;
#[doc(hidden)]
pub mod reference;
mod shade;
#[cfg(test)]
mod tests;

use std::sync::Mutex;
use std::time::{Duration, Instant};

use b2p_kernels::Isa;
use b2p_kernels::splat::Tile;
use rayon::prelude::*;

pub use effects::{Choice, Effect, EffectSet, Effects, Explanation};
pub use image::{Image, box_half};
pub use shade::Channel;

use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::projection::{Camera, Dropped, Ellipses, How};
use crate::tiles::{Bins, Count, Grid, Nearest, Part, TILE};

/// What is seen where the Gaussians let light through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Background {
    /// Nothing: the picture keeps its transparency.
    Transparent,
    /// A colour, red, green and blue in `[0, 1]`: the picture is opaque.
    Colour([f32; 3]),
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

/// What a picture took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Stats {
    /// Gaussians drawn.
    pub visible: u64,
    /// Gaussians not drawn, and why.
    pub dropped: Dropped,
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
pub struct Times {
    /// From Gaussians to ellipses, and before that to the colours of the view, if that is called for.
    pub project: Duration,
    /// Into the lists of the tiles.
    pub bin: Duration,
    /// Of each tile, into narrow ranges of depth; in order within these only as they are drawn.
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

/// Draws pictures one after the other, reusing its memory.
#[derive(Debug)]
pub struct Renderer {
    isa: Isa,
    effects: Effects,
    shades: Vec<[f32; 3]>,
    ellipses: Ellipses,
    counts: Vec<Count>,
    bins: Bins,
    /// One for each thread.
    desks: Vec<Mutex<Desk>>,
}

/// What a thread needs to draw tiles.
#[derive(Debug, Default)]
struct Desk {
    nearest: Nearest,
    tile: Tile,
    touched: u64,
    sorting: Duration,
    blending: Duration,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer::new(Isa::detect())
    }
}

/// One picture; [`Renderer::render`] for many.
///
/// # Errors
/// As [`Renderer::render`].
pub fn render(
    gaussians: &Gaussians,
    camera: &Camera,
    background: Background,
    limits: &Limits,
) -> Result<(Image, Stats)> {
    Renderer::default().render(gaussians, camera, background, limits)
}

impl Renderer {
    /// With the instructions of `isa`; [`Renderer::default`] takes the best that the machine has.
    pub fn new(isa: Isa) -> Self {
        Renderer {
            isa,
            effects: Effects::default(),
            shades: Vec::new(),
            ellipses: Ellipses::default(),
            counts: Vec::new(),
            bins: Bins::default(),
            desks: Vec::new(),
        }
    }

    /// Forces effects on or off from now on.
    pub fn set_effects(&mut self, effects: Effects) {
        self.effects = effects;
    }

    /// One picture.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    pub fn render(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: Background,
        limits: &Limits,
    ) -> Result<(Image, Stats)> {
        let mut image = Image::default();
        let stats = self.render_into(gaussians, camera, background, limits, &mut image)?;
        Ok((image, stats))
    }

    /// One picture into `image`, whose size becomes the camera's. Its memory is reused, and after an error it holds nothing sensible.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] if the camera is none, the background is not finite, or the arrays of `gaussians` differ in length;
    /// [`crate::Error::LimitExceeded`] if the picture or the memory to draw it is over the `limits`.
    pub fn render_into(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: Background,
        limits: &Limits,
        image: &mut Image,
    ) -> Result<Stats> {
        self.draw_into(
            gaussians,
            camera,
            Channel::Colour,
            background,
            limits,
            image,
        )
    }

    /// As [`Renderer::render_into`], of any channel.
    ///
    /// # Errors
    /// As [`Renderer::render_into`].
    pub fn draw_into(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        channel: Channel,
        background: Background,
        limits: &Limits,
        image: &mut Image,
    ) -> Result<Stats> {
        camera.check()?;
        gaussians.check_lengths()?;
        if let Background::Colour(c) = background
            && !c.iter().all(|x| x.is_finite())
        {
            let what = format!("the background {c:?} is not a colour");
            return Err(crate::Error::Usage(what));
        }
        let count = u64::from(camera.width) * u64::from(camera.height);
        limits.check_pixels("pixels of the picture", count)?;
        let grid = Grid::new(camera.width, camera.height);
        let effects = self.effects.derive(gaussians);
        let shaded = effects.harmonics || channel != Channel::Colour;
        let shade = u64::from(shaded) * size_of::<[f32; 3]>() as u64;
        let bytes = count * size_of::<[f32; 4]>() as u64
            + gaussians.len() as u64 * (Ellipses::BYTES + shade)
            + grid.bytes(Ellipses::runs_of(gaussians.len()));
        limits.check_bytes("bytes to draw the picture", bytes)?;

        let mut times = Times::default();
        let mut clock = Instant::now();
        let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed();
        if shaded {
            shade::fill(gaussians, camera, channel, &mut self.shades);
        }
        let how = How {
            isa: self.isa,
            compensated: effects.antialias,
            colours: shaded.then_some(&self.shades),
        };
        let dropped = self.ellipses.project(
            gaussians,
            camera,
            how,
            &mut self.counts,
            |count, ellipses| count.count(grid, ellipses),
        )?;
        times.project = lap();
        let pairs = self.bins.plan(grid, &self.counts, bytes, limits)?;
        times.bin = lap();

        let size = [camera.width, camera.height];
        [image.width, image.height] = size;
        image.pixels.resize(count as usize, [0.0; 4]);
        self.desks
            .resize_with(rayon::current_num_threads(), Mutex::default);
        let mut part = self.bins.next(None);
        while let Some(now) = part {
            self.bins
                .fill(now.clone(), &self.ellipses, &mut self.counts);
            times.bin += lap();
            let [sorting, blending] = self.draw_part(&now, size, background, &mut image.pixels);
            let drawn = lap();
            let share = sorting.as_secs_f64() / (sorting + blending).as_secs_f64().max(1e-9);
            times.sort += drawn.mul_f64(share);
            times.blend += drawn.mul_f64(1.0 - share);
            part = self.bins.next(Some(&now));
        }
        let touched = |desk: &mut Mutex<Desk>| {
            let desk = desk.get_mut().unwrap_or_else(|e| e.into_inner());
            std::mem::take(&mut desk.touched)
        };
        Ok(Stats {
            touched: self.desks.iter_mut().map(touched).sum(),
            visible: self.ellipses.len() as u64,
            dropped,
            pairs,
            effects,
            times,
        })
    }

    /// Draws a part of the picture; returns the threads' time for sorting and for the pixels.
    fn draw_part(
        &self,
        part: &Part,
        size: [u32; 2],
        background: Background,
        pixels: &mut [[f32; 4]],
    ) -> [Duration; 2] {
        let width = size[0] as usize;
        let band = TILE as usize * width;
        let end = (part.rows.end * band).min(pixels.len());
        pixels[part.rows.start * band..end]
            .par_chunks_mut(band)
            .zip(part.rows.clone())
            .with_max_len(1)
            .for_each(|(band, row)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                // Only this thread uses this desk, and a panic would have ended the drawing.
                let mut desk = self.desks[thread].lock().unwrap_or_else(|e| e.into_inner());
                for column in part.columns.clone() {
                    self.draw_tile([column, row], size, background, &mut desk, band);
                }
            });
        self.desks.iter().fold(Default::default(), |sum, desk| {
            let desk = &mut *desk.lock().unwrap_or_else(|e| e.into_inner());
            let times = [&mut desk.sorting, &mut desk.blending].map(std::mem::take);
            [sum[0] + times[0], sum[1] + times[1]]
        })
    }

    /// `band`: the pixels of the tile's row of tiles.
    fn draw_tile(
        &self,
        [column, row]: [usize; 2],
        size: [u32; 2],
        background: Background,
        desk: &mut Desk,
        band: &mut [[f32; 4]],
    ) {
        let (side, width) = (TILE as usize, size[0] as usize);
        let left = column * side;
        let columns = left..(left + side).min(width);
        let entries = self.bins.tile(row, column);
        if entries.is_empty() {
            let [r, g, b, a] = background.behind();
            let clear = [r, g, b, 1.0 + a];
            for line in band.chunks_exact_mut(width) {
                line[columns.clone()].fill(clear);
            }
            return;
        }
        let start = Instant::now();
        desk.nearest.take(entries);
        let sorted = Instant::now();
        desk.tile.start([left as u32, (row * side) as u32], size);
        desk.nearest
            .each(|keys, next| desk.tile.blend(self.isa, keys, next, self.ellipses.all()));
        let behind = background.behind();
        let touched = desk
            .tile
            .write(self.isa, behind, &mut band[left..], width, columns.len());
        desk.touched += u64::from(touched);
        desk.sorting += sorted - start;
        desk.blending += sorted.elapsed();
    }
}
