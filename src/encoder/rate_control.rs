//! The best stream of at most so many bits.
//!
//! Streams of more and more bits are on one path. First λ falls to the value that the model was made for. Then the
//! low-frequency band of the colour residual is coded as well, with λ from twice that value down again: at a higher λ
//! the band costs more than it gains. From there on a fine residual, in smaller and smaller steps, gains more for its
//! bits than latents at a still lower λ. Sizes along the path hardly ever fall, so it is halved until the last that
//! fits is found.

use std::iter::successors;
use std::num::NonZeroU8;

use super::{Encoded, EncoderInput, Options, Residual};
use crate::cloud::ColouredVoxels;
use crate::error::{Error, Result};
use crate::latents::Steps;
use crate::latents::network::Model;
use crate::log::Log;

/// Scales of λ, each about a fifth above the next.
const PRICES: [f32; 9] = [4.0, 3.36, 2.83, 2.38, 2.0, 1.68, 1.41, 1.19, USUAL];

/// The scale of λ with a fine residual.
const USUAL: f32 = 1.0;

/// The highest scale of λ with a coarse residual.
const COARSE: f32 = 2.0;

/// Codes a cloud as well as it can be with at most so many bits for each of its points, the whole stream counted, and
/// says with which options: [`encode`](super::encode) makes the same stream of them. `options` say what else is to be;
/// their scale of λ and residual are ignored.
///
/// From few bits to many it chooses scales of λ from 4 down to 1 without a residual; from 2 to 1 with
/// [`Residual::Coarse`], where filters are made; and 1 with [`Residual::Fine`], in steps from 255 down to 1. More bits
/// never lead back on this path; with more than its end takes, that comes out. It takes at most seven tries, those at a
/// scale that was tried before of the residual alone.
///
/// # Errors
/// [`Error::Usage`] if the bits are no finite number above 0, [`Error::TooFewBits`] if no such stream was found, and
/// those of [`encode`](super::encode).
pub fn encode_to_rate(
    cloud: &ColouredVoxels,
    model: &Model,
    options: &Options,
    bits_per_point: f64,
    log: &Log,
) -> Result<(Encoded, Options)> {
    if !(bits_per_point.is_finite() && bits_per_point > 0.0) {
        return Err(Error::Usage(format!(
            "{bits_per_point} bits per point cannot be kept to: more than 0, and finitely many, can"
        )));
    }
    let points = cloud.voxels.len();
    let bits = |stream: &[u8]| stream.len() as f64 * 8.0 / points as f64;
    let subject = EncoderInput::new(cloud, model, options, log)?;
    // One for each price so far.
    let mut coded = vec![(USUAL, subject.code(USUAL, true, log)?)];
    let path = path(options);
    let most = path.len().ilog2() + 1;
    let (mut tries, mut least, mut best) = (0, f64::INFINITY, None);
    let fits = |at: usize| -> Result<bool> {
        let Options {
            bit_price, residual, ..
        } = path[at];
        tries += 1;
        let name = format!("try {tries} of {most}: λ scale {bit_price:.2}, {residual}");
        let (own, stream) = log.step(name, points, "points", || {
            let known = coded.iter().position(|(price, _)| *price == bit_price);
            let own = known.unwrap_or(coded.len());
            if known.is_none() {
                let new = subject.code(bit_price, options.filter, &Log::off())?;
                coded.push((bit_price, new));
            }
            Ok((own, subject.stream(&coded[own].1, residual)?))
        })?;
        let bits = bits(&stream);
        least = bits.min(least);
        let fits = bits <= bits_per_point;
        if fits {
            best = Some((at, own, stream));
        }
        Ok(fits)
    };
    halve(path.len(), fits)?;
    let (at, own, stream) = best.ok_or(Error::TooFewBits {
        asked: bits_per_point,
        least,
    })?;
    let encoded = subject.checked(stream, &coded[own].1.features, log)?;
    Ok((encoded, path[at].clone()))
}

/// Looks for the last of `count` places that fits, as if all before it did; each that does is after those before.
fn halve(count: usize, mut fits: impl FnMut(usize) -> Result<bool>) -> Result<()> {
    let (mut first, mut end) = (0, count);
    while first < end {
        let middle = first.midpoint(end);
        match fits(middle)? {
            true => first = middle + 1,
            false => end = middle,
        }
    }
    Ok(())
}

