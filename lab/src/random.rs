//! Random numbers that are the same everywhere: SplitMix64, which can start at any place of its sequence.

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// A SplitMix64 sequence.
#[derive(Debug, Clone)]
pub struct Random(u64);

impl Random {
    /// The sequence of `seed`.
    #[inline]
    pub fn new(seed: u64) -> Self {
        Random(mix(seed.wrapping_add(GOLDEN)))
    }

    /// The sequence of `seed` from its draw number `index` on.
    #[inline]
    pub fn at(seed: u64, index: u64) -> Self {
        let mut random = Random::new(seed);
        random.0 = random.0.wrapping_add(index.wrapping_mul(GOLDEN));
        random
    }

    /// An independent sequence for item `index`.
    pub fn fork(&self, index: u64) -> Self {
        Random::new(self.0 ^ mix(index.wrapping_add(GOLDEN)))
    }

    /// 64 random bits.
    #[inline]
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(GOLDEN);
        mix(self.0)
    }

    /// Uniform in `[0, 1)`.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in `[low, high)`.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Log-uniform in `[low, high)`, both positive.
    pub fn log_range(&mut self, low: f64, high: f64) -> f64 {
        self.range(low.ln(), high.ln()).exp()
    }

    /// Uniform in `0..count`; `count` must not be 0.
    pub fn below(&mut self, count: u64) -> u64 {
        ((u128::from(self.bits()) * u128::from(count)) >> 64) as u64
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }

    /// Puts `items` into a random order.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i as u64 + 1) as usize);
        }
    }
}

#[inline]
fn mix(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sequence_can_start_anywhere() {
        let mut whole = Random::new(7);
        for _ in 0..5 {
            whole.bits();
        }
        assert_eq!(whole.bits(), Random::at(7, 5).bits());
    }

    #[test]
    fn draws_fill_their_range_evenly() {
        let mut random = Random::new(1);
        let mut counts = [0u32; 8];
        for _ in 0..80_000 {
            counts[random.below(8) as usize] += 1;
        }
        assert!(counts.iter().all(|c| (9_600..10_400).contains(c)), "{counts:?}");
        let mean = (0..10_000).map(|_| random.normal()).sum::<f64>() / 10_000.0;
        assert!(mean.abs() < 0.05, "{mean}");
    }
}
