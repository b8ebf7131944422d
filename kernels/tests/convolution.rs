//! The convolutions against their definitions, on every instruction set of this machine.

use b2p_kernels::reference;
use b2p_kernels::{ABSENT, ExactConv, FloatConv, Isa, LIMIT, Output, Requantise, Scale, Taps};
use half::f16;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }

    /// In −limit..=limit.
    fn signed(&mut self, limit: i32) -> i32 {
        self.below(2 * limit as usize + 1) as i32 - limit
    }

    /// In −1..1.
    fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// Row counts around the tile's and the block's edges.
const ROWS: [usize; 7] = [1, 3, 4, 127, 128, 129, 300];
const CHANNELS: [usize; 7] = [3, 8, 14, 16, 32, 72, 128];

/// All kinds of taps over `rows` output rows, and how many input rows each needs.
fn kernels(random: &mut Random, rows: usize) -> Vec<(Owned, usize)> {
    let inputs = rows + 5;
    let mut map = |volume: usize, density: usize| {
        let entry = |random: &mut Random| match random.below(100) < density {
            true => random.below(inputs) as u32,
            false => ABSENT,
        };
        let rows = (0..rows * volume).map(|_| entry(random)).collect();
        (Owned::Map(volume, rows), inputs)
    };
    let mut all = vec![
        map(27, 40),
        map(27, 0),
        map(27, 100),
        map(8, 60),
        map(1, 100),
    ];
    all.push((Owned::Same, rows));
    let parents = (0..rows).map(|_| random.below(inputs) as u32).collect();
    let octants = (0..rows).map(|_| random.below(8) as u8).collect();
    all.push((Owned::Octants(parents, octants), inputs));
    all.push((Owned::Children, rows.div_ceil(8)));
    all
}

enum Owned {
    Same,
    Map(usize, Vec<u32>),
    Octants(Vec<u32>, Vec<u8>),
    Children,
}

impl Owned {
    fn taps(&self) -> Taps<'_> {
        match self {
            Owned::Same => Taps::Same,
            Owned::Map(volume, rows) => Taps::Map {
                volume: *volume,
                rows,
            },
            Owned::Octants(parents, octants) => Taps::Octants { parents, octants },
            Owned::Children => Taps::Children,
        }
    }
}

/// The extents to test: every count of input channels and every count of output channels, with each kind of taps.
fn cases(random: &mut Random) -> Vec<(Owned, usize, usize, [usize; 2])> {
    let mut cases = Vec::new();
    for (i, &a) in CHANNELS.iter().enumerate() {
        let b = CHANNELS[(i * 3 + 1) % CHANNELS.len()];
        let rows = ROWS[i];
        for (taps, inputs) in kernels(random, rows) {
            cases.push((taps, rows, inputs, [a, b]));
        }
    }
    cases
}

fn check_exact(
    [cin, cout]: [usize; 2],
    weights: &[i16],
    requantise: &Requantise,
    taps: &Taps<'_>,
    input: &[i16],
    rows: usize,
    residual: Option<&[i16]>,
    relu: bool,
) {
    let expected = reference::exact(
        [cin, cout],
        weights,
        requantise,
        taps,
        input,
        rows,
        residual,
        relu,
    );
    let conv = ExactConv::new(taps.volume(), cin, cout, weights, requantise.clone());
    for isa in Isa::available() {
        let mut out = vec![i16::MIN; rows * cout];
        let output = Output {
            rows: &mut out,
            stride: cout,
            column: 0,
            residual,
            relu,
        };
        conv.run(isa, *taps, input, 0, output);
        if let Some(i) = (0..out.len()).find(|&i| out[i] != expected[i]) {
            let (volume, got, want) = (taps.volume(), out[i], expected[i]);
            panic!(
                "{isa}: {cin} → {cout}, {volume} taps, {rows} rows: value {i} is {got}, not {want}"
            );
        }
    }
}

#[test]
fn exact_layers_equal_their_definition_to_the_bit() {
    println!("ran on {:?}", Isa::available());
    let mut random = Random(1);
    for (taps, rows, inputs, [cin, cout]) in cases(&mut random) {
        let taps = taps.taps();
        let weights: Vec<i16> = (0..taps.volume() * cin * cout)
            .map(|_| random.signed(511) as i16)
            .collect();
        let mut activations =
            |n: usize| -> Vec<i16> { (0..n).map(|_| random.signed(2047) as i16).collect() };
        let input = activations(inputs * cin);
        let residual = activations(rows * cout);
        let residual = (cin % 16 == 0).then_some(&residual[..]);
        let shift = Requantise::Shift {
            bias: (0..cout).map(|_| random.signed(1 << 20)).collect(),
            shift: (0..cout).map(|_| 6 + random.below(12) as u8).collect(),
        };
        let invariant = Requantise::Invariant {
            gain: (0..cout).map(|_| random.unit() * 3.0).collect(),
            bias: (0..cout).map(|_| random.unit() * 300.0).collect(),
        };
        for (requantise, relu) in [(shift, false), (invariant, true)] {
            check_exact(
                [cin, cout],
                &weights,
                &requantise,
                &taps,
                &input,
                rows,
                residual,
                relu,
            );
        }
    }
}

