//! What is wrong with the colours that heads generate for one cloud, fitted to pictures.
//!
//! Pictures are linear in the colours of Gaussians, so the weights of a [`ColourFilter`] that bring pictures of the
//! Gaussians nearest to pictures of the same Gaussians in the cloud's colours are a linear least-squares problem, with
//! an equation for each pixel inside the silhouette.

use rayon::prelude::*;

use crate::error::Result;
use crate::gaussians::Gaussians;
use crate::latents::{COLOUR_INPUTS as INPUTS, ColourFilter, Surroundings};
use crate::limits::Limits;
use crate::renderer::camera::Camera;
use crate::renderer::{Quality, Renderer};

/// Cameras, once around the cloud, from above and below by turns.
const VIEWS: usize = 3;
/// A pixel counts where the picture is as opaque as that.
const OPAQUE: f32 = 0.9;
/// Of the mean square of each input, added against inputs that go together.
const DAMPING: f64 = 1e-4;
/// The share of the latents' bytes that a decibel of what these pictures differ by is worth: from `lite-low` to `lite`
/// it takes 9 to 17 % more.
const DECIBEL: f64 = 0.12;

/// The filter that brings pictures of Gaussians nearest to those of the same Gaussians of the colours `wanted`, unless
/// it is not worth its bytes beside `latents` bytes of latents. A voxel of level `level` is about a pixel wide.
///
/// # Errors
/// Those of [`Renderer::render`].
pub(super) fn fit(
    gaussians: &Gaussians,
    surroundings: &Surroundings,
    wanted: &[[f32; 3]],
    level: u8,
    latents: usize,
) -> Result<Option<ColourFilter>> {
    let size = 1 << level.clamp(6, 10);
    let mut renderer = Renderer::default();
    renderer.set_quality(Quality::Fast);
    let colours = &gaussians.colour;
    let numbers = |i: usize| -> [f32; INPUTS + 3] {
        let mut numbers = [0.0; INPUTS + 3];
        numbers[..INPUTS].copy_from_slice(&surroundings.inputs(i, colours[i]));
        for (missing, (wanted, own)) in numbers[INPUTS..].iter_mut().zip(wanted[i].iter().zip(colours[i])) {
            *missing = wanted - own;
        }
        numbers
    };
    let (limits, mut pixels) = (Limits::unlimited(), Vec::new());
    let mut sums = Sums::default();
    for view in 0..VIEWS {
        let elevation = if view % 2 == 0 { 15.0 } else { -15.0 };
        let azimuth = 360.0 / VIEWS as f64 * (view as f64 + 0.5);
        let camera = Camera::orbit(azimuth, elevation, 3.0, 45.0, size, size)?;
        renderer.mix_into(gaussians, &camera, numbers, &limits, &mut pixels)?;
        sums.add(&pixels);
    }
    Ok(sums.solve(latents))
}

/// Of the equations' two sides: inputs by inputs, inputs by what they should give, and the squares of that.
#[derive(Clone, Default)]
struct Sums {
    inputs: [[f64; INPUTS]; INPUTS],
    wanted: [[f64; INPUTS]; 3],
    squares: f64,
    pixels: usize,
}

impl Sums {
    /// Adds the pixels of a view: the inputs, of which the first is the opacity, and what they are to give.
    fn add(&mut self, pixels: &[[f32; INPUTS + 3]]) {
        let part = |pixels: &[[f32; INPUTS + 3]]| {
            let mut sums = Sums::default();
            let opaque = pixels.iter().filter(|pixel| pixel[0] >= OPAQUE);
            opaque.for_each(|pixel| sums.add_pixel(pixel.map(f64::from)));
            sums
        };
        let parts: Vec<Sums> = pixels.par_chunks(PART).map(part).collect();
        parts.iter().for_each(|part| self.add_all(part));
    }

    fn add_pixel(&mut self, pixel: [f64; INPUTS + 3]) {
        self.pixels += 1;
        let inputs: &[f64; INPUTS] = pixel[..INPUTS].try_into().expect("the first of them");
        let missing = [0, 1, 2].map(|c| pixel[INPUTS + c]);
        for (sums, x) in self.inputs.iter_mut().zip(inputs) {
            for (sum, y) in sums.iter_mut().zip(inputs) {
                *sum += x * y;
            }
        }
        for (sums, y) in self.wanted.iter_mut().zip(missing) {
            for (sum, x) in sums.iter_mut().zip(inputs) {
                *sum += x * y;
            }
            self.squares += y * y;
        }
    }

