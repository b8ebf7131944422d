//! Coefficients of colours as bytes: triples of whole numbers, most of them zero, under probabilities that follow what
//! was coded.
//!
//! The triples of a slice come in parts, and of each part only some channels are *present*: all three, the first, the
//! last two, or none. Those that are not are 0 without a decision; a part without any takes no decision at all and
//! leaves everything below as it is.
//!
//! A triple is coded in decisions between 0 and 1, each under the probability of its context. A context holds two
//! numbers of 16 bits, *quick* and *slow*, how likely 0 is in units of 2⁻¹⁶; the decision's row has the two entries `p`
//! and `2¹⁶ − p`, where `p` is half of their sum, rounded down, but at least 64 and at most 2¹⁶ − 64. After a 0 they
//! grow by `(65535 − quick) >> r` and `(65535 − slow) >> t`, after a 1 they shrink by `quick >> r` and `slow >> t`.
//! With d as the decisions made in the context before, and b as the bits of d + 2 (⌊log₂(d + 2)⌋ + 1), r is b, but at
//! most 4, and t is b, but at most 7.
//!
//! The *activity* of a channel is the running mean of its magnitudes, in units of 2⁻¹²: 0 at first, and after a triple
//! with the magnitude `m` it grows by `(4096·min(m, 15) − activity) >> 2`, rounded down. The *class* of a number is how
//! many of [`CLASSES`] it reaches.
//!
//! 1. Is anything not 0? Context: the class of the sum of the three activities.
//! 2. For each channel present: is it not 0? Context: the channel; the class of its activity; the sum of magnitudes
//!    before it in the triple, at most 2. Left out for the last channel present, if the others are 0: then it is not.
//! 3. If it is not: is it negative? That is an equiprobable bit. Then its magnitude less 1 in as many ones, at most 14,
//!    and, unless there are 14, a zero. Context: whether it is the first channel; the class as before; how many ones
//!    came before it, at most 3. After 14 ones, what is left, less 14, plus 1, is `e`, which follows as distances from
//!    a row do: `⌊log₂ e⌋` ones, a zero, and the lowest bits of `e`.
//!
//! Contexts start with both numbers at [`FIRST`] of their class. A slice is coded as latents are ([`super`]), by
//! itself.

use std::fmt::Display;
use std::num::NonZeroU16;
use std::ops::Range;

use constriction::stream::model::{DecoderModel, EntropyModel};

use super::slice::{self, END_STATE};
use crate::coding::ans::{BITS, Interval, Stack};
use crate::error::{Error, Result, Stage};

/// Where classes of activity begin.
const CLASSES: [i32; 7] = [80, 240, 500, 1000, 1800, 3300, 6500];
/// How likely 0 is at first, in each class.
const FIRST: [u16; CLASSES.len() + 1] = [64_000, 61_500, 58_000, 53_000, 47_000, 40_000, 32_000, 24_000];
const LEAST: u32 = 64;
const QUICK: u32 = 4;
const SLOW: u32 = 7;
/// Ones of a magnitude before the rest is coded otherwise.
const ONES: u32 = 14;
/// Ones that contexts tell apart.
const COUNTED: u32 = 3;
/// Ones before the zero of the rest.
const MAX_PREFIX: u32 = 15;

/// How likely 0 is.
#[derive(Debug, Clone, Copy)]
struct Context {
    quick: u16,
    slow: u16,
    /// Decisions so far, up to where that stops to matter.
    made: u8,
}

impl Context {
    fn new(first: u16) -> Context {
        Context {
            quick: first,
            slow: first,
            made: 0,
        }
    }

    fn interval(self, bit: bool) -> Interval {
        let p = (u32::from(self.quick) + u32::from(self.slow)) / 2;
        let p = p.clamp(LEAST, (1 << 16) - LEAST) as u16;
        match bit {
            false => Interval { start: 0, size: p },
            true => Interval {
                start: p,
                size: 0u16.wrapping_sub(p),
            },
        }
    }

    fn learn(&mut self, bit: bool) {
        let rate = u8::BITS - (self.made + 2).leading_zeros();
        let (quick, slow) = (rate.min(QUICK), rate.min(SLOW));
        self.made += u8::from(rate < SLOW);
        if bit {
            self.quick -= self.quick >> quick;
            self.slow -= self.slow >> slow;
        } else {
            self.quick += (u16::MAX - self.quick) >> quick;
            self.slow += (u16::MAX - self.slow) >> slow;
        }
    }
}

