//! How much colours differ by chance between two samplings of one surface.

use rayon::prelude::*;

use super::choice::in_255ths;
use crate::cloud::ColouredVoxels;
use crate::colour::{Ycc, from_rgb};
use crate::geometry::{Octree, Voxels};

/// Colours of the cloud's voxels in a voxel of a coarser level.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sampled {
    /// How many there are.
    pub count: f32,
    /// Sum of their squared differences from their mean, in squared 255ths.
    pub squares: f32,
}

/// What the colours of several voxels, of samples of one surface, tell of their errors.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Chance {
    voxels: f32,
    /// Of how many differences the squares are.
    free: f32,
    squares: f32,
    /// Sum of the inverses of the counts.
    inverses: f32,
}

impl Chance {
    pub fn add(&mut self, sampled: Sampled) {
        self.voxels += 1.0;
        self.free += (sampled.count - 1.0).max(0.0);
        self.squares += sampled.squares;
        self.inverses += 1.0 / sampled.count.max(1.0);
    }

    /// The squared standard error of a voxel's mean colour: what another sampling of the same surface would change. 0 if
    /// it cannot be told.
    pub fn squared_error(&self) -> f32 {
        let variance = self.squares / self.free.max(1.0);
        variance * self.inverses / self.voxels.max(1.0)
    }
}

/// The samples in every voxel of level `top`.
pub(super) fn samples(cloud: &ColouredVoxels, octree: &Octree, top: u8) -> Vec<Sampled> {
    let shift = 3 * (cloud.voxels.depth() - top);
    let keys = octree.level(top).keys().par_iter();
    keys.map(|key| in_voxel(&cloud.voxels, &cloud.colours, shift, *key))
        .collect()
}

fn in_voxel(voxels: &Voxels, colours: &[[u8; 3]], shift: u8, key: u64) -> Sampled {
    let (mut count, mut sums, mut squares) = (0.0f32, [0.0f32; 3], 0.0f32);
    for colour in &colours[voxels.within(key, shift)] {
        let colour: Ycc = from_rgb(colour.map(i32::from)).map(|x| x as i16);
        let colour = in_255ths(colour.map(f32::from));
        count += 1.0;
        for (sum, x) in sums.iter_mut().zip(colour) {
            *sum += x;
            squares += x * x;
        }
    }
    let of_mean = sums.iter().map(|sum| sum * sum / count.max(1.0)).sum::<f32>();
    Sampled {
        count,
        squares: (squares - of_mean).max(0.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Placement;

    /// The error of a square of 16×16 voxels of level 5, of which some are missing, in the colours that `shade` gives.
    fn error(shade: impl Fn(u64) -> u8) -> f32 {
        let keys: Vec<u64> = (0..1 << 12)
            .filter(|key| key & 0b1001_0010_0100 == 0 && !random(*key).is_multiple_of(4))
            .collect();
        let cloud = ColouredVoxels {
            colours: keys.iter().map(|key| [shade(*key); 3]).collect(),
            voxels: Voxels::new(5, keys),
            placement: Placement::VOXEL_GRID,
        };
        let octree = Octree::new(Voxels::new(4, cloud.voxels.keys().iter().map(|key| key >> 3).collect())).unwrap();
        let mut chance = Chance::default();
        samples(&cloud, &octree, 4)
            .into_iter()
            .for_each(|voxel| chance.add(voxel));
        chance.squared_error()
    }

    fn random(number: u64) -> u64 {
        let x = (number + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40
    }

    #[test]
    fn even_colours_have_no_error_and_random_ones_that_of_their_mean() {
        assert_eq!(error(|_| 77), 0.0);
        // From 0 to 63: a variance of 63·65/12. Of one to four voxels, three on average, the inverses' mean is 0.39.
        let found = error(|key| (random(key + 5000) % 64) as u8);
        assert!((found / (0.39 * 63.0 * 65.0 / 12.0) - 1.0).abs() < 0.15, "{found}");
    }
}
