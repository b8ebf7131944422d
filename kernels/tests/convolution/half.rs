//! Sums in f16: within the bound that [`Precision::Half`] states, of whatever numbers.

use b2p_kernels::{ABSENT, FloatConv, Isa, Precision, Scale, Taps, f16, reference};

use crate::cases::{Random, cases, kernels, whole};

/// The roundings of a block of sixteen, of its terms' magnitudes.
const BLOCK: f64 = 1.004 / 128.0;
/// What is too small for f16, of an output channel's largest weight times an activation and one.
const FLOOR: f64 = 1.01 / (1 << 19) as f64;

/// For each result, the magnitudes that [`FLOOR`] is of.
fn floors(
    [cin, cout]: [usize; 2],
    weights: &[f16],
    scale: &Scale,
    taps: &Taps<'_>,
    input: &[f16],
    rows: usize,
) -> Vec<f64> {
    let mut peaks = vec![0.0f64; cout];
    for weights in weights.chunks_exact(cout) {
        for (peak, w) in peaks.iter_mut().zip(weights) {
            *peak = peak.max(w.to_f64().abs());
        }
    }
    let mut floors = Vec::with_capacity(rows * cout);
    for i in 0..rows {
        let read = |k| Some((k, reference::tap(taps, i, k)?));
        let read: Vec<_> = (0..taps.volume()).filter_map(read).collect();
        let inputs = read.iter().flat_map(|(_, row)| &input[row * cin..][..cin]);
        let reach: f64 = inputs.map(|x| x.to_f64().abs() + 1.0).sum();
        for (o, peak) in peaks.iter().enumerate() {
            let factor = match scale {
                Scale::Plain => 1.0,
                Scale::Invariant(gain) => {
                    let channels = read.iter().flat_map(|(k, _)| k * cin..(k + 1) * cin);
                    let squares = channels.map(|c| weights[c * cout + o].to_f64().powi(2));
                    f64::from(gain[o]).abs() / (squares.sum::<f64>() + 1e-8).sqrt()
                }
            };
            floors.push(peak * reach * factor);
        }
    }
    floors
}

struct Layer {
    extents: [usize; 2],
    weights: Vec<f16>,
    bias: Vec<f32>,
    scale: Scale,
}

impl Layer {
    fn conv(&self, volume: usize, precision: Precision) -> FloatConv {
        let [cin, cout] = self.extents;
        let (bias, scale) = (self.bias.clone(), self.scale.clone());
        FloatConv::new(volume, cin, cout, &self.weights, bias, scale).with_precision(precision)
    }

    /// Holds the layer to its bound, and to f32's bits where there are no sums in f16.
    fn check(&self, what: &str, taps: &Taps<'_>, input: &[f16], rows: usize) {
        let ([cin, cout], volume) = (self.extents, taps.volume());
        let expected = reference::float(
            [cin, cout],
            &self.weights,
            &self.bias,
            &self.scale,
            taps,
            input,
            rows,
            None,
            false,
        );
        let floors = floors(self.extents, &self.weights, &self.scale, taps, input, rows);
        let (half, single) = (self.conv(volume, Precision::Half), self.conv(volume, Precision::F32));
        for isa in Isa::available() {
            let run = |conv: &FloatConv| {
                let mut out = vec![f32::NAN; rows * cout];
                conv.run(isa, *taps, input, 0, whole(&mut out, cout, None, false));
                out
            };
            let out = run(&half);
            if !isa.has_half() {
                assert_eq!(out, run(&single), "{isa} has no sums in f16");
            }
            let mut stored = vec![f16::NAN; rows * cout];
            half.run(isa, *taps, input, 0, whole(&mut stored, cout, None, false));
            // In f32: a rounding for each block and a few for scale and bias.
            let block = BLOCK + (volume * cin.div_ceil(16) + 8) as f64 * f64::from(f32::EPSILON);
            for (i, (got, want)) in out.iter().zip(&expected).enumerate() {
                let error = (f64::from(*got) - want.value).abs();
                let bound = block * want.magnitude + FLOOR * floors[i] + 1e-30;
                assert!(
                    error <= bound,
                    "{isa}, {what}, {cin} → {cout}: {got} against {want:?} ± {bound}"
                );
                assert!(stored[i].is_finite(), "{isa}, {what}: {}", stored[i]);
            }
        }
    }
}

