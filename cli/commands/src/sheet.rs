//! `--contact-sheet`: all views in one picture, with their angles below them.

use b2p::renderer::Image;
use b2p::{Error, Limits};

use super::font::{CHARACTER, glyph};

/// Pixels between pictures, and around them.
const GAP: u32 = 8;

/// A picture that is filled view by view.
pub struct Sheet {
    pub image: Image,
    columns: u32,
    tile: [u32; 2],
    /// How much characters are enlarged.
    zoom: u32,
    ink: [f32; 4],
    filled: u32,
}

impl Sheet {
    /// An empty sheet for `count` pictures of one size.
    pub fn new(count: u32, [width, height]: [u32; 2], paper: [f32; 4], limits: &Limits) -> b2p::Result<Sheet> {
        let zoom = (width.min(height) / 160).max(1);
        let label = 2 * CHARACTER * zoom;
        let columns = columns(count, width, height + label);
        let rows = count.div_ceil(columns);
        let side = |n: u32, each: u64| u64::from(n) * each + u64::from(GAP) * (u64::from(n) + 1);
        let [across, down] = [
            side(columns, width.into()),
            side(rows, u64::from(height) + u64::from(label)),
        ];
        let pixels = across.saturating_mul(down);
        limits.check_pixels("pixels of the contact sheet", pixels)?;
        limits.check_bytes("bytes of the contact sheet", pixels * size_of::<[f32; 4]>() as u64)?;
        let mut empty = Vec::new();
        let reserved = empty.try_reserve_exact(pixels as usize);
        reserved.map_err(|_| Error::OutOfMemory {
            what: "the contact sheet",
            bytes: pixels * size_of::<[f32; 4]>() as u64,
        })?;
        empty.resize(pixels as usize, paper);
        // Dark on light paper, light on dark.
        let light = paper[0] + paper[1] + paper[2] > 1.5 || paper[3] < 0.5;
        let ink = if light { [0.0, 0.0, 0.0, 1.0] } else { [1.0; 4] };
        Ok(Sheet {
            image: Image {
                width: across as u32,
                height: down as u32,
                pixels: empty,
            },
            columns,
            tile: [width, height + label],
            zoom,
            ink,
            filled: 0,
        })
    }

    /// Adds the next picture, with its label below.
    pub fn add(&mut self, picture: &Image, label: &str) {
        let [column, row] = [self.filled % self.columns, self.filled / self.columns];
        let [left, top] = [GAP + column * (self.tile[0] + GAP), GAP + row * (self.tile[1] + GAP)];
        let across = self.image.width as usize;
        for y in 0..picture.height as usize {
            let from = &picture.pixels[y * picture.width as usize..][..picture.width as usize];
            let at = (top as usize + y) * across + left as usize;
            self.image.pixels[at..at + from.len()].copy_from_slice(from);
        }
        let room = (self.tile[0] / (CHARACTER * self.zoom)) as usize;
        let length = label.chars().count().min(room) as u32;
        let start = left + (self.tile[0] - length * CHARACTER * self.zoom) / 2;
        let line = top + picture.height + CHARACTER * self.zoom / 2;
        for (i, character) in label.chars().take(room).enumerate() {
            self.write(character, start + i as u32 * CHARACTER * self.zoom, line);
        }
        self.filled += 1;
    }

    fn write(&mut self, character: char, left: u32, top: u32) {
        let side = CHARACTER * self.zoom;
        let rows = glyph(character);
        for y in 0..side {
            for x in 0..side {
                let bits = rows[(y / self.zoom) as usize];
                if bits >> (x / self.zoom) & 1 == 1 {
                    let at = (top + y) as usize * self.image.width as usize + (left + x) as usize;
                    self.image.pixels[at] = self.ink;
                }
            }
        }
    }
}

/// How many tiles stand side by side, so that the sheet is about as wide as it is high.
fn columns(count: u32, width: u32, height: u32) -> u32 {
    let square = (f64::from(count) * f64::from(height) / f64::from(width)).sqrt();
    (square.round() as u32).clamp(1, count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_picture_is_on_the_sheet_where_it_belongs_with_ink_below_it() {
        let limits = Limits::default();
        let (paper, size) = ([1.0; 4], [200, 100]);
        let mut sheet = Sheet::new(5, size, paper, &limits).unwrap();
        for i in 0..5u8 {
            let colour = [f32::from(i) / 10.0, 0.5, 0.25, 1.0];
            let picture = Image {
                width: 200,
                height: 100,
                pixels: vec![colour; 200 * 100],
            };
            sheet.add(&picture, "45°");
        }
        let colours = |i: u8| {
            let red = f32::from(i) / 10.0;
            let pixels = sheet.image.pixels.iter();
            pixels.filter(|p| **p == [red, 0.5, 0.25, 1.0]).count()
        };
        assert!((0..5).all(|i| colours(i) == 200 * 100));
        let ink = sheet
            .image
            .pixels
            .iter()
            .filter(|p| **p == [0.0, 0.0, 0.0, 1.0])
            .count();
        assert!(ink > 5 * 20, "{ink}");
        let tight = limits.with_max_pixels(1000);
        assert!(Sheet::new(5, size, paper, &tight).is_err());
    }

    #[test]
    fn a_sheet_is_about_square() {
        assert_eq!(columns(8, 100, 100), 3);
        assert_eq!(columns(1, 100, 10), 1);
        assert_eq!(columns(12, 100, 300), 6);
    }
}
