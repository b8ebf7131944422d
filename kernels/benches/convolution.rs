//! How fast one thread convolves, in multiply-adds of taps that read something, and as a share of what the core can do
//! at best. Least time of a few repeats. Arguments: the number of voxels, the names of instruction sets, layers such as
//! `64x16`.

use std::collections::HashMap;
use std::time::Instant;

use b2p_kernels::f16;
use b2p_kernels::{ABSENT, ExactConv, FloatConv, Isa, Output, Plan, Precision, Requantise, Scale, Taps, peak};

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
            .map(|i| (0..3).map(|a| (v[a] as u64 >> i & 1) << (3 * i + a)).sum::<u64>())
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

/// The least time of a few runs, in seconds.
fn least(mut run: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    let begin = Instant::now();
    for i in 0.. {
        let start = Instant::now();
        run();
        best = best.min(start.elapsed().as_secs_f64());
        if i >= 2 && begin.elapsed().as_secs_f64() > 0.25 {
            break;
        }
    }
    best
}

/// Input and output channels of the layers.
const LAYERS: [[usize; 2]; 8] = [
    [64, 64],
    [32, 32],
    [32, 14],
    [64, 14],
    [16, 16],
    [64, 16],
    [64, 32],
    [16, 32],
];

struct Bench {
    map: Vec<u32>,
    plan: Plan,
    voxels: usize,
    pairs: usize,
}

impl Bench {
    fn report(&self, isa: Isa, [cin, cout]: [usize; 2], what: &str, ceiling: f64, seconds: f64) {
        let rate = (self.pairs * cin * cout) as f64 / seconds / 1e9;
        println!(
            "{:>7} {cin:>3} → {cout:<3} {what:<16} {:7.1} ms {rate:6.1} GMAC/s {:4.0} %",
            isa.to_string(),
            seconds * 1e3,
            100.0 * rate / ceiling
        );
    }

    fn taps(&self) -> Taps<'_> {
        Taps::Map {
            volume: 27,
            rows: &self.map,
            plan: Some(&self.plan),
        }
    }

    fn exact(&self, isa: Isa, [cin, cout]: [usize; 2], ceiling: f64) {
        let weights: Vec<i16> = (0..27 * cin * cout).map(|i| (i * 7919 % 1023) as i16 - 511).collect();
        let input: Vec<i16> = (0..self.voxels * cin)
            .map(|i| (i * 7907 % 4095) as i16 - 2047)
            .collect();
        let shift = Requantise::Shift {
            bias: vec![0; cout],
            shift: vec![14; cout],
        };
        let invariant = Requantise::Invariant {
            gain: vec![1.0; cout],
            bias: vec![0.0; cout],
        };
        for (what, requantise) in [("exact", shift), ("exact invariant", invariant)] {
            let conv = ExactConv::new(27, cin, cout, &weights, requantise);
            let mut out = vec![0; self.voxels * cout];
            let seconds = least(|| {
                for (i, rows) in out.chunks_mut(512 * cout).enumerate() {
                    let output = Output {
                        rows,
                        stride: cout,
                        column: 0,
                        residual: None,
                        relu: true,
                    };
                    conv.run(isa, self.taps(), &input, i * 512, output);
                }
            });
            self.report(isa, [cin, cout], what, ceiling, seconds);
        }
    }

    fn float(&self, isa: Isa, [cin, cout]: [usize; 2], ceiling: f64) {
        let value = |i: usize| f16::from_f32((i * 7919 % 1023) as f32 / 512.0 - 1.0);
        let weights: Vec<f16> = (0..27 * cin * cout).map(value).collect();
        let input: Vec<f16> = (0..self.voxels * cin).map(value).collect();
        let scales = [
            ("float", Scale::Plain, Precision::F32),
            ("float invariant", Scale::Invariant(vec![1.0; cout]), Precision::F32),
            ("bf16", Scale::Plain, Precision::Bf16),
            ("half", Scale::Plain, Precision::Half),
        ];
        for (what, scale, precision) in scales {
            let ceiling = match precision {
                Precision::F32 => ceiling,
                Precision::Bf16 if isa.has_bf16() => peak::bf16(isa),
                Precision::Half if isa.has_half() => peak::half(isa),
                Precision::Bf16 | Precision::Half | Precision::Fastest => continue,
            };
            let conv = FloatConv::new(27, cin, cout, &weights, vec![0.0; cout], scale);
            let conv = conv.with_precision(precision);
            let mut out = vec![f16::ZERO; self.voxels * cout];
            let seconds = least(|| {
                for (i, rows) in out.chunks_mut(512 * cout).enumerate() {
                    let output = Output {
                        rows,
                        stride: cout,
                        column: 0,
                        residual: None,
                        relu: true,
                    };
                    conv.run(isa, self.taps(), &input, i * 512, output);
                }
            });
            self.report(isa, [cin, cout], what, ceiling, seconds);
        }
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let count = args.iter().find_map(|arg| arg.parse().ok());
    let only: Vec<Isa> = args.iter().filter_map(|arg| arg.parse().ok()).collect();
    let asked = args.iter().filter_map(|arg| {
        let (cin, cout) = arg.split_once('x')?;
        Some([cin.parse().ok()?, cout.parse().ok()?])
    });
    let mut layers: Vec<[usize; 2]> = asked.collect();
    if layers.is_empty() {
        layers = LAYERS.to_vec();
    }
    let voxels = surface(count.unwrap_or(200_000));
    let map = kernel_map(&voxels);
    let pairs = map.iter().filter(|&&r| r != ABSENT).count();
    let plan = Plan::new(voxels.len());
    let bench = Bench {
        map,
        plan,
        voxels: voxels.len(),
        pairs,
    };
    let each = pairs as f64 / voxels.len() as f64;
    println!("{} voxels, {each:.2} neighbours each", voxels.len());
    for isa in Isa::available() {
        if !only.is_empty() && !only.contains(&isa) {
            continue;
        }
        let (float, exact) = (peak::f32(isa), peak::i16(isa));
        let name = isa.to_string();
        println!("{name:>7} at best: f32 {float:.1} GMAC/s, i16 {exact:.1} GMAC/s");
        if isa.has_bf16() {
            println!("{name:>7} at best: bf16 {:.1} GMAC/s", peak::bf16(isa));
        }
        if isa.has_half() {
            println!("{name:>7} at best: half {:.1} GMAC/s", peak::half(isa));
        }
        for &layer in &layers {
            bench.exact(isa, layer, exact);
            bench.float(isa, layer, float);
        }
    }
}
