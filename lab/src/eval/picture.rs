//! Eight-bit pictures, as metrics compare them.

use b2p::renderer::Image;

use crate::error::{LabError, Result};

/// An opaque 8-bit sRGB picture, row by row from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// `width · height` pixels.
    pub rgb: Vec<[u8; 3]>,
}

impl Picture {
    /// A picture of one colour.
    pub fn new(width: usize, height: usize, colour: [u8; 3]) -> Self {
        Picture {
            width,
            height,
            rgb: vec![colour; width * height],
        }
    }

    /// Rounds colours in `[0, 1]` to the nearest of 256 values; what lies outside is clamped.
    pub fn quantise(width: usize, height: usize, colours: impl Iterator<Item = [f32; 3]>) -> Self {
        let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let rgb: Vec<[u8; 3]> = colours.map(|c| c.map(byte)).collect();
        assert_eq!(rgb.len(), width * height, "a picture has all its pixels");
        Picture { width, height, rgb }
    }

    /// The picture's bytes, red green blue.
    pub fn bytes(&self) -> &[u8] {
        self.rgb.as_flattened()
    }

    /// As a PNG file.
    ///
    /// # Errors
    /// If a side is 0.
    pub fn to_png(&self) -> Result<Vec<u8>> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let (width, height) = (self.width as u32, self.height as u32);
        image::write_buffer_with_format(
            &mut bytes,
            self.bytes(),
            width,
            height,
            image::ExtendedColorType::Rgb8,
            image::ImageFormat::Png,
        )
        .map_err(|e| LabError::Usage(format!("a picture of {width}x{height}: {e}")))?;
        Ok(bytes.into_inner())
    }

    /// The pixel at column `x`, row `y`.
    pub fn at(&self, x: usize, y: usize) -> [u8; 3] {
        self.rgb[y * self.width + x]
    }
}

impl From<&Image> for Picture {
    /// An opaque picture of the renderer.
    fn from(image: &Image) -> Self {
        let colours = image.pixels.iter().map(|&[r, g, b, _]| [r, g, b]);
        Picture::quantise(image.width as usize, image.height as usize, colours)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_round_to_the_nearest_and_stay_in_range() {
        let colours = [[0.5 / 255.0, 1.49 / 255.0, -3.0], [2.0, 1.0, 0.999]];
        let picture = Picture::quantise(2, 1, colours.into_iter());
        assert_eq!(picture.rgb, [[1, 1, 0], [255, 255, 255]]);
        assert_eq!(picture.bytes()[3..], [255; 3]);
    }

    #[test]
    fn a_png_holds_the_same_pixels() {
        let mut picture = Picture::new(3, 2, [9, 8, 7]);
        picture.rgb[4] = [255, 0, 1];
        let read = image::load_from_memory(&picture.to_png().unwrap()).unwrap();
        assert_eq!(read.to_rgb8().as_raw(), picture.bytes());
        assert!(Picture::new(0, 0, [0; 3]).to_png().is_err());
    }
}
