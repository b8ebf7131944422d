//! Integers: equal to the bit.

use b2p_kernels::{ABSENT, ExactConv, Isa, LIMIT, MadeRows, Output, Plan, Requantise, Taps, reference};

use crate::cases::{Random, cases, kernels, whole};

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
    let expected = reference::exact([cin, cout], weights, requantise, taps, input, rows, residual, relu);
    let conv = ExactConv::new(taps.volume(), cin, cout, weights, requantise.clone());
    for isa in Isa::available() {
        let mut out = vec![i16::MIN; rows * cout];
        let output = whole(&mut out, cout, residual, relu);
        conv.run(isa, *taps, input, 0, output);
        if residual.is_none() && !matches!(requantise, Requantise::Shift { .. }) {
            let mut real = vec![f32::NAN; rows * cout];
            conv.run_f32(isa, *taps, input, 0, whole(&mut real, cout, None, relu));
            let limit = f32::from(LIMIT);
            let round = |x: &f32| x.round_ties_even().clamp(-limit, limit) as i16;
            let rounded: Vec<i16> = real.iter().map(round).collect();
            assert_eq!(rounded, expected, "{isa}: real results");
        }
        if let Some(i) = (0..out.len()).find(|&i| out[i] != expected[i]) {
            let (volume, got, want) = (taps.volume(), out[i], expected[i]);
            panic!("{isa}: {cin} → {cout}, {volume} taps, {rows} rows: value {i} is {got}, not {want}");
        }
    }
}

/// A layer of random weights by random activations, both of the model's ranges, requantised in every way.
fn check_random(random: &mut Random, taps: &Taps<'_>, [rows, inputs]: [usize; 2], [cin, cout]: [usize; 2]) {
    let weights: Vec<i16> = (0..taps.volume() * cin * cout)
        .map(|_| random.signed(511) as i16)
        .collect();
    let mut activations = |n: usize| -> Vec<i16> { (0..n).map(|_| random.signed(2047) as i16).collect() };
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
    let scale = Requantise::Scale {
        scale: (0..cout).map(|_| random.unit() * 1e-3).collect(),
        bias: (0..cout).map(|_| random.unit() * 300.0).collect(),
    };
    for (requantise, relu) in [(shift, false), (scale, false), (invariant, true)] {
        check_exact([cin, cout], &weights, &requantise, taps, &input, rows, residual, relu);
    }
}

#[test]
fn exact_layers_equal_their_definition_to_the_bit() {
    let mut random = Random(1);
    for (taps, rows, inputs, extents) in cases(&mut random) {
        check_random(&mut random, &taps.taps(), [rows, inputs], extents);
    }
}

