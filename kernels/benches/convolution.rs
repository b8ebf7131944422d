//! How fast one thread convolves, in multiply-adds of taps that read something. Least time of a few repeats. Takes the number of
//! voxels as its argument.

use std::collections::HashMap;
use std::time::Instant;

use b2p_kernels::{ABSENT, ExactConv, FloatConv, Isa, Output, Requantise, Scale, Taps};
use half::f16;

/// A bumpy closed surface of about `count` voxels, in Morton order.
fn surface(count: usize) -> Vec<[i32; 3]> {
    let radius = (count as f64 / 19.0).sqrt();
    let size = (radius * 1.5) as i32;
    let mut voxels = Vec::new();
    for z in -size..size {
        for y in -size..size {
            for x in -size..size {
                let [a, b, c] = [x, y, z].map(|v| f64::from(v) + 0.5);
                let bump = 1.0 + 0.05 * ((a * 0.1).sin() + (b * 0.13).cos() + (c * 0.07).sin());
                if ((a * a + b * b + c * c).sqrt() - radius * bump).abs() < 0.75 {
                    voxels.push([x + size, y + size, z + size]);
                }
            }
        }
    }
    let key = |v: &[i32; 3]| -> u64 {
        (0..21)
            .map(|i| {
                (0..3)
                    .map(|a| (v[a] as u64 >> i & 1) << (3 * i + a))
                    .sum::<u64>()
            })
            .sum()
    };
    voxels.sort_by_cached_key(key);
    voxels
}

fn kernel_map(voxels: &[[i32; 3]]) -> Vec<u32> {
    let index: HashMap<[i32; 3], u32> = voxels.iter().zip(0..).map(|(v, i)| (*v, i)).collect();
    let mut rows = Vec::with_capacity(voxels.len() * 27);
    for [x, y, z] in voxels {
        for k in 0..27 {
            let at = [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1];
            rows.push(index.get(&at).copied().unwrap_or(ABSENT));
        }
    }
    rows
}

fn least(mut run: impl FnMut()) -> f64 {
    let once = |run: &mut dyn FnMut()| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    };
    (0..9).map(|_| once(&mut run)).fold(f64::INFINITY, f64::min)
}

fn main() {
    let count = std::env::args().skip(1).find_map(|arg| arg.parse().ok());
    let voxels = surface(count.unwrap_or(50_000));
    let rows = kernel_map(&voxels);
    let taps = Taps::Map {
        volume: 27,
        rows: &rows,
    };
    let pairs = rows.iter().filter(|&&r| r != ABSENT).count();
    let n = voxels.len();
    println!("{n} voxels, {:.2} neighbours each", pairs as f64 / n as f64);
    for isa in Isa::available() {
        for (cin, cout) in [(64, 64), (64, 16), (16, 32), (16, 16)] {
            let weights: Vec<i16> = (0..27 * cin * cout)
                .map(|i| (i * 7919 % 1023) as i16 - 511)
                .collect();
            let halves: Vec<f16> = weights
                .iter()
                .map(|&w| f16::from_f32(f32::from(w) / 4096.0))
                .collect();
            let shift = Requantise::Shift {
                bias: vec![0; cout],
                shift: vec![14; cout],
            };
            let invariant = Requantise::Invariant {
                gain: vec![1.0; cout],
                bias: vec![0.0; cout],
            };
            let input: Vec<i16> = (0..n * cin)
                .map(|i| (i * 7907 % 4095) as i16 - 2047)
                .collect();
            let float: Vec<f16> = input
                .iter()
                .map(|&x| f16::from_f32(f32::from(x) / 1024.0))
                .collect();
            let report = |what: &str, seconds: f64| {
                let rate = (pairs * cin * cout) as f64 / seconds / 1e9;
                println!(
                    "{:>7} {cin:>3} → {cout:<3} {what:<16} {:7.1} ms {rate:6.1} GMAC/s",
                    isa.to_string(),
                    seconds * 1e3
                );
            };
            for (what, requantise) in [("exact", shift), ("exact invariant", invariant)] {
                let conv = ExactConv::new(27, cin, cout, &weights, requantise);
                let mut out = vec![0; n * cout];
                report(
                    what,
                    least(|| {
                        conv.run(
                            isa,
                            taps,
                            &input,
                            0,
                            Output {
                                rows: &mut out,
                                stride: cout,
                                column: 0,
                                residual: None,
                                relu: true,
                            },
                        );
                    }),
                );
            }
            for (what, scale) in [
                ("float", Scale::Plain),
                ("float invariant", Scale::Invariant(vec![1.0; cout])),
            ] {
                let conv = FloatConv::new(27, cin, cout, &halves, vec![0.0; cout], scale);
                let mut out = vec![f16::ZERO; n * cout];
                report(
                    what,
                    least(|| {
                        conv.run(
                            isa,
                            taps,
                            &float,
                            0,
                            Output {
                                rows: &mut out,
                                stride: cout,
                                column: 0,
                                residual: None,
                                relu: true,
                            },
                        );
                    }),
                );
            }
        }
    }
}
