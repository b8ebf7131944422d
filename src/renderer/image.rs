//! Pictures.

use std::io::Write;
use std::path::Path;

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;
use tiny_skia::{IntSize, Pixmap, PremultipliedColorU8};

use crate::error::{Error, Result};

/// Pixels of a plane of YUV4MPEG2 that are written at once, and that a task converts.
const PLANE_PART: usize = 1 << 17;
const PLANE_TASK: usize = 1 << 13;

/// A picture in floats: premultiplied red, green, blue, and alpha, row by row from the top left.
///
/// The colours are display-referred (sRGB) values, blended as they are; they may lie outside `[0, 1]` if Gaussians'
/// colours do.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Image {
    /// Pixels in a row, at least 1 once something is drawn.
    pub width: u32,
    /// Rows, at least 1 once something is drawn.
    pub height: u32,
    /// `width·height` pixels.
    pub pixels: Vec<[f32; 4]>,
}

/// Which Gaussian each pixel shows most of.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Ids {
    /// Pixels in a row, at least 1 once something is drawn.
    pub width: u32,
    /// Rows, at least 1 once something is drawn.
    pub height: u32,
    /// Row by row, the index of the Gaussian, [`u32::MAX`] where there is none.
    pub indices: Vec<u32>,
}

impl Image {
    /// The pixel in column `x` and row `y`.
    ///
    /// # Panics
    /// If there is none.
    pub fn pixel(&self, x: u32, y: u32) -> [f32; 4] {
        assert!(x < self.width, "column {x} of {}", self.width);
        self.pixels[y as usize * self.width as usize + x as usize]
    }

    /// Half the size: each pixel is the mean of 2×2. A last odd column or row is the mean of the pixels that there are.
    pub fn box_half(&self) -> Image {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut pixels = vec![[0.0; 4]; width as usize * height as usize];
        let rows = pixels.par_chunks_mut(width.max(1) as usize).enumerate();
        rows.with_min_len(8).for_each(|(y, row)| {
            for (pixel, from) in row.iter_mut().zip(quarters(self.width, self.height, y)) {
                let from = from.map(|i| self.pixels[i]);
                *pixel = std::array::from_fn(|k| 0.25 * ((from[0][k] + from[1][k]) + (from[2][k] + from[3][k])));
            }
        });
        Image { width, height, pixels }
    }

    /// Eight bits a channel, premultiplied: clamped (alpha to `[0, 1]`, colours to `[0, alpha]`), then rounded to the
    /// nearest.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if a side is 0 or a row longer than 2²⁹ pixels; never for a picture of a
    /// [`Renderer`](super::Renderer).
    #[doc(hidden)]
    pub fn to_pixmap(&self) -> Result<Pixmap> {
        let mut bytes = vec![0; self.pixels.len() * 4];
        bytes
            .par_chunks_exact_mut(4)
            .zip(self.pixels.par_iter())
            .with_min_len(1 << 14)
            .for_each(|(bytes, pixel)| bytes.copy_from_slice(&eight_bits(pixel)));
        pixmap(bytes, self.width, self.height)
    }

    /// A PNG file of eight bits a channel, with straight alpha.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the picture is too large for the format.
    pub fn to_png(&self) -> Result<Vec<u8>> {
        in_memory(|file| self.write_png(file, Path::new("")))
    }

    /// As [`Image::to_png`], row by row into `to`. `path` appears in error messages only.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the picture is too large for the format, [`Error::Io`] if `to` fails.
    pub fn write_png(&self, to: &mut dyn Write, path: &Path) -> Result<()> {
        self.stream_png(to, path, png::BitDepth::Eight, 4, |pixel, bytes| {
            let [r, g, b, a] = eight_bits(pixel);
            let straight = PremultipliedColorU8::from_rgba(r, g, b, a).map(|c| c.demultiply());
            let straight = straight.map_or([0; 4], |c| [c.red(), c.green(), c.blue(), c.alpha()]);
            bytes.copy_from_slice(&straight);
        })
    }
}

impl Image {
    /// A PNG file of 16 bits a channel, with straight alpha.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the picture is too large for the format.
    pub fn to_png16(&self) -> Result<Vec<u8>> {
        in_memory(|file| self.write_png16(file, Path::new("")))
    }

