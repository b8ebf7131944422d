//! What a setting is expected to take, and how good its pictures are.

use b2p::gaussians::HeadSet;
use serde::{Deserialize, Serialize};

/// SSIMULACRA2 against the textured mesh by the evaluation protocol, of levels 0 to 3 above that of the cloud, with
/// each of [`HeadSet::ALL`]: means over a procedural still life and a person at 1 bit per point
/// (`docs/accuracy.md`). It does not depend on the machine, and orders settings; pictures of another cloud may be
/// better or worse.
const SCORES: [[f64; 3]; 4] = [
    [78.6, 77.1, 75.3],
    [70.3, 68.7, 67.0],
    [56.0, 53.9, 42.7],
    [27.9, 22.7, 7.2],
];
/// What each further level is taken to cost: about as much as those before it.
const STEP: f64 = 30.0;

/// How good pictures are: of a level so many above that of the cloud, with these heads.
pub fn score(above: u8, heads: HeadSet) -> f64 {
    let row = usize::from(above).min(SCORES.len() - 1);
    let further = usize::from(above) - row;
    let column = HeadSet::ALL.iter().position(|h| *h == heads).unwrap_or(2);
    SCORES[row][column] - STEP * further as f64
}

/// Nanoseconds by the number of voxels, in rising order of the latter.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Curve(pub Vec<[f64; 2]>);

impl Curve {
    /// Nanoseconds of so many voxels: interpolated between those that were measured, proportional above them, and below
    /// them as many as of the fewest.
    pub fn of(&self, voxels: f64) -> Option<f64> {
        let above = self.0.iter().position(|[n, _]| *n >= voxels);
        match above {
            None => self.0.last().map(|[n, time]| time * voxels / n.max(1.0)),
            Some(0) => Some(self.0[0][1]),
            Some(i) => {
                let [[n, t], [m, u]] = [self.0[i - 1], self.0[i]];
                Some(t + (u - t) * (voxels - n) / (m - n).max(1.0))
            }
        }
    }

    /// Adds what so many voxels took, if they are more than those before.
    pub fn push(&mut self, voxels: f64, time: f64) {
        if self.0.last().is_none_or(|[last, _]| *last < voxels) {
            self.0.push([voxels, time]);
        }
    }

    /// All its numbers.
    pub fn numbers(&self) -> impl Iterator<Item = f64> + '_ {
        self.0.as_flattened().iter().copied()
    }
}

/// What a picture costs in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureCost {
    /// For any.
    pub fixed: f64,
    /// For each Gaussian.
    pub per_gaussian: f64,
    /// For each pixel …
    pub per_pixel: f64,
    /// … and how much more if something is drawn on it.
    pub per_covered: f64,
}

/// A picture's size: pixels, and how many of them the surface takes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PictureSize {
    pub pixels: f64,
    pub covered: f64,
}

impl PictureSize {
    /// Of a surface of so many voxels of a level, where a cube-frame unit takes `per_unit` pixels: as if half of it
    /// were turned to the camera, never more than there is.
    pub fn of_surface(pixels: f64, per_unit: f64, voxels: f64, level: u8) -> Self {
        let voxel = 2.0 / f64::from(1u32 << level) * per_unit;
        PictureSize {
            pixels,
            covered: (0.5 * voxels * voxel * voxel).min(pixels),
        }
    }
}

impl PictureCost {
    /// From pictures of two sizes of as many Gaussians, and empty ones of the same sizes.
    pub fn from_times(gaussians: f64, sizes: [PictureSize; 2], times: [f64; 2], empty: [f64; 2]) -> PictureCost {
        let empty = [0, 1].map(|i| empty[i].min(times[i]));
        let more = (sizes[1].pixels - sizes[0].pixels).max(1.0);
        let per_pixel = ((empty[1] - empty[0]) / more).clamp(0.0, empty[0] / sizes[0].pixels.max(1.0));
        // At most `empty` is subtracted, but for rounding.
        let fixed = (empty[0] - per_pixel * sizes[0].pixels).max(0.0);
        let [few, many] = [0, 1].map(|i| (times[i] - fixed - per_pixel * sizes[i].pixels).max(0.0));
        let more = sizes[1].covered - sizes[0].covered;
        // No more than the smaller picture took, or its Gaussians would cost less than nothing.
        let most = few / sizes[0].covered.max(1.0);
        let per_covered = if more > 0.0 {
            ((many - few) / more).clamp(0.0, most)
        } else {
            0.0
        };
        PictureCost {
            fixed,
            // At most `few` is subtracted, but for rounding.
            per_gaussian: (few - per_covered * sizes[0].covered).max(0.0) / gaussians.max(1.0),
            per_pixel,
            per_covered,
        }
    }

