//! The index of a scene: where its blocks lie, in space and in the file (`docs/format.md`, clause 18).
//!
//! A scene is a header, an index of the form that sequences have, and blocks. A block is a cube of the octree with a
//! stream of its own.

use xxhash_rust::xxh3::xxh3_64;

use super::chunk::ChunkKind;
use super::header::{Header, Section};
use super::malformed;
use super::reader::put_varint;
use super::sequence::{InPayload, only_chunk, put_chunk};
use crate::error::{Error, Result, feature};
use crate::limits::Limits;

/// The deepest level whose voxels may be blocks.
pub const MAX_BLOCK_LEVEL: u8 = 10;
/// What the units of the index are: blocks in space.
const UNITS_IN_SPACE: u8 = 1;

/// A voxel of the octree, seen as the cube of all voxels below it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Cube {
    /// Its level.
    pub level: u8,
    /// Its Morton key.
    pub key: u64,
}

impl Cube {
    /// Keys of the voxels of a level that lie in the cube; none if the level is above the cube.
    pub fn keys(&self, level: u8) -> std::ops::Range<u64> {
        match level.checked_sub(self.level) {
            Some(below) => self.key << (3 * below)..(self.key + 1) << (3 * below),
            None => 0..0,
        }
    }

    /// The first cube of a level that starts at this key of the same level or later, where `before` ends.
    fn first_after(before: Option<Cube>, level: u8) -> u64 {
        match before {
            None => 0,
            Some(before) if before.level <= level => before.keys(level).end,
            Some(before) => (before.key >> (3 * (before.level - level))) + 1,
        }
    }
}

/// A block in the index.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlockEntry {
    /// The cube.
    pub cube: Cube,
    /// Voxels of level N.
    pub points: u32,
    /// Voxels of the levels L to M.
    pub voxels: Vec<u32>,
    /// Byte offset in the scene.
    pub offset: u64,
    /// Length in bytes.
    pub bytes: u32,
    /// XXH3-64 of its bytes.
    pub hash: u64,
}

impl BlockEntry {
    /// The entry of the block whose stream is `bytes`. Its offset is not known yet.
    ///
    /// # Errors
    /// Those of [`Header::parse`], and [`Error::Usage`] if it is 4 GiB or more, or has 2³² points or more.
    pub fn of(cube: Cube, bytes: &[u8]) -> Result<Self> {
        let header = Header::parse(bytes, &Limits::unlimited())?;
        let small = |number: u64, what: &str| {
            u32::try_from(number).map_err(|_| Error::Usage(format!("a block has less than 2^32 {what}")))
        };
        Ok(BlockEntry {
            cube,
            points: small(header.points, "points")?,
            voxels: header.voxels,
            offset: 0,
            bytes: small(bytes.len() as u64, "bytes")?,
            hash: xxh3_64(bytes),
        })
    }

    /// What the header of the block's stream states, but for its placement and the lengths of its sections. `common` is
    /// the header of the scene.
    ///
    /// # Panics
    /// If the scene has no such block.
    pub fn header(&self, common: &Header) -> Header {
        let level = self.cube.level;
        Header {
            bits: common.bits - level,
            base: common.base - level,
            top: common.top - level,
            points: self.points.into(),
            voxels: self.voxels.clone(),
            sections: vec![Section::default(); self.voxels.len()],
            ..common.clone()
        }
    }

    /// Checks that these bytes are those that were written.
    ///
    /// # Errors
    /// [`Error::Malformed`] if their hash differs.
    pub fn check_hash(&self, bytes: &[u8]) -> Result<()> {
        let found = xxh3_64(bytes);
        if found == self.hash {
            return Ok(());
        }
        let (found, expected) = (format!("{found:#018x}"), format!("{:#018x}", self.hash));
        Err(malformed("18.2.4", self.offset, "hash of the block", found, expected))
    }

    /// Checks that the header of the block's stream says what the index says, and that all levels are there and nothing
    /// follows them.
    ///
    /// # Errors
    /// [`Error::Malformed`] if not.
    pub fn check_header(&self, found: &Header, common: &Header) -> Result<()> {
        let expected = self.header(common);
        let stated = |header: &Header| {
            let Header { bits, base, top, .. } = *header;
            format!(
                "{bits} bits, levels {base} to {top}, {} points, {:?} voxels",
                header.points, header.voxels
            )
        };
        if stated(found) != stated(&expected) || found.format.version() != 3 {
            let (found, expected) = (stated(found), stated(&expected));
            return Err(malformed("18.3.1", self.offset, "header of the block", found, expected));
        }
        let whole = found.prefix_bytes(found.top)?;
        match u64::from(self.bytes) == whole {
            true => Ok(()),
            false => Err(malformed(
                "2.1.1",
                self.offset,
                "bytes of the block's stream",
                self.bytes,
                whole,
            )),
        }
    }
}