/// Symbols are the two outcomes.
impl EntropyModel<BITS> for Context {
    type Symbol = bool;
    type Probability = u16;
}

impl DecoderModel<BITS> for Context {
    #[inline(always)]
    fn quantile_function(&self, quantile: u16) -> (bool, u16, NonZeroU16) {
        let bit = quantile >= self.interval(true).start;
        let (start, size) = self.interval(bit).parts();
        (bit, start, size)
    }
}

/// Contexts of one kind of decision: one for each class and `N` other circumstances.
type Contexts<const N: usize> = [[Context; N]; FIRST.len()];

fn contexts<const N: usize>() -> Contexts<N> {
    FIRST.map(|first| [Context::new(first); N])
}

/// Where decisions go to, or come from.
trait Decisions {
    /// The decision that is made: the encoder's is `bit`, the decoder's what it reads.
    fn decide(&mut self, context: Context, bit: bool) -> bool;
    /// The same with both as likely.
    fn even(&mut self, bit: bool) -> bool;
}

/// The intervals that an encoder puts on the stack at the end, the last first.
struct Record(Vec<Interval>);

impl Decisions for Record {
    fn decide(&mut self, context: Context, bit: bool) -> bool {
        self.0.push(context.interval(bit));
        bit
    }

    fn even(&mut self, bit: bool) -> bool {
        self.decide(Context::new(1 << 15), bit)
    }
}

impl Decisions for Stack {
    #[inline]
    fn decide(&mut self, context: Context, _: bool) -> bool {
        self.pop(context)
    }

    #[inline]
    fn even(&mut self, _: bool) -> bool {
        self.pop_bit()
    }
}

/// What a slice has learned so far.
struct Model {
    activity: [i32; 3],
    any: Contexts<1>,
    not_zero: [Contexts<3>; 3],
    more: [Contexts<{ COUNTED as usize + 1 }>; 2],
}

fn class(activity: i32) -> usize {
    CLASSES.iter().filter(|&&begin| activity >= begin).count()
}

impl Model {
    fn new() -> Model {
        Model {
            activity: [0; 3],
            any: contexts(),
            not_zero: [contexts(); 3],
            more: [contexts(); 2],
        }
    }

    /// The next triple, of these channels: the encoder's is `wanted`, the decoder's what it reads; `None` if that has a
    /// magnitude beyond 16 bits.
    #[inline]
    fn triple(&mut self, decisions: &mut impl Decisions, present: Range<usize>, wanted: [i16; 3]) -> Option<[i16; 3]> {
        let all: i32 = self.activity.iter().sum();
        let any = &mut self.any[class(all)][0];
        let is = decisions.decide(*any, wanted != [0; 3]);
        any.learn(is);
        let mut triple = [0; 3];
        if is {
            let mut before = 0;
            for channel in present.clone() {
                let class = class(self.activity[channel]);
                let must = channel + 1 == present.end && before == 0;
                let is = must || {
                    let context = &mut self.not_zero[channel][class][before.min(2) as usize];
                    let is = decisions.decide(*context, wanted[channel] != 0);
                    context.learn(is);
                    is
                };
                if is {
                    let negative = decisions.even(wanted[channel] < 0);
                    let more = &mut self.more[channel.min(1)][class];
                    let magnitude = magnitude(decisions, more, wanted[channel].unsigned_abs())?;
                    let magnitude = i16::try_from(magnitude).ok()?;
                    triple[channel] = if negative { -magnitude } else { magnitude };
                    before += i32::from(magnitude);
                }
            }
        }
        for (activity, value) in self.activity.iter_mut().zip(triple) {
            *activity += ((i32::from(value).abs().min(15) << 12) - *activity) >> 2;
        }
        Some(triple)
    }
}

/// A magnitude of at least 1; `None` beyond what any encoder writes.
fn magnitude(decisions: &mut impl Decisions, contexts: &mut [Context], wanted: u16) -> Option<u32> {
    let rest = u32::from(wanted).saturating_sub(1);
    for ones in 0..ONES {
        let context = &mut contexts[ones.min(COUNTED) as usize];
        let more = decisions.decide(*context, rest > ones);
        context.learn(more);
        if !more {
            return Some(ones + 1);
        }
    }
    let wanted = rest.saturating_sub(ONES) + 1;
    let mut bits = 0;
    while decisions.even(bits < wanted.ilog2()) {
        bits += 1;
        if bits > MAX_PREFIX {
            return None;
        }
    }
    let bit = |e, k| e << 1 | u32::from(decisions.even(wanted >> k & 1 == 1));
    let e = (0..bits).rev().fold(1, bit);
    Some(ONES + e)
}

