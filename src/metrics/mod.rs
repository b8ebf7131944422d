//! How far pictures are apart.

use crate::renderer::Image;
use serde::Serialize;

mod machine;
mod spread;

#[doc(hidden)]
pub use b2p_kernels::give_back;
pub use machine::Machine;
pub use spread::{Spread, Verdict};

/// How far a picture is from what it should be: colours of pictures without transparency, in `[0, 1]`, not rounded to
/// eight bits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Distance {
    /// Mean of the squared differences over pixels and channels.
    pub mean_square: f64,
    /// Multi-scale structural similarity: 1 for equal pictures; none of pictures with a side of 160 pixels or less.
    pub ms_ssim: Option<f64>,
    /// The largest difference of a channel, in steps of eight bits.
    pub worst: f64,
    /// Column and row of the pixel that has it.
    pub at: [u32; 2],
}

impl Distance {
    /// Of `picture` from `truth`. Colours are clamped, as a screen does.
    ///
    /// # Panics
    /// If they differ in size, or are empty.
    pub fn between(truth: &Image, picture: &Image) -> Distance {
        let (mean_square, worst, at) = pixels_apart(truth, picture);
        let planes = |image: &Image, k: usize| Plane {
            width: image.width as usize,
            height: image.height as usize,
            values: image.pixels.iter().map(|p| 255.0 * shown(p[k])).collect(),
        };
        Distance {
            ms_ssim: ms_ssim([0, 1, 2].map(|k| [planes(truth, k), planes(picture, k)])),
            mean_square,
            worst,
            at,
        }
    }

    /// Peak signal-to-noise ratio in dB; infinite for equal pictures.
    pub fn psnr(&self) -> f64 {
        psnr(self.mean_square)
    }
}

/// Peak signal-to-noise ratio in dB of a mean squared difference of colours in `[0, 1]`.
pub fn psnr(mean_square: f64) -> f64 {
    -10.0 * mean_square.log10()
}

/// The mean square of the differences, the largest in steps of eight bits, and where that is.
pub fn pixels_apart(truth: &Image, picture: &Image) -> (f64, f64, [u32; 2]) {
    let size = |image: &Image| (image.width, image.height);
    assert_eq!(size(truth), size(picture), "pictures to compare are of one size");
    let (mut squares, mut worst, mut place) = (0.0, 0.0f32, 0);
    for (i, (a, b)) in truth.pixels.iter().zip(&picture.pixels).enumerate() {
        for k in 0..3 {
            let apart = (shown(a[k]) - shown(b[k])).abs();
            squares += f64::from(apart).powi(2);
            if apart > worst {
                (worst, place) = (apart, i);
            }
        }
    }
    let at = [place as u32 % truth.width, place as u32 / truth.width];
    let mean = squares / (3 * truth.pixels.len()) as f64;
    (mean, f64::from(worst) * 255.0, at)
}

/// What a screen shows of a value.
fn shown(value: f32) -> f32 {
    value.clamp(0.0, 1.0)
}

/// The picture at another size, each pixel interpolated between the four nearest: how a viewer shows a small picture
/// large.
pub fn resized(image: &Image, width: u32, height: u32) -> Image {
    // Left and right neighbour, and the weight of the right one, of every column (or row).
    let places = |from: u32, to: u32| -> Vec<(usize, usize, f32)> {
        let ratio = f64::from(from) / f64::from(to);
        let place = |i: u32| {
            let at = ((f64::from(i) + 0.5) * ratio - 0.5).clamp(0.0, f64::from(from - 1));
            let left = at.floor();
            let right = (left as usize + 1).min(from as usize - 1);
            (left as usize, right, (at - left) as f32)
        };
        (0..to).map(place).collect()
    };
    let columns = places(image.width, width);
    let row_of = |y: usize| &image.pixels[y * image.width as usize..][..image.width as usize];
    let mut pixels = Vec::with_capacity(columns.len() * height as usize);
    for (above, below, down) in places(image.height, height) {
        let (above, below) = (row_of(above), row_of(below));
        let between = |&(left, right, across): &(usize, usize, f32)| -> [f32; 4] {
            std::array::from_fn(|k| {
                let along = |row: &[[f32; 4]]| row[left][k] + across * (row[right][k] - row[left][k]);
                along(above) + down * (along(below) - along(above))
            })
        };
        pixels.extend(columns.iter().map(between));
    }
    Image { width, height, pixels }
}

