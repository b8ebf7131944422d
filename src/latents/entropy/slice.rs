//! One slice: latents to bytes and back.

use std::fmt::Display;

use super::rows::Row;
use super::tables::Tables;
use crate::coding::ans::Stack;
use crate::error::{Error, Result, Stage};

/// The coder's state before the first symbol is put on the stack, so after the last one is taken off.
pub const END_STATE: u64 = 0x1_9e37_79b9;

/// In place of a scale index: this latent has no prediction, and is coded as at a base level without one.
pub const UNPREDICTED: u8 = u8::MAX;

/// Ones before the zero of an escape: distances are below 2²¹.
const MAX_PREFIX: u32 = 20;

/// States of the coder take these numbers of bytes.
const LEAST_STATE_BYTES: usize = 5;
const WORD_BYTES: usize = 4;

/// What is known of latents before they are decoded.
#[derive(Debug, Clone, Copy)]
pub enum Condition<'a> {
    /// Nothing but the channel: the base level.
    Prior,
    /// A mean and a scale for each latent, voxel by voxel.
    Gauss {
        /// Means in sixteenths.
        mu: &'a [i16],
        /// Scale indices, 0 to 63; [`UNPREDICTED`] where the channel alone is known.
        sigma: &'a [u8],
    },
}

impl<'a> Condition<'a> {
    /// The condition of the latents `range` alone.
    pub(super) fn of(self, range: std::ops::Range<usize>) -> Condition<'a> {
        match self {
            Condition::Prior => Condition::Prior,
            Condition::Gauss { mu, sigma } => Condition::Gauss {
                mu: &mu[range.clone()],
                sigma: &sigma[range],
            },
        }
    }

    pub(super) fn check(&self, tables: &Tables, latents: usize) {
        assert_eq!(latents % tables.channels(), 0, "latents come in whole voxels");
        if let Condition::Gauss { mu, sigma } = self {
            assert_eq!(
                (mu.len(), sigma.len()),
                (latents, latents),
                "one mean and scale per latent"
            );
        }
    }

    /// The row of latent `i`, and what its values count from.
    #[inline]
    pub(super) fn row<'t>(&self, tables: &'t Tables, i: usize) -> (Row<'t>, i32) {
        match self {
            Condition::Gauss { mu, sigma } => row(tables, i % tables.channels(), mu[i], sigma[i]),
            Condition::Prior => (tables.prior(i % tables.channels()), 0),
        }
    }
}

/// The row of a latent of a channel, and what its values count from.
#[inline]
pub(super) fn row(tables: &Tables, channel: usize, mu: i16, sigma: u8) -> (Row<'_>, i32) {
    match sigma {
        UNPREDICTED => (tables.prior(channel), 0),
        _ => tables.gauss(mu, sigma),
    }
}

/// Codes the latents of one slice, voxel by voxel. Never fails: every `i16` has a code under every row.
///
/// # Panics
/// If the latents are not whole voxels, the condition has not one mean and scale for each, or a scale index is above
/// 63.
pub fn encode_slice(tables: &Tables, condition: Condition, latents: &[i16]) -> Vec<u8> {
    condition.check(tables, latents.len());
    let mut stack = Stack::new(END_STATE, Vec::new());
    // A stack: what is to be read first is put on last.
    for (i, &latent) in latents.iter().enumerate().rev() {
        let (row, centre) = condition.row(tables, i);
        let entry = i32::from(latent) - centre - row.low();
        let values = row.escape() as i32;
        if (0..values).contains(&entry) {
            stack.push(entry as usize, row);
        } else {
            let above = entry >= values;
            let distance = if above { entry - values + 1 } else { -entry };
            push_distance(&mut stack, above, distance as u32);
            stack.push(row.escape(), row);
        }
    }
    sealed(stack)
}

/// The bytes of a slice whose symbols are all on the stack.
pub(super) fn sealed(stack: Stack) -> Vec<u8> {
    let (state, words) = stack.into_parts();
    let state_bytes = (u64::BITS - state.leading_zeros()).div_ceil(8) as usize;
    let mut bytes = Vec::with_capacity(state_bytes + WORD_BYTES * words.len());
    bytes.extend(&state.to_le_bytes()[..state_bytes]);
    bytes.extend(words.iter().rev().flat_map(|word| word.to_le_bytes()));
    bytes
}

