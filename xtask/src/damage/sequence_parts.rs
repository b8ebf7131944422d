//! A sequence taken apart, so that one thing in it can be made wrong and all checksums and hashes right again.

use b2p::Limits;
use b2p::container::Header;
use b2p::container::sequence::{FrameKind, Index, parse_table};
use xxhash_rust::xxh3::xxh3_64;

use super::parts::{Chunk, framed, varint};

/// A sequence as its parts.
#[derive(Clone)]
pub struct Sequence {
    /// The header without its checksum, and what is wrong with that.
    pub header: Vec<u8>,
    pub sum: u32,
    /// What is in front of the groups; the one without a payload is the index.
    pub chunks: Vec<Chunk>,
    /// What the units of the index are; ticks per second, and of a frame.
    pub units: u8,
    pub rate: [u32; 2],
    pub groups: Vec<Group>,
    /// What the index adds to the number of groups.
    pub more: i64,
    /// Bytes behind the last entry of the index, and behind the last group.
    pub tails: [Vec<u8>; 2],
    /// Bytes that are missing at the end of the index, and at the end of the sequence.
    pub short: [usize; 2],
}

/// A group, and its entry in the index.
#[derive(Clone)]
pub struct Group {
    /// As it is written.
    pub count: Vec<u8>,
    pub gap: u64,
    pub ticks: u64,
    /// The frame table, of which payload and count are made.
    pub table: Chunk,
    pub frames: Vec<Frame>,
    /// What the table adds to the number of frames.
    pub more: i64,
    /// Bytes behind the last entry of the table, and behind the last frame.
    pub tails: [Vec<u8>; 2],
    /// Bytes that are missing at the end of the table's entries, and at the end of the group.
    pub short: [usize; 2],
    /// What the index adds to its length, and what is wrong with its hash.
    pub longer: u64,
    pub hash: u64,
}

/// A frame, and its entry in the table.
#[derive(Clone)]
pub struct Frame {
    pub kind: u8,
    /// Ticks after the frame before.
    pub step: u64,
    pub points: u64,
    pub levels: Vec<Level>,
}

/// A level of a frame.
#[derive(Clone)]
pub struct Level {
    pub voxels: u64,
    /// Motion, geometry section and colour section.
    pub parts: [Vec<u8>; 3],
    /// What the table adds to their lengths.
    pub longer: [i64; 3],
}

impl Sequence {
    /// Takes a valid sequence apart.
    pub fn of(bytes: &[u8]) -> Self {
        let limits = Limits::unlimited();
        let header = Header::parse_sequence(bytes, &limits).expect("a header");
        let index = Index::parse(bytes, &header, &limits).expect("an index");
        let (mut groups, mut end) = (Vec::new(), 0);
        for entry in &index.groups {
            let content = entry.take(bytes).expect("a group");
            let mut before = 0;
            let mut frames = Vec::new();
            for frame in parse_table(content, entry, &header, &limits).expect("a frame table") {
                let mut rest = &content[frame.offset as usize..];
                let levels = frame.levels.iter().map(|level| {
                    let lengths = [level.motion, level.section.geometry, level.section.colours];
                    let parts = lengths.map(|length| {
                        let (part, behind) = rest.split_at(length as usize);
                        rest = behind;
                        part.to_vec()
                    });
                    Level {
                        voxels: level.voxels.into(),
                        parts,
                        longer: [0; 3],
                    }
                });
                frames.push(Frame {
                    kind: u8::from(frame.kind == FrameKind::Predicted),
                    step: u64::from(frame.ticks - before),
                    points: frame.points.into(),
                    levels: levels.collect(),
                });
                before = frame.ticks;
            }
            groups.push(Group {
                count: varint(entry.frames.into()),
                gap: entry.start - end,
                ticks: entry.ticks.into(),
                table: Chunk::new(11, 0, 0, 0, &[]),
                frames,
                more: 0,
                tails: Default::default(),
                short: [0; 2],
                longer: 0,
                hash: 0,
            });
            end = entry.start + u64::from(entry.ticks);
        }
        Sequence {
            header: bytes[..header.bytes() - 4].to_vec(),
            sum: 0,
            chunks: vec![Chunk::new(10, 0, 0, 0, &[])],
            units: 0,
            rate: [index.timescale, index.duration],
            groups,
            more: 0,
            tails: Default::default(),
            short: [0; 2],
        }
    }

    /// The frame at this place of the first group.
    pub fn frame(&mut self, at: usize) -> &mut Frame {
        &mut self.groups[0].frames[at]
    }

    /// The motion of a level of the second frame, which is predicted.
    pub fn motion(&mut self, level: usize) -> &mut Vec<u8> {
        &mut self.frame(1).levels[level].parts[0]
    }

    pub fn last(&mut self) -> &mut Group {
        self.groups.last_mut().expect("a group")
    }

    /// Cuts the sequence after so many bytes.
    pub fn keep(&mut self, bytes: usize) {
        self.short[1] = self.bytes().len() - bytes;
    }

    /// Bytes of the header with its checksum.
    pub fn header_bytes(&self) -> usize {
        self.header.len() + 4
    }

    /// The sequence, every checksum and hash made right.
    pub fn bytes(&self) -> Vec<u8> {
        let mut payload = vec![self.units];
        payload.extend(self.rate.iter().flat_map(|number| number.to_le_bytes()));
        let groups: Vec<Vec<u8>> = self.groups.iter().map(Group::bytes).collect();
        for (group, bytes) in self.groups.iter().zip(&groups) {
            payload.extend(&group.count);
            payload.extend([group.gap, group.ticks].into_iter().flat_map(varint));
            payload.extend(varint((bytes.len() as u64).wrapping_add(group.longer)));
            payload.extend((xxh3_64(bytes) ^ group.hash).to_le_bytes());
        }
        payload.extend(&self.tails[0]);
        payload.truncate(payload.len().saturating_sub(self.short[0]));
        let units = self.groups.len() as i64 + self.more;
        let mut bytes = framed(&self.header, self.sum, &self.chunks, &payload, units);
        groups.iter().for_each(|group| bytes.extend(group));
        bytes.extend(&self.tails[1]);
        bytes.truncate(bytes.len() - self.short[1]);
        bytes
    }
}

impl Group {
    /// The group, the table's checksum made right.
    pub fn bytes(&self) -> Vec<u8> {
        let mut table = self.table.clone();
        table.payload = self.frames.iter().flat_map(Frame::entry).collect();
        table.payload.extend(&self.tails[0]);
        table.payload.truncate(table.payload.len() - self.short[0]);
        table.count = varint((self.frames.len() as i64 + self.more) as u64);
        let mut bytes = Vec::new();
        table.write(true, &mut bytes);
        let levels = self.frames.iter().flat_map(|frame| &frame.levels);
        levels.for_each(|level| bytes.extend(level.parts.concat()));
        bytes.extend(&self.tails[1]);
        bytes.truncate(bytes.len().saturating_sub(self.short[1]));
        bytes
    }
}

impl Frame {
    fn entry(&self) -> Vec<u8> {
        let mut bytes = vec![self.kind];
        bytes.extend([self.step, self.points].into_iter().flat_map(varint));
        for level in &self.levels {
            bytes.extend(varint(level.voxels));
            let lengths = level.parts.iter().zip(level.longer);
            let lengths = lengths.map(|(part, longer)| (part.len() as i64 + longer) as u64);
            // Whole frames have no motion.
            lengths
                .skip(usize::from(self.kind == 0))
                .for_each(|length| bytes.extend(varint(length)));
        }
        bytes
    }
}