    fn add_all(&mut self, other: &Sums) {
        let own = self.inputs.as_flattened_mut().iter_mut();
        own.zip(other.inputs.as_flattened()).for_each(|(a, b)| *a += b);
        let own = self.wanted.as_flattened_mut().iter_mut();
        own.zip(other.wanted.as_flattened()).for_each(|(a, b)| *a += b);
        self.squares += other.squares;
        self.pixels += other.pixels;
    }

    /// The filter, in steps of its weights, if it is worth its bytes.
    fn solve(&self, latents: usize) -> Option<ColourFilter> {
        let reals = self.wanted.map(|wanted| least_squares(&self.inputs, &wanted));
        let greatest = reals.iter().flat_map(|w| &w[1..]).fold(0.0, |m: f64, w| m.max(w.abs()));
        let exponent = (127.0 / greatest.max(1e-3)).log2().floor().clamp(0.0, 15.0) as u8;
        let step = |k| f64::from(ColourFilter::step(exponent, k));
        let mut weights = [[0i8; INPUTS]; 3];
        let mut left = self.squares;
        for (weights, (reals, wanted)) in weights.iter_mut().zip(reals.iter().zip(&self.wanted)) {
            let steps = |real: f64, k| (real / step(k)).round().clamp(-127.0, 127.0) as i8;
            for k in 1..INPUTS {
                weights[k] = steps(reals[k], k);
            }
            let real = |k: usize, weights: &[i8; INPUTS]| f64::from(weights[k]) * step(k);
            // The first again, now that the others are rounded.
            let others: f64 = (1..INPUTS).map(|k| self.inputs[0][k] * real(k, weights)).sum();
            weights[0] = steps((wanted[0] - others) / self.inputs[0][0].max(1e-9), 0);
            for (k, (row, wanted)) in self.inputs.iter().zip(wanted).enumerate() {
                let given = row.iter().enumerate().map(|(j, x)| x * real(j, weights));
                left += real(k, weights) * (given.sum::<f64>() - 2.0 * wanted);
            }
        }
        // As many weights as pixels would fit them whatever they are.
        let free = self.pixels.checked_sub(INPUTS + 1)?;
        let left = left * (self.pixels as f64 / (free + 1) as f64);
        let worth = worth([self.squares, left], CHUNK + 1 + 3 * INPUTS, latents);
        worth.then_some(ColourFilter { exponent, weights })
    }
}

/// Whether squares of what colours are off that become less, from the first to the second, are worth so many `bytes`
/// beside `latents` bytes of latents.
pub(super) fn worth([before, after]: [f64; 2], bytes: usize, latents: usize) -> bool {
    let gain = 10.0 * (before / after.max(1e-9)).log10();
    gain * DECIBEL * latents as f64 > bytes as f64
}

/// Pixels of a task.
const PART: usize = 1024;
/// Bytes of a chunk around its payload.
pub(super) const CHUNK: usize = 16;

