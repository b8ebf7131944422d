//! Streams whose checksums are right and whose numbers are not.

use b2p::Limits;
use b2p::container::Header;
use b2p::container::Stream;
use b2p::gaussians::Heads;
use b2p::latents::{ColourFilter, ColourResidual};
use rayon::prelude::*;

use crate::common::{all_in, small_stream, with_filter, with_residual};
use crate::seal::{FIXED, chunks, header_end, seal};
use crate::{decoded, model, pushed};

/// What a number of `bits` bits may pretend to be.
fn lies(truth: u64, bits: u32) -> Vec<u64> {
    let most = u64::MAX >> (64 - bits);
    let mut lies = vec![
        0,
        1,
        2,
        truth / 2,
        truth.wrapping_sub(1),
        truth + 1,
        2 * truth,
        8 * truth,
    ];
    lies.extend([16_384, 16_385, most / 8, most / 2, most / 2 + 1, most - 1, most]);
    lies.extend((0..bits).map(|bit| truth ^ 1 << bit));
    lies.retain(|lie| *lie != truth && *lie <= most);
    lies.sort_unstable();
    lies.dedup();
    lies
}

/// Offset and width in bytes of every number of the stream that counts something or says how long something is.
fn numbers(bytes: &[u8]) -> Vec<(usize, usize)> {
    let (levels, end) = header_end(bytes).expect("a header");
    let mut numbers = vec![(80, 4)];
    numbers.extend((FIXED..end).step_by(4).map(|at| (at, 4)));
    assert_eq!(numbers.len(), 1 + 3 * levels);
    for at in chunks(bytes) {
        numbers.extend([(at, 1), (at + 1, 1), (at + 2, 2), (at + 4, 4), (at + 8, 4)]);
    }
    // Depth, base and top level.
    numbers.extend([(20, 1), (21, 1), (22, 1)]);
    numbers
}

/// Whether the stream means the same: a larger slice is none where no level fills two.
fn means_the_same(bytes: &[u8], changed: &[u8]) -> bool {
    let parse = |bytes| Header::parse(bytes, &Limits::unlimited());
    let (Ok(before), Ok(mut after)) = (parse(bytes), parse(changed)) else {
        return false;
    };
    // How fine the cloud was before it was coded bears on nothing but the scale of the world.
    after.bits = before.bits;
    after == before
}

#[test]
fn no_lie_about_a_count_or_a_length_is_believed() {
    let model = model();
    let bytes = small_stream(&model);
    let numbers = numbers(&bytes);
    println!("{} numbers", numbers.len());
    numbers.into_par_iter().for_each(|(at, width)| {
        let mut truth = [0; 8];
        truth[..width].copy_from_slice(&bytes[at..at + width]);
        for lie in lies(u64::from_le_bytes(truth), 8 * width as u32) {
            let mut changed = bytes.clone();
            changed[at..at + width].copy_from_slice(&lie.to_le_bytes()[..width]);
            seal(&mut changed);
            if means_the_same(&bytes, &changed) && at < 24 {
                continue;
            }
            let whole = decoded(&model, &changed, None);
            assert!(whole.is_err(), "{lie} at byte {at} was believed");
            let (_, pieces) = pushed(&model, &changed, None, [50, 200, 3, 1000]);
            assert_eq!(pieces, whole, "{lie} at byte {at}");
        }
    });
}

/// The byte that an error names.
fn place(error: &str) -> Option<usize> {
    let (_, rest) = error.split_once("at: \"byte ").or(error.split_once("offset: "))?;
    let digits = rest.split(|c: char| !c.is_ascii_digit()).next();
    digits?.parse().ok()
}

