//! How far a picture is from the truth.

use b2p::metrics::Plane;
use fast_ssim2::{PixelDescriptor, PixelSlice, Ssimulacra2Error, Ssimulacra2Reference};

use super::picture::Picture;

/// Peak signal-to-noise ratio in dB over all pixels and the three channels; infinite for equal pictures.
///
/// # Panics
/// If the pictures differ in size.
pub fn psnr(a: &Picture, b: &Picture) -> f64 {
    decibel(a, b, |_| true)
}

/// [`psnr`] over the pixels of a mask alone; infinite if there are none.
///
/// # Panics
/// If the pictures and the mask differ in size.
pub fn masked_psnr(a: &Picture, b: &Picture, mask: &[bool]) -> f64 {
    assert_eq!(a.rgb.len(), mask.len(), "a mask has a picture's pixels");
    decibel(a, b, |i| mask[i])
}

fn decibel(a: &Picture, b: &Picture, counts: impl Fn(usize) -> bool) -> f64 {
    assert_same_size(a, b);
    let (mut sum, mut count) = (0u64, 0u64);
    for (i, (p, q)) in a.rgb.iter().zip(&b.rgb).enumerate() {
        if counts(i) {
            let square = |k: usize| u64::from(p[k].abs_diff(q[k])).pow(2);
            sum += square(0) + square(1) + square(2);
            count += 3;
        }
    }
    if sum == 0 {
        return f64::INFINITY;
    }
    10.0 * (255.0 * 255.0 * count as f64 / sum as f64).log10()
}

fn assert_same_size(a: &Picture, b: &Picture) {
    assert_eq!(
        (a.width, a.height),
        (b.width, b.height),
        "pictures to compare are of one size"
    );
}

/// Multi-scale structural similarity: see [`b2p::metrics::ms_ssim`]. None if a side is 160 pixels or less.
///
/// # Panics
/// If the pictures differ in size.
pub fn ms_ssim(a: &Picture, b: &Picture) -> Option<f64> {
    assert_same_size(a, b);
    let plane = |p: &Picture, k: usize| Plane {
        width: p.width,
        height: p.height,
        values: p.rgb.iter().map(|c| f32::from(c[k])).collect(),
    };
    b2p::metrics::ms_ssim([0, 1, 2].map(|k| [plane(a, k), plane(b, k)]))
}

/// The truth, prepared for SSIMULACRA2.
pub struct Ssimulacra2(Ssimulacra2Reference);

impl Ssimulacra2 {
    /// Prepares the picture that others will be compared to.
    ///
    /// # Errors
    /// If the picture is too small for the metric.
    pub fn new(truth: &Picture) -> Result<Self, Ssimulacra2Error> {
        Ssimulacra2Reference::new(&slice(truth)?).map(Ssimulacra2)
    }

    /// The score: 100 for equal pictures, 90 hardly to be told apart, 50 middling, below 0 very bad.
    ///
    /// # Errors
    /// If the picture is of another size.
    pub fn score(&self, picture: &Picture) -> Result<f64, Ssimulacra2Error> {
        self.0.compare(&slice(picture)?)
    }
}