/// Decodes `voxels` voxels, whose number the caller has held against its limits.
///
/// The work is bounded by that number, whatever the bytes.
///
/// # Errors
/// [`Error::Malformed`], naming `at`, if the bytes are not what [`encode_slice`] makes of any latents
/// under this condition.
///
/// # Panics
/// As [`encode_slice`] does.
pub fn decode_slice(
    tables: &Tables,
    condition: Condition,
    bytes: &[u8],
    voxels: usize,
    at: &dyn Display,
) -> Result<Vec<i16>> {
    let mut latents = vec![0; voxels * tables.channels()];
    decode_into(tables, condition, bytes, &mut latents, at)?;
    Ok(latents)
}

pub(super) fn decode_into(
    tables: &Tables,
    condition: Condition,
    bytes: &[u8],
    latents: &mut [i16],
    at: &dyn Display,
) -> Result<()> {
    let mut reader = Reader::open(tables, bytes, at)?;
    reader.read(condition, latents)?;
    reader.finish()
}

/// A slice that is read part by part.
pub(super) struct Reader<'a> {
    tables: &'a Tables,
    stack: Stack,
    at: &'a dyn Display,
}

impl<'a> Reader<'a> {
    /// # Errors
    /// [`Error::Malformed`], naming `at`, if the bytes do not begin as a slice does.
    pub fn open(tables: &'a Tables, bytes: &[u8], at: &'a dyn Display) -> Result<Self> {
        Ok(Reader {
            tables,
            stack: open(bytes, at)?,
            at,
        })
    }

    /// The next latents, whole voxels.
    ///
    /// # Errors
    /// [`Error::Malformed`], naming `at`, if one is no number of 16 bits.
    pub fn read(&mut self, condition: Condition, latents: &mut [i16]) -> Result<()> {
        condition.check(self.tables, latents.len());
        for (i, latent) in latents.iter_mut().enumerate() {
            let (row, centre) = condition.row(self.tables, i);
            *latent = self.under(row, centre)?;
        }
        Ok(())
    }

    /// The next latent, of a channel that is predicted so; [`UNPREDICTED`] in place of a scale index if it is not.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_one(&mut self, channel: usize, mu: i16, sigma: u8) -> Result<i16> {
        let (row, centre) = row(self.tables, channel, mu, sigma);
        self.under(row, centre)
    }

    #[inline]
    fn under(&mut self, row: Row, centre: i32) -> Result<i16> {
        let entry = self.stack.pop(row);
        let value = if entry < row.escape() {
            centre + row.low() + entry as i32
        } else {
            let (above, distance) = pop_distance(&mut self.stack, self.at)?;
            match above {
                true => centre + row.low() + row.escape() as i32 - 1 + distance,
                false => centre + row.low() - distance,
            }
        };
        let expected = "a number of 16 bits";
        i16::try_from(value).map_err(|_| malformed("10.3.4", self.at, "latent", value, expected))
    }

    /// Nothing may be left.
    ///
    /// # Errors
    /// [`Error::Malformed`], naming `at`, if something is.
    pub fn finish(self) -> Result<()> {
        expect_end(self.stack, self.at)
    }
}

/// Fails, naming `at`, if anything is left on the stack.
pub(super) fn expect_end(stack: Stack, at: &dyn Display) -> Result<()> {
    let (state, words) = stack.into_parts();
    if !words.is_empty() {
        let left = format!("{} bytes", words.len() * WORD_BYTES);
        return Err(malformed("10.3.5", at, "rest after the last symbol", left, "none"));
    }
    if state != END_STATE {
        let (state, end) = (format!("{state:#x}"), format!("{END_STATE:#x}"));
        let field = "coder state after the last symbol";
        return Err(malformed("10.3.5", at, field, state, end));
    }
    Ok(())
}

