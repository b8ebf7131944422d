//! What a sequence decodes to, as hashes, and which clause a damaged one breaks.

use b2p::{DecodedFrame, Decoder, Error, Limits, SequenceDecoder, SequenceReader};

use crate::digest::{gaussians_hash, hash};

/// The lines of the suite: of the sequence its timescale and the tick of each frame, then `level=geometry,colours,surfels`
/// of each level of each frame. Each level is decoded for all frames in turn, or from the last one on, if `backwards`.
pub fn lines(decoder: &Decoder, name: &str, bytes: &[u8], backwards: bool) -> b2p::Result<String> {
    let sequence = SequenceReader::new(bytes, &Limits::default())?;
    sequence.check_end()?;
    let index = sequence.index();
    let mut first = format!("{name} {}", index.timescale);
    for (number, entry) in index.groups.iter().enumerate() {
        let group = sequence.group(number)?;
        let ticks = (0..group.len()).map(|at| entry.start + u64::from(group.ticks(at)));
        first.extend(ticks.map(|tick| format!(" {tick}")));
    }
    let count = sequence.frames();
    let mut frames: Vec<String> = (0..count).map(|frame| format!("{name}/{frame}")).collect();
    for level in sequence.header().base..=sequence.header().top {
        let mut decoder = SequenceDecoder::new(decoder.clone().with_level(level));
        for i in 0..count {
            let number = if backwards { count - 1 - i } else { i };
            let found = decoder.frame(&sequence, number).and_then(|frame| digest(&frame));
            match found {
                // Learned heads do not draw it.
                Err(error) if level == 0 && is_unsupported(&error) => (),
                found => frames[number as usize] += &format!(" {level}={}", found?),
            }
        }
    }
    Ok(format!("{first}\n{}\n", frames.join("\n")))
}

fn is_unsupported(error: &Error) -> bool {
    match error {
        Error::Frame { source, .. } => is_unsupported(source),
        error => matches!(error, Error::Unsupported { .. }),
    }
}

fn digest(frame: &DecodedFrame) -> b2p::Result<String> {
    let points = frame.points().expect("a level has been reached");
    Ok(format!(
        "{},{},{}",
        hash(points.voxels.keys().iter().flat_map(|key| key.to_le_bytes())),
        hash(points.colours.iter().flatten().copied()),
        gaussians_hash(&frame.gaussians()?),
    ))
}

/// The clause that a sequence breaks first: in its index, in a frame, or at its end.
pub fn broken_clause(bytes: &[u8]) -> Option<&'static str> {
    let limits = Limits::unlimited();
    let faults = match SequenceReader::new(bytes, &limits) {
        Ok(sequence) => SequenceDecoder::new(Decoder::new().with_limits(limits)).faults(&sequence),
        Err(error) => vec![error],
    };
    faults.first().and_then(|error| error.clause())
}