/// Where sums are small enough, all children of a voxel are computed at once, else each by itself: on both sides of
/// that border, and with the largest sums on either side of zero.
#[test]
fn all_children_equal_their_definition_up_to_the_largest_sums() {
    // 27 voxels around one, and one far from all.
    let around = |voxel: i32, k: i32| {
        let along = |base: i32| voxel / base % 3 + k / base % 3 - 1;
        let at = [along(1), along(3), along(9)];
        let inside = at.iter().all(|x| (0..3).contains(x));
        inside.then(|| (at[0] + 3 * at[1] + 9 * at[2]) as u32)
    };
    let mut neighbours: Vec<u32> = (0..27)
        .flat_map(|voxel| (0..27).map(move |k| around(voxel, k).unwrap_or(ABSENT)))
        .collect();
    neighbours.extend((0..27).map(|k| if k == 13 { 27 } else { ABSENT }));
    let rows = 8 * 28;
    let plan = Plan::new(rows);
    let taps = Taps::AllChildren {
        neighbours: &neighbours,
        plan: &plan,
    };
    for [cin, cout] in [[16, 16], [32, 14], [64, 40]] {
        // The largest even weight, if all are alike, with which sums stay below 2²⁸; the next; what transforms make too
        // large.
        let most = ((1 << 28) / 2047 - 1) / (27 * cin as i32);
        for weight in [most, most + 1, 2047, i16::MAX.into()] {
            for sign in [1, -1] {
                let weights = vec![(sign * weight) as i16; 27 * cin * cout];
                let mixed: Vec<i16> = (0..weights.len() as i32)
                    .map(|i| if i * 7919 % 5 < 2 { weight } else { -weight } as i16)
                    .collect();
                let input = vec![LIMIT; rows * cin];
                let scale = Requantise::Scale {
                    scale: vec![1e-5; cout],
                    bias: vec![0.0; cout],
                };
                let invariant = Requantise::Invariant {
                    gain: vec![0.3; cout],
                    bias: vec![-1.0; cout],
                };
                for (weights, requantise) in [(&weights, &scale), (&mixed, &invariant)] {
                    let input: Vec<i16> = match requantise {
                        Requantise::Scale { .. } => input.clone(),
                        _ => (0..input.len()).map(|i| LIMIT - (i % 3) as i16 * LIMIT).collect(),
                    };
                    check_exact([cin, cout], weights, requantise, &taps, &input, rows, None, false);
                }
            }
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
        plan: None,
    };
    let [cin, cout] = [128, 48];
    for (w, x) in [(i16::MIN, i16::MIN), (i16::MAX, i16::MIN), (511, 2047), (-511, 2047)] {
        let (weights, input) = (vec![w; 27 * cin * cout], vec![x; cin]);
        for (bias, shift) in [(i32::MAX, 0), (i32::MIN, 31), (1 << 29, 30), (-1, 1)] {
            let requantise = Requantise::Shift {
                bias: vec![bias; cout],
                shift: vec![shift; cout],
            };
            check_exact([cin, cout], &weights, &requantise, &taps, &input, rows, None, false);
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
            check_exact([cin, cout], &weights, &requantise, &taps, &input, rows, None, true);
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
        conv.run(isa, taps, &input, 0, whole(&mut out, 1, None, false));
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
    let columns: Vec<i16> = residual.chunks(8).flat_map(|row| &row[2..5]).copied().collect();
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

/// Rows that are there, and made nevertheless.
#[derive(Debug)]
struct Copied<'a>(usize, &'a [u32]);

impl MadeRows for Copied<'_> {
    fn fill(&self, first: usize, rows: &mut [u32]) {
        rows.copy_from_slice(&self.1[first * self.0..][..rows.len()]);
    }
}

#[test]
fn neither_a_plan_nor_rows_that_are_made_when_they_are_read_change_anything() {
    let mut random = Random(5);
    let [rows, cin, cout] = [1300, 40, 40];
    let (taps, _) = kernels(&mut random, rows).swap_remove(5);
    let Taps::Map {
        volume,
        rows: map,
        plan: None,
    } = taps.taps()
    else {
        panic!("the sixth kernel is a surface's");
    };
    let weights: Vec<i16> = (0..volume * cin * cout).map(|_| random.signed(2047) as i16).collect();
    let input: Vec<i16> = (0..rows * cin).map(|_| random.signed(2047) as i16).collect();
    let requantise = Requantise::Invariant {
        gain: vec![0.5; cout],
        bias: vec![0.0; cout],
    };
    let conv = ExactConv::new(volume, cin, cout, &weights, requantise);
    for isa in Isa::available() {
        let plan = Plan::new(rows);
        // From a tile's first row on, and from amid one.
        for first in [512, 0, 700, 512] {
            let run = |taps| {
                let mut out = vec![i16::MIN; (rows - first) * cout];
                conv.run(isa, taps, &input, first, whole(&mut out, cout, None, true));
                out
            };
            let stored = |plan| Taps::Map {
                volume,
                rows: map,
                plan,
            };
            let made = Taps::Made {
                volume,
                rows: &Copied(volume, map),
                plan: &Plan::new(rows),
            };
            let expected = run(stored(None));
            assert!(run(stored(Some(&plan))) == expected, "{isa}, from row {first}");
            assert!(run(made) == expected, "{isa}, made, from row {first}");
            assert_eq!(
                reference::tap(&made, first, 13),
                reference::tap(&stored(None), first, 13)
            );
        }
    }
}

#[test]
fn every_width_and_no_row_at_all_equal_their_definition_to_the_bit() {
    let mut random = Random(4);
    for width in 1..=70 {
        for extents in [[width, 5], [6, width], [width, width]] {
            let (taps, inputs) = kernels(&mut random, 31).swap_remove(3);
            check_random(&mut random, &taps.taps(), [31, inputs], extents);
        }
    }
    for rows in [0, 1] {
        for (taps, inputs) in kernels(&mut random, rows) {
            check_random(&mut random, &taps.taps(), [rows, inputs], [16, 24]);
        }
    }
}
