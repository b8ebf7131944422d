//! `b2p check`: whether streams are valid, and where not, which clause of the format they break.

use std::path::Path;

use b2p::container::{Header, ScannedChunk, version};
use b2p::decoder::{Checked, Fault};
use b2p::latents::network::Model;
use b2p::{Decoder, Error, Limits};
use serde_json::{Value, json};

use super::args::Check;
use super::manners::{self, Said};
use super::table::{count, counted};
use super::{Failure, Result, load, scene, sequence};

/// Checks every stream, then fails if one of them is not valid.
pub fn run(args: &Check, limits: &Limits) -> Result<Said> {
    let mut model = None;
    let mut reports = Vec::new();
    for path in &args.inputs {
        reports.push(Report::of(path, args, &mut model, limits)?);
    }
    let bad = reports.iter().filter(|report| !report.is_valid()).count();
    let result = match manners::json() {
        true => format!("{:#}\n", Value::from_iter(reports.iter().map(Report::json))),
        false => reports.iter().map(Report::text).collect::<String>(),
    };
    let said = Said::result(result);
    if bad == 0 {
        return Ok(said);
    }
    said.say()?;
    let streams = counted(reports.len() as u64, "stream");
    Err(Failure(format!("{bad} of {streams} not known to be valid")))
}

/// The clause of the format that a stream breaks, as it is put behind its error.
pub fn named_clause(error: &Error) -> String {
    let named = error.clause().map(|clause| format!(" (clause {clause})"));
    named.unwrap_or_default()
}

/// What is said of a file whose header or index is refused.
pub fn refused(path: &Path) -> impl Fn(Error) -> Failure + '_ {
    move |error| {
        let clause = named_clause(&error);
        let Failure(text) = Failure::in_file(path)(error);
        Failure(text + &clause)
    }
}

/// What is said of a file.
struct Report<'a> {
    path: &'a Path,
    found: Result<Found>,
}

/// What was found in a file.
enum Found {
    /// Of a stream its length, and what was found in it.
    Stream(usize, Box<Checked>),
    Units(Units),
}

/// What was found in a sequence or a scene.
pub struct Units {
    /// How many frames or blocks it has.
    pub count: String,
    pub faults: Vec<UnitFault>,
}

/// What is wrong with a sequence or a scene.
pub struct UnitFault {
    /// The group, frame or block; `None` if it is the file's.
    pub unit: Option<(&'static str, u64)>,
    pub level: Option<u8>,
    /// The byte of the file.
    pub offset: Option<u64>,
    /// What is there.
    pub part: Option<String>,
    pub clause: Option<&'static str>,
    /// What is wrong, and what was expected.
    pub what: String,
}

impl UnitFault {
    /// A fault of the file.
    pub fn of_file(error: &Error) -> Self {
        UnitFault {
            unit: None,
            level: None,
            offset: error.offset(),
            part: None,
            clause: error.clause(),
            what: error.to_string(),
        }
    }

    fn text(&self) -> String {
        let place = [
            self.clause.map(|clause| format!("clause {clause}")),
            self.unit.map(|(name, number)| format!("{name} {number}")),
            self.level.map(|level| format!("level {level}")),
            self.offset.map(|offset| format!("byte {offset}")),
            self.part.clone(),
        ];
        let place: Vec<String> = place.into_iter().flatten().collect();
        match place.is_empty() {
            true => self.what.clone(),
            false => format!("{}: {}", place.join(", "), self.what),
        }
    }

    fn json(&self) -> Value {
        let mut value = json!({
            "clause": self.clause,
            "level": self.level,
            "offset": self.offset,
            "chunk": self.part,
            "what": self.what,
        });
        if let Some((name, number)) = self.unit {
            value[name] = number.into();
        }
        value
    }
}

impl Units {
    fn verdict(&self) -> String {
        match self.faults.len() {
            0 => format!("valid, {}", self.count),
            n => format!("not valid: {}, {}", counted(n as u64, "fault"), self.count),
        }
    }

    fn text(&self) -> String {
        let faults = self.faults.iter().map(|fault| format!("  {}\n", fault.text()));
        format!("{}\n{}", self.verdict(), faults.collect::<String>())
    }

    fn json(&self, name: &str) -> Value {
        json!({
            "input": name,
            "valid": self.faults.is_empty(),
            "verdict": self.verdict(),
            "faults": self.faults.iter().map(UnitFault::json).collect::<Vec<_>>(),
        })
    }
}

impl<'a> Report<'a> {
    fn of(path: &'a Path, args: &Check, model: &mut Option<Model>, limits: &Limits) -> Result<Self> {
        let units = match (scene::is_scene(path), sequence::is_sequence(path)) {
            (true, _) => Some(scene::check(path, limits)),
            (_, true) => Some(sequence::check(path, limits)),
            _ => None,
        };
        if let Some(units) = units {
            let found = units.map(Found::Units);
            return Ok(Report { path, found });
        }
        let bytes = match load::bytes(path, limits) {
            Ok(bytes) => bytes,
            Err(failure) => {
                let found = Err(failure);
                return Ok(Report { path, found });
            }
        };
        let mut decoder = Decoder::new().with_limits(limits.clone());
        if version(&bytes) == Some(2) {
            let model = match model {
                Some(model) => model,
                None => model.insert(load::from_file(args.model.as_deref())?),
            };
            decoder = decoder.with_model(model.clone());
        }
        let found = Ok(Found::Stream(bytes.len(), Box::new(decoder.check(&bytes))));
        Ok(Report { path, found })
    }

