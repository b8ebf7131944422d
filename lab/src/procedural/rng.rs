//! Chance that is the same every time, in single precision, and the noise made of it.

use glam::Vec3;

use crate::random::Random;

/// A stream of numbers that depends on its seed alone.
#[derive(Debug, Clone)]
pub struct Rng(Random);

impl Rng {
    /// Starts the stream of `seed`.
    pub fn new(seed: u64) -> Self {
        Rng(Random::new(seed))
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0.bits()
    }

    /// Uniform in `[0, 1)`.
    pub fn unit(&mut self) -> f32 {
        fraction(self.0.bits())
    }

    /// Uniform in `[low, high)`.
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Uniform in `0..n`; `n` must not be 0.
    pub fn below(&mut self, n: u32) -> u32 {
        self.0.below(n.into()) as u32
    }

    /// Whether an event of this probability happens.
    pub fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    /// Uniform on the unit sphere.
    pub fn direction(&mut self) -> Vec3 {
        let z = self.range(-1.0, 1.0);
        let angle = self.range(0.0, std::f32::consts::TAU);
        let r = (1.0 - z * z).max(0.0).sqrt();
        Vec3::new(r * angle.cos(), z, r * angle.sin())
    }
}

/// The upper bits as a number in `[0, 1)`.
fn fraction(bits: u64) -> f32 {
    (bits >> 40) as f32 / (1u64 << 24) as f32
}

/// A number in `[0, 1)` that belongs to a lattice point; the lattice repeats after 2²¹ points.
pub fn lattice(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    let low = |v: i32| u64::from(v as u32 & 0x1f_ffff);
    let index = low(x) | low(y) << 21 | low(z) << 42;
    fraction(Random::at(seed.into(), index).bits())
}

/// Value noise: numbers on the unit lattice, joined smoothly; in `[0, 1]`.
pub fn value_noise(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let t = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let [x, y, z] = cell.as_ivec3().to_array();
    let at = |i, j, k| lattice(x + i, y + j, z + k, seed);
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let row = |j, k| lerp(at(0, j, k), at(1, j, k), t.x);
    lerp(lerp(row(0, 0), row(1, 0), t.y), lerp(row(0, 1), row(1, 1), t.y), t.z)
}

/// Gradient (Perlin) noise, about in `[−1, 1]`, 0 on lattice points.
pub fn gradient_noise(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let t = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let [x, y, z] = cell.as_ivec3().to_array();
    let at = |i: i32, j: i32, k: i32| {
        let h = (lattice(x + i, y + j, z + k, seed) * 12.0) as u32;
        let d = f - Vec3::new(i as f32, j as f32, k as f32);
        let (a, b) = match h >> 2 {
            0 => (d.x, d.y),
            1 => (d.x, d.z),
            _ => (d.y, d.z),
        };
        (if h & 1 == 0 { a } else { -a }) + (if h & 2 == 0 { b } else { -b })
    };
    let lerp = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let row = |j, k| lerp(at(0, j, k), at(1, j, k), t.x);
    lerp(lerp(row(0, 0), row(1, 0), t.y), lerp(row(0, 1), row(1, 1), t.y), t.z)
}

/// A sum of `octaves` of gradient noise, each twice as fine and half as strong; about in `[−1, 1]`.
pub fn fractal(p: Vec3, octaves: u32, seed: u32) -> f32 {
    (0..octaves)
        .map(|o| {
            let scale = (1u32 << o) as f32;
            gradient_noise(p * scale, seed.wrapping_add(o)) / scale
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_and_stays_in_its_range() {
        let mut rng = Rng::new(2);
        for _ in 0..5_000 {
            let p = rng.direction() * rng.range(0.0, 50.0);
            let q = p + rng.direction() * 1e-3;
            assert!((0.0..=1.0).contains(&value_noise(p, 3)));
            assert!(gradient_noise(p, 3).abs() <= 1.5);
            assert!((value_noise(p, 3) - value_noise(q, 3)).abs() < 0.01);
            assert!((gradient_noise(p, 3) - gradient_noise(q, 3)).abs() < 0.02);
        }
    }

    #[test]
    fn directions_favour_no_side() {
        let mut rng = Rng::new(3);
        let sum: Vec3 = (0..4_000).map(|_| rng.direction()).sum();
        assert!(sum.length() / 4_000.0 < 0.04);
    }
}
