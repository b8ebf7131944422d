//! Floats: within the rounding of their sums.

use b2p_kernels::f16;
use b2p_kernels::{FloatConv, Isa, Precision, Scale, Taps, reference};

use crate::cases::{Random, cases, kernels, whole};

/// A layer of random values, plain and geometry-invariant.
fn check_random(random: &mut Random, taps: &Taps<'_>, [rows, inputs]: [usize; 2], [cin, cout]: [usize; 2]) {
    let mut values =
        |n: usize, scale: f32| -> Vec<f16> { (0..n).map(|_| f16::from_f32(random.unit() * scale)).collect() };
    let weights = values(taps.volume() * cin * cout, 0.3);
    let input = values(inputs * cin, 4.0);
    let skip = values(rows * cout, 4.0);
    let bias: Vec<f32> = (0..cout).map(|_| random.unit()).collect();
    let invariant = Scale::Invariant((0..cout).map(|_| random.unit() * 2.0).collect());
    for (scale, relu, residual) in [(Scale::Plain, true, None), (invariant, false, Some(&skip[..]))] {
        let expected = reference::float([cin, cout], &weights, &bias, &scale, taps, &input, rows, residual, relu);
        let conv = FloatConv::new(taps.volume(), cin, cout, &weights, bias.clone(), scale);
        let mut first: Option<Vec<f32>> = None;
        check_bf16(&conv, taps, &input, rows, residual, relu, &expected);
        for isa in Isa::available() {
            let mut out = vec![f32::NAN; rows * cout];
            let mut halves = vec![f16::NAN; rows * cout];
            let output = whole(&mut out, cout, residual, relu);
            conv.run(isa, *taps, &input, 0, output);
            let output = whole(&mut halves, cout, residual, relu);
            conv.run(isa, *taps, &input, 0, output);
            // At most one rounding a term in sequence, and a few for scale and bias.
            let terms = (taps.volume() * cin + 8) as f64;
            for ((&got, &half), want) in out.iter().zip(&halves).zip(&expected) {
                let bound = want.magnitude * terms * f64::from(f32::EPSILON) / 2.0 + 1e-30;
                let error = (f64::from(got) - want.value).abs();
                assert!(error <= bound, "{isa}: {got} against {want:?}: {cin} → {cout}");
                assert_eq!(half, f16::from_f32(got), "{isa}");
            }
            assert!(
                *first.get_or_insert_with(|| out.clone()) == out,
                "{isa} rounds in another order"
            );
        }
    }
}

/// Both factors of a product are off by at most 2⁻⁹ of themselves; adding them up in f32 hardly counts beside that.
fn check_bf16(
    conv: &FloatConv,
    taps: &Taps<'_>,
    input: &[f16],
    rows: usize,
    residual: Option<&[f16]>,
    relu: bool,
    expected: &[reference::Value],
) {
    let of = |precision| conv.clone().with_precision(precision);
    let (conv, fastest) = (of(Precision::Bf16), of(Precision::Fastest));
    for isa in Isa::available() {
        let mut out = vec![f32::NAN; rows * conv.cout()];
        let output = whole(&mut out, conv.cout(), residual, relu);
        conv.run(isa, *taps, input, 0, output);
        if isa.has_tiles() {
            let mut same = vec![f32::NAN; out.len()];
            let output = whole(&mut same, conv.cout(), residual, relu);
            fastest.run(isa, *taps, input, 0, output);
            assert_eq!(same, out, "tiles hold bf16");
        }
        for (&got, want) in out.iter().zip(expected) {
            let error = (f64::from(got) - want.value).abs();
            let bound = want.magnitude / 128.0 + 1e-30;
            assert!(error <= bound, "{isa}: {got} against {want:?} in bf16");
        }
    }
}