#[test]
fn exact_layers_wrap_like_their_definition_at_the_extremes() {
    let rows = 130;
    let map = vec![0; 27 * rows];
    let taps = Taps::Map {
        volume: 27,
        rows: &map,
    };
    let [cin, cout] = [128, 16];
    for (w, x) in [
        (i16::MIN, i16::MIN),
        (i16::MAX, i16::MIN),
        (511, 2047),
        (-511, 2047),
    ] {
        let (weights, input) = (vec![w; 27 * cin * cout], vec![x; cin]);
        for (bias, shift) in [(i32::MAX, 0), (i32::MIN, 31), (1 << 29, 30), (-1, 1)] {
            let requantise = Requantise::Shift {
                bias: vec![bias; cout],
                shift: vec![shift; cout],
            };
            check_exact(
                [cin, cout],
                &weights,
                &requantise,
                &taps,
                &input,
                rows,
                None,
                false,
            );
        }
        for (gain, bias) in [
            (f32::MAX, f32::MAX),
            (f32::MAX, -f32::MAX),
            (1e-45, 0.5),
            (1.0, 1.5),
            (-1.0, -0.5),
        ] {
            let requantise = Requantise::Invariant {
                gain: vec![gain; cout],
                bias: vec![bias; cout],
            };
            check_exact(
                [cin, cout],
                &weights,
                &requantise,
                &taps,
                &input,
                rows,
                None,
                true,
            );
        }
    }
}

#[test]
fn halves_round_to_even_and_sums_stay_within_the_limit() {
    let taps = Taps::Same;
    let conv = ExactConv::new(
        1,
        1,
        1,
        &[2],
        Requantise::Invariant {
            gain: vec![1.0],
            bias: vec![0.5],
        },
    );
    // The weight's own norm is its magnitude, so a row's value is itself plus a half.
    let input = [0, 1, 2, -1, -2, LIMIT, -LIMIT];
    for isa in Isa::available() {
        let mut out = [0; 7];
        conv.run(
            isa,
            taps,
            &input,
            0,
            Output {
                rows: &mut out,
                stride: 1,
                column: 0,
                residual: None,
                relu: false,
            },
        );
        assert_eq!(out, [0, 2, 2, 0, -2, LIMIT, -2046], "{isa}");
        let residual = [-1, 1, 2000, -2047, -2047, 1, -2];
        let output = Output {
            rows: &mut out,
            stride: 1,
            column: 0,
            residual: Some(&residual),
            relu: false,
        };
        conv.run(isa, taps, &input, 0, output);
        assert_eq!(out, [-1, 3, 2002, -2047, -2047, LIMIT, -LIMIT], "{isa}");
    }
}

#[test]
fn a_layer_writes_only_its_own_columns_and_rows_from_the_first_on() {
    let mut random = Random(2);
    let weights: Vec<i16> = (0..8 * 4 * 3).map(|_| random.signed(511) as i16).collect();
    let input: Vec<i16> = (0..40 * 4).map(|_| random.signed(2047) as i16).collect();
    let requantise = Requantise::Shift {
        bias: vec![0; 3],
        shift: vec![9; 3],
    };
    let residual: Vec<i16> = (0..320 * 8).map(|_| random.signed(2047) as i16).collect();
    let columns: Vec<i16> = residual
        .chunks(8)
        .flat_map(|row| &row[2..5])
        .copied()
        .collect();
    let whole = reference::exact(
        [4, 3],
        &weights,
        &requantise,
        &Taps::Children,
        &input,
        320,
        Some(&columns),
        true,
    );
    let conv = ExactConv::new(8, 4, 3, &weights, requantise);
    for isa in Isa::available() {
        let mut out = vec![i16::MIN; 150 * 8];
        let output = Output {
            rows: &mut out,
            stride: 8,
            column: 2,
            residual: Some(&residual[170 * 8..]),
            relu: true,
        };
        conv.run(isa, Taps::Children, &input, 170, output);
        for (i, row) in out.chunks(8).enumerate() {
            assert_eq!(row[2..5], whole[(170 + i) * 3..][..3], "{isa}: row {i}");
            assert!(row[..2].iter().chain(&row[5..]).all(|&x| x == i16::MIN));
        }
    }
}