/// Weights of the five scales of [`ms_ssim`], the finest first (Wang, Simoncelli and Bovik 2003).
const SCALES: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];
/// Half the taps of its window, without the middle one.
const REACH: usize = 5;

/// Multi-scale structural similarity of pairs of planes, one pair for each of three channels, and their mean: 1 for
/// equal pictures.
///
/// As the `pytorch_msssim` package computes it for a data range of 255: Gaussian window of 11 taps, σ 1.5, no padding;
/// K = 0.01, 0.03; means over 2×2 from scale to scale, with zeros around odd sides. None if a side is 160 pixels or
/// less.
///
/// # Panics
/// If a plane lacks values, or planes of a pair differ in size.
pub fn ms_ssim(channels: [[Plane; 2]; 3]) -> Option<f64> {
    let planes = channels.as_flattened();
    let side = planes.iter().map(|p| p.width.min(p.height)).min();
    if side <= Some((2 * REACH) << (SCALES.len() - 1)) {
        return None;
    }
    let of_channel = |[mut x, mut y]: [Plane; 2]| {
        let mut product = 1.0;
        for (scale, weight) in SCALES.iter().enumerate() {
            if scale > 0 {
                (x, y) = (x.half(), y.half());
            }
            let [ssim, contrast] = similarity(&x, &y);
            let last = scale + 1 == SCALES.len();
            product *= if last { ssim } else { contrast }.max(0.0).powf(*weight);
        }
        product
    };
    let [r, g, b] = channels;
    let (r, (g, b)) = rayon::join(|| of_channel(r), || rayon::join(|| of_channel(g), || of_channel(b)));
    Some((r + g + b) / 3.0)
}

/// Means of structural similarity and of its contrast and structure part over all whole windows.
fn similarity(x: &Plane, y: &Plane) -> [f64; 2] {
    const C1: f32 = (0.01 * 255.0) * (0.01 * 255.0);
    const C2: f32 = (0.03 * 255.0) * (0.03 * 255.0);
    let (mx, my) = (x.blur(), y.blur());
    let product = |a: &Plane, b: &Plane| {
        let values = a.values.iter().zip(&b.values).map(|(a, b)| a * b).collect();
        Plane { values, ..*a }.blur()
    };
    let (xx, yy, xy) = (product(x, x), product(y, y), product(x, y));
    let (mut ssim, mut contrast) = (0.0, 0.0);
    for i in 0..mx.values.len() {
        let (ux, uy) = (mx.values[i], my.values[i]);
        let variances = (xx.values[i] - ux * ux) + (yy.values[i] - uy * uy);
        let covariance = xy.values[i] - ux * uy;
        let structure = (2.0 * covariance + C2) / (variances + C2);
        contrast += f64::from(structure);
        ssim += f64::from((2.0 * ux * uy + C1) / (ux * ux + uy * uy + C1) * structure);
    }
    let count = mx.values.len() as f64;
    [ssim / count, contrast / count]
}

/// One channel of a picture.
pub struct Plane {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// `width · height` values from 0 to 255, row by row.
    pub values: Vec<f32>,
}

impl Plane {
    /// Convolved with the window; 10 less in each extent.
    fn blur(&self) -> Plane {
        let window = window();
        let (width, height) = (self.width - 2 * REACH, self.height - 2 * REACH);
        let mut down = vec![0.0; self.width * height];
        for (y, row) in down.chunks_exact_mut(self.width).enumerate() {
            for (k, w) in window.iter().enumerate() {
                let from = &self.values[(y + k) * self.width..][..self.width];
                row.iter_mut().zip(from).for_each(|(r, f)| *r += w * f);
            }
        }
        let mut values = vec![0.0; width * height];
        for (y, row) in values.chunks_exact_mut(width).enumerate() {
            for (k, w) in window.iter().enumerate() {
                let from = &down[y * self.width + k..][..width];
                row.iter_mut().zip(from).for_each(|(r, f)| *r += w * f);
            }
        }
        Plane { width, height, values }
    }