#[test]
fn sums_in_half_stay_within_their_bound() {
    let mut random = Random(11);
    // The others take long in double precision, and only differ in how many tiles there are.
    let cases = cases(&mut random).into_iter();
    for (taps, rows, inputs, extents) in cases.filter(|(_, rows, ..)| *rows < 200) {
        let (taps, [cin, cout]) = (taps.taps(), extents);
        let mut values = |n: usize, scale: f32| -> Vec<f16> {
            let each = (0..n).map(|_| f16::from_f32(random.unit() * scale));
            each.collect()
        };
        let weights = values(taps.volume() * cin * cout, 0.3);
        let input = values(inputs * cin, 4.0);
        let mut numbers = |scale: f32| (0..cout).map(|_| random.unit() * scale).collect();
        let (bias, gain) = (numbers(1.0), numbers(2.0));
        let mut layer = Layer {
            extents,
            weights,
            bias,
            scale: Scale::Plain,
        };
        layer.check("plain", &taps, &input, rows);
        layer.scale = Scale::Invariant(gain);
        layer.check("geometry-invariant", &taps, &input, rows);
    }
}

#[test]
fn sums_in_half_stay_within_their_bound_for_every_width() {
    let mut random = Random(12);
    for width in 1..=70 {
        for extents in [[width, 5], [6, width]] {
            let (taps, inputs) = kernels(&mut random, 31).swap_remove(3);
            let (taps, [cin, cout]) = (taps.taps(), extents);
            let mut values = |n: usize| -> Vec<f16> { (0..n).map(|_| f16::from_f32(random.unit())).collect() };
            let layer = Layer {
                extents,
                weights: values(taps.volume() * cin * cout),
                bias: vec![0.0; cout],
                scale: Scale::Plain,
            };
            layer.check("any width", &taps, &values(inputs * cin), 31);
        }
    }
}

