//! What a picture shows, and the file that it becomes.

use std::path::Path;

use b2p::gaussians::Gaussians;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Channel, Ids, Image, Renderer, Stats};
use b2p::{Error, Limits};

use super::args::{Format, Render, Show};
use super::pipe::PIPE;
use super::{Failure, Result};

/// Draws pictures one after the other, with what else their files need.
pub struct Artist<'a> {
    pub renderer: Renderer,
    pub gaussians: &'a Gaussians,
    limits: &'a Limits,
    pub args: &'a Render,
    pub format: Format,
    pub image: Image,
    depth: Image,
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
            depth: Image::default(),
            ids: Ids::default(),
        }
    }

    /// Draws what is asked for.
    pub fn draw(&mut self, camera: &Camera) -> b2p::Result<Stats> {
        let (channel, background) = match self.args.show {
            Show::Colour => (Channel::Colour, self.args.view.background),
            Show::Depth => (Channel::Depth, Background::Transparent),
            Show::Normal => (Channel::Normal, Background::Transparent),
            Show::Alpha => (Channel::Colour, Background::Transparent),
            Show::Id => return self.draw_ids(camera),
        };
        let (gaussians, limits) = (self.gaussians, self.limits);
        let mut draw = |channel, background, image: &mut Image| {
            self.renderer
                .draw_into(gaussians, camera, channel, background, limits, image)
        };
        let stats = draw(channel, background, &mut self.image)?;
        if self.format == Format::Exr && self.args.show == Show::Colour {
            draw(Channel::Depth, Background::Transparent, &mut self.depth)?;
        }
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

    /// The number of the Gaussian plus one, its lowest eight bits in red, the next in green and in blue.
    fn draw_ids(&mut self, camera: &Camera) -> b2p::Result<Stats> {
        if self.gaussians.len() >= 1 << 24 {
            return Err(Error::Unsupported {
                what: "a picture of the numbers of 2^24 Gaussians or more",
                detail: format!("there are {}", self.gaussians.len()),
            });
        }
        let stats = self
            .renderer
            .ids_into(self.gaussians, camera, self.limits, &mut self.ids)?;
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

    /// The picture drawn last, as a file. Of a video, one frame.
    pub fn file(&self) -> b2p::Result<Vec<u8>> {
        match self.format {
            Format::Png => self.image.to_png(),
            Format::Png16 => self.image.to_png16(),
            Format::Ppm => Ok(self.image.to_ppm()),
            Format::Y4m => Ok(self.image.to_y4m_frame()),
            Format::Exr => {
                let depth = self.args.show == Show::Colour;
                Ok(self.image.to_exr(depth.then_some(&self.depth)))
            }
        }
    }
}

/// The format asked for, or that the ending tells.
pub fn format_of(args: &Render, pictures: usize) -> Result<Format> {
    if let Some(format) = args.format {
        return Ok(format);
    }
    if args.output == Path::new(PIPE) {
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