    /// Means over 2×2; an odd side gets a zero before its first and after its last pixel.
    fn half(&self) -> Plane {
        let (ox, oy) = (self.width % 2, self.height % 2);
        let (width, height) = ((self.width + 2 * ox) / 2, (self.height + 2 * oy) / 2);
        let at = |x: usize, y: usize| {
            if x < ox || y < oy || x - ox >= self.width || y - oy >= self.height {
                0.0
            } else {
                self.values[(y - oy) * self.width + x - ox]
            }
        };
        let mean = |x: usize, y: usize| {
            let (x, y) = (2 * x, 2 * y);
            0.25 * (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1))
        };
        let values = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .map(|(x, y)| mean(x, y))
            .collect();
        Plane { width, height, values }
    }
}

fn window() -> [f32; 2 * REACH + 1] {
    let bell: [f64; 2 * REACH + 1] = std::array::from_fn(|i| {
        let d = i as f64 - REACH as f64;
        (-d * d / (2.0 * 1.5 * 1.5)).exp()
    });
    let sum: f64 = bell.iter().sum();
    bell.map(|w| (w / sum) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, pixel: impl Fn(u32, u32) -> f32) -> Image {
        let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let pixels = places.map(|(x, y)| [pixel(x, y), 0.5, 0.0, 1.0]).collect();
        Image { width, height, pixels }
    }

    #[test]
    fn the_worst_pixel_is_found_and_the_mean_is_over_channels() {
        let truth = image(4, 3, |_, _| 0.25);
        let mut other = truth.clone();
        other.pixels[6][0] = 0.75;
        let distance = Distance::between(&truth, &other);
        assert_eq!(distance.at, [2, 1]);
        assert!((distance.worst - 127.5).abs() < 1e-9);
        assert!((distance.mean_square - 0.25 / 36.0).abs() < 1e-12);
        assert_eq!(distance.ms_ssim, None);
        assert_eq!(Distance::between(&truth, &truth).psnr(), f64::INFINITY);
    }

    #[test]
    fn what_a_screen_cannot_show_makes_no_difference() {
        let (a, b) = (image(2, 2, |_, _| 1.0), image(2, 2, |_, _| 7.0));
        assert_eq!(Distance::between(&a, &b).mean_square, 0.0);
    }

    #[test]
    fn enlarging_keeps_ramps_and_the_same_size_keeps_everything() {
        let ramp = image(8, 4, |x, y| 0.1 * x as f32 + 0.01 * y as f32);
        assert_eq!(resized(&ramp, 8, 4), ramp);
        let large = resized(&ramp, 16, 8);
        // Pixel 5 of 16 lies at 2.25 of 8, row 3 of 8 at 1.25 of 4.
        assert!((large.pixel(5, 3)[0] - 0.2375).abs() < 1e-6);
        assert_eq!(large.pixel(0, 0), ramp.pixel(0, 0));
    }

    #[test]
    fn a_large_picture_has_a_structural_similarity_that_falls_with_noise() {
        let truth = image(170, 165, |x, y| 0.5 + 0.4 * (0.3 * x as f32 + 0.1 * y as f32).sin());
        let noisy = |strength: f32| {
            let noise = |x: u32, y: u32| ((x * 7919 + y * 104_729) % 101) as f32 / 101.0 - 0.5;
            let mut noisy = truth.clone();
            for (i, pixel) in noisy.pixels.iter_mut().enumerate() {
                pixel[0] += strength * noise(i as u32 % 170, i as u32 / 170);
            }
            Distance::between(&truth, &noisy).ms_ssim.unwrap()
        };
        assert!((noisy(0.0) - 1.0).abs() < 1e-5);
        assert!(noisy(0.3) < noisy(0.1) && noisy(0.1) < 1.0);
    }
}