/// Reads the index behind the header of a scene. Returns the blocks in the order of space. The blocks need not be
/// there.
///
/// # Errors
/// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Malformed`], and [`Error::LimitExceeded`] for a block
/// with too many points.
pub fn parse_index(bytes: &[u8], header: &Header, limits: &Limits) -> Result<Vec<BlockEntry>> {
    if let Some(section) = header.sections.iter().find(|section| section.bytes() > 0) {
        let value = format!("{section:?}");
        return Err(malformed("18.1.2", 72, "section lengths of a scene", value, 0));
    }
    let chunk = only_chunk(bytes, header.bytes(), ChunkKind::Index, "index of the scene").map_err(of_index)?;
    if chunk.count == 0 {
        return Err(malformed("18.2.1", chunk.offset, "number of blocks", 0, "at least 1"));
    }
    let mut reader = InPayload::new(&chunk, "18.2.2");
    let units = reader.read(|r| r.u8("units of the index"))?;
    if units != UNITS_IN_SPACE {
        return Err(Error::Unsupported {
            what: feature::UNITS_OF_SCENE,
            detail: format!("its units are of kind {units}; this version knows blocks, kind 1"),
        });
    }
    let mut blocks: Vec<BlockEntry> = Vec::new();
    let mut offset = (chunk.payload_at + chunk.payload.len()) as u64;
    for _ in 0..chunk.count {
        let at = reader.at();
        let block = read_block(&mut reader, blocks.last(), header, offset)?;
        block.header(header).check(limits).map_err(|error| match error {
            Error::Malformed {
                field, value, expected, ..
            } => malformed("18.2.3", at, field, value, expected),
            error => error,
        })?;
        offset += u64::from(block.bytes);
        blocks.push(block);
    }
    reader.finish()?;
    check_sums(&blocks, header, chunk.offset)?;
    Ok(blocks)
}

/// What is wrong with the chunk, as the clauses of scenes say it.
fn of_index(error: Error) -> Error {
    match error {
        Error::Malformed {
            clause: Some("17.2.1"), ..
        } => error.breaks("18.2.1"),
        error => error,
    }
}

fn read_block(
    reader: &mut InPayload<'_>,
    before: Option<&BlockEntry>,
    header: &Header,
    offset: u64,
) -> Result<BlockEntry> {
    let at = reader.at();
    let level = reader.read(|r| r.u8("level of a block"))?;
    let most = most_level(header.base, header.bits);
    if level > most {
        return Err(malformed(
            "18.2.2",
            at,
            "level of a block",
            level,
            format!("at most {most}"),
        ));
    }
    let at = reader.at();
    let gap = reader.varint("cubes before a block")?;
    let key = Cube::first_after(before.map(|block| block.cube), level) + u64::from(gap);
    if key >> (3 * level) != 0 {
        let expected = format!("a cube of level {level}");
        return Err(malformed("18.2.2", at, "cubes before a block", gap, expected));
    }
    let points = reader.varint("points of a block")?;
    let levels = header.voxels.len();
    let voxels = (0..levels).map(|_| reader.varint("voxels of a block"));
    Ok(BlockEntry {
        cube: Cube { level, key },
        points,
        voxels: voxels.collect::<Result<_>>()?,
        offset,
        bytes: reader.varint("bytes of a block")?,
        hash: reader.read(|reader| reader.u64("hash of a block"))?,
    })
}

/// Checks that the header states the sums of the blocks.
fn check_sums(blocks: &[BlockEntry], header: &Header, at: usize) -> Result<()> {
    let points: u64 = blocks.iter().map(|block| u64::from(block.points)).sum();
    if points != header.points {
        return Err(malformed("18.1.2", at, "points of all blocks", points, header.points));
    }
    for (i, &stated) in header.voxels.iter().enumerate() {
        let sum: u64 = blocks.iter().map(|block| u64::from(block.voxels[i])).sum();
        if sum != u64::from(stated) {
            let field = format!("voxels of all blocks at level {}", usize::from(header.base) + i);
            return Err(malformed("18.1.2", at, field, sum, stated));
        }
    }
    Ok(())
}

/// The deepest level whose voxels may be blocks of a scene with this base level and bit depth.
pub fn most_level(base: u8, bits: u8) -> u8 {
    MAX_BLOCK_LEVEL.min(base).min(bits - 1)
}

/// Header and index of a scene of these blocks, which follow in their order. Of `common`, points, voxels and sections
/// do not count.
///
/// # Errors
/// [`Error::Usage`] if there is no block, the blocks overlap or are not in Morton order, or their sums are too large.
pub fn write_index(common: &Header, blocks: &[BlockEntry]) -> Result<Vec<u8>> {
    let levels = usize::from(common.top - common.base) + 1;
    let sum = |i: usize| blocks.iter().map(|block| u64::from(block.voxels[i])).sum::<u64>();
    let voxels = (0..levels).map(|i| u32::try_from(sum(i)));
    let voxels = voxels.collect::<std::result::Result<_, _>>();
    let header = Header {
        points: blocks.iter().map(|block| u64::from(block.points)).sum(),
        voxels: voxels.map_err(|_| Error::Usage("a level of a scene has less than 2^32 voxels".into()))?,
        sections: vec![Section::default(); levels],
        ..common.clone()
    };
    let mut payload = vec![UNITS_IN_SPACE];
    let mut before = None;
    for block in blocks {
        let Cube { level, key } = block.cube;
        let gap = key.checked_sub(Cube::first_after(before, level));
        let Some(gap) = gap.and_then(|gap| u32::try_from(gap).ok()) else {
            return Err(Error::Usage("the blocks of a scene must follow one another".into()));
        };
        before = Some(block.cube);
        payload.push(level);
        let counts = [gap, block.points].into_iter().chain(block.voxels.iter().copied());
        for number in counts.chain([block.bytes]) {
            put_varint(&mut payload, number);
        }
        payload.extend(block.hash.to_le_bytes());
    }
    if blocks.is_empty() {
        return Err(Error::Usage("a scene has at least one block".into()));
    }
    let mut bytes = header.write_scene();
    put_chunk(ChunkKind::Index, blocks.len(), &payload, &mut bytes)?;
    parse_index(
        &bytes,
        &Header::parse_scene(&bytes, &Limits::unlimited())?,
        &Limits::unlimited(),
    )?;
    Ok(bytes)
}