/// The first state and the stack of words, the next to be read on top.
pub(super) fn open(bytes: &[u8], at: &dyn Display) -> Result<Stack> {
    let Some(more) = bytes.len().checked_sub(LEAST_STATE_BYTES) else {
        let expected = format!("at least {LEAST_STATE_BYTES} bytes");
        return Err(malformed("10.3.1", at, "length of the slice", bytes.len(), expected));
    };
    let (first, words) = bytes.split_at(LEAST_STATE_BYTES + more % WORD_BYTES);
    if first.last() == Some(&0) {
        let expected = "a first state in as few bytes as hold it";
        return Err(malformed("10.3.1", at, "highest byte of the coder state", 0, expected));
    }
    let mut state = [0; 8];
    state[..first.len()].copy_from_slice(first);
    let words = words.rchunks_exact(WORD_BYTES);
    let words = words.map(|w| u32::from_le_bytes([w[0], w[1], w[2], w[3]]));
    Ok(Stack::new(u64::from_le_bytes(state), words.collect()))
}

/// Side and distance of an escape, last bit first.
fn push_distance(stack: &mut Stack, above: bool, distance: u32) {
    let bits = distance.ilog2();
    for bit in 0..bits {
        stack.push_bit(distance >> bit & 1 == 1);
    }
    stack.push_bit(false);
    for _ in 0..bits {
        stack.push_bit(true);
    }
    stack.push_bit(above);
}

fn pop_distance(stack: &mut Stack, at: &dyn Display) -> Result<(bool, i32)> {
    let mut bit = || stack.pop_bit();
    let above = bit();
    let mut bits = 0;
    while bit() {
        bits += 1;
        if bits > MAX_PREFIX {
            let expected = format!("at most {MAX_PREFIX}");
            return Err(malformed("10.3.4", at, "ones before an escape's zero", bits, expected));
        }
    }
    let distance = (0..bits).fold(1, |distance, _| distance << 1 | i32::from(bit()));
    Ok((above, distance))
}

