//! Prediction from neighbours by its definition.

use super::super::structure::Neighbours;
use super::{Layer, Oracle, Rows, Sites, relu};

impl Oracle {
    /// Means in sixteenths, scale indices, and whether anything is known, of base-level voxels whose latents are
    /// `latents`.
    pub fn base(&self, at: &Sites, latents: &Rows) -> (Rows, Rows, Vec<bool>) {
        let network = self.exact.base.as_ref().unwrap();
        let unit = f64::from(1 << self.shape.latent_shift);
        let raised = each(latents, |y| y * unit);
        let inputs = |v: &[i32; 3]| {
            let sets = (1..8).map(|other| before(at, *v, other));
            self.known(v, sets.collect(), &raised, Vec::new())
        };
        let (x, known): (Rows, Vec<bool>) = at.voxels.iter().map(inputs).unzip();
        let (mu, sigma) = self.of_neighbours(network, at, &x);
        (mu, each(&sigma, |s| s.clamp(0.0, 63.0)), known)
    }

    /// The same of a higher role's voxels, whose level has the parameters `mu` and `sigma`.
    pub fn near(&self, role: usize, at: &Sites, latents: &Rows, (mu, sigma): (&Rows, &Rows)) -> (Rows, Rows) {
        let network = self.exact.near[role - 1].as_ref().unwrap();
        let step = f64::from(1 << self.shape.latent_shift) / 16.0;
        let both = |y: (&Vec<f64>, &Vec<f64>)| {
            let left = |(y, mu): (&f64, &f64)| ((16.0 * y - mu) * step).floor();
            y.0.iter().zip(y.1).map(left).collect()
        };
        let left: Rows = latents.iter().zip(mu).map(both).collect();
        let inputs = |(i, v): (usize, &[i32; 3])| {
            let parent = |w: &[i32; 3]| w.map(|w| w.div_euclid(2));
            let sets = (1..8).flat_map(|other| {
                let all = before(at, *v, other).into_iter();
                let (same, others): (Vec<_>, Vec<_>) = all.partition(|&w| parent(&at.voxels[w]) == parent(v));
                [same, others]
            });
            let mut own: Vec<f64> = mu[i]
                .iter()
                .map(|mu| (mu * step).floor().clamp(-2047.0, 2047.0))
                .collect();
            own.extend(sigma[i].iter().map(|s| s * 8.0));
            self.known(v, sets.collect(), &left, own)
        };
        let (x, known): (Rows, Vec<bool>) = at.voxels.iter().enumerate().map(inputs).unzip();
        let (by, wider) = self.of_neighbours(network, at, &x);
        let corrected = |old: &Rows, change: &Rows, low: f64, high: f64| -> Rows {
            let one = |((old, change), known): ((&Vec<f64>, &Vec<f64>), &bool)| {
                let sum = |(old, change): (&f64, &f64)| match known {
                    true => (old + change).clamp(low, high),
                    false => *old,
                };
                old.iter().zip(change).map(sum).collect()
            };
            old.iter().zip(change).zip(&known).map(one).collect()
        };
        (corrected(mu, &by, -2047.0, 2047.0), corrected(sigma, &wider, 0.0, 63.0))
    }

    fn of_neighbours(&self, network: &Neighbours<Layer>, at: &Sites, x: &Rows) -> (Rows, Rows) {
        let x = relu(self.here(&network.lin1, at, x));
        let x = relu(self.here(&network.lin2, at, &x));
        (self.here(&network.mu, at, &x), self.here(&network.sigma, at, &x))
    }

    /// One voxel's inputs: of each set of voxels the mean of `values`, and whether there are any; `own`; the octant.
    /// Also whether anything is known.
    fn known(&self, v: &[i32; 3], sets: Vec<Vec<usize>>, values: &Rows, own: Vec<f64>) -> (Vec<f64>, bool) {
        let unit = f64::from(1 << self.shape.latent_shift);
        let mut row = Vec::new();
        let any = sets.iter().any(|set| !set.is_empty());
        for set in sets {
            row.extend((0..self.shape.latents).map(|c| {
                let sum: f64 = set.iter().map(|&w| values[w][c]).sum();
                let mean = sum / set.len().max(1) as f64;
                (mean + 0.5).floor().clamp(-2047.0, 2047.0)
            }));
            row.push(if set.is_empty() { 0.0 } else { unit });
        }
        row.extend(own);
        row.extend((0..3).map(|a| f64::from(octant(v) >> a & 1) * unit));
        (row, any)
    }
}

/// The octant of a voxel: bit 0 = x, 1 = y, 2 = z.
fn octant(v: &[i32; 3]) -> i32 {
    v[0] % 2 + 2 * (v[1] % 2) + 4 * (v[2] % 2)
}

/// Which neighbours differ from a voxel along just the axes in `other` and lie in a lower octant.
fn before(at: &Sites, v: [i32; 3], other: i32) -> Vec<usize> {
    (0..27)
        .map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1])
        .filter(|d| (0..3).all(|a| (d[a] != 0) == (other >> a & 1 == 1)))
        .map(|d| std::array::from_fn(|a| v[a] + d[a]))
        .filter(|w| octant(&v) ^ other < octant(&v) && at.index.contains_key(w))
        .map(|w: [i32; 3]| at.index[&w])
        .collect()
}

fn each(rows: &Rows, f: impl Fn(f64) -> f64) -> Rows {
    rows.iter().map(|row| row.iter().map(|&v| f(v)).collect()).collect()
}
