//! Changes of streams that get past what notices them first: checksums, lengths, the model's identity.

use crate::MODEL;
use crate::seal;

/// Where the header of version 2 holds the model's identity.
const MODEL_ID: usize = 64;

/// How a fuzzer changes the first bytes of a buffer: how many they are, how many they may become; how many they are
/// then.
pub type Change<'a> = &'a mut dyn FnMut(&mut [u8], usize, usize) -> usize;

/// Changes the stream that the first `size` bytes of `data` are, and says how many they are then, `most` at the most.
///
/// The seed tells how. One in four is changed anywhere; one in four too, and then has its checksums recomputed; in the
/// other half the payload of one chunk is changed, and every length, every checksum and the model's identity fit what
/// comes out.
pub fn mutate(data: &mut [u8], size: usize, most: usize, seed: u32, change: Change) -> usize {
    if !seed.is_multiple_of(2)
        && let Some(stream) = with_other_payload(&data[..size], most, seed / 4, change)
    {
        data[..stream.len()].copy_from_slice(&stream);
        return stream.len();
    }
    let size = change(data, size, most);
    if !seed.is_multiple_of(4) {
        seal::seal(&mut data[..size]);
    }
    size
}

/// A stream that fits together, with the payload of one chunk changed; nothing if these bytes have no chunks.
fn with_other_payload(bytes: &[u8], most: usize, which: u32, change: Change) -> Option<Vec<u8>> {
    let places = seal::places(bytes);
    let place = *places.get(which as usize % places.len().max(1))?;
    let length = place.end - place.payload;

    let room = most.checked_sub(bytes.len() - length)?.max(length);
    let mut changed = bytes[place.payload..place.end].to_vec();
    changed.resize(room, 0);
    let now = match room {
        0 => 0,
        _ => change(&mut changed, length, room),
    };
    let mut stream = seal::with_payload(bytes, place, &changed[..now]);
    if b2p::container::version(&stream) == Some(2) {
        stream[MODEL_ID..MODEL_ID + 16].copy_from_slice(&MODEL.id());
        seal::seal(&mut stream);
    }
    (stream.len() <= most).then_some(stream)
}

#[cfg(test)]
mod tests {
    use b2p::Limits;
    use b2p::container::Stream;

    use super::*;
    use crate::seeds::seeds;

    #[test]
    fn a_stream_whose_payload_grows_or_shrinks_still_fits_together() {
        let mut changed = 0;
        for stream in [seeds("stream"), seeds("transform")].concat() {
            // What the trunk of the geometry holds is read with the container.
            let trunk = usize::from(b2p::container::version(&stream) == Some(3));
            let parsed = Stream::parse(&stream, &Limits::default()).expect("a stream");
            assert!(parsed.damage().is_none());
            for which in trunk as u32..seal::chunks(&stream).len() as u32 {
                let mut longer = |data: &mut [u8], size: usize, _| {
                    data[size..size + 3].copy_from_slice(b"abc");
                    size + 3
                };
                let mut shorter = |data: &mut [u8], size: usize, _| {
                    data[..size].reverse();
                    // The first eight bytes of a level's features are their hash.
                    size - size.min(3).min(size.saturating_sub(8))
                };
                let changes: [Change; 2] = [&mut longer, &mut shorter];
                for change in changes {
                    let stream = with_other_payload(&stream, 4000, which, change);
                    let stream = stream.expect("it has chunks");
                    let parsed = Stream::parse(&stream, &Limits::default()).expect("a stream");
                    assert!(parsed.damage().is_none(), "{:?}", parsed.damage());
                    changed += 1;
                }
            }
        }
        assert!(changed > 20);
    }
}
