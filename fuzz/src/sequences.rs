//! Untrusted sequences of frames.

use b2p::container::Header;
use b2p::container::sequence::{GroupEntry, Index};
use b2p::{Decoder, Error, Limits, SequenceDecoder, SequenceReader};

use crate::streams::check;
use crate::transform::limits;
use crate::{giving_back, within};

/// Frames that are decoded of each input.
const FRAMES: u64 = 6;
/// A decoder holds the frame before while it decodes one.
const HELD: usize = 2;

/// Any bytes as a sequence under small limits, as they are and with the hashes of their groups made right: every frame
/// is an error or has as many colours as voxels, the same when it is decoded once more by itself. Memory stays within
/// the limit, and all of it is given back.
pub fn sequence(bytes: &[u8]) {
    giving_back(|| {
        decoded(bytes);
        if let Some(bytes) = sealed(bytes) {
            decoded(&bytes);
        }
    });
}

type Points = (Vec<u64>, Vec<[u8; 3]>);

fn decoded(bytes: &[u8]) {
    let sequence = match SequenceReader::new(bytes, &limits()) {
        Ok(sequence) => sequence,
        Err(error) => return check(&error),
    };
    let frames = sequence.frames().min(FRAMES);
    let most = HELD * (limits().max_bytes + Limits::OVERHEAD) as usize;
    let found = within(most, || {
        let mut decoder = SequenceDecoder::new(Decoder::new().with_limits(limits()));
        (0..frames)
            .map(|n| frame(&mut decoder, &sequence, n))
            .collect::<Vec<_>>()
    });
    if let Some(last) = found.last() {
        let mut decoder = SequenceDecoder::new(Decoder::new().with_limits(limits()));
        let again = frame(&mut decoder, &sequence, frames - 1);
        assert_eq!(
            again.as_ref().ok(),
            last.as_ref().ok(),
            "a frame depends on where decoding began"
        );
    }
}

fn frame(decoder: &mut SequenceDecoder, sequence: &SequenceReader, n: u64) -> Result<Points, ()> {
    match decoder.frame(sequence, n) {
        Ok(frame) => {
            let points = frame.points().expect("a frame has a level");
            assert_eq!(points.voxels.len(), points.colours.len());
            Ok((points.voxels.keys().to_vec(), points.colours.to_vec()))
        }
        Err(Error::Frame { frame, source }) => {
            // It may be an earlier one, which this one is predicted from.
            assert!(frame <= n);
            check(&source);
            Err(())
        }
        Err(error) => {
            check(&error);
            Err(())
        }
    }
}

/// The same sequence, the hashes of its groups those of their bytes.
fn sealed(bytes: &[u8]) -> Option<Vec<u8>> {
    let header = Header::parse_sequence(bytes, &limits()).ok()?;
    let mut index = Index::parse(bytes, &header, &limits()).ok()?;
    let first = index.groups.first()?.offset as usize;
    for group in &mut index.groups {
        let start = usize::try_from(group.offset).ok()?;
        let content = bytes.get(start..start.checked_add(group.bytes as usize)?)?;
        let hash = GroupEntry::of(content, group.frames, group.start, group.ticks)
            .ok()?
            .hash;
        group.hash = hash;
    }
    let mut sealed = header.write_sequence();
    index.write(&mut sealed).ok()?;
    sealed.extend(bytes.get(first..)?);
    Some(sealed)
}
