//! WebP pictures of RGBA pixels.

use std::io::Cursor;

use b2p::{Error, Limits, Result};
use image_webp::WebPDecoder;

use crate::splats::bytes::malformed;

/// Pictures that an archive may have, and the copy that the decoder holds of one: each may be as large as the largest.
const PICTURES: u64 = 8;
/// Most pixels along a side of a WebP picture.
const MOST: u32 = 16_383;

pub(super) struct Picture {
    pub name: String,
    pub width: u32,
    pub height: u32,
    pixels: Vec<[u8; 4]>,
}

impl Picture {
    pub fn read(name: &str, bytes: &[u8], limits: &Limits) -> Result<Self> {
        let damaged = |e: image_webp::DecodingError| malformed(name, "picture", e, "WebP");
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
        let (width, height) = decoder.dimensions();
        let size = PICTURES * 4 * u64::from(width) * u64::from(height);
        limits.check_bytes("bytes of the pictures of the archive", size)?;
        if decoder.is_animated() || decoder.is_lossy() {
            return Err(malformed(name, "picture", "lossy or animated", "lossless WebP"));
        }
        decoder.set_memory_limit(usize::try_from(limits.max_bytes).unwrap_or(usize::MAX));
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut raw = vec![0; width as usize * height as usize * channels];
        decoder.read_image(&mut raw).map_err(damaged)?;
        let pixel = |p: &[u8]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)];
        Ok(Picture {
            name: name.to_owned(),
            width,
            height,
            pixels: raw.chunks_exact(channels).map(pixel).collect(),
        })
    }

    /// Whether there is a pixel for each of `count` Gaussians.
    pub fn check_pixels(&self, count: u64) -> Result<()> {
        if (self.pixels.len() as u64) < count {
            let found = format!("{}×{}", self.width, self.height);
            return Err(malformed(
                &self.name,
                "size of the picture",
                found,
                format!("{count} pixels or more"),
            ));
        }
        Ok(())
    }

    /// Pixel `i`, in rows.
    pub fn pixel(&self, i: usize) -> [u8; 4] {
        self.pixels[i]
    }
}

/// Width and height of pictures with a pixel for each of `count` Gaussians: multiples of 4.
pub(super) fn size_of_pictures(count: usize) -> Result<(u32, u32)> {
    let width = ((count as f64).sqrt().ceil() as usize).div_ceil(4).max(1) * 4;
    let height = count.div_ceil(width).div_ceil(4).max(1) * 4;
    match (u32::try_from(width), u32::try_from(height)) {
        (Ok(width), Ok(height)) if width <= MOST && height <= MOST => Ok((width, height)),
        _ => Err(Error::Usage(format!(
            "{count} Gaussians are more than SOG's pictures have pixels"
        ))),
    }
}
