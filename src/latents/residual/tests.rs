use super::*;
use crate::testing::Random;
use proptest::prelude::*;
use std::collections::BTreeSet;

fn keys(seed: u64, count: usize, depth: u32) -> Vec<u64> {
    let mut random = Random(seed);
    let draw = (0..count).map(|_| random.next() >> (64 - 3 * depth));
    draw.collect::<BTreeSet<_>>().into_iter().collect()
}

/// Both bands in the same steps.
fn steps(luma: u8, chroma: u8) -> ResidualSteps {
    let steps = Steps { luma, chroma };
    ResidualSteps {
        fine: steps,
        coarse: steps,
        boundary: 6,
    }
}

/// What is read back of a residual's payloads.
fn reread(residual: &ColourResidual, keys: &[u64]) -> ColourResidual {
    let payloads = residual.to_payloads(keys);
    let chunks = payloads.iter().zip(keys.chunks(residual.slice));
    let slices: Vec<_> = chunks
        .map(|(bytes, keys)| Slice {
            voxels: keys.len() as u32,
            bytes,
            offset: 9,
        })
        .collect();
    let parsed = ColourResidual::parse(&slices, keys, residual.slice, 3);
    parsed.unwrap().expect("payloads")
}

fn colours(seed: u64, count: usize) -> Vec<[f32; 3]> {
    let mut random = Random(seed);
    let mut draw = || (random.next() >> 40) as f32 / (1 << 24) as f32 - 0.5;
    (0..count).map(|_| [draw(), draw(), draw()]).collect()
}

fn grey(count: usize) -> Gaussians {
    Gaussians {
        colour: vec![[0.5; 3]; count],
        ..Gaussians::default()
    }
}

/// What the module's documentation says of one slice, word by word: coefficients in the order of the payload.
fn by_definition(values: &[[f64; 3]], keys: &[u64]) -> Vec<[f64; 3]> {
    let joins_at = |j: usize| (0..64).rev().find(|b| (keys[j] ^ keys[j - 1]) >> b & 1 == 1);
    let mut x = values.to_vec();
    let mut order = Vec::new();
    for bit in 0..63 {
        let joining = (1..keys.len()).filter(|&j| joins_at(j) == Some(bit));
        let joining: Vec<_> = joining.collect();
        for &j in &joining {
            let left = (1..j).rev().find(|&i| joins_at(i) > Some(bit)).unwrap_or(0);
            let next = (j + 1..keys.len()).find(|&i| joins_at(i) >= Some(bit));
            let (v, w) = (j - left, next.unwrap_or(keys.len()) - j);
            let root = |n: usize| (n as f64 / (v + w) as f64).sqrt();
            let (a, c) = (root(v), root(w));
            let (low, high) = (x[left], x[j]);
            x[left] = std::array::from_fn(|k| a * low[k] + c * high[k]);
            x[j] = std::array::from_fn(|k| a * high[k] - c * low[k]);
        }
        order.splice(0..0, joining);
    }
    order.insert(0, 0);
    order.into_iter().map(|j| x[j]).collect()
}

#[test]
fn coefficients_are_those_of_the_definition_and_those_decode_to_the_colours() {
    for (seed, count, depth) in [(1, 1, 1), (2, 2, 21), (3, 9, 1), (4, 300, 3), (5, 700, 21)] {
        let keys = keys(seed, count, depth);
        let missing = colours(seed, keys.len());
        let residual = ColourResidual::of(&missing, &keys, keys.len(), steps(1, 1));
        let luma = |rgb: &[f32; 3]| BASIS.map(|unit| (0..3).map(|k| f64::from(unit[k] * rgb[k])).sum::<f64>());
        let values: Vec<_> = missing.iter().map(luma).collect();
        for (found, want) in residual.coefficients.iter().zip(by_definition(&values, &keys)) {
            for (q, want) in found.iter().zip(want) {
                let off = f64::from(*q) - 255.0 * want;
                assert!(off.abs() < f64::from(ROUND_UP) + 1e-3, "{q} for {}", 255.0 * want);
            }
        }
        let mut decoded = grey(keys.len());
        residual.apply(&mut decoded, &keys);
        let squares =
            |(got, want): (&[f32; 3], &[f32; 3])| -> f32 { (0..3).map(|k| (got[k] - 0.5 - want[k]).powi(2)).sum() };
        // The transform keeps squares, so those of the colours are those of the rounding.
        let off: f32 = decoded.colour.iter().zip(&missing).map(squares).sum();
        let most = 3.0 * keys.len() as f32 * (ROUND_UP / 255.0).powi(2);
        assert!(off < most, "{off} of {most}");
    }
}

#[test]
fn finer_steps_take_more_bytes_and_bring_colours_nearer() {
    let keys: Vec<u64> = (0..4096).collect();
    let missing: Vec<_> = colours(7, 4096).iter().map(|c| c.map(|x| 0.3 * x)).collect();
    let mut before = (usize::MAX, 0.0);
    for step in [1, 8, 40, 200] {
        let residual = ColourResidual::of(&missing, &keys, 1000, steps(step, step));
        let bytes = residual.to_payloads(&keys).iter().map(Vec::len).sum();
        let mut decoded = grey(keys.len());
        residual.apply(&mut decoded, &keys);
        let pairs = decoded.colour.as_flattened().iter().zip(missing.as_flattened());
        let off: f32 = pairs.map(|(got, want)| (got - 0.5 - want).powi(2)).sum();
        assert!(bytes < before.0 && off > before.1, "step {step}: {bytes}, {off}");
        before = (bytes, off);
    }
}