/// All that is tried, from few bits to many.
fn path(options: &Options) -> Vec<Options> {
    let plain = PRICES.map(|price| (price, Residual::None)).into_iter();
    let wide = PRICES
        .into_iter()
        .filter(|price| options.filter && *price <= COARSE)
        .map(|price| (price, Residual::Coarse));
    let fine = steps().map(|steps| (USUAL, Residual::Fine(steps)));
    let with = |(bit_price, residual)| Options {
        bit_price,
        residual,
        ..options.clone()
    };
    plain.chain(wide).chain(fine).map(with).collect()
}

/// Of luma from 255 down to 1, each by a sixteenth or by one; where that makes those of chroma an eighth smaller or
/// more, luma's go first.
fn steps() -> impl Iterator<Item = Steps> {
    let next = |step: &NonZeroU8| NonZeroU8::new(step.get() - (step.get() / 16).max(1));
    let lumas = successors(Some(NonZeroU8::MAX), next);
    let mut chroma = u8::MAX;
    lumas.map(Steps::from).flat_map(move |steps| {
        let luma_first = Steps { chroma, ..steps };
        let leaps = chroma < u8::MAX && 8 * (chroma - steps.chroma) >= chroma;
        chroma = steps.chroma;
        leaps.then_some(luma_first).into_iter().chain([steps])
    })
}

#[cfg(test)]
mod tests {
    use std::mem::discriminant;

    use super::*;

    /// The last that fits, and how many tries it took.
    fn last(count: usize, fits: impl Fn(usize) -> bool) -> (Option<usize>, usize) {
        let (mut last, mut tries) = (None, 0);
        let looked = halve(count, |at| {
            tries += 1;
            if fits(at) {
                assert!(last < Some(at), "each is after those before");
                last = Some(at);
            }
            Ok(fits(at))
        });
        looked.unwrap();
        (last, tries)
    }

    #[test]
    fn the_last_that_fits_is_found_in_at_most_seven_tries() {
        let count = path(&Options::default()).len();
        assert_eq!(last(count, |_| false).0, None);
        for end in 0..count {
            let (last, tries) = last(count, |at| at <= end);
            assert_eq!(last, Some(end));
            assert!(tries <= 7, "{tries}");
        }
    }

    #[test]
    fn where_sizes_fall_more_room_still_never_leads_back() {
        let size = |at: usize| at + 13 * (at * 7 % 5);
        let found: Vec<_> = (0..150).map(|room| last(64, |at| size(at) <= room).0).collect();
        assert!(found.is_sorted(), "{found:?}");
        let fit = |(room, at): (usize, &Option<usize>)| at.is_none_or(|at| size(at) <= room);
        assert!(found.iter().enumerate().all(fit));
    }

    #[test]
    fn lambda_falls_and_then_steps_get_smaller() {
        let path = path(&Options::default());
        let parts: Vec<_> = path
            .chunk_by(|a, b| discriminant(&a.residual) == discriminant(&b.residual))
            .collect();
        let ends = |part: &[Options]| {
            let [first, last] = [&part[0], &part[part.len() - 1]];
            assert!(part.is_sorted_by(|a, b| a.bit_price >= b.bit_price));
            [first, last].map(|end| (end.bit_price, end.residual))
        };
        let fine = |luma, chroma| Residual::Fine(Steps { luma, chroma });
        let [none, coarse] = [Residual::None, Residual::Coarse];
        let want = [
            [(4.0, none), (1.0, none)],
            [(2.0, coarse), (1.0, coarse)],
            [(1.0, fine(255, 95)), (1.0, fine(1, 1))],
        ];
        assert_eq!(parts.iter().map(|part| ends(part)).collect::<Vec<_>>(), want);
    }

    #[test]
    fn no_step_is_much_smaller_than_the_one_before_it_and_never_both_are() {
        let steps: Vec<_> = steps().collect();
        for pair in steps.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            assert!(to.luma <= from.luma && to.chroma <= from.chroma && to != from);
            // As far as there are whole steps between.
            assert!(8 * (from.luma - to.luma) <= from.luma.max(8), "{from:?}");
            let both = to.luma < from.luma && 8 * (from.chroma - to.chroma) >= from.chroma;
            assert!(!both, "{from:?} to {to:?}");
        }
    }

    #[test]
    fn the_low_frequency_band_is_coded_only_beside_filters() {
        let options = Options {
            filter: false,
            levels: Some(3..=4),
            ..Options::default()
        };
        for tried in path(&options) {
            assert_ne!(tried.residual, Residual::Coarse);
            assert!(!tried.filter && tried.levels == Some(3..=4));
        }
    }
}