#[test]
fn float_layers_stay_within_rounding_of_their_definition_and_agree_on_every_isa() {
    println!("ran on {:?}", Isa::available());
    let mut random = Random(3);
    for (taps, rows, inputs, [cin, cout]) in cases(&mut random) {
        let taps = taps.taps();
        let mut values = |n: usize, scale: f32| -> Vec<f16> {
            (0..n)
                .map(|_| f16::from_f32(random.unit() * scale))
                .collect()
        };
        let weights = values(taps.volume() * cin * cout, 0.3);
        let input = values(inputs * cin, 4.0);
        let skip = values(rows * cout, 4.0);
        let bias: Vec<f32> = (0..cout).map(|_| random.unit()).collect();
        let invariant = Scale::Invariant((0..cout).map(|_| random.unit() * 2.0).collect());
        for (scale, relu, residual) in [
            (Scale::Plain, true, None),
            (invariant, false, Some(&skip[..])),
        ] {
            let expected = reference::float(
                [cin, cout],
                &weights,
                &bias,
                &scale,
                &taps,
                &input,
                rows,
                residual,
                relu,
            );
            let conv = FloatConv::new(taps.volume(), cin, cout, &weights, bias.clone(), scale);
            let mut first: Option<Vec<f32>> = None;
            for isa in Isa::available() {
                let mut out = vec![f32::NAN; rows * cout];
                let mut halves = vec![f16::NAN; rows * cout];
                conv.run(
                    isa,
                    taps,
                    &input,
                    0,
                    Output {
                        rows: &mut out,
                        stride: cout,
                        column: 0,
                        residual,
                        relu,
                    },
                );
                conv.run(
                    isa,
                    taps,
                    &input,
                    0,
                    Output {
                        rows: &mut halves,
                        stride: cout,
                        column: 0,
                        residual,
                        relu,
                    },
                );
                // At most one rounding a term in sequence, and a few for scale and bias.
                let terms = (taps.volume() * cin + 8) as f64;
                for ((&got, &half), want) in out.iter().zip(&halves).zip(&expected) {
                    let bound = want.magnitude * terms * f64::from(f32::EPSILON) / 2.0 + 1e-30;
                    let error = (f64::from(got) - want.value).abs();
                    assert!(
                        error <= bound,
                        "{isa}: {got} against {want:?}: {cin} → {cout}"
                    );
                    assert_eq!(half, f16::from_f32(got), "{isa}");
                }
                assert!(
                    *first.get_or_insert_with(|| out.clone()) == out,
                    "{isa} rounds in another order"
                );
            }
        }
    }
}

#[test]
fn float_layers_saturate_and_never_store_a_nan() {
    let conv = FloatConv::new(
        1,
        2,
        2,
        &[f16::MAX, f16::MAX, f16::MAX, f16::MIN],
        vec![0.0; 2],
        Scale::Plain,
    );
    let infinite = FloatConv::new(
        1,
        1,
        1,
        &[f16::ZERO],
        vec![0.0],
        Scale::Invariant(vec![f32::MAX]),
    );
    for isa in Isa::available() {
        let mut out = [f16::ZERO; 2];
        conv.run(
            isa,
            Taps::Same,
            &[f16::MAX; 2],
            0,
            Output {
                rows: &mut out,
                stride: 2,
                column: 0,
                residual: None,
                relu: false,
            },
        );
        assert_eq!(out, [f16::MAX, f16::ZERO], "{isa}");
        let mut out = [f16::NAN; 1];
        infinite.run(
            isa,
            Taps::Same,
            &[f16::ONE],
            0,
            Output {
                rows: &mut out,
                stride: 1,
                column: 0,
                residual: None,
                relu: false,
            },
        );
        assert!(out[0].is_finite(), "{isa}: {}", out[0]);
    }
}

#[test]
#[should_panic(expected = "another kernel")]
fn taps_of_another_kernel_are_refused() {
    let conv = ExactConv::new(
        1,
        1,
        1,
        &[1],
        Requantise::Shift {
            bias: vec![0],
            shift: vec![0],
        },
    );
    conv.run(
        Isa::SCALAR,
        Taps::Children,
        &[1],
        0,
        Output {
            rows: &mut [0; 8],
            stride: 1,
            column: 0,
            residual: None,
            relu: false,
        },
    );
}
