//! The best stream of at most so many bits.
//!
//! Streams of more and more bits are on one path, which a level and a quantisation step make: first the coarsest level
//! in smaller and smaller steps, then the next level, and so on; at the end of the path are the exact colours of the
//! finest level. A level is on the path from the greatest step that its geometry is worth.

use std::sync::Arc;

use super::quality::{MAX_CHROMA, QualityTarget, steps_of};
use super::reference::Reference;
use super::shape::Shape;
use super::{Coded, EncoderInput, GeometryTarget, Options, Tune, choose_levels};
use crate::cloud::ColouredVoxels;
use crate::colour::{Steps, Truth};
use crate::encoder::Encoded;
use crate::error::{Error, Result};
use crate::log::Log;

/// The coarsest place of a level that the stream could do without: a step of luma of 76 255ths.
const COARSEST: u8 = 116;

/// The same where geometry is lossy, and leaves more bits to colours: a step of luma of 54.
const COARSEST_OF_LOSSY: u8 = 108;

/// Up to this step of luma, refined streams look better at equal sizes.
const SURE: f32 = 32.0;

/// Places that are tried with descent, from the one on that fits without: it adds some bytes.
const DESCENTS: u8 = 4;

/// Shapes that are kept: places next to each other mostly have the same.
const SHAPES: usize = 2;

/// The place that is tried first: a step of luma of 11.
const FIRST: u8 = 72;

/// The steps of a place: luma and chroma become finer in turn.
fn steps_at(at: u8) -> Steps {
    steps_of(at / 2, at.div_ceil(2))
}

/// One place on the path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Place {
    top: u8,
    steps: Steps,
    /// Whether what is drawn is compared with the cloud.
    refined: bool,
    /// Rounds of descent through pictures, after that.
    rounds: usize,
}

/// Codes a cloud as well as it can be with at most so many bits for each of its points, the whole stream counted, and
/// says with which options: [`encode`](super::encode) makes the same stream of them. `options` say what else is to be;
/// of their levels (N − 3 to N of a cloud of N bits by default), the finest may be left out.
///
/// # Errors
/// [`Error::Usage`] if the bits are no finite number above 0, [`Error::TooFewBits`] if the smallest stream has more,
/// and those of [`encode`](super::encode).
pub fn encode_to_rate(
    cloud: &ColouredVoxels,
    options: &Options,
    bits_per_point: f64,
    log: &Log,
) -> Result<(Encoded, Options)> {
    if !(bits_per_point.is_finite() && bits_per_point > 0.0) {
        return Err(Error::Usage(format!(
            "{bits_per_point} bits per point cannot be kept to: more than 0, and finitely many, can"
        )));
    }
    let depth = cloud.voxels.depth();
    let wanted = options.levels.clone();
    let levels = choose_levels(depth, wanted.or(Some(depth.saturating_sub(3)..=depth)))?;
    let mut subject = EncoderInput::new(cloud, levels.clone(), options, log)?;
    let room = bits_per_point * cloud.voxels.len() as f64 / 8.0;
    let mut search = Search {
        subject: &subject,
        room,
        least: f64::INFINITY,
        shapes: Vec::new(),
        truth: None,
        tries: 0,
    };
    let mut found = None;
    for top in levels.clone().rev() {
        let only = top == *levels.start();
        // What does not fit without colours does not fit with them.
        let least = search.least_geometry(top, only, log)?;
        if !only && least > room {
            continue;
        }
        found = search.level(top, only, least, log)?;
        if found.is_some() {
            break;
        }
    }
    let bits = |bytes: f64| bytes * 8.0 / cloud.voxels.len() as f64;
    let (place, coded) = found.ok_or_else(|| Error::TooFewBits {
        asked: bits_per_point,
        least: bits(search.least),
    })?;
    let maps = search.head_map_bytes(place.top) > 0;
    subject.pictures.take();
    let encoded = subject.checked(coded, maps, room as usize, log)?;
    let chosen = Options {
        head_maps: maps,
        levels: Some(*levels.start().min(&place.top)..=place.top),
        fineness: QualityTarget::of(place.steps),
        tune: if place.refined { options.tune } else { Tune::Psnr },
        rounds: place.rounds,
        ..options.clone()
    };
    Ok((encoded, chosen))
}

/// What was found on the way.
struct Search<'a> {
    subject: &'a EncoderInput<'a>,
    /// Bytes that a stream may have.
    room: f64,
    /// Of the smallest stream so far.
    least: f64,
    /// The last [`SHAPES`] shapes, by level and λ.
    shapes: Vec<(u8, u32, Option<Arc<Shape>>)>,
    /// The lossy colours of the level at hand, by its λ, too.
    truth: Option<(u8, u32, Truth)>,
    tries: usize,
}

