//! Validates a stream down to the last bit, and goes on behind a fault where it can.

use std::borrow::Cow;

use super::stream::Decoder;
use super::streaming::{Decoding, State};
use crate::colour::Filter;
use crate::container::feed::Goal;
use crate::container::{Header, Level, Note, Scan, ScannedChunk};
use crate::error::{Error, Result};
use crate::geometry::{KernelMap, Octree, codec};

/// What was found out about a stream.
#[derive(Debug)]
#[non_exhaustive]
pub struct Checked {
    /// The header, if it can be read.
    pub header: Option<Header>,
    /// The chunks whose checksums are valid.
    pub chunks: Vec<ScannedChunk>,
    /// Everything that breaks the format.
    pub faults: Vec<Fault>,
    /// What is unusual, and valid.
    pub notes: Vec<Note>,
    /// The finest level that decodes, as do all before, with valid checksums and hashes.
    pub valid_to: Option<u8>,
    /// The stream ends within a level or its header.
    pub is_cut: bool,
    /// Why levels after `valid_to` were not decoded, if the stream is not to blame: no model, or limits.
    pub unchecked: Option<Error>,
}

/// A breach of the format.
#[derive(Debug)]
#[non_exhaustive]
pub struct Fault {
    /// The level; none of the header.
    pub level: Option<u8>,
    /// Byte offset in the stream, where there is one.
    pub offset: Option<u64>,
    /// What is wrong; [`Error::clause`] is the clause of `docs/format.md`.
    pub error: Error,
}

impl Checked {
    /// Whether the stream is valid, and was checked to the last bit. A stream cut right after a level is.
    pub fn is_valid(&self) -> bool {
        self.faults.is_empty() && self.unchecked.is_none()
    }

    /// The chunk in which a fault lies.
    pub fn chunk_of(&self, fault: &Fault) -> Option<&ScannedChunk> {
        let at = usize::try_from(fault.offset?).ok()?;
        self.chunks.iter().find(|chunk| (chunk.start..chunk.end).contains(&at))
    }

    /// The same of a stream that starts at this byte of a file.
    pub(crate) fn moved(mut self, start: u64) -> Self {
        let place = |byte: u64| start + byte;
        let here = |byte: &mut usize| *byte = byte.saturating_add(usize::try_from(start).unwrap_or(usize::MAX));
        for Fault { offset, error, .. } in &mut self.faults {
            *offset = offset.map(place);
            let own = std::mem::replace(error, Error::Cancelled);
            *error = own.moved(place);
        }
        self.unchecked = self.unchecked.map(|error| error.moved(place));
        for chunk in &mut self.chunks {
            here(&mut chunk.start);
            here(&mut chunk.end);
        }
        self.notes.iter_mut().for_each(|note| here(&mut note.offset));
        self
    }

    fn fault(&mut self, level: Option<u8>, error: Error) {
        let said = error.to_string();
        if self.faults.iter().all(|fault| fault.error.to_string() != said) {
            let offset = error.offset();
            self.faults.push(Fault { level, offset, error });
        }
    }
}

impl Decoder {
    /// Validates a stream of either version: header, order and checksums of all chunks, and the decoded values of every
    /// level. A fault does not end the check where something after it can be told from what it broke.
    pub fn check(&self, bytes: &[u8]) -> Checked {
        let mut checked = Checked {
            header: None,
            chunks: Vec::new(),
            faults: Vec::new(),
            notes: Vec::new(),
            valid_to: None,
            is_cut: false,
            unchecked: None,
        };
        let Some((header, bytes)) = self.check_header(bytes, &mut checked) else {
            return checked;
        };
        note_header(&header, &bytes, &mut checked.notes);
        let scan = Scan::new(&bytes, &header);
        checked.chunks = scan.chunks;
        checked.notes.extend(scan.notes);
        for (level, error) in scan.faults {
            checked.fault(Some(level), error);
        }
        let bytes = scan.bytes;
        let levels = read_levels(&bytes, &header, &mut checked);
        let whole = levels.iter().take_while(|level| level.is_some()).count();
        self.check_levels(&bytes, &header, &levels[..whole], &mut checked);
        if checked.valid_to.map_or(0, |level| usize::from(level - header.base) + 1) < whole {
            self.check_rest(&header, &levels[..whole], &mut checked);
        }
        let start = header.bytes() as u64;
        checked.header = Some(header);
        // In the order of the stream.
        checked.faults.sort_by_key(|fault| match fault.level {
            None if fault.offset >= Some(start) => (u8::MAX, None),
            None => (0, fault.offset),
            Some(level) => (1 + level, fault.offset.or(Some(u64::MAX))),
        });
        checked
    }

