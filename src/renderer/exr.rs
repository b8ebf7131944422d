//! OpenEXR files: one part of scan lines, 32-bit floats, not compressed (openexr.com, "OpenEXR File Layout").

use std::io::Write;
use std::path::Path;

use super::Image;
use super::image::io_error;
use crate::error::Result;

const MAGIC: u32 = 20_000_630;
/// Version 2, no flags: scan lines, names of up to 31 bytes.
const VERSION: u32 = 2;
/// 32-bit floats, among the types of channels.
const FLOAT: u32 = 2;

impl Image {
    /// An OpenEXR file: linear light premultiplied by alpha in R, G, B, and A; with `depth`, a picture of the same size
    /// drawn of [`Channel::Depth`](super::Channel::Depth) on nothing, distances along the viewing direction in Z, ∞
    /// where nothing is.
    ///
    /// # Panics
    /// If the pictures differ in size.
    pub fn to_exr(&self, depth: Option<&Image>) -> Vec<u8> {
        let distances = depth.map(Image::distances);
        let mut file = Vec::new();
        // A vector takes all.
        let _ = self.write_exr(&mut file, Path::new(""), distances.as_deref());
        file
    }

    /// Of a picture drawn of [`Channel::Depth`](super::Channel::Depth) on nothing: the distance of each pixel, ∞ where
    /// nothing is.
    pub fn distances(&self) -> Vec<f32> {
        let distance = |[z, _, _, alpha]: &[f32; 4]| if *alpha > 0.0 { z / alpha } else { f32::INFINITY };
        self.pixels.iter().map(distance).collect()
    }

    /// As [`Image::to_exr`], row by row into `to`, with the distances of the pixels. `path` appears in error messages
    /// only.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails.
    ///
    /// # Panics
    /// If there are fewer distances than pixels.
    pub fn write_exr(&self, to: &mut dyn Write, path: &Path, distances: Option<&[f32]>) -> Result<()> {
        let names: &[u8] = match distances {
            Some(_) => b"ABGRZ",
            None => b"ABGR",
        };
        let mut file = header(self.width, self.height, names);
        let (width, height) = (self.width as usize, self.height as usize);
        let line = width * names.len() * size_of::<f32>();
        // Before its samples, each line tells its row and its length.
        let start = file.len() + height * size_of::<u64>();
        for y in 0..height {
            file.extend(((start + y * (8 + line)) as u64).to_le_bytes());
        }
        to.write_all(&file).map_err(io_error(path))?;
        for y in 0..height {
            file.clear();
            file.extend((y as u32).to_le_bytes());
            file.extend((line as u32).to_le_bytes());
            let row = y * width..(y + 1) * width;
            let pixels = &self.pixels[row.clone()];
            for k in [3, 2, 1, 0] {
                let values = pixels.iter().map(|p| linear(p)[k]);
                file.extend(values.flat_map(f32::to_le_bytes));
            }
            if let Some(distances) = distances {
                file.extend(distances[row].iter().flat_map(|z| z.to_le_bytes()));
            }
            to.write_all(&file).map_err(io_error(path))?;
        }
        Ok(())
    }
}

/// Display-referred to linear light (IEC 61966-2-1), on colours that are not premultiplied; alpha stays.
fn linear([r, g, b, alpha]: &[f32; 4]) -> [f32; 4] {
    let light = |c: f32| {
        if *alpha <= 0.0 {
            return 0.0;
        }
        let c = c / alpha;
        let size = c.abs();
        let light = if size <= 0.040_45 {
            size / 12.92
        } else {
            ((size + 0.055) / 1.055).powf(2.4)
        };
        light.copysign(c) * alpha
    };
    [light(*r), light(*g), light(*b), *alpha]
}

fn header(width: u32, height: u32, names: &[u8]) -> Vec<u8> {
    let mut file = [MAGIC, VERSION].map(u32::to_le_bytes).concat();
    let mut attribute = |name: &str, kind: &str, value: &[u8]| {
        for text in [name, kind] {
            file.extend(text.as_bytes());
            file.push(0);
        }
        file.extend((value.len() as u32).to_le_bytes());
        file.extend(value);
    };
    let mut channels = Vec::new();
    for &name in names {
        channels.extend([name, 0]);
        // Type, linearity and padding, steps along x and y.
        channels.extend([FLOAT, 0, 1, 1].map(u32::to_le_bytes).concat());
    }
    channels.push(0);
    let window = [0, 0, width - 1, height - 1].map(u32::to_le_bytes).concat();
    attribute("channels", "chlist", &channels);
    attribute("compression", "compression", &[0]);
    attribute("dataWindow", "box2i", &window);
    attribute("displayWindow", "box2i", &window);
    attribute("lineOrder", "lineOrder", &[0]);
    attribute("pixelAspectRatio", "float", &1f32.to_le_bytes());
    attribute("screenWindowCenter", "v2f", &[0; 8]);
    attribute("screenWindowWidth", "float", &1f32.to_le_bytes());
    file.push(0);
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_says_where_each_line_is_and_holds_linear_light_and_distances() {
        let pixels = vec![[0.5, 1.0, 0.0, 1.0], [0.25, 0.0, 0.0, 0.5], [0.0; 4]];
        let image = Image {
            width: 1,
            height: 3,
            pixels,
        };
        let depth = Image {
            pixels: vec![[2.0, 2.0, 2.0, 1.0], [1.5, 1.5, 1.5, 0.5], [0.0; 4]],
            ..image.clone()
        };
        let file = image.to_exr(Some(&depth));
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
        assert_eq!([word(0), word(4)], [MAGIC, VERSION]);
        let line = 8 + 5 * 4;
        let table = file.len() - 3 * (8 + line);
        // 0.5 of the display is 0.214 of the light, also under half a cover.
        let light = 0.214_041_14;
        let expected = [
            [1.0, 0.0, 1.0, light, 2.0],
            [0.5, 0.0, 0.0, 0.5 * light, 3.0],
            [0.0, 0.0, 0.0, 0.0, f32::INFINITY],
        ];
        for (y, expected) in expected.into_iter().enumerate() {
            let at = word(table + 8 * y) as usize;
            assert_eq!(at, file.len() - (3 - y) * line);
            assert_eq!([word(at), word(at + 4)], [y as u32, 20]);
            for (k, expected) in expected.into_iter().enumerate() {
                let found = f32::from_bits(word(at + 8 + 4 * k));
                assert!(found == expected || (found - expected).abs() < 1e-6, "{y} {k}: {found}");
            }
        }
    }
}
