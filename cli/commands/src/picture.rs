//! What a picture shows, and the file that it becomes.

use std::io::Write;
use std::path::Path;

use b2p::gaussians::Gaussians;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Channel, Ids, Image, Renderer, Stats};
use b2p::{Error, Limits};

use super::args::{Format, Render, Show};
use super::{Failure, Result, manners};

/// Draws pictures one after the other, with what else their files need.
pub struct Artist<'a> {
    pub renderer: Renderer,
    pub gaussians: &'a Gaussians,
    limits: &'a Limits,
    pub args: &'a Render,
    pub format: Format,
    pub image: Image,
    /// Bytes that are held beside the picture.
    pub other_bytes: u64,
    distances: Vec<f32>,
    ids: Ids,
}

impl<'a> Artist<'a> {
    pub fn new(
        renderer: Renderer,
        gaussians: &'a Gaussians,
        limits: &'a Limits,
        args: &'a Render,
        format: Format,
    ) -> Self {
        Artist {
            renderer,
            gaussians,
            limits,
            args,
            format,
            image: Image::default(),
            other_bytes: 0,
            distances: Vec::new(),
            ids: Ids::default(),
        }
    }

    /// Draws what is asked for. Beside the picture, an OpenEXR file needs the distances, and numbers their own picture:
    /// the memory of both is within the limits.
    pub fn draw(&mut self, camera: &Camera) -> b2p::Result<Stats> {
        let (channel, background) = match self.args.show {
            Show::Colour => (Channel::Colour, self.args.view.background),
            Show::Depth => (Channel::Depth, Background::Transparent),
            Show::Normal => (Channel::Normal, Background::Transparent),
            Show::Alpha => (Channel::Colour, Background::Transparent),
            Show::Id => return self.draw_ids(camera),
        };
        let gaussians = self.gaussians;
        let each = if self.needs_depth() { size_of::<f32>() } else { 0 };
        let limits = self.limits_beside(camera, each as u64)?;
        if self.needs_depth() {
            let (nothing, image) = (Background::Transparent, &mut self.image);
            self.renderer
                .draw_into(gaussians, camera, Channel::Depth, nothing, &limits, image)?;
            self.distances = self.image.distances();
        }
        let image = &mut self.image;
        let stats = self
            .renderer
            .draw_into(gaussians, camera, channel, background, &limits, image)?;
        match self.args.show {
            Show::Alpha => {
                for pixel in &mut self.image.pixels {
                    *pixel = [pixel[3], pixel[3], pixel[3], 1.0];
                }
            }
            Show::Depth => {
                let depth = |p: &[f32; 4]| if p[3] > 0.0 { p[0] / p[3] } else { 0.0 };
                let farthest = self.image.pixels.iter().map(depth).fold(0.0, f32::max);
                for pixel in &mut self.image.pixels {
                    let share = depth(pixel) / farthest.max(f32::MIN_POSITIVE);
                    *pixel = [share, share, share, 1.0];
                }
            }
            Show::Colour | Show::Normal | Show::Id => {}
        }
        Ok(stats)
    }

    fn needs_depth(&self) -> bool {
        self.format == Format::Exr && self.args.show == Show::Colour
    }

    /// The limits that are left for drawing beside what takes `each` bytes a pixel.
    fn limits_beside(&self, camera: &Camera, each: u64) -> b2p::Result<Limits> {
        let [width, height] = camera.size();
        let pixels = u64::from(width) * u64::from(height);
        self.limits.check_pixels("pixels of the picture", pixels)?;
        let beside = pixels.saturating_mul(each).saturating_add(self.other_bytes);
        self.limits.check_bytes("bytes to draw the picture", beside)?;
        let left = self.limits.max_bytes - beside;
        Ok(self.limits.clone().with_max_bytes(left))
    }

    /// The number of the Gaussian plus one, its lowest eight bits in red, the next in green and in blue.
    fn draw_ids(&mut self, camera: &Camera) -> b2p::Result<Stats> {
        if self.gaussians.len() >= 1 << 24 {
            return Err(Error::Unsupported {
                what: "a picture of the numbers of 2^24 Gaussians or more",
                detail: format!("there are {}", self.gaussians.len()),
            });
        }
        let limits = self.limits_beside(camera, size_of::<[f32; 4]>() as u64)?;
        let stats = self.renderer.ids_into(self.gaussians, camera, &limits, &mut self.ids)?;
        let colour = |id: &u32| {
            let bytes = id.wrapping_add(1).to_le_bytes();
            let [r, g, b] = [0, 1, 2].map(|k| f32::from(bytes[k]) / 255.0);
            [r, g, b, 1.0]
        };
        (self.image.width, self.image.height) = (self.ids.width, self.ids.height);
        self.image.pixels.clear();
        self.image.pixels.extend(self.ids.indices.iter().map(colour));
        Ok(stats)
    }

    /// Writes the picture drawn last as a file. Of a video, one frame.
    pub fn write(&self, to: &mut dyn Write, path: &Path) -> b2p::Result<()> {
        match self.format {
            Format::Png => self.image.write_png(to, path),
            Format::Png16 => self.image.write_png16(to, path),
            Format::Ppm => self.image.write_ppm(to, path),
            Format::Y4m => self.image.write_y4m_frame(to, path),
            Format::Exr => {
                let distances = self.needs_depth().then_some(&self.distances[..]);
                self.image.write_exr(to, path, distances)
            }
        }
    }
}

/// The ending of a format's files.
pub fn ending(format: Format) -> &'static str {
    match format {
        Format::Png | Format::Png16 => "png",
        Format::Ppm => "ppm",
        Format::Y4m => "y4m",
        Format::Exr => "exr",
    }
}

/// The format asked for, or that the ending tells.
pub fn format_of(args: &Render, pictures: usize) -> Result<Format> {
    if let Some(format) = args.format {
        return Ok(format);
    }
    if manners::is_pipe(&args.output) {
        return Ok(if pictures == 1 { Format::Png } else { Format::Y4m });
    }
    let ending = args.output.extension().unwrap_or_default();
    match ending.to_string_lossy().to_lowercase().as_str() {
        "ppm" => Ok(Format::Ppm),
        "y4m" => Ok(Format::Y4m),
        "exr" => Ok(Format::Exr),
        "png" | "" => Ok(Format::Png),
        other => Err(Failure(format!(
            "{}: no pictures are written as .{other}, but as .png, .ppm, .exr and .y4m",
            args.output.display()
        ))),
    }
}
