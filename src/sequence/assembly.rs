//! Puts groups together to sequences: what encoding, cutting and joining end with.

use std::ops::Range;

use super::SequenceReader;
use crate::container::Header;
use crate::container::sequence::{FrameEntry, GroupEntry, Index};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// Groups that become a sequence.
pub(super) struct Assembly {
    /// Its voxels and points are the most of any frame so far.
    header: Header,
    index: Index,
    groups: Vec<Vec<u8>>,
}

impl Assembly {
    /// No groups yet. Of `common`, voxels and points do not count.
    pub fn new(common: &Header, timescale: u32, duration: u32) -> Self {
        let mut header = common.clone();
        header.points = 0;
        header.voxels.fill(0);
        header.sections.fill(Default::default());
        Assembly {
            header,
            index: Index {
                timescale,
                duration,
                groups: Vec::new(),
            },
            groups: Vec::new(),
        }
    }

    /// Adds a group of these frames and bytes, `gap` ticks after the one before.
    pub fn push(&mut self, frames: &[FrameEntry], bytes: Vec<u8>, gap: u64, ticks: u32) -> Result<()> {
        for frame in frames {
            self.header.points = self.header.points.max(frame.points.into());
            for (most, level) in self.header.voxels.iter_mut().zip(&frame.levels) {
                *most = level.voxels.max(*most);
            }
        }
        let end = self
            .index
            .groups
            .last()
            .map_or(0, |group| group.start + u64::from(group.ticks));
        let entry = GroupEntry::of(&bytes, frames.len() as u32, end + gap, ticks)?;
        self.index.groups.push(entry);
        self.groups.push(bytes);
        Ok(())
    }

    /// The sequence, once it has been read again.
    pub fn finish(self) -> Result<Vec<u8>> {
        let mut bytes = self.header.write_sequence();
        self.index.write(&mut bytes)?;
        bytes.extend(self.groups.concat());
        SequenceReader::new(&bytes, &Limits::unlimited())?.check_end()?;
        Ok(bytes)
    }
}

/// A group of frames, each an entry of the table and its bytes.
#[cfg(feature = "encoder")]
pub(super) fn group_of(frames: &[(FrameEntry, Vec<u8>)]) -> Result<(Vec<FrameEntry>, Vec<u8>)> {
    let entries: Vec<FrameEntry> = frames.iter().map(|frame| frame.0.clone()).collect();
    let mut bytes = crate::container::sequence::table_bytes(&entries)?;
    for (_, coded) in frames {
        bytes.extend(coded);
    }
    Ok((entries, bytes))
}

impl SequenceReader<'_> {
    /// The sequence of the frames `frames`, which must start and end with groups. Its groups are the same bytes. The
    /// first frame is at time 0.
    ///
    /// # Errors
    /// [`Error::Usage`] if the frames do not start and end with groups, naming frames that do; those of
    /// [`SequenceReader::group`].
    pub fn cut(&self, frames: Range<u64>) -> Result<Vec<u8>> {
        if frames.is_empty() {
            return Err(Error::Usage("a cut must have at least one frame".into()));
        }
        let first = self.group_of(frames.start)?;
        let last = self.group_of(frames.end - 1)?;
        let groups = &self.index().groups;
        let (start, end) = (groups[first].first, groups[last].first + u64::from(groups[last].frames));
        if frames != (start..end) {
            return Err(Error::Usage(format!(
                "sequences are cut between groups: {start}..{end} would do, {}..{} does not",
                frames.start, frames.end
            )));
        }
        let mut assembly = Assembly::new(self.header(), self.index().timescale, self.index().duration);
        self.add_groups(first..last + 1, &mut assembly)?;
        assembly.finish()
    }

    /// Adds groups; the first one follows what is there without a gap.
    fn add_groups(&self, groups: Range<usize>, assembly: &mut Assembly) -> Result<()> {
        let mut end = None;
        for group in groups {
            let entry = self.index().groups[group];
            let gap = entry.start - end.unwrap_or(entry.start);
            end = Some(entry.start + u64::from(entry.ticks));
            let frames = self.group(group)?.frames;
            assembly.push(&frames, self.group_bytes(group)?.to_vec(), gap, entry.ticks)?;
        }
        Ok(())
    }
}

/// One sequence of the frames of several, one after the other. Its groups are the same bytes.
///
/// # Errors
/// [`Error::Usage`] if there are no sequences, or they differ in grid, levels, slice sizes or timescale, naming which;
/// those of [`SequenceReader::group`].
pub fn join(sequences: &[SequenceReader]) -> Result<Vec<u8>> {
    let Some(first) = sequences.first() else {
        return Err(Error::Usage("there is nothing to join".into()));
    };
    let mut assembly = Assembly::new(first.header(), first.index().timescale, first.index().duration);
    for (i, sequence) in sequences.iter().enumerate() {
        if let Some(what) = difference(first, sequence) {
            return Err(Error::Usage(format!(
                "sequences 1 and {} cannot be joined: they differ in {what}",
                i + 1
            )));
        }
        sequence.add_groups(0..sequence.groups(), &mut assembly)?;
    }
    assembly.finish()
}

/// What keeps two sequences from being one.
fn difference(a: &SequenceReader, b: &SequenceReader) -> Option<&'static str> {
    let (p, q) = (a.header(), b.header());
    let same = [
        ("the grid", p.bits == q.bits && p.placement == q.placement),
        ("their levels", (p.base, p.top) == (q.base, q.top)),
        ("slice sizes", p.format == q.format && p.slice_voxels == q.slice_voxels),
        ("flags", p.optional_flags == q.optional_flags),
        ("their timescale", a.index().timescale == b.index().timescale),
    ];
    same.iter().find(|(_, same)| !same).map(|(what, _)| *what)
}
