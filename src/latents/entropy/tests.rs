//! Tables for tests: Gaussian rows as a model has them, and two channels.

use std::sync::LazyLock;

use super::tables::{RawRows, Tables};

pub(crate) fn tables() -> Tables {
    static TABLES: LazyLock<Tables> = LazyLock::new(build);
    TABLES.clone()
}

fn build() -> Tables {
    let (mut entries, mut offsets, mut low) = (vec![], vec![0u32], vec![]);
    for scale in 0..64 {
        let sigma = 0.11 * (64.0f64 / 0.11).powf(f64::from(scale) / 63.0);
        for fraction in -8..8 {
            let reach = (5.0 * sigma).ceil().max(1.0) as i32 + 1;
            let mean = f64::from(fraction) / 16.0;
            let masses: Vec<f64> = (-reach..=reach).map(|d| mass(d, mean, sigma)).collect();
            entries.extend(row(&masses));
            offsets.push(entries.len() as u32);
            low.push(-reach as i16);
        }
    }
    let gauss = RawRows {
        name: "cdf.gauss",
        entries: &entries,
        offsets: &offsets,
        low: &low,
    };
    let channel = [16_383u16, 32_767, 16_382, 0];
    let prior = RawRows {
        name: "cdf.prior",
        entries: &[channel, channel].concat(),
        offsets: &[0, 4, 8],
        low: &[-1, -1],
    };
    Tables::new(gauss, prior).unwrap()
}

/// The normal distribution's share of `[d − ½, d + ½]`, by the midpoint rule.
fn mass(d: i32, mean: f64, sigma: f64) -> f64 {
    let steps = 64;
    let density = |i| {
        let x = (f64::from(d) - 0.5 + (f64::from(i) + 0.5) / f64::from(steps) - mean) / sigma;
        (-x * x / 2.0).exp() / (sigma * std::f64::consts::TAU.sqrt())
    };
    (0..steps).map(density).sum::<f64>() / f64::from(steps)
}

/// Masses and an escape as entries minus 1, of which every one is at least 0; the largest takes what rounding left.
fn row(masses: &[f64]) -> Vec<u16> {
    let total: f64 = masses.iter().sum();
    let free = 65_536 - (masses.len() as i64 + 1);
    let mut row: Vec<i64> = masses.iter().map(|m| (m / total * free as f64) as i64).collect();
    row.push(0);
    let rest = free - row.iter().sum::<i64>();
    *row.iter_mut().max().unwrap() += rest;
    row.into_iter().map(|e| e as u16).collect()
}