/// The damped solution of `gram · x = wanted`, by Cholesky's method; 0 for inputs that are never there.
fn least_squares(gram: &[[f64; INPUTS]; INPUTS], wanted: &[f64; INPUTS]) -> [f64; INPUTS] {
    let scale: [f64; INPUTS] = std::array::from_fn(|k| {
        let square = gram[k][k];
        if square > 0.0 { square.sqrt().recip() } else { 0.0 }
    });
    let mut lower = [[0.0; INPUTS]; INPUTS];
    for i in 0..INPUTS {
        for j in 0..=i {
            let own = if i == j {
                DAMPING + f64::from(u8::from(scale[i] == 0.0))
            } else {
                0.0
            };
            let known: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let left = gram[i][j] * scale[i] * scale[j] + own - known;
            lower[i][j] = if i == j {
                left.max(DAMPING / 2.0).sqrt()
            } else {
                left / lower[j][j]
            };
        }
    }
    let mut x: [f64; INPUTS] = std::array::from_fn(|k| wanted[k] * scale[k]);
    for i in 0..INPUTS {
        let known: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (x[i] - known) / lower[i][i];
    }
    for i in (0..INPUTS).rev() {
        let known: f64 = (i + 1..INPUTS).map(|k| lower[k][i] * x[k]).sum();
        x[i] = (x[i] - known) / lower[i][i];
    }
    std::array::from_fn(|k| x[k] * scale[k])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels, morton};

    /// Eight balls for every voxel of a disc across the cube, of smooth colours, and what surrounds them.
    fn scene() -> (Gaussians, Surroundings) {
        let at = (0..1024u32).map(|i| [i % 32, i / 32, 16]);
        let voxels = Voxels::new(5, at.map(morton::encode).collect());
        let octree = Octree::new(voxels).unwrap();
        let voxels = octree.level(5);
        let mut gaussians = Gaussians::default();
        for i in 0..8 * voxels.len() {
            let parent = voxels.coordinate(i / 8);
            let at: [f32; 3] = std::array::from_fn(|k| {
                let child = 2 * parent[k] + (i as u32 >> k & 1);
                (child as f32 + 0.5) / 32.0 - 1.0
            });
            gaussians.position.push(at);
            gaussians.scale.push([1.0 / 64.0; 3]);
            gaussians.rotation.push([1.0, 0.0, 0.0, 0.0]);
            gaussians.opacity.push(1.0);
            let wave = |k: f32| 0.5 + 0.3 * (at[0] * k + at[1] * 7.0).sin();
            gaussians.colour.push([wave(5.0), wave(9.0), wave(13.0)]);
        }
        let map = octree.kernel_map(5);
        let around = Surroundings::of_level(&gaussians, &octree, 5, &map, None);
        (gaussians, around)
    }

    #[test]
    fn a_decibel_is_worth_its_share_of_the_latents() {
        let halved = [2.0, 1.0];
        assert!(worth(halved, 36, 100) && !worth(halved, 37, 100));
        assert!(!worth([1.0, 1.0], 1, 1000) && !worth([0.0, 0.0], 1, 1000));
    }

    #[test]
    fn a_filter_that_was_applied_is_found_again() {
        let (gaussians, around) = scene();
        let mut applied = ColourFilter {
            exponent: 7,
            weights: [[0; INPUTS]; 3],
        };
        applied.weights[0][0] = 40;
        applied.weights[1][3] = -30;
        applied.weights[2][4] = 50;
        applied.weights[2][12] = 25;
        let mut wanted = gaussians.clone();
        applied.apply(&mut wanted, &around);
        let off = |colours: &[[f32; 3]]| {
            let pairs = colours.iter().flatten().zip(wanted.colour.iter().flatten());
            pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        };
        let found = fit(&gaussians, &around, &wanted.colour, 6, 1 << 20).unwrap();
        let mut corrected = gaussians.clone();
        found.unwrap().apply(&mut corrected, &around);
        let (before, after) = (off(&gaussians.colour), off(&corrected.colour));
        assert!(after < before / 300.0, "{before} to {after}");
    }

    #[test]
    fn right_colours_have_no_filter_and_few_latents_do_not_pay_for_one() {
        let (gaussians, around) = scene();
        let colours = gaussians.colour.clone();
        let none = fit(&gaussians, &around, &colours, 6, 1 << 20).unwrap();
        assert_eq!(none, None);
        let wanted: Vec<_> = colours.iter().map(|c| c.map(|x| x * 0.9)).collect();
        let few = fit(&gaussians, &around, &wanted, 6, 8).unwrap();
        assert_eq!(few, None);
        let many = fit(&gaussians, &around, &wanted, 6, 1 << 20).unwrap();
        assert!(many.is_some());
    }

    #[test]
    fn a_few_pixels_of_any_colours_do_not_make_a_filter() {
        let at = [[3, 3, 3], [4, 3, 3], [3, 4, 3], [4, 4, 4]];
        let mut keys = at.map(morton::encode);
        keys.sort();
        let octree = Octree::new(Voxels::new(5, keys.to_vec())).unwrap();
        let (some, _) = scene();
        let of = |i: usize| (i as f32 * 0.7).sin().abs();
        let few = Gaussians {
            position: some.position[..32].to_vec(),
            scale: some.scale[..32].to_vec(),
            rotation: some.rotation[..32].to_vec(),
            opacity: some.opacity[..32].to_vec(),
            colour: (0..32).map(|i| [of(i), of(2 * i), of(3 * i)]).collect(),
            ..Gaussians::default()
        };
        let around = Surroundings::of_level(&few, &octree, 5, &octree.kernel_map(5), None);
        let wanted: Vec<_> = (0..32).map(|i| [of(5 * i), of(7 * i), of(9 * i)]).collect();
        assert_eq!(fit(&few, &around, &wanted, 6, 1 << 8).unwrap(), None);
    }

    #[test]
    fn nothing_in_sight_gives_no_filter() {
        let (mut gaussians, around) = scene();
        gaussians.opacity.fill(0.0);
        let wanted = vec![[0.0; 3]; gaussians.len()];
        assert_eq!(fit(&gaussians, &around, &wanted, 6, 1 << 20).unwrap(), None);
    }

    #[test]
    fn the_same_filter_is_found_with_any_number_of_threads() {
        let (gaussians, around) = scene();
        let wanted: Vec<_> = gaussians.colour.iter().map(|c| c.map(|x| x * x)).collect();
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let find = || fit(&gaussians, &around, &wanted, 6, 1 << 20);
            pool.build().unwrap().install(find).unwrap()
        };
        assert_eq!(with(1), with(3));
        assert!(with(1).is_some());
    }
}