impl Search<'_> {
    /// The coarsest place of a level; `only` tells that no coarser level could take its place.
    fn last(&self, only: bool) -> u8 {
        match self.subject.options.geometry {
            _ if only => 2 * MAX_CHROMA,
            GeometryTarget::Exact => COARSEST,
            _ => COARSEST_OF_LOSSY,
        }
    }

    /// The largest stream with the last level `top` that fits, if there is one. `fixed` are bytes that all of them have.
    fn level(&mut self, top: u8, only: bool, fixed: f64, log: &Log) -> Result<Option<(Place, Coded)>> {
        let range = LevelRange {
            top,
            last: self.last(only),
            fixed,
        };
        let Some((at, mut best)) = self.finest(range, FIRST, false, log)? else {
            return Ok(None);
        };
        if at == 0 {
            let exact = Place {
                top,
                steps: Steps::LOSSLESS,
                refined: false,
                rounds: 0,
            };
            if let (_, Some(found)) = self.attempt(exact, log)? {
                return Ok(Some(found));
            }
        }
        // Refined streams are larger: of the places that are coarser, the finest that fits then.
        if self.subject.is_refined(best.0.steps) {
            let first = (at + 2).min(range.last);
            if let Some((at, refined)) = self.finest(range, first, true, log)? {
                let refined = self.descended(range, at, refined, log)?;
                if self.looks_better(&refined, &best, log)? {
                    best = refined;
                }
            }
        }
        Ok(Some(best))
    }

    /// The finest place from `at` on whose stream fits with descent, if that is asked for; `refined`, which fits without,
    /// if there is none.
    fn descended(&mut self, range: LevelRange, at: u8, refined: (Place, Coded), log: &Log) -> Result<(Place, Coded)> {
        let rounds = self.subject.options.rounds;
        let tried = if rounds > 0 { DESCENTS } else { 0 };
        for at in (at..=range.last).take(tried.into()) {
            let place = Place {
                steps: steps_at(at),
                rounds,
                ..refined.0
            };
            if let (_, Some(found)) = self.attempt(place, log)? {
                return Ok(found);
            }
        }
        Ok(refined)
    }

    /// Whether a refined stream looks more like the cloud than one of mean colours, in finer steps.
    fn looks_better(&self, refined: &(Place, Coded), plain: &(Place, Coded), log: &Log) -> Result<bool> {
        let (place, subject) = (refined.0, self.subject);
        if place.steps.luma_step() <= SURE {
            return Ok(true);
        }
        log.step("compare pictures", plain.1.colours.len(), "voxels", || {
            let reference = Reference::new(subject.isa, subject.cloud, subject.sparse, std::iter::once(place.top))?;
            let errors = |coded: &Coded| reference.errors(place.top, &subject.drawn(coded)?);
            let ([whole, foreground], [old_whole, old_foreground]) = (errors(&refined.1)?, errors(&plain.1)?);
            Ok(whole / old_whole.max(1e-12) + foreground / old_foreground.max(1e-12) <= 2.0)
        })
    }

    /// The finest place of a level whose stream fits, and that stream; `first` is tried first.
    fn finest(
        &mut self,
        range: LevelRange,
        first: u8,
        refined: bool,
        log: &Log,
    ) -> Result<Option<(u8, (Place, Coded))>> {
        let LevelRange { top, last, fixed } = range;
        // Bytes of the finest place that fits and of the coarsest that does not, beyond the geometry's.
        let (mut fits, mut exceeds): (Option<Candidate>, Option<Candidate>) = (None, None);
        let mut best = None;
        let mut next = Some(first);
        let mut tries = 0;
        while let Some(at) = next {
            if best.is_some() && tries >= self.subject.options.tries {
                break;
            }
            tries += 1;
            let place = Place {
                top,
                steps: steps_at(at),
                refined,
                rounds: 0,
            };
            let (size, found) = self.attempt(place, log)?;
            let tried = Some(Candidate {
                at,
                bytes: (size - fixed).max(1.0),
            });
            match found {
                Some(found) => (fits, best) = (tried, Some((at, found))),
                None => exceeds = tried,
            }
            next = between(fits, exceeds, self.room - fixed, last);
        }
        Ok(best)
    }

    /// The shape of a stream with the last level `top` and these steps.
    fn shape(&mut self, top: u8, steps: Steps, log: &Log) -> Result<Option<Arc<Shape>>> {
        let lambda = self.subject.lambda(top, steps);
        let known = self.shapes.iter().find(|known| (known.0, known.1) == (top, lambda));
        if let Some((_, _, shape)) = known {
            return Ok(shape.clone());
        }
        let shape = self.subject.shape(top, lambda, log)?;
        if self.shapes.len() == SHAPES {
            self.shapes.remove(0);
        }
        self.shapes.push((top, lambda, shape.clone()));
        Ok(shape)
    }

    /// Bytes of the geometry of a stream with the last level `top`, at the coarsest place.
    fn least_geometry(&mut self, top: u8, only: bool, log: &Log) -> Result<f64> {
        let shape = self.shape(top, steps_at(self.last(only)), log)?;
        Ok(self.subject.geometry_bytes(top, shape.as_deref()) as f64)
    }

    /// Bytes to set aside for head maps: none where they might take more than 6 % of the stream.
    fn head_map_bytes(&self, top: u8) -> usize {
        let bytes = match self.subject.options.has_head_maps() {
            true => self.subject.head_map_bytes(top),
            false => 0,
        };
        if 16.0 * bytes as f64 <= self.room { bytes } else { 0 }
    }

    /// Codes at a place: the bytes, and the stream if it fits.
    fn attempt(&mut self, place: Place, log: &Log) -> Result<(f64, Option<(Place, Coded)>)> {
        self.tries += 1;
        let Place {
            top,
            steps,
            refined,
            rounds,
        } = place;
        let how = QualityTarget::of(steps);
        let name = format!("try {}: level {top}, {how}", self.tries);
        let points = self.subject.cloud.voxels.len();
        let shape = self.shape(top, steps, log)?;
        let coded = log.step(name, points, "points", || {
            let log = &log.quiet();
            let coded = self.plain(place, shape, log)?;
            match refined {
                true => self.subject.refined(coded, steps, rounds, log),
                false => Ok(coded),
            }
        })?;
        let size = (coded.bytes.len() + self.head_map_bytes(top)) as f64;
        self.least = self.least.min(size);
        Ok((size, (size <= self.room).then_some((place, coded))))
    }

    /// Codes the mean colours of voxels at a place.
    fn plain(&mut self, place: Place, shape: Option<Arc<Shape>>, log: &Log) -> Result<Coded> {
        let Place { top, steps, .. } = place;
        let lossless = steps.is_lossless();
        let lambda = shape.as_ref().map_or(0, |shape| shape.lambda());
        let truth = match self.truth.take() {
            Some((level, of, truth)) if !lossless && (level, of) == (top, lambda) => truth,
            _ => self.subject.truth(top, shape.as_deref(), lossless),
        };
        let coded = self.subject.code_towards(&truth, top, steps, shape, log);
        if !lossless {
            self.truth = Some((top, lambda, truth));
        }
        coded
    }
}