#[test]
fn what_is_written_is_read_and_slices_do_not_know_of_each_other() {
    let keys = keys(8, 500, 4);
    let missing = colours(8, keys.len());
    let whole = ColourResidual::of(&missing, &keys, 64, steps(12, 7));
    assert_eq!(reread(&whole, &keys), whole);
    let payloads = whole.to_payloads(&keys);
    for ((payload, missing), keys) in payloads.iter().zip(missing.chunks(64)).zip(keys.chunks(64)) {
        let alone = ColourResidual::of(missing, keys, 64, steps(12, 7));
        assert_eq!(alone.to_payloads(keys), std::slice::from_ref(payload));
    }
}

#[test]
fn all_gaussians_of_a_voxel_get_the_same_and_stay_colours() {
    let residual = ColourResidual {
        slice: 2,
        precisions: vec![steps(255, 9), steps(1, 100)],
        coefficients: vec![[2, 0, 0], [0, 0, 0], [0, 1, 0]],
    };
    let mut some = grey(24);
    some.colour[20] = [0.1, 0.2, 0.9];
    residual.apply(&mut some, &[0, 1, 5]);
    // Two voxels share the mean, and one is alone with a difference of red and blue.
    assert_eq!(some.colour[..16], [[1.0; 3]; 16]);
    let by = 100.0 / 255.0 * BASIS[1][0];
    assert_eq!(some.colour[16], [0.5 + by, 0.5, 0.5 - by]);
    assert_eq!(some.colour[20], [0.1 + by, 0.2, 0.9 - by]);
}

#[test]
fn chromas_are_told_more_finely_unless_said_otherwise() {
    for (luma, chroma) in [(1, 1), (2, 1), (8, 3), (64, 24), (255, 95)] {
        assert_eq!(Steps::from(NonZeroU8::new(luma).unwrap()), Steps { luma, chroma });
    }
}

#[test]
fn the_basis_is_orthonormal() {
    for (i, a) in BASIS.iter().enumerate() {
        for (j, b) in BASIS.iter().enumerate() {
            let dot: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            assert!((dot - f32::from(u8::from(i == j))).abs() < 1e-6);
        }
    }
}

#[test]
fn a_payload_without_steps_or_code_is_refused() {
    let steps = "steps of the colour residual";
    for (bytes, wrong) in [
        (&[][..], steps),
        (&[9, 9, 9, 9], steps),
        (&[0, 0, 0, 0, 9, 3, 4, 5, 6, 7], steps),
        (&[1, 1, 1, 1, 64, 3, 4, 5, 6, 7], steps),
        (&[1, 1, 1, 1, 63, 3], "length of the slice"),
    ] {
        let payload = Slice {
            voxels: 1,
            bytes,
            offset: 100,
        };
        let error = ColourResidual::parse(&[payload], &[0], 64, 3).unwrap_err().to_string();
        assert!(error.contains(wrong), "{error}");
        assert!(error.contains("byte 100, residual of level 3"), "{error}");
        let told = wrong != steps || error.contains("four steps, not all 0, and a bit up to 63");
        assert!(told, "{error}");
    }
}

proptest! {
    #[test]
    fn bands_of_any_steps_come_back_and_are_zero_where_they_have_none(
        own in any::<[bool; 4]>().prop_filter("some step", |own| own.contains(&true)),
        boundary in 0..=ResidualSteps::MAX_BOUNDARY,
        seed in any::<u64>(),
        count in 1..200usize,
    ) {
        let [a, b, c, d] = std::array::from_fn(|i| [3, 5, 7, 11][i] * u8::from(own[i]));
        let precision = ResidualSteps {
            fine: Steps { luma: a, chroma: b },
            coarse: Steps { luma: c, chroma: d },
            boundary,
        };
        let keys = keys(seed, count, 5);
        let residual = ColourResidual::of(&colours(seed, keys.len()), &keys, 50, precision);
        prop_assert_eq!(&reread(&residual, &keys), &residual);
        for (keys, triples) in keys.chunks(50).zip(residual.coefficients.chunks(50)) {
            let coarse = precision.coarse_of(keys);
            for (place, triple) in triples.iter().enumerate() {
                let steps = if place < coarse { precision.coarse } else { precision.fine };
                let told = [steps.luma, steps.chroma, steps.chroma].map(|step| step > 0);
                prop_assert!(triple.iter().zip(told).all(|(q, told)| told || *q == 0));
            }
        }
    }
}

#[test]
fn the_coarse_band_alone_is_the_mean_of_each_cell() {
    // All of four cells of 4³ voxels, which join at bits 6 and 7.
    let keys: Vec<u64> = (0..256).collect();
    let missing = colours(5, keys.len());
    let precision = ResidualSteps {
        fine: Steps::NONE,
        ..steps(1, 1)
    };
    let residual = ColourResidual::of(&missing, &keys, keys.len(), precision);
    let mut decoded = grey(keys.len());
    residual.apply(&mut decoded, &keys);
    for (decoded, missing) in decoded.colour.chunks(64).zip(missing.chunks(64)) {
        for k in 0..3 {
            let mean = missing.iter().map(|c| c[k]).sum::<f32>() / 64.0;
            // A step of a coefficient is an eighth of that of a mean.
            let off = |c: &[f32; 3]| (c[k] - 0.5 - mean).abs();
            assert!(decoded.iter().all(|c| off(c) < 4.0 / 255.0 / 8.0));
        }
    }
    // As many decisions as four triples have, whatever the number of voxels.
    assert!(residual.to_payloads(&keys)[0].len() < 40);
}