    /// As [`Image::to_png16`], row by row into `to`. `path` appears in error messages only.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if the picture is too large for the format, [`Error::Io`] if `to` fails.
    pub fn write_png16(&self, to: &mut dyn Write, path: &Path) -> Result<()> {
        self.stream_png(to, path, png::BitDepth::Sixteen, 8, |&[r, g, b, alpha], bytes| {
            let alpha = alpha.clamp(0.0, 1.0);
            let straight = [r, g, b].map(|c| if alpha > 0.0 { c / alpha } else { 0.0 });
            let values = [straight[0], straight[1], straight[2], alpha];
            for (bytes, value) in bytes.chunks_exact_mut(2).zip(values) {
                let value = (value.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16;
                bytes.copy_from_slice(&value.to_be_bytes());
            }
        })
    }

    /// Writes a PNG file whose pixels of `size` bytes `fill` makes.
    fn stream_png(
        &self,
        to: &mut dyn Write,
        path: &Path,
        depth: png::BitDepth,
        size: usize,
        fill: impl Fn(&[f32; 4], &mut [u8]),
    ) -> Result<()> {
        let failed = |error: png::EncodingError| match error {
            png::EncodingError::IoError(source) => io_error(path)(source),
            other => unsupported(format!("{}×{}: {other}", self.width, self.height)),
        };
        let mut encoder = png::Encoder::new(to, self.width, self.height);
        encoder.set_color(png::ColorType::Rgba);
        encoder.set_depth(depth);
        let mut writer = encoder.write_header().map_err(failed)?;
        let mut stream = writer.stream_writer().map_err(failed)?;
        let mut row = vec![0; self.width as usize * size];
        for pixels in self.pixels.chunks(self.width as usize) {
            for (pixel, bytes) in pixels.iter().zip(row.chunks_exact_mut(size)) {
                fill(pixel, bytes);
            }
            stream.write_all(&row).map_err(io_error(path))?;
        }
        stream.finish().map_err(failed)?;
        writer.finish().map_err(failed)
    }

    /// A binary PPM file: eight bits a channel, what is transparent over black.
    pub fn to_ppm(&self) -> Vec<u8> {
        let mut file = Vec::new();
        // A vector takes all.
        let _ = self.write_ppm(&mut file, Path::new(""));
        file
    }

    /// As [`Image::to_ppm`], row by row into `to`. `path` appears in error messages only.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails.
    pub fn write_ppm(&self, to: &mut dyn Write, path: &Path) -> Result<()> {
        let header = format!("P6\n{} {}\n255\n", self.width, self.height);
        to.write_all(header.as_bytes()).map_err(io_error(path))?;
        let byte = |value: f32| (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        let mut row = Vec::with_capacity(3 * self.width as usize);
        for pixels in self.pixels.chunks(self.width.max(1) as usize) {
            row.clear();
            row.extend(pixels.iter().flat_map(|[r, g, b, _]| [r, g, b].map(|c| byte(*c))));
            to.write_all(&row).map_err(io_error(path))?;
        }
        Ok(())
    }

    /// What a YUV4MPEG2 stream of pictures of this size begins with, at 30 pictures a second.
    #[doc(hidden)]
    pub fn y4m_header(&self) -> Vec<u8> {
        format!("YUV4MPEG2 W{} H{} F30:1 Ip A1:1 C444\n", self.width, self.height).into_bytes()
    }

    /// One picture of a YUV4MPEG2 stream: ITU-R BT.601, limited range, colour at full resolution; what is transparent
    /// over black.
    #[doc(hidden)]
    pub fn to_y4m_frame(&self) -> Vec<u8> {
        let mut file = Vec::new();
        // A vector takes all.
        let _ = self.write_y4m_frame(&mut file, Path::new(""));
        file
    }

    /// As [`Image::to_y4m_frame`], part by part into `to`. `path` appears in error messages only.
    ///
    /// # Errors
    /// [`Error::Io`] if `to` fails.
    #[doc(hidden)]
    pub fn write_y4m_frame(&self, to: &mut dyn Write, path: &Path) -> Result<()> {
        let rows = [
            [65.481, 128.553, 24.966, 16.0],
            [-37.797, -74.203, 112.0, 128.0],
            [112.0, -93.786, -18.214, 128.0],
        ];
        let isa = Isa::detect();
        to.write_all(b"FRAME\n").map_err(io_error(path))?;
        let mut plane = vec![0; self.pixels.len().min(PLANE_PART)];
        for row in rows {
            for pixels in self.pixels.chunks(PLANE_PART) {
                let plane = &mut plane[..pixels.len()];
                let tasks = plane.par_chunks_mut(PLANE_TASK).zip(pixels.par_chunks(PLANE_TASK));
                tasks.for_each(|(plane, pixels)| isa.run(PlaneTask { row, pixels, plane }));
                to.write_all(plane).map_err(io_error(path))?;
            }
        }
        Ok(())
    }
}

/// A part of a plane of YUV4MPEG2.
struct PlaneTask<'a> {
    /// Factors of red, green and blue, and what is added.
    row: [f32; 4],
    pixels: &'a [[f32; 4]],
    plane: &'a mut [u8],
}

impl Work for PlaneTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let [kr, kg, kb, offset] = self.row;
        for (value, [r, g, b, _]) in self.plane.iter_mut().zip(self.pixels) {
            let [r, g, b] = [r, g, b].map(|c| c.clamp(0.0, 1.0));
            *value = floor(kr * r + kg * g + kb * b + offset + 0.5);
        }
    }
}

