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
mod frame;
mod gather;
mod image;
mod options;
pub mod projection;
#[doc(hidden)]
pub mod reference;
mod shade;
mod splat_sizes;
mod stats;
#[cfg(test)]
mod tests;
pub mod tiles;

use std::sync::Mutex;

use b2p_kernels::Isa;

pub use effects::{Effect, EffectMode, EffectSet, Effects, Explanation, MOST_SAMPLES, RESOLVED};
pub use image::{Ids, Image, box_half};
pub use options::{Background, LEAST_FLOOR, Quality};
pub use shade::Channel;
pub use stats::{Stats, Times};

use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::projection::Ellipses;
use crate::renderer::tiles::{Bins, Count};
use canvas::{Colours, Indices, Mixed, Scratch};
use options::OutputOptions;

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
    /// Per-thread scratch.
    scratch: Vec<Mutex<Scratch>>,
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
            scratch: Vec::new(),
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
        let options = OutputOptions { channel, background };
        let pixels = &mut image.pixels;
        let stats = self.frame(gaussians, camera, options, &Colours, limits, pixels)?;
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
        let (options, indices) = (OutputOptions::default(), &mut ids.indices);
        let stats = self.frame(gaussians, camera, options, &Indices, limits, indices)?;
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
        let (options, mixed) = (OutputOptions::default(), Mixed(numbers));
        self.frame(gaussians, camera, options, &mixed, limits, pixels)?;
        Ok(())
    }
}