#[test]
fn a_coder_s_bytes_changed_behind_the_checksums_are_refused() {
    let model = model();
    let bytes = small_stream(&model);
    let starts = chunks(&bytes);
    // What latents of the base level are coded with, and where its voxels lie, nothing else depends on.
    let first_feature = starts.iter().position(|at| bytes[*at] == 2).expect("features");
    let payload = |at: &usize| at + 16..at + 16 + usize::from(bytes[at + 8]) + 256 * usize::from(bytes[at + 9]);
    // What corrects colours means something whatever its steps are, so nobody can tell that those were others.
    let coded = |at: &&usize| bytes[**at] <= 2;
    let tried: usize = starts[first_feature..]
        .par_iter()
        .filter(coded)
        .map(|at| {
            for byte in payload(at) {
                for bit in 0..8 {
                    let mut changed = bytes.clone();
                    changed[byte] ^= 1 << bit;
                    seal(&mut changed);
                    let result = decoded(&model, &changed, None);
                    let Err(error) = result else {
                        panic!("bit {bit} of byte {byte} was believed");
                    };
                    // Counted from the start of the stream; what comes after the change may be found wrong instead.
                    if let Some(place) = place(&error) {
                        assert!((payload(at).start..=bytes.len()).contains(&place), "{error}");
                    }
                }
            }
            8 * payload(at).len()
        })
        .sum();
    println!("{tried} flipped bits behind right checksums, all refused");
}

#[test]
fn a_colour_filter_of_another_length_or_exponent_is_refused_and_the_level_before_stays() {
    let (model, whole) = (model(), small_stream(&model()));
    let with = |filter: &[u8]| with_filter(&whole, Heads::Best, filter);
    let sound = ColourFilter {
        exponent: 15,
        weights: [[127; _]; 3],
    };
    let sound = sound.to_bytes();
    let top = Header::parse(&whole, &Limits::default()).unwrap().top;
    assert!(decoded(&model, &with(&sound), Some(top)).is_ok());
    let before = decoded(&model, &whole, Some(top - 1));
    for (wrong, told) in [
        (sound[1..].to_vec(), "length of the colour filter"),
        ([&sound[..], &[0]].concat(), "length of the colour filter"),
        ([&[16], &sound[1..]].concat(), "exponent of the colour filter"),
    ] {
        let bytes = with(&wrong);
        let error = decoded(&model, &bytes, Some(top)).unwrap_err();
        let named = error.contains("Malformed") && error.contains(told);
        assert!(named && place(&error).is_some_and(|at| at < bytes.len()), "{error}");
        assert_eq!(decoded(&model, &bytes, Some(top - 1)), before);
    }
}

#[test]
fn a_colour_residual_without_steps_or_with_another_code_is_refused_and_the_level_before_stays() {
    let (model, whole) = (model(), small_stream(&model()));
    let stream = Stream::parse(&whole, &Limits::default()).unwrap();
    let top = stream.levels().last().unwrap();
    let slice = stream.header().slice_voxels as usize;
    let count = top.voxels as usize;
    let keys: Vec<u64> = (0..count as u64).collect();
    let missing: Vec<_> = (0..count).map(|i| [(i % 7) as f32 / 9.0; 3]).collect();
    let sound = ColourResidual::of(&missing, &keys, slice, all_in(3)).to_payloads(&keys);
    assert!(sound.len() > 2, "several slices");
    let level = Some(top.level);
    assert!(decoded(&model, &with_residual(&whole, &sound), level).is_ok());
    let before = decoded(&model, &whole, Some(top.level - 1));
    let flipped = [&sound[1][..12], &[!sound[1][12]], &sound[1][13..]].concat();
    for (wrong, told) in [
        (vec![], "steps of the colour residual"),
        ([&[0; 4], &sound[1][4..]].concat(), "steps of the colour residual"),
        (
            [&sound[1][..4], &[64], &sound[1][5..]].concat(),
            "steps of the colour residual",
        ),
        (sound[1][..8].to_vec(), "length of the slice"),
        ([&sound[1][..], &[7; 4]].concat(), "last symbol"),
        (flipped, "last symbol"),
    ] {
        let mut slices = sound.clone();
        // What is wrong later does not show.
        slices[2].clear();
        slices[1] = wrong;
        let bytes = with_residual(&whole, &slices);
        let error = decoded(&model, &bytes, level).unwrap_err();
        let named = error.contains("Malformed") && error.contains(told);
        assert!(named && place(&error).is_some_and(|at| at < bytes.len()), "{error}");
        assert_eq!(decoded(&model, &bytes, Some(top.level - 1)), before);
    }
}