/// The whole part of a number from 0 to 255; 0 for what is not a number. Compilers find the vectors in it, which they
/// do not in a conversion that saturates.
#[inline(always)]
fn floor(x: f32) -> u8 {
    /// The last bits of the sum with it are those of the nearest whole number.
    const WHOLE: f32 = (1u32 << 23) as f32;
    let nearest = x + WHOLE;
    let above = nearest - WHOLE > x;
    nearest.to_bits().wrapping_sub(u32::from(above)) as u8
}

/// Eight bits a channel, premultiplied.
fn eight_bits(&[r, g, b, alpha]: &[f32; 4]) -> [u8; 4] {
    let alpha = alpha.clamp(0.0, 1.0);
    [r, g, b, alpha].map(|value| (value.clamp(0.0, alpha) * 255.0 + 0.5) as u8)
}

fn in_memory(write: impl FnOnce(&mut Vec<u8>) -> Result<()>) -> Result<Vec<u8>> {
    let mut file = Vec::new();
    write(&mut file)?;
    Ok(file)
}

pub(super) fn io_error(path: &Path) -> impl Fn(std::io::Error) -> Error + '_ {
    |source| Error::Io {
        path: path.to_owned(),
        source,
    }
}

/// [`Image::box_half`] of eight-bit pixels: means rounded to the nearest, halves up.
///
/// # Errors
/// [`Error::Unsupported`] never for a pixmap of an [`Image`].
pub fn box_half(pixmap: &Pixmap) -> Result<Pixmap> {
    let (width, height) = (pixmap.width(), pixmap.height());
    let data = pixmap.data();
    let bytes = (0..height.div_ceil(2) as usize)
        .flat_map(|y| quarters(width, height, y))
        .flat_map(|from| -> [u8; 4] {
            std::array::from_fn(|k| {
                let sum: u16 = from.iter().map(|i| u16::from(data[4 * i + k])).sum();
                ((sum + 2) / 4) as u8
            })
        })
        .collect();
    self::pixmap(bytes, width.div_ceil(2), height.div_ceil(2))
}

/// For every pixel of row `y` of a picture of half the size, the four that it is the mean of; at an odd edge they repeat.
fn quarters(width: u32, height: u32, y: usize) -> impl Iterator<Item = [usize; 4]> {
    let (width, height) = (width as usize, height as usize);
    let rows = [2 * y * width, (2 * y + 1).min(height - 1) * width];
    (0..width).step_by(2).map(move |x| {
        let next = (x + 1).min(width - 1);
        [rows[0] + x, rows[0] + next, rows[1] + x, rows[1] + next]
    })
}

fn pixmap(bytes: Vec<u8>, width: u32, height: u32) -> Result<Pixmap> {
    IntSize::from_wh(width, height)
        .and_then(|size| Pixmap::from_vec(bytes, size))
        .ok_or_else(|| unsupported(format!("{width}×{height}")))
}