    /// Nanoseconds of a picture of so many Gaussians.
    pub fn of(&self, gaussians: f64, size: PictureSize) -> f64 {
        self.fixed + self.per_gaussian * gaussians + self.per_pixel * size.pixels + self.per_covered * size.covered
    }

    /// All its numbers.
    pub fn numbers(&self) -> [f64; 4] {
        [self.fixed, self.per_gaussian, self.per_pixel, self.per_covered]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_costs_less_than_nothing_however_long_the_larger_picture_took() {
        for i in 1..1000 {
            let [covered, time] = [f64::from(i) * 7.3, 1e6 + f64::from(i) * 331.7];
            let sizes = [covered, 16.0 * covered].map(|covered| PictureSize {
                pixels: 2.0 * covered,
                covered,
            });
            let cost = PictureCost::from_times(1000.0, sizes, [time, 1000.0 * time], [0.0; 2]);
            assert!(
                cost.numbers().iter().all(|n| *n >= 0.0),
                "{cost:?} of {covered} pixels in {time} ns"
            );
        }
    }

    #[test]
    fn better_heads_look_better_on_any_level_and_a_finer_level_with_any_heads() {
        for above in 0..8 {
            let [best, quick, surfels] = HeadSet::ALL.map(|heads| score(above, heads));
            assert!(best > quick && quick > surfels, "{above}");
            assert!(surfels > score(above + 1, HeadSet::Best), "{above}");
        }
    }

    #[test]
    fn what_lies_between_measured_sizes_is_interpolated_and_what_lies_above_proportional() {
        let mut curve = Curve::default();
        assert_eq!(curve.of(5.0), None);
        curve.push(10.0, 100.0);
        curve.push(20.0, 400.0);
        curve.push(20.0, 9000.0);
        let at = |voxels| curve.of(voxels).unwrap();
        assert_eq!(
            [5.0, 10.0, 15.0, 20.0, 40.0].map(at),
            [100.0, 100.0, 250.0, 400.0, 800.0]
        );
    }

    #[test]
    fn pictures_cost_what_those_took_that_they_were_calibrated_with() {
        let cost = PictureCost {
            fixed: 700.0,
            per_gaussian: 2.0,
            per_pixel: 3.0,
            per_covered: 4.0,
        };
        let sizes = [100.0, 1000.0].map(|pixels| PictureSize {
            pixels,
            covered: pixels / 2.0,
        });
        let times = sizes.map(|size| cost.of(500.0, size));
        let empty = [1000.0, 3700.0];
        assert_eq!(PictureCost::from_times(500.0, sizes, times, empty), cost);
        // Whatever a busy machine measured, nothing costs less than nothing.
        for (times, empty) in [
            ([9.0, 1.0], [5.0; 2]),
            ([1.0, 9e9], [9.0, 0.0]),
            ([0.0, 0.0], [1e9, 1.0]),
        ] {
            let odd = PictureCost::from_times(500.0, sizes, times, empty);
            assert!(odd.numbers().iter().all(|n| *n >= 0.0), "{odd:?}");
        }
    }

    #[test]
    fn a_surface_takes_no_more_pixels_than_there_are() {
        let far = PictureSize::of_surface(10_000.0, 8.0, 1000.0, 4);
        assert_eq!(far.covered, 500.0);
        assert_eq!(PictureSize::of_surface(100.0, 8.0, 1000.0, 4).covered, 100.0);
    }
}