/// The root of the mean squared error over that of the values themselves: above f32's wherever it is not f32 after all.
#[test]
fn bf16_is_off_by_a_few_thousandths_and_half_by_less() {
    let mut random = Random(7);
    let [rows, cin, cout] = [600, 64, 64];
    let (taps, _) = kernels(&mut random, rows).swap_remove(5);
    let mut values =
        |n: usize, low: f32| -> Vec<f16> { (0..n).map(|_| f16::from_f32(random.unit().max(low))).collect() };
    let weights = values(27 * cin * cout, -1.0);
    // Of any sign, and as a ReLU leaves them.
    for low in [-1.0, 0.0] {
        let (input, bias) = (values(rows * cin, low), vec![0.0; cout]);
        let expected = reference::float(
            [cin, cout],
            &weights,
            &bias,
            &Scale::Plain,
            &taps.taps(),
            &input,
            rows,
            None,
            false,
        );
        let conv = FloatConv::new(27, cin, cout, &weights, bias, Scale::Plain);
        for precision in [Precision::F32, Precision::Bf16, Precision::Fastest, Precision::Half] {
            let conv = conv.clone().with_precision(precision);
            assert_eq!(conv.precision(), precision);
            for isa in Isa::available() {
                let mut out = vec![0.0f32; rows * cout];
                conv.run(isa, taps.taps(), &input, 0, whole(&mut out, cout, None, false));
                let pairs = out.iter().zip(&expected);
                let (error, size) = pairs.fold((0.0, 0.0), |(error, size), (&got, want)| {
                    let off = f64::from(got) - want.value;
                    (error + off * off, size + want.value * want.value)
                });
                let relative = f64::sqrt(error / size);
                println!("{isa}, {precision:?}, inputs above {low}: {relative:.2e}");
                let expected = match precision {
                    Precision::Bf16 if isa.has_bf16() => 1e-3..4e-3,
                    Precision::Fastest if isa.has_tiles() => 1e-3..4e-3,
                    Precision::Half if isa.has_half() => 1e-4..1e-3,
                    _ => 0.0..1e-6,
                };
                assert!(expected.contains(&relative), "{relative}");
            }
        }
    }
}

#[test]
fn float_layers_stay_within_rounding_of_their_definition() {
    let mut random = Random(3);
    for (taps, rows, inputs, extents) in cases(&mut random) {
        check_random(&mut random, &taps.taps(), [rows, inputs], extents);
    }
}

#[test]
fn every_width_and_no_row_at_all_stay_within_rounding_of_their_definition() {
    let mut random = Random(5);
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

/// Which rows are computed together depends on where a call begins; what a row becomes must not.
#[test]
fn a_row_s_bits_do_not_depend_on_the_rows_beside_it() {
    let mut random = Random(6);
    for (taps, inputs) in kernels(&mut random, 300) {
        let [cin, cout] = [20, 40];
        let taps = taps.taps();
        let mut values = |n: usize| -> Vec<f16> { (0..n).map(|_| f16::from_f32(random.unit())).collect() };
        let (weights, input) = (values(taps.volume() * cin * cout), values(inputs * cin));
        let gain = Scale::Invariant(vec![1.0; cout]);
        let conv = FloatConv::new(taps.volume(), cin, cout, &weights, vec![0.1; cout], gain);
        let half = conv.clone().with_precision(Precision::Half);
        let isas = Isa::available().into_iter();
        for (isa, conv) in isas.flat_map(|isa| [(isa, &conv), (isa, &half)]) {
            let mut together = vec![0.0f32; 300 * cout];
            let output = whole(&mut together, cout, None, false);
            conv.run(isa, taps, &input, 0, output);
            for (first, count) in [(0, 1), (1, 7), (100, 199), (299, 1)] {
                let mut part = vec![0.0f32; count * cout];
                let output = whole(&mut part, cout, None, false);
                conv.run(isa, taps, &input, first, output);
                assert_eq!(part, together[first * cout..][..count * cout], "{isa}");
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
    let infinite = FloatConv::new(1, 1, 1, &[f16::ZERO], vec![0.0], Scale::Invariant(vec![f32::MAX]));
    for isa in Isa::available() {
        let mut out = [f16::ZERO; 2];
        conv.run(isa, Taps::Same, &[f16::MAX; 2], 0, whole(&mut out, 2, None, false));
        assert_eq!(out, [f16::MAX, f16::ZERO], "{isa}");
        let mut out = [f16::NAN; 1];
        infinite.run(isa, Taps::Same, &[f16::ONE], 0, whole(&mut out, 1, None, false));
        assert!(out[0].is_finite(), "{isa}: {}", out[0]);
    }
}