fn slice(picture: &Picture) -> Result<PixelSlice<'_>, Ssimulacra2Error> {
    let (width, height) = (picture.width as u32, picture.height as u32);
    let format = PixelDescriptor::RGB8_SRGB;
    PixelSlice::new(picture.bytes(), width, height, picture.width * 3, format)
        .map_err(|_| Ssimulacra2Error::InvalidImageSize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::procedural::rng::Rng;

    fn noisy(width: usize, height: usize, base: &Picture, strength: f32, seed: u64) -> Picture {
        let mut rng = Rng::new(seed);
        let colours = base
            .rgb
            .iter()
            .map(|c| c.map(|v| (f32::from(v) + rng.range(-strength, strength)) / 255.0));
        Picture::quantise(width, height, colours)
    }

    /// Stripes and gradients.
    fn scene(width: usize, height: usize) -> Picture {
        let colours = (0..width * height).map(|i| {
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            let wave = |f: f32| 0.5 + 0.4 * (x * f + y * 0.07).sin();
            [wave(0.3), wave(0.11), y / height as f32]
        });
        Picture::quantise(width, height, colours)
    }

    #[test]
    fn a_difference_of_one_everywhere_is_48_db() {
        let (a, b) = (Picture::new(8, 8, [100; 3]), Picture::new(8, 8, [101; 3]));
        assert!((psnr(&a, &b) - 20.0 * 255f64.log10()).abs() < 1e-9);
        assert_eq!(psnr(&a, &a), f64::INFINITY);
    }

    #[test]
    fn a_mask_hides_what_is_outside() {
        let a = Picture::new(4, 1, [10; 3]);
        let mut b = a.clone();
        b.rgb[0] = [250; 3];
        b.rgb[1] = [10, 20, 10];
        let inside = masked_psnr(&a, &b, &[false, true, true, false]);
        assert!((inside - 10.0 * (255f64 * 255.0 * 6.0 / 100.0).log10()).abs() < 1e-9);
    }

    #[test]
    fn ms_ssim_is_1_for_equal_pictures_symmetric_and_falls_with_noise() {
        let truth = scene(200, 170);
        let (little, much) = (noisy(200, 170, &truth, 8.0, 1), noisy(200, 170, &truth, 60.0, 1));
        let score = |p: &Picture| ms_ssim(&truth, p).unwrap();
        assert!((score(&truth) - 1.0).abs() < 1e-5);
        assert!((score(&little) - ms_ssim(&little, &truth).unwrap()).abs() < 1e-6);
        assert!(score(&much) < score(&little) && score(&little) < 1.0);
    }

    #[test]
    fn ms_ssim_of_a_constant_shift_is_that_of_the_means_at_the_coarsest_scale() {
        let (a, b) = (Picture::new(176, 176, [100; 3]), Picture::new(176, 176, [120; 3]));
        let c1 = 2.55f64 * 2.55;
        let means = (2.0 * 100.0 * 120.0 + c1) / (100.0 * 100.0 + 120.0 * 120.0 + c1);
        assert!((ms_ssim(&a, &b).unwrap() - means.powf(0.1333)).abs() < 1e-4);
    }

    #[test]
    fn ms_ssim_is_what_pytorch_msssim_computes() {
        let (width, height) = (203, 170);
        let places = || (0..width * height).map(|i| (i % width, i / width));
        let ramp = |x: usize, y: usize, k: usize| (x * (3 + k) + y * (5 - k)) / 4 % 256;
        let tiled = |x, y, k| ramp(x, y, k) * 7 / 8 + 16 * ((x / 8 + y / 8) % 2);
        let picture = |f: &dyn Fn(usize, usize, usize) -> usize| Picture {
            width,
            height,
            rgb: places().map(|(x, y)| [0, 1, 2].map(|k| f(x, y, k) as u8)).collect(),
        };
        let score = ms_ssim(&picture(&ramp), &picture(&tiled)).unwrap();
        assert!((score - 0.855834).abs() < 1e-5, "{score}");
    }

    #[test]
    fn ms_ssim_needs_more_than_160_pixels_a_side() {
        let small = Picture::new(160, 400, [0; 3]);
        assert_eq!(ms_ssim(&small, &small), None);
        let enough = Picture::new(161, 163, [0; 3]);
        assert!(ms_ssim(&enough, &enough).is_some());
    }

    #[test]
    fn ssimulacra2_is_100_for_equal_pictures_and_falls_with_noise() {
        let truth = scene(64, 64);
        let reference = Ssimulacra2::new(&truth).unwrap();
        let score = |p: &Picture| reference.score(p).unwrap();
        assert_eq!(score(&truth), 100.0);
        let (little, much) = (noisy(64, 64, &truth, 8.0, 2), noisy(64, 64, &truth, 60.0, 2));
        assert!(score(&much) < score(&little) && score(&little) < 100.0);
        assert!(reference.score(&scene(64, 65)).is_err());
    }
}