fn malformed(
    clause: &'static str,
    at: &dyn Display,
    field: &str,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(Stage::Entropy, at, field, value, expected).breaks(clause)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::latents::entropy::tests::tables;
    use crate::testing::Random;
    use proptest::prelude::*;

    fn decode(condition: Condition, bytes: &[u8], voxels: usize) -> Result<Vec<i16>> {
        decode_slice(&tables(), condition, bytes, voxels, &"slice 0")
    }

    #[test]
    fn a_first_state_in_more_bytes_than_hold_it_is_refused() {
        // Nothing but the state, which has five bytes.
        let bytes = sealed(Stack::new(END_STATE, Vec::new()));
        assert_eq!(bytes.len(), LEAST_STATE_BYTES);
        assert!(open(&bytes, &"slice 0").is_ok());
        for zeros in 1..4 {
            let padded = [&bytes[..], &[0; 3][..zeros]].concat();
            let error = open(&padded, &"slice 0").unwrap_err().to_string();
            assert!(error.contains("highest byte of the coder state"), "{error}");
        }
    }

    proptest! {
        #[test]
        fn any_latents_come_back_under_any_prediction(
            latents in prop::collection::vec((any::<i16>(), any::<i16>(), 0u8..64, 0..4), 0..40)
        ) {
            let k = tables().channels();
            let whole = &latents[..latents.len() / k * k];
            let mu: Vec<i16> = whole.iter().map(|l| l.1).collect();
            let sigma: Vec<u8> = whole.iter().map(|l| l.2).collect();
            // Near the prediction, and anywhere.
            let values: Vec<i16> = whole
                .iter()
                .map(|&(value, mu, _, near)| if near > 0 { value % 100 + mu / 16 } else { value })
                .collect();
            for condition in [Condition::Prior, Condition::Gauss { mu: &mu, sigma: &sigma }] {
                let bytes = encode_slice(&tables(), condition, &values);
                prop_assert_eq!(&decode(condition, &bytes, values.len() / k).unwrap(), &values);
            }
        }

        #[test]
        fn arbitrary_bytes_never_panic(
            bytes in prop::collection::vec(any::<u8>(), 0..200),
            voxels in 0..100usize,
            sigma in 0u8..64,
        ) {
            let count = voxels * tables().channels();
            let (mu, sigma) = (vec![-2047; count], vec![sigma; count]);
            let _ = decode(Condition::Prior, &bytes, voxels);
            let _ = decode(Condition::Gauss { mu: &mu, sigma: &sigma }, &bytes, voxels);
        }
    }

    #[test]
    fn every_value_comes_back_under_every_row() {
        let k = tables().channels();
        let values: Vec<i16> = [0, 1, 2, 3, 400, 4000]
            .into_iter()
            .flat_map(|v| [v, -v])
            .chain([i16::MIN, i16::MAX, 7, 7])
            .collect();
        assert_eq!(values.len() % k, 0);
        for sigma in 0..64 {
            for mu in -2047..=-2032 {
                let (mu, sigma) = (vec![mu; values.len()], vec![sigma; values.len()]);
                let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
                let bytes = encode_slice(&tables(), condition, &values);
                assert_eq!(decode(condition, &bytes, values.len() / k).unwrap(), values);
            }
        }
    }

    #[test]
    fn the_bytes_are_those_that_the_format_describes() {
        // Nothing coded: the end state alone.
        assert_eq!(
            encode_slice(&tables(), Condition::Prior, &[]),
            [0xb9, 0x79, 0x37, 0x9e, 1]
        );
        // By hand: both channels of one voxel, the second read last so put on first. Their rows are -1, 0, 1 and the
        // escape with 16384, 32768, 16383 and 1 of 65536.
        let state = END_STATE;
        let state = (state / 32_768) << 16 | (16_384 + state % 32_768);
        let state = (state / 16_383) << 16 | (49_152 + state % 16_383);
        let bytes = encode_slice(&tables(), Condition::Prior, &[1, 0]);
        assert_eq!(bytes, state.to_le_bytes()[..5]);
    }

    /// Latents drawn from the rows themselves, and the bits that their probabilities promise.
    fn drawn(voxels: usize) -> (Vec<i16>, Vec<u8>, Vec<i16>, f64) {
        let tables = tables();
        let mut random = Random(7);
        let (mut mu, mut sigma, mut latents, mut ideal) = (vec![], vec![], vec![], 0.0);
        while latents.len() < voxels * tables.channels() {
            mu.push((random.next() % 4095) as i16 - 2047);
            sigma.push((random.next() % 64) as u8);
            let (row, centre) = tables.gauss(mu[mu.len() - 1], sigma[sigma.len() - 1]);
            let (entry, interval) = row.find(random.next() as u16);
            if entry == row.escape() {
                mu.pop();
                sigma.pop();
                continue;
            }
            ideal -= (f64::from(interval.size) / 65536.0).log2();
            latents.push((centre + row.low() + entry as i32) as i16);
        }
        (mu, sigma, latents, ideal)
    }

    #[test]
    fn the_size_is_what_the_probabilities_promise() {
        let (mu, sigma, latents, ideal) = drawn(16_384);
        let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
        let bits = 8.0 * encode_slice(&tables(), condition, &latents).len() as f64;
        assert!(bits > ideal && bits < 1.001 * ideal + 64.0, "{bits} bits for {ideal}");
    }

    #[test]
    fn the_coder_alone_notices_nearly_every_damage() {
        let (mu, sigma, latents, _) = drawn(300);
        let voxels = latents.len() / tables().channels();
        let condition = Condition::Gauss { mu: &mu, sigma: &sigma };
        let bytes = encode_slice(&tables(), condition, &latents);
        for length in 0..bytes.len() {
            assert!(decode(condition, &bytes[..length], voxels).is_err(), "cut at {length}");
        }
        let longer = [&bytes[..], &[0; 4]].concat();
        assert!(decode(condition, &longer, voxels).is_err());
        let mut missed = 0;
        for bit in 0..8 * bytes.len() {
            let mut damaged = bytes.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            missed += usize::from(decode(condition, &damaged, voxels).is_ok());
        }
        let share = missed as f64 / (8 * bytes.len()) as f64;
        println!("{missed} of {} flipped bits went unnoticed", 8 * bytes.len());
        assert!(share < 0.01, "{share}");
    }
}