    fn is_valid(&self) -> bool {
        match &self.found {
            Ok(Found::Stream(_, checked)) => checked.is_valid(),
            Ok(Found::Units(units)) => units.faults.is_empty(),
            Err(_) => false,
        }
    }

    fn text(&self) -> String {
        let name = self.path.display();
        let (bytes, checked) = match &self.found {
            Ok(Found::Stream(bytes, checked)) => (bytes, checked),
            Ok(Found::Units(units)) => return format!("{name}: {}", units.text()),
            Err(Failure(why)) => return format!("{why}\n"),
        };
        let mut text = format!("{name}: {}\n", verdict(*bytes, checked));
        if let Some(header) = &checked.header {
            text += &contents(header, checked);
        }
        for fault in &checked.faults {
            text += &format!("  {}\n", fault_text(checked, fault));
        }
        if let Some(error) = &checked.unchecked {
            let Failure(why) = why(error);
            text += &format!("  not checked further: {why}\n");
        }
        for note in &checked.notes {
            text += &format!("  note, clause {}, byte {}: {}\n", note.clause, note.offset, note.text);
        }
        text
    }

    fn json(&self) -> Value {
        let name = self.path.display().to_string();
        let (bytes, checked) = match &self.found {
            Ok(Found::Stream(bytes, checked)) => (bytes, checked),
            Ok(Found::Units(units)) => return units.json(&name),
            Err(Failure(why)) => return json!({ "input": name, "valid": false, "verdict": why }),
        };
        let header = checked.header.as_ref();
        let faults = checked.faults.iter().map(|fault| {
            json!({
                "clause": fault.error.clause(),
                "level": fault.level,
                "offset": fault.offset,
                "chunk": checked.chunk_of(fault).map(chunk_text),
                "what": fault.error.to_string(),
            })
        });
        let notes = checked.notes.iter();
        let notes = notes.map(|note| json!({ "clause": note.clause, "offset": note.offset, "what": note.text }));
        json!({
            "input": name,
            "valid": checked.is_valid(),
            "verdict": verdict(*bytes, checked),
            "bytes": bytes,
            "version": header.map(|header| header.format.version()),
            "points": header.map(|header| header.points),
            "levels": header.map(|header| [header.base, header.top]),
            "valid_to_level": checked.valid_to,
            "cut": checked.is_cut,
            "chunks": checked.chunks.len(),
            "faults": faults.collect::<Vec<_>>(),
            "notes": notes.collect::<Vec<_>>(),
            "not_checked": checked.unchecked.as_ref().map(|error| why(error).0),
        })
    }
}

/// The outcome in a few words.
fn verdict(bytes: usize, checked: &Checked) -> String {
    let Some(header) = checked.header.as_ref() else {
        return match checked.is_cut {
            true => "not valid: it ends within the header".into(),
            false => "not valid: the header cannot be read".into(),
        };
    };
    let to = match checked.valid_to {
        Some(level) => format!("complete to level {level}"),
        None => "no level is complete".into(),
    };
    let only_cut = checked
        .faults
        .iter()
        .all(|fault| matches!(fault.error, Error::Truncated { .. }));
    match checked.faults.len() {
        0 if checked.unchecked.is_some() => format!("not checked to the end: {to}"),
        0 if checked.valid_to == Some(header.top) => "valid".into(),
        0 => format!("valid: a prefix, {to} of {}", header.top),
        _ if only_cut && checked.is_cut => format!("cut at byte {}, but {to} of {}", count(bytes as u64), header.top),
        n => format!("not valid: {}, {to} of {}", counted(n as u64, "fault"), header.top),
    }
}

/// What is in the stream.
fn contents(header: &Header, checked: &Checked) -> String {
    let mut text = format!(
        "  version {}, {} at {}, {}\n",
        header.format.version(),
        counted(header.points, "point"),
        counted(header.bits.into(), "bit"),
        counted(checked.chunks.len() as u64, "chunk"),
    );
    for (level, voxels) in (header.base..).zip(&header.voxels) {
        let own = checked.chunks.iter().filter(|chunk| chunk.section == level);
        let mut kinds: Vec<(String, u64)> = Vec::new();
        for kind in own.map(|chunk| chunk.kind.to_string()) {
            match kinds.iter_mut().find(|(known, _)| *known == kind) {
                Some((_, number)) => *number += 1,
                None => kinds.push((kind, 1)),
            }
        }
        let kinds = kinds.iter().map(|(kind, number)| format!("{number} {kind}"));
        let kinds = kinds.collect::<Vec<_>>().join(", ");
        text += &format!(
            "  level {level}: {}; chunks: {kinds}\n",
            counted((*voxels).into(), "voxel")
        );
    }
    text
}

fn fault_text(checked: &Checked, fault: &Fault) -> String {
    let clause = fault.error.clause().unwrap_or("?");
    let mut place = format!("clause {clause}");
    if let Some(level) = fault.level {
        place += &format!(", level {level}");
    }
    if let Some(offset) = fault.offset {
        place += &format!(", byte {offset}");
    }
    if let Some(chunk) = checked.chunk_of(fault) {
        place += &format!(", {}", chunk_text(chunk));
    }
    format!("{place}: {}", fault.error)
}

pub fn chunk_text(chunk: &ScannedChunk) -> String {
    format!("{} chunk of level {}, slice {}", chunk.kind, chunk.level, chunk.slice)
}

/// Why a level was not decoded, with what would help.
fn why(error: &Error) -> Failure {
    let text = error.to_string();
    Failure(match error {
        Error::ModelMismatch { .. } => format!("{text}; --model FILE loads another"),
        Error::LimitExceeded { .. } => format!("{text} (--limits)"),
        _ => text,
    })
}
