//! `b2p info` and `b2p check` of a sequence.

use std::path::Path;

use b2p::sequence::FramePart;
use b2p::{Decoder, Error, Limits, SequenceDecoder, SequenceReader};
use serde_json::json;

use super::super::Result;
use super::super::check::{UnitFault, Units, chunk_text, refused};
use super::super::load;
use super::super::manners::{self, Said};
use super::super::table::{count, counted, table};

/// Says what a sequence holds.
pub fn run(path: &Path, limits: &Limits) -> Result<Said> {
    let sequence = super::read(path, limits)?;
    let (mut rows, mut groups) = (Vec::new(), Vec::new());
    rows.push(
        ["group", "frames", "start", "bytes", "whole", "warped", "bits per point"]
            .map(String::from)
            .to_vec(),
    );
    for group in 0..sequence.groups() {
        let frames = sequence.frames_of(group).unwrap_or(0..0);
        let Ok(found) = sequence.group(group) else {
            rows.push(vec![
                group.to_string(),
                format!("{}..{}", frames.start, frames.end),
                "damaged".into(),
            ]);
            groups.push(json!({ "frames": [frames.start, frames.end], "damaged": true }));
            continue;
        };
        let bytes: u64 = (0..found.len()).map(|at| found.frame_bytes(at)).sum();
        let points: u64 = (0..found.len()).map(|at| found.frame_header(at).points).sum();
        let whole = (0..found.len()).filter(|at| found.is_whole(*at)).count();
        let warped = (0..found.len()).filter(|at| found.is_warped(*at)).count();
        let start = sequence.time_of(frames.start)?;
        rows.push(vec![
            group.to_string(),
            format!("{}..{}", frames.start, frames.end),
            format!("{start:.3} s"),
            count(bytes),
            whole.to_string(),
            warped.to_string(),
            format!("{:.4}", bytes as f64 * 8.0 / points.max(1) as f64),
        ]);
        groups.push(json!({
            "frames": [frames.start, frames.end],
            "start": start,
            "bytes": bytes,
            "points": points,
            "whole": whole,
            "warped": warped,
        }));
    }
    let header = sequence.header();
    let (frames, rate, seconds) = (sequence.frames(), sequence.frame_rate(), sequence.seconds());
    if manners::json() {
        let value = json!({
            "frames": frames,
            "frame_rate": rate,
            "seconds": seconds,
            "bits": header.bits,
            "levels": [header.base, header.top],
            "most_points": header.points,
            "groups": groups,
        });
        return Ok(Said::result(format!("{value:#}\n")));
    }
    let text = format!(
        "sequence of {} at {rate:.3} Hz, {seconds:.3} s\n{} deep, levels {} to {}, at most {} a frame\n{}",
        counted(frames, "frame"),
        counted(header.bits.into(), "bit"),
        header.base,
        header.top,
        counted(header.points, "point"),
        table(&rows)
    );
    Ok(Said::result(text))
}

/// Decodes every frame, and says what is wrong, and where.
pub fn check(path: &Path, limits: &Limits) -> Result<Units> {
    let bytes = load::bytes(path, limits)?;
    let sequence = SequenceReader::new(bytes, limits).map_err(refused(path))?;
    let faults = SequenceDecoder::new(Decoder::new().with_limits(limits.clone())).faults(&sequence);
    Ok(Units {
        count: counted(sequence.frames(), "frame"),
        faults: faults.iter().map(|error| placed(&sequence, error)).collect(),
    })
}

/// A fault with what lies at its place.
fn placed(sequence: &SequenceReader, error: &Error) -> UnitFault {
    let of_file = UnitFault::of_file(error);
    let Error::Frame { frame, source } = error else {
        return of_file;
    };
    // What is cut is of the part before its end.
    let before = u64::from(matches!(**source, Error::Truncated { .. }));
    let part = of_file
        .offset
        .and_then(|byte| sequence.part_at(byte - before.min(byte)));
    let text = |part: &FramePart| match &part.chunk {
        Some(chunk) => Some(chunk_text(chunk)),
        None => part.is_motion.then(|| format!("motion of level {}", part.level)),
    };
    let level = match **source {
        Error::DeterminismMismatch { level, .. } => Some(level),
        _ => part.map(|part| part.level),
    };
    UnitFault {
        unit: Some(("frame", *frame)),
        level,
        part: part.as_ref().and_then(text),
        what: source.to_string(),
        ..of_file
    }
}

/// Points of all frames of groups that can be read.
pub fn points(sequence: &SequenceReader) -> Result<u64> {
    let mut points = 0;
    for group in 0..sequence.groups() {
        let group = sequence.group(group)?;
        points += (0..group.len()).map(|at| group.frame_header(at).points).sum::<u64>();
    }
    Ok(points)
}