/// A kind of numbers that are hard to sum in f16.
type Kind = (&'static str, fn(&mut Random) -> f16);

const KINDS: [Kind; 7] = [
    ("the largest", |_| f16::MAX),
    ("the largest of either sign", |r| match r.below(2) {
        0 => f16::MAX,
        _ => f16::MIN,
    }),
    ("subnormals", |r| {
        f16::from_bits(r.below(1 << 10) as u16 | (r.below(2) as u16) << 15)
    }),
    ("the smallest", |_| f16::from_bits(1)),
    ("any", |r| {
        loop {
            let any = f16::from_bits(r.next() as u16);
            if any.is_finite() {
                return any;
            }
        }
    }),
    ("zeros", |_| f16::ZERO),
    ("mostly small", |r| match r.below(50) {
        0 => f16::MAX,
        _ => f16::from_f32(r.unit() * 1e-4),
    }),
];

#[test]
fn sums_in_half_of_extreme_numbers_stay_within_their_bound_and_finite() {
    let mut random = Random(13);
    let rows = 37;
    let all = kernels(&mut random, rows);
    let mut taps = all.iter().cycle();
    for (name, of) in KINDS {
        for (other, of_input) in KINDS {
            let Some((taps, inputs)) = taps.next() else {
                continue;
            };
            let (taps, [cin, cout]) = (taps.taps(), [40, 24]);
            let count = taps.volume() * cin * cout;
            let weights: Vec<f16> = (0..count).map(|_| of(&mut random)).collect();
            let input: Vec<f16> = (0..inputs * cin).map(|_| of_input(&mut random)).collect();
            let mut layer = Layer {
                extents: [cin, cout],
                weights,
                bias: vec![0.0; cout],
                scale: Scale::Plain,
            };
            let what = format!("weights {name}, inputs {other}");
            layer.check(&what, &taps, &input, rows);
            layer.scale = Scale::Invariant(vec![1.5; cout]);
            layer.check(&what, &taps, &input, rows);
        }
    }
}

/// A voxel without neighbours, and sums of which nothing is left: what is in one block cancels, and what is in two.
#[test]
fn lone_voxels_and_sums_that_cancel_stay_within_their_bound() {
    let (rows, [cin, cout]) = (9, [64, 32]);
    let lone = |i: usize| match i % 27 {
        13 => (i / 27) as u32,
        _ => ABSENT,
    };
    let rows_read: Vec<u32> = (0..rows * 27).map(lone).collect();
    let taps = Taps::Map {
        volume: 27,
        rows: &rows_read,
        plan: None,
    };
    for apart in [1, 2, 8, 16, 32] {
        for size in [f16::from_bits(1), f16::from_f32(0.0307), f16::MAX] {
            let sign = |c: usize| {
                if (c / apart).is_multiple_of(2) { 1.0 } else { -1.0 }
            };
            let weight = |i: usize| f16::from_f32(size.to_f32() * sign(i / cout % cin));
            let layer = Layer {
                extents: [cin, cout],
                weights: (0..27 * cin * cout).map(weight).collect(),
                bias: vec![0.0; cout],
                scale: Scale::Plain,
            };
            for x in [f16::from_bits(1), f16::from_f32(1.7), f16::MAX] {
                layer.check("cancelling", &taps, &vec![x; rows * cin], rows);
            }
        }
    }
}

/// The nearest f16 of a number below 65520, ties to even.
fn rounded(x: f64) -> f64 {
    let exponent = (x.to_bits() >> 52 & 0x7ff) as i32 - 1023;
    let step = f64::powi(2.0, exponent.max(-14) - 10);
    (x / step).round_ties_even() * step
}

/// `sum + a · b` of f16, rounded once.
fn fused(sum: f64, a: f64, b: f64) -> f64 {
    let product = a * b;
    let total = sum + product;
    let added = total - sum;
    let lost = (sum - (total - added)) + (product - added);
    // The last bit says whether anything did not fit, with which nothing is halfway between two f16.
    let bits = total.to_bits();
    let odd = match (lost > 0.0) == (total > 0.0) {
        true => bits + 1,
        false => bits - 1,
    };
    rounded(if lost == 0.0 || bits & 1 == 1 {
        total
    } else {
        f64::from_bits(odd)
    })
}

/// Weights scaled to below 1/32, sixteen products in f16, blocks in f32, tap by tap.
#[test]
fn sums_in_half_equal_their_definition_to_the_bit() {
    let mut random = Random(15);
    let (rows, [cin, cout]) = (70, [40, 20]);
    for scale in [1e-6, 0.3, 3e4] {
        let (taps, _) = kernels(&mut random, rows).swap_remove(5);
        let taps = taps.taps();
        let mut values = |n: usize, scale: f32| -> Vec<f16> {
            let each = (0..n).map(|_| f16::from_f32(random.unit() * scale));
            each.collect()
        };
        let layer = Layer {
            extents: [cin, cout],
            weights: values(27 * cin * cout, scale),
            bias: vec![0.0; cout],
            scale: Scale::Plain,
        };
        let input = values(rows * cin, 4.0);
        let weights = |o: usize| layer.weights.iter().skip(o).step_by(cout);
        let unit = |o: usize| {
            let peak = weights(o).map(|w| w.to_f32().abs()).fold(0.0, f32::max);
            64.0 * f32::from_bits(peak.to_bits() & f32::INFINITY.to_bits())
        };
        let mut expected = Vec::new();
        for i in 0..rows {
            for o in 0..cout {
                let unit = unit(o);
                let scaled: Vec<f64> = weights(o).map(|w| rounded(w.to_f64() / f64::from(unit))).collect();
                let mut sum = 0.0f32;
                for k in 0..27 {
                    let Some(row) = reference::tap(&taps, i, k) else {
                        continue;
                    };
                    let weights = scaled[k * cin..][..cin].chunks(16);
                    let blocks = weights.zip(input[row * cin..][..cin].chunks(16));
                    for (weights, inputs) in blocks {
                        let products = weights.iter().zip(inputs);
                        let add = |sum, (w, x): (&f64, &f16)| fused(sum, *w, x.to_f64());
                        sum += products.fold(0.0, add) as f32;
                    }
                }
                expected.push(sum * unit);
            }
        }
        let conv = layer.conv(27, Precision::Half);
        for isa in Isa::available().into_iter().filter(|isa| isa.has_half()) {
            let mut out = vec![f32::NAN; rows * cout];
            conv.run(isa, taps, &input, 0, whole(&mut out, cout, None, false));
            assert_eq!(out, expected, "{isa}, weights up to {scale}");
        }
    }
}
