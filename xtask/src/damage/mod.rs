//! Damaged streams: what is wrong with each, and the clause of `docs/format.md` that it breaks.
//!
//! `tests/data/conformance/damage.txt` has a line for each: name, stream of the suite, clause, then the changes
//! `offset:bytes removed:bytes inserted` in ascending order, offsets being those of the undamaged stream.

mod kinds;
mod parts;
mod scenes;
mod sequence_parts;
mod sequences;

use std::fmt::Write;
use std::path::Path;

use b2p::Decoder;

use crate::{Result, digest_scene, digest_sequence, models};
use parts::Parts;

/// Makes the list of all damaged streams. Each must be refused for the clause that its kind states.
pub fn list(suite: &Path) -> Result<String> {
    let read = |name: &str| std::fs::read(suite.join(format!("{name}.b2p")));
    let mut text = String::new();
    let names = std::fs::read_to_string(suite.join("suite.txt"))?;
    let streams = kinds::all(|name| Parts::of(&read(name).unwrap_or_default()));
    let scenes = scenes::all(&read(scenes::DAMAGED)?);
    let sequences = sequences::all(|name| read(name).unwrap_or_default());
    for kind in streams.into_iter().chain(scenes).chain(sequences) {
        let whole = read(kind.stream)?;
        let mut decoder = Decoder::new();
        let line = names.lines().find(|line| line.split(' ').next() == Some(kind.stream));
        if let Some(model) = line.and_then(|line| line.split(' ').nth(1)) {
            decoder = decoder.with_model(models::model(model));
        }
        let mut found = None;
        let broken = kind.tries.into_iter().find(|bytes| {
            let broken_clause = match kind.stream.split('/').next() {
                Some("scenes") => Some(digest_scene::broken_clause(bytes)),
                Some("sequences") => Some(digest_sequence::broken_clause(bytes)),
                _ => None,
            };
            if let Some(clause) = broken_clause {
                found = clause.map(str::to_owned);
                return clause == Some(kind.clause);
            }
            let checked = decoder.check(bytes);
            found = checked.faults.first().map(|fault| fault.error.to_string());
            checked.faults.first().and_then(|fault| fault.error.clause()) == Some(kind.clause)
        });
        let Some(broken) = broken else {
            return Err(format!("{}: not a breach of {}, but {found:?}", kind.name, kind.clause).into());
        };
        let changes = changes(&whole, &broken);
        writeln!(text, "{} {} {}{changes}", kind.name, kind.stream, kind.clause)?;
    }
    Ok(text)
}

/// The changes from `old` to `new`. What moved is taken as one change.
fn changes(old: &[u8], new: &[u8]) -> String {
    let mut text = String::new();
    let mut put = |at: usize, removed: usize, inserted: &[u8]| {
        let hex: String = inserted.iter().map(|byte| format!("{byte:02x}")).collect();
        text += &format!(" {at}:{removed}:{hex}");
    };
    let ends = old.iter().rev().zip(new.iter().rev());
    let same = old.len().min(new.len());
    let mut tail = ends.take_while(|(a, b)| a == b).count().min(same);
    if old.len() == new.len() {
        tail = 0;
    }
    // Up to where bytes stay in place, changes are small.
    let shift = (0..=same - tail)
        .rev()
        .find(|at| old[..*at].iter().zip(&new[..*at]).filter(|(a, b)| a != b).count() <= 40);
    let fixed = shift.unwrap_or(0);
    let mut at = 0;
    while at < fixed {
        let length = old[at..fixed]
            .iter()
            .zip(&new[at..fixed])
            .take_while(|(a, b)| a != b)
            .count();
        if length > 0 {
            put(at, length, &new[at..at + length]);
        }
        at += length.max(1);
    }
    let (removed, inserted) = (old.len() - tail - fixed, &new[fixed..new.len() - tail]);
    if removed > 0 || !inserted.is_empty() {
        put(fixed, removed, inserted);
    }
    text
}
