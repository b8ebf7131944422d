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

mod blend;
mod exp2;
mod image;
#[doc(hidden)]
pub mod reference;
#[cfg(test)]
mod tests;

use std::time::{Duration, Instant};

use rayon::prelude::*;

pub use image::{Image, box_half};

use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::projection::{Camera, Dropped, Ellipses, project};
use crate::tiles::{Lists, Order, Rows, TILE};

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

    /// The final pixel over this background, from premultiplied colour and transmittance.
    fn behind(self, [r, g, b, through]: [f32; 4]) -> [f32; 4] {
        match self {
            Background::Transparent => [r, g, b, 1.0 - through],
            Background::Colour([br, bg, bb]) => {
                [r + through * br, g + through * bg, b + through * bb, 1.0]
            }
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
    /// Pairs of a Gaussian and a tile of 16×16 pixels that it may touch.
    pub pairs: u64,
    /// Wall time of each stage.
    pub times: Times,
}

/// Wall time by stage.
///
/// The last two run as one, row of tiles by row: their time is divided in proportion to what the threads spent on each.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Times {
    /// From Gaussians to ellipses.
    pub project: Duration,
    /// Into the order of drawing.
    pub sort: Duration,
    /// Into the lists of the tiles.
    pub bin: Duration,
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
#[derive(Debug, Default)]
pub struct Renderer {
    ellipses: Ellipses,
    order: Order,
    rows: Rows,
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
    /// One picture.
    ///
    /// # Errors
    /// [`crate::Error::Usage`] if the camera is none, the background is not finite, or the arrays of `gaussians` differ in length;
    /// [`crate::Error::LimitExceeded`] if the picture or the memory to draw it is over the `limits`.
    pub fn render(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        background: Background,
        limits: &Limits,
    ) -> Result<(Image, Stats)> {
        camera.check()?;
        if let Background::Colour(c) = background
            && !c.iter().all(|x| x.is_finite())
        {
            let what = format!("the background {c:?} is not a colour");
            return Err(crate::Error::Usage(what));
        }
        let count = u64::from(camera.width) * u64::from(camera.height);
        limits.check_pixels("pixels of the picture", count)?;
        let per_gaussian = Ellipses::BYTES + Order::BYTES;
        let bytes = count * size_of::<[f32; 4]>() as u64 + gaussians.len() as u64 * per_gaussian;
        limits.check_bytes("bytes to draw the picture", bytes)?;

        let mut times = Times::default();
        let mut clock = Instant::now();
        let mut lap = || std::mem::replace(&mut clock, Instant::now()).elapsed();
        let dropped = project(gaussians, camera, &mut self.ellipses)?;
        times.project = lap();
        self.order.sort(&self.ellipses.depth)?;
        times.sort = lap();
        let bounds = &self.ellipses.bounds;
        self.rows
            .deal(&self.order, bounds, camera.height, bytes, limits)?;
        let dealt = lap();
        let (image, [binning, blending]) = self.draw(camera, background);
        let drawn = lap();
        let share = binning.as_secs_f64() / (binning + blending).as_secs_f64().max(1e-9);
        times.bin = dealt + drawn.mul_f64(share);
        times.blend = drawn.mul_f64(1.0 - share);
        let stats = Stats {
            visible: self.ellipses.len() as u64,
            dropped,
            pairs: self.rows.pairs(),
            times,
        };
        Ok((image, stats))
    }

    /// The picture, and the threads' time for the tiles' lists and for the pixels.
    fn draw(&self, camera: &Camera, background: Background) -> (Image, [Duration; 2]) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut image = Image {
            width: camera.width,
            height: camera.height,
            pixels: vec![[0.0; 4]; width * height],
        };
        let times = image
            .pixels
            .par_chunks_mut(TILE as usize * width)
            .enumerate()
            .map_init(Lists::default, |lists, (row, band)| {
                let start = Instant::now();
                lists.deal(self.rows.row(row), &self.ellipses.bounds, camera.width);
                let dealt = Instant::now();
                for column in 0..width.div_ceil(TILE as usize) {
                    self.draw_tile(lists.tile(column), [column, row], width, background, band);
                }
                [dealt - start, dealt.elapsed()]
            })
            .reduce(Default::default, |a, b| [a[0] + b[0], a[1] + b[1]]);
        (image, times)
    }

    /// `band`: the pixels of the tile's row of tiles.
    fn draw_tile(
        &self,
        ids: &[u32],
        [column, row]: [usize; 2],
        width: usize,
        background: Background,
        band: &mut [[f32; 4]],
    ) {
        let side = TILE as usize;
        let left = column * side;
        let columns = left..(left + side).min(width);
        if ids.is_empty() {
            let clear = background.behind([0.0, 0.0, 0.0, 1.0]);
            for line in band.chunks_exact_mut(width) {
                line[columns.clone()].fill(clear);
            }
            return;
        }
        let mut tile = blend::Tile::new();
        tile.blend([left as u32, (row * side) as u32], ids, &self.ellipses);
        for (y, line) in band.chunks_exact_mut(width).enumerate() {
            for (x, pixel) in line[columns.clone()].iter_mut().enumerate() {
                *pixel = background.behind(tile.pixel(x, y));
            }
        }
    }
}