/// The places of a level.
#[derive(Debug, Clone, Copy)]
struct LevelRange {
    top: u8,
    /// The coarsest one.
    last: u8,
    /// Bytes that streams of all of them have.
    fixed: f64,
}

/// A candidate that was tried.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    at: u8,
    bytes: f64,
}

/// The place to try next, from the one that fits and the one that does not, near where the room ends: bytes are about a
/// power of the step. `None` if nothing is between them.
fn between(fits: Option<Candidate>, exceeds: Option<Candidate>, room: f64, last: u8) -> Option<u8> {
    /// How much the logarithm of the bytes falls from one place to the next, more or less.
    const SLOPE: f64 = 0.038;
    let low = exceeds.map_or(0, |tried| tried.at + 1);
    let high = match fits {
        Some(tried) => tried.at.checked_sub(1)?,
        None => last,
    };
    if low > high {
        return None;
    }
    let known = fits.or(exceeds)?;
    let slope = match (fits, exceeds) {
        (Some(a), Some(b)) => (b.bytes / a.bytes).ln() / (f64::from(a.at) - f64::from(b.at)).max(1.0),
        _ => SLOPE,
    };
    let off = (known.bytes / room.max(1.0)).ln() / slope.max(0.01);
    // A little to the side that fits, so that both sides close in.
    let guess = f64::from(known.at) + off + 0.3;
    Some(guess.round().clamp(f64::from(low), f64::from(high)) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The place that is found where so many bytes are taken, and how many tries it took.
    fn search(bytes: impl Fn(u8) -> f64, room: f64) -> (Option<u8>, usize) {
        let (mut fits, mut exceeds, mut tries) = (None, None, 0);
        let mut next = Some(FIRST);
        while let Some(at) = next {
            tries += 1;
            let tried = Some(Candidate { at, bytes: bytes(at) });
            match bytes(at) <= room {
                true => fits = tried,
                false => exceeds = tried,
            }
            next = between(fits, exceeds, room, COARSEST);
        }
        (fits.map(|tried: Candidate| tried.at), tries)
    }

    #[test]
    fn the_finest_step_that_fits_is_found_in_a_few_tries() {
        for (slope, more) in [(0.015, 0.0), (0.04, 300.0), (0.1, 0.0)] {
            let bytes = |at: u8| 1e6 * (-slope * f64::from(at)).exp() + more;
            for at in 0..=COARSEST {
                let (found, tries) = search(bytes, bytes(at) + 0.1);
                assert_eq!(found, Some(at));
                assert!(tries <= 12, "{tries} tries for {at} at {slope}");
            }
            assert_eq!(search(bytes, bytes(COARSEST) - 1.0).0, None);
        }
    }
}
