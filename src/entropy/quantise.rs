//! From real latents to whole ones, with an eye on what they cost.

use rayon::prelude::*;

use super::rows::Row;
use super::slice::Condition;
use super::tables::Tables;

/// Voxels of one task.
const BLOCK: usize = 4096;

/// Rounds each latent down or up, whichever has the smaller `(y − q)² + price · bits(q)`, within ±`limit`; ties go to the nearer one.
///
/// `price` is in squared latent steps per bit, at least 0: at 0 every latent goes to its nearest whole number.
///
/// # Panics
/// If the latents are not whole voxels, or the condition has not one mean and scale for each.
pub fn quantise(
    tables: &Tables,
    condition: Condition,
    latents: &[f32],
    limit: i16,
    price: f32,
) -> Vec<i16> {
    condition.check(tables, latents.len());
    let bound = f32::from(limit);
    let block = BLOCK * tables.channels();
    let mut out = vec![0; latents.len()];
    let blocks = out.par_chunks_mut(block).zip(latents.par_chunks(block));
    blocks.enumerate().for_each(|(b, (out, latents))| {
        let first = b * block;
        let condition = condition.of(first..first + latents.len());
        for (i, (q, y)) in out.iter_mut().zip(latents).enumerate() {
            let y = y.clamp(-bound, bound);
            let near = y.round_ties_even();
            let far = if y > near { near + 1.0 } else { near - 1.0 };
            *q = near as i16;
            if price > 0.0 && far.abs() <= bound && near != y {
                let (row, centre) = condition.row(tables, i);
                let cost = |q: f32| (y - q).powi(2) + price * row.bits(q as i32 - centre);
                if cost(far) < cost(near) {
                    *q = far as i16;
                }
            }
        }
    });
    out
}

impl Row<'_> {
    /// About what it costs to code `d`.
    fn bits(&self, d: i32) -> f32 {
        let entry = d - self.low();
        let values = self.escape() as i32;
        let (entry, beyond) = if entry < 0 {
            (self.escape(), -entry)
        } else if entry >= values {
            (self.escape(), entry - values + 1)
        } else {
            (entry as usize, 0)
        };
        let more = if beyond > 0 {
            2 + 2 * beyond.ilog2()
        } else {
            0
        };
        16.0 - f32::from(self.interval(entry).size).log2() + more as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::entropy::encode_slice;
    use crate::entropy::test_tables::tables;

    /// Latents spread evenly around means of their own.
    fn some(count: usize) -> (Vec<f32>, Vec<i16>, Vec<u8>) {
        let unit = |i: usize, k: usize| (i * k % 1009) as f32 / 1009.0 - 0.5;
        let mu: Vec<i16> = (0..count).map(|i| (unit(i, 31) * 200.0) as i16).collect();
        let y = |(i, mu): (usize, &i16)| f32::from(*mu) / 16.0 + 3.0 * unit(i, 617);
        let y = mu.iter().enumerate().map(y).collect();
        (y, mu, (0..count).map(|i| (i % 40) as u8).collect())
    }

    #[test]
    fn without_a_price_every_latent_goes_to_its_nearest_number_within_the_limit() {
        let k = tables().channels();
        let (y, mu, sigma) = some(100 * k);
        let condition = Condition::Gauss {
            mu: &mu,
            sigma: &sigma,
        };
        let q = quantise(&tables(), condition, &y, 5, 0.0);
        for (q, y) in q.iter().zip(&y) {
            assert_eq!(f32::from(*q), y.clamp(-5.0, 5.0).round_ties_even());
        }
    }

    #[test]
    fn the_dearer_a_bit_the_fewer_are_spent_and_no_latent_moves_by_more_than_one() {
        let k = tables().channels();
        let (y, mu, sigma) = some(3000 * k);
        let condition = Condition::Gauss {
            mu: &mu,
            sigma: &sigma,
        };
        let lengths: Vec<usize> = [0.0, 0.05, 0.2, 1.0]
            .into_iter()
            .map(|price| {
                let q = quantise(&tables(), condition, &y, 127, price);
                let moved = |(q, y): (&i16, &f32)| (f32::from(*q) - y).abs();
                assert!(q.iter().zip(&y).map(moved).all(|moved| moved <= 1.0));
                encode_slice(&tables(), condition, &q).len()
            })
            .collect();
        assert!(lengths.windows(2).all(|w| w[1] < w[0]), "{lengths:?}");
    }
}