/// Triples of a slice, `T` being a slice of them, of which the same channels are present.
#[derive(Debug, Clone)]
pub struct SlicePart<T> {
    /// The channels: `0..3`, `0..1`, `1..3`, or none.
    pub present: Range<usize>,
    /// The triples.
    pub triples: T,
}

/// Codes the coefficients of one slice; those of channels that are not present must be 0. Of −2¹⁵ the code is that of
/// −2¹⁵ + 1: magnitudes have 15 bits.
pub fn encode_coefficients(parts: &[SlicePart<&[[i16; 3]]>]) -> Vec<u8> {
    let (mut model, mut record) = (Model::new(), Record(Vec::new()));
    for SlicePart { present, triples } in parts.iter().filter(|part| !part.present.is_empty()) {
        for triple in *triples {
            let within = triple.map(|value| value.max(-i16::MAX));
            let coded = model.triple(&mut record, present.clone(), within);
            debug_assert_eq!(coded, Some(within));
        }
    }
    let mut stack = Stack::new(END_STATE, Vec::new());
    record.0.iter().rev().for_each(|&one| stack.push((), one));
    slice::sealed(stack)
}

/// Decodes as many triples as there is room for, which the caller has held against its limits: the work is bounded by
/// that, whatever the bytes. Triples of parts without channels are left as they are.
///
/// # Errors
/// [`Error::Malformed`], naming `at`, if the bytes are not what [`encode_coefficients`] makes of as many.
pub fn decode_coefficients(bytes: &[u8], parts: &mut [SlicePart<&mut [[i16; 3]]>], at: &dyn Display) -> Result<()> {
    let mut stack = slice::open(bytes, at)?;
    let mut model = Model::new();
    for SlicePart { present, triples } in parts.iter_mut().filter(|part| !part.present.is_empty()) {
        for triple in triples.iter_mut() {
            let read = model.triple(&mut stack, present.clone(), [0; 3]);
            *triple = read.ok_or_else(|| {
                let (field, found) = ("colour coefficient", "one of 16 bits or more");
                Error::malformed(Stage::Entropy, at, field, found, "magnitudes of 15 bits").breaks("14.3.4")
            })?;
        }
    }
    slice::expect_end(stack, at)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Random;
    use proptest::prelude::*;

    /// All channels of as many triples.
    fn decode(bytes: &[u8], count: usize) -> Result<Vec<[i16; 3]>> {
        let mut triples = vec![[0; 3]; count];
        let whole = SlicePart {
            present: 0..3,
            triples: &mut triples[..],
        };
        decode_coefficients(bytes, &mut [whole], &"slice 0")?;
        Ok(triples)
    }

    fn encode(triples: &[[i16; 3]]) -> Vec<u8> {
        encode_coefficients(&[SlicePart { present: 0..3, triples }])
    }

    fn channels() -> impl Strategy<Value = Range<usize>> {
        prop::sample::select(vec![0..3, 0..1, 1..3, 0..0])
    }

    fn value() -> impl Strategy<Value = i16> {
        prop_oneof![8 => Just(0), 4 => -2i16..=2, 2 => -40i16..=40, 1 => -i16::MAX..=i16::MAX]
    }

    proptest! {
        #[test]
        fn any_coefficients_come_back(triples in prop::collection::vec([value(), value(), value()], 0..300)) {
            let bytes = encode(&triples);
            prop_assert_eq!(decode(&bytes, triples.len()).unwrap(), triples);
        }

        #[test]
        fn channels_that_are_not_present_cost_nothing_and_the_others_come_back(
            first in (channels(), prop::collection::vec([value(), value(), value()], 0..100)),
            second in (channels(), prop::collection::vec([value(), value(), value()], 0..100)),
        ) {
            let mut parts = [first, second];
            for (present, triples) in &mut parts {
                for triple in triples {
                    (0..3).filter(|k| !present.contains(k)).for_each(|k| triple[k] = 0);
                }
            }
            let part = |(present, triples): &(Range<usize>, Vec<[i16; 3]>)| (present.clone(), triples.clone());
            let bytes = encode_coefficients(&parts.each_ref().map(|(present, triples)| SlicePart {
                present: present.clone(),
                triples: &triples[..],
            }));
            let mut decoded = parts.each_ref().map(part);
            decoded.iter_mut().for_each(|(_, triples)| triples.fill([0; 3]));
            let mut room = decoded.each_mut().map(|(present, triples)| SlicePart {
                present: present.clone(),
                triples: &mut triples[..],
            });
            decode_coefficients(&bytes, &mut room, &"slice 0").unwrap();
            prop_assert_eq!(&decoded, &parts);
            if parts.iter().all(|(present, _)| present.is_empty()) {
                prop_assert_eq!(bytes, encode(&[]));
            }
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), count in 0..2000usize) {
            if let Ok(triples) = decode(&bytes, count) {
                prop_assert_eq!(triples.len(), count);
            }
        }
    }

    #[test]
    fn magnitudes_of_every_length_come_back() {
        let ends = (0..15).flat_map(|bit| [1 << bit, (1 << bit) + 13, (1 << bit) + 14]);
        let all = ends.chain([i16::MAX]).map(|m: i16| [m, 0, -m]);
        let all: Vec<_> = all.collect();
        assert_eq!(decode(&encode(&all), all.len()).unwrap(), all);
    }

    #[test]
    fn the_one_magnitude_of_sixteen_bits_is_brought_within() {
        let coded = encode(&[[i16::MIN, 0, 1]]);
        assert_eq!(decode(&coded, 1).unwrap(), [[-i16::MAX, 0, 1]]);
    }

    #[test]
    fn zeros_cost_hardly_anything() {
        let bytes = encode(&vec![[0; 3]; 16_384]);
        assert!(bytes.len() < 40, "{}", bytes.len());
    }

    #[test]
    fn what_is_likelier_after_what_came_takes_fewer_bits_than_its_histogram_says() {
        // Calm for long, then lively for long: an order-0 code would have to average.
        let mut random = Random(3);
        let mut draw = |odds: u64| i16::from(random.next().is_multiple_of(odds));
        let triples: Vec<[i16; 3]> = (0..16_000)
            .map(|i| if i / 2000 % 2 == 0 { 400 } else { 3 })
            .map(|odds| [draw(odds), draw(odds), draw(odds)])
            .collect();
        let ones = triples.as_flattened().iter().filter(|&&x| x != 0).count() as f64;
        let all = 3.0 * triples.len() as f64;
        let entropy = -(ones * (ones / all).log2() + (all - ones) * (1.0 - ones / all).log2());
        let signs = ones;
        let bits = 8.0 * encode(&triples).len() as f64;
        assert!(bits < 0.85 * (entropy + signs), "{bits} of {entropy} + {signs}");
    }

    #[test]
    fn bytes_that_end_early_or_late_are_refused() {
        let triples: Vec<_> = (0..500i16).map(|i| [i % 7 - 3, i % 3, 0]).collect();
        let bytes = encode(&triples);
        let refused = |bytes: &[u8], count| decode(bytes, count).unwrap_err().to_string();
        assert!(refused(&bytes, 499).contains("slice 0"));
        assert!(refused(&bytes, 501).contains("slice 0"));
        assert!(refused(&bytes[..3], 500).contains("length of the slice"));
        assert!(refused(&[&bytes[..], &[0; 4]].concat(), 500).contains("slice 0"));
    }

    #[test]
    fn a_magnitude_beyond_what_is_written_is_refused() {
        let mut record = Record(Vec::new());
        let mut model = Model::new();
        // Any, the first channel, negative, all ones, and a prefix that does not end.
        let any = &mut model.any[0][0];
        record.decide(*any, true);
        record.decide(model.not_zero[0][0][0], true);
        record.even(true);
        let more = &mut model.more[0][0];
        for ones in 0..ONES {
            let context = &mut more[ones.min(COUNTED) as usize];
            record.decide(*context, true);
            context.learn(true);
        }
        (0..=MAX_PREFIX).for_each(|_| {
            record.even(true);
        });
        let mut stack = Stack::new(END_STATE, Vec::new());
        record.0.iter().rev().for_each(|&one| stack.push((), one));
        let error = decode(&slice::sealed(stack), 1).unwrap_err().to_string();
        assert!(error.contains("15 bits"), "{error}");
    }
}