fn unsupported(detail: String) -> Error {
    Error::Unsupported {
        what: "an eight-bit picture of this size",
        detail,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, pixel: impl Fn(u32, u32) -> [f32; 4]) -> Image {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let pixels = pixels.map(|(x, y)| pixel(x, y)).collect();
        Image { width, height, pixels }
    }

    #[test]
    fn values_are_clamped_and_rounded_to_the_nearest() {
        let image = image(2, 1, |x, _| match x {
            0 => [100.49 / 255.0, 100.51 / 255.0, -3.0, 1.0],
            _ => [f32::NAN, 1e30, 0.5, 0.4],
        });
        let pixmap = image.to_pixmap().unwrap();
        assert_eq!(pixmap.data(), [100, 101, 0, 255, 0, 102, 102, 102]);
    }

    #[test]
    fn a_png_has_straight_alpha() {
        let image = image(3, 1, |x, _| match x {
            0 => [0.5, 0.25, 0.0, 0.5],
            1 => [0.0; 4],
            _ => [1.0, 0.5, 0.0, 1.0],
        });
        let png = image.to_png().unwrap();
        let straight = Pixmap::decode_png(&png).unwrap().take_demultiplied();
        assert_eq!(straight, [255, 128, 0, 128, 0, 0, 0, 0, 255, 128, 0, 255]);
    }

    #[test]
    fn sixteen_bits_keep_what_eight_lose() {
        let picture = image(2, 1, |x, _| match x {
            0 => [0.25, 0.5, 300.0 / 65535.0, 1.0],
            _ => [0.25, 0.5, 0.0, 0.5],
        });
        let file = picture.to_png16().unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        let mut bytes = [0; 16];
        reader.next_frame(&mut bytes).unwrap();
        let values: Vec<u16> = bytes.chunks(2).map(|b| u16::from_be_bytes([b[0], b[1]])).collect();
        assert_eq!(values, [16384, 32768, 300, 65535, 32768, 65535, 0, 32768]);
    }

    #[test]
    fn ppm_and_y4m_hold_the_colours_one_after_the_other_and_plane_by_plane() {
        let picture = image(2, 1, |x, _| [[1.0; 4], [1.0, 0.0, 0.0, 1.0]][x as usize]);
        assert_eq!(picture.to_ppm(), b"P6\n2 1\n255\n\xff\xff\xff\xff\0\0");
        assert!(picture.y4m_header().starts_with(b"YUV4MPEG2 W2 H1 "));
        let frame = picture.to_y4m_frame();
        assert_eq!(frame[6..], [235, 81, 128, 90, 128, 240]);
    }

    #[test]
    fn whole_parts_are_those_of_a_conversion() {
        let numbers = (0..=255u32 << 12).map(|i| i as f32 / 4096.0);
        let halves = (0..=255).flat_map(|i| [(i as f32).next_down().max(0.0), (i as f32 + 0.5).next_down()]);
        for x in numbers.chain(halves).chain([f32::NAN]) {
            assert_eq!(floor(x), x as u8, "{x}");
        }
    }

    #[test]
    fn halving_averages_two_by_two_and_keeps_odd_edges() {
        let image = image(3, 3, |x, y| [x as f32, y as f32, (x * y) as f32, 1.0]);
        let half = image.box_half();
        assert_eq!((half.width, half.height), (2, 2));
        let expected = [
            [0.5, 0.5, 0.25, 1.0],
            [2.0, 0.5, 1.0, 1.0],
            [0.5, 2.0, 1.0, 1.0],
            [2.0, 2.0, 4.0, 1.0],
        ];
        assert_eq!(half.pixels, expected);
    }

    #[test]
    fn halving_eight_bits_rounds_to_the_nearest() {
        let image = image(4, 2, |x, y| {
            let ink = if x < 2 { x + y > 1 } else { x + y > 2 };
            [f32::from(ink); 4]
        });
        let half = box_half(&image.to_pixmap().unwrap()).unwrap();
        // One of four: 63.75. Three of four … (2,0) is blank: 191.25.
        assert_eq!(half.data(), [64, 64, 64, 64, 191, 191, 191, 191]);
    }

    #[test]
    fn a_picture_of_one_pixel_can_be_halved() {
        let image = image(1, 1, |_, _| [0.25, 0.5, 0.75, 1.0]);
        assert_eq!(image.box_half(), image);
    }
}