    /// The header. If nothing but its checksum is wrong, the stream with the right one.
    fn check_header<'b>(&self, bytes: &'b [u8], checked: &mut Checked) -> Option<(Header, Cow<'b, [u8]>)> {
        let error = match Header::parse(bytes, &self.limits) {
            Ok(header) => return Some((header, Cow::Borrowed(bytes))),
            Err(error) => error,
        };
        checked.is_cut = matches!(error, Error::Truncated { .. });
        let sum = match error {
            Error::ChecksumMismatch { found, .. } => Some(found),
            _ => None,
        };
        match error.clause() {
            Some(_) => checked.fault(None, error),
            None => checked.unchecked = Some(error),
        }
        let mut mended = bytes.to_vec();
        let at = Header::checksum_at(bytes)?;
        mended.get_mut(at..at + 4)?.copy_from_slice(&sum?.to_le_bytes());
        let header = Header::parse(&mended, &self.limits).ok()?;
        Some((header, Cow::Owned(mended)))
    }

    /// Decodes the levels to the first fault.
    fn check_levels(&self, bytes: &[u8], header: &Header, levels: &[Option<Level>], checked: &mut Checked) {
        let Some(last) = levels.iter().flatten().last().map(|level| level.level) else {
            return;
        };
        let mut decoding = Decoding::new(self.clone(), Goal::Exact(last), Cow::Borrowed(bytes));
        loop {
            match decoding.advance() {
                Ok(Some(level)) => {
                    checked.valid_to = Some(level);
                    let index = usize::from(level - header.base);
                    note_head_map(&decoding, levels[index].as_ref(), &mut checked.notes);
                }
                Ok(None) => return,
                Err(error @ Error::ModelMismatch { .. }) => {
                    checked.unchecked = Some(error);
                    return;
                }
                Err(error) if error.clause().is_none() => {
                    checked.unchecked = Some(error);
                    return;
                }
                Err(error) => {
                    let level = decoding.level().map_or(header.base, |level| level + 1);
                    return checked.fault(Some(level), error);
                }
            }
        }
    }

    /// What does not depend on the colours before: geometry, and filters.
    fn check_rest(&self, header: &Header, levels: &[Option<Level>], checked: &mut Checked) {
        for level in levels.iter().flatten() {
            let filter = level.colours.as_ref().and_then(|colours| colours.filter);
            if let Some(Err(error)) = filter.map(|filter| Filter::parse(filter.bytes, filter.offset)) {
                checked.fault(Some(level.level), error);
            }
        }
        if matches!(checked.unchecked, Some(Error::LimitExceeded { .. } | Error::Cancelled)) {
            return;
        }
        let (mut octree, mut map) = (Octree::root(), KernelMap::root());
        for level in levels.iter().flatten() {
            if let Err(error) = self.grow(header, level, &mut octree, &mut map) {
                match error.clause() {
                    Some(_) => checked.fault(Some(level.level), error),
                    None => checked.unchecked = Some(error),
                }
                return;
            }
        }
    }

    fn grow(&self, header: &Header, level: &Level, octree: &mut Octree, map: &mut KernelMap) -> Result<()> {
        for part in &level.geometry {
            let slice = header.slice_voxels as usize;
            codec::decode_level(self.isa(), octree, map, &part.slices, slice, self.cancel())?;
            *map = octree.child_map(part.level - 1, map);
        }
        Ok(())
    }
}

/// Takes the levels apart, each by itself: `None` of those that are damaged or missing.
fn read_levels<'b>(bytes: &'b [u8], header: &Header, checked: &mut Checked) -> Vec<Option<Level<'b>>> {
    let length = bytes.len() as u64;
    let mut levels = Vec::new();
    for level in header.base..=header.top {
        if level > header.base && header.prefix_bytes(level - 1).is_ok_and(|end| end >= length) {
            break;
        }
        levels.push(match Level::read(bytes, header, level) {
            Ok(level) => Some(level),
            Err(error) => {
                checked.is_cut |= header.prefix_bytes(level).is_ok_and(|end| end > length);
                checked.fault(Some(level), error);
                None
            }
        });
    }
    if let Err(error) = header.check_end(length) {
        checked.fault(None, error);
    }
    levels
}

fn note_header(header: &Header, bytes: &[u8], notes: &mut Vec<Note>) {
    let minor = bytes.get(10..12).map_or(0, |b| u16::from_le_bytes([b[0], b[1]]));
    let mut note = |offset, text| {
        notes.push(Note {
            clause: "1.6.2",
            offset,
            text,
        });
    };
    if minor != 0 {
        note(
            10,
            format!("minor version {minor}, of which this decoder knows nothing"),
        );
    }
    if header.optional_flags != 0 {
        note(
            16,
            format!(
                "optional flags {:#010x}, which this decoder ignores",
                header.optional_flags
            ),
        );
    }
}

/// Notes a head map that is none.
fn note_head_map(decoding: &Decoding, level: Option<&Level>, notes: &mut Vec<Note>) {
    let State::Transform(decoding) = &decoding.state else {
        return;
    };
    let stated = level.and_then(|level| level.colours.as_ref()?.head_map);
    let used = decoding.reached().is_some_and(|reached| reached.head_map.is_some());
    if let (Some(stated), false) = (stated, used) {
        notes.push(Note {
            clause: "7.5.1",
            offset: stated.offset,
            text: "a head map of another form: it has no effect".into(),
        });
    }
}
