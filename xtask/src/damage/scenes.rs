//! What can be wrong with a scene, and the clause of `docs/format.md` that it breaks.

use b2p::container::scene::{BlockEntry, Cube};
use b2p::{Limits, SceneReader};
use xxhash_rust::xxh3::xxh3_64;

use super::kinds::Kind;
use super::parts::{Chunk, framed, varint};

/// The scene that is damaged: levels 3 to 5 of 6 bits, blocks of several sizes.
pub const DAMAGED: &str = "scenes/blocks-of-many-sizes";

/// A scene taken apart.
#[derive(Clone)]
struct Scene {
    /// The header, without its checksum.
    header: Vec<u8>,
    /// What is wrong with that.
    sum: u32,
    /// Chunks between header and blocks; the payload of the index is made of what follows.
    chunks: Vec<Chunk>,
    units: u8,
    blocks: Vec<Block>,
    /// What the index adds to the number of blocks.
    more: i64,
    /// Bytes behind the last entry of the index, and behind the last block.
    tails: [Vec<u8>; 2],
    /// Bytes that are missing at the end of the index, and at the end of the scene.
    short: [usize; 2],
}

/// A block, and its entry in the index.
#[derive(Clone)]
struct Block {
    level: u8,
    gap: u64,
    points: u64,
    voxels: Vec<u64>,
    stream: Vec<u8>,
    /// What the index adds to its length, and what is wrong with its hash.
    longer: u64,
    hash: u64,
}

/// All kinds of damage of this scene.
pub fn all(bytes: &[u8]) -> Vec<Kind> {
    let whole = Scene::of(bytes);
    let mut kinds = Vec::new();
    let mut add = |name: &'static str, clause: &'static str, damage: &dyn Fn(&mut Scene)| {
        let mut scene = whole.clone();
        damage(&mut scene);
        let tries = vec![scene.bytes()];
        kinds.push(Kind {
            name,
            stream: DAMAGED,
            clause,
            tries,
        });
    };
    headers(&mut add);
    indices(&mut add);
    entries(&mut add);
    blocks(&mut add);
    kinds
}

type Add<'a> = dyn FnMut(&'static str, &'static str, &dyn Fn(&mut Scene)) + 'a;

fn headers(add: &mut Add) {
    add("scene-header-checksum", "2.2.1", &|s| s.sum = 1);
    add("scene-that-is-a-sequence-too", "2.2.1", &|s| s.header[12] = 3);
    add("scene-of-a-later-version", "2.2.1", &|s| s.header[13] = 1);
    add("scene-origin-nan", "2.2.3", &|s| {
        s.header[32..40].copy_from_slice(&f64::NAN.to_le_bytes())
    });
    add("scene-with-a-section", "18.1.2", &|s| s.header[84] = 1);
    add("scene-points-one-more", "18.1.2", &|s| s.header[24] += 1);
    add("scene-voxels-one-less", "18.1.2", &|s| s.header[80] -= 1);
    add("scene-points-none", "2.2.2", &|s| {
        s.header[24..32].copy_from_slice(&[0; 8])
    });
}

fn indices(add: &mut Add) {
    add("scene-cut-after-the-header", "18.1.1", &|s| s.keep(112));
    add("scene-cut-in-the-index-header", "18.1.1", &|s| s.keep(114));
    add("scene-cut-in-the-index", "18.1.1", &|s| s.keep(140));
    add("scene-index-checksum", "3.1.1", &|s| s.chunks[0].sum = 1);
    add("scene-index-of-slice-65536", "3.1.1", &|s| {
        s.chunks[0].slice = varint(65_536)
    });
    add("scene-index-of-type-1", "3.1.2", &|s| s.chunks[0].kind = 1);
    add("scene-index-is-a-frame-table", "18.2.1", &|s| s.chunks[0].kind = 11);
    add("scene-index-of-level-1", "18.2.1", &|s| s.chunks[0].level = 1);
    add("scene-index-of-slice-1", "18.2.1", &|s| s.chunks[0].slice = varint(1));
    add("scene-index-of-no-block", "18.2.1", &|s| {
        s.more = -(s.blocks.len() as i64)
    });
    add("scene-index-of-one-block-more", "18.2.2", &|s| s.more = 1);
    add("scene-index-of-one-block-less", "18.2.2", &|s| s.more = -1);
    add("scene-index-of-4-billion-blocks", "18.2.2", &|s| {
        s.more = u32::MAX as i64 - s.blocks.len() as i64
    });
    add("scene-index-goes-on", "18.2.2", &|s| s.tails[0] = vec![0]);
    add("scene-index-short", "18.2.2", &|s| s.short[0] = 1);
    add("scene-index-without-units", "18.2.2", &|s| s.short[0] = usize::MAX);
    add("scene-units-in-time", "18.2.2", &|s| s.units = 0);
    add("scene-units-unknown", "18.2.2", &|s| s.units = 2);
    add("scene-ancillary-chunk-before-the-index", "3.1.1", &|s| {
        let mut chunk = Chunk::new(200, 9, 9, 9, b"later");
        chunk.sum = 1;
        s.chunks.insert(0, chunk);
    });
    add("scene-ancillary-chunk-behind-the-index", "18.2.4", &|s| {
        s.chunks.push(Chunk::new(200, 9, 9, 9, b"later"))
    });
}

fn entries(add: &mut Add) {
    add("block-of-a-level-below-the-first", "18.2.2", &|s| s.blocks[0].level = 4);
    add("block-of-level-255", "18.2.2", &|s| s.blocks[0].level = 255);
    add("block-outside-the-cube", "18.2.2", &|s| {
        s.blocks.iter_mut().for_each(|block| block.gap += 600)
    });
    // No gap is below 0: a block that overlaps the one before cannot be said. One of level 0 lies behind all others.
    add("block-behind-the-last-cube", "18.2.2", &|s| {
        let copy = s.blocks[0].clone();
        s.blocks.push(Block { level: 0, ..copy })
    });
    add("block-gap-not-shortest", "1.4.2", &|s| s.blocks[0].gap = u64::MAX);
    add("block-without-points", "18.2.3", &|s| s.blocks[0].points = 0);
    add("block-without-voxels", "18.2.3", &|s| s.blocks[0].voxels[0] = 0);
    add("block-with-more-voxels-than-its-cube", "18.2.3", &|s| {
        let most = 8u64.pow(3 - u32::from(s.blocks[0].level));
        s.blocks[0].voxels[0] = most + 1
    });
    add("block-with-more-children-than-eight", "18.2.3", &|s| {
        s.blocks[0].voxels[1] = 8 * s.blocks[0].voxels[0] + 1
    });
    add("block-with-fewer-points-than-voxels", "18.2.3", &|s| {
        s.blocks[0].points = s.blocks[0].voxels[2] - 1
    });
    add("blocks-that-lie-about-each-other", "18.3.1", &|s| {
        s.blocks[0].points += 1;
        s.blocks[1].points -= 1;
    });
    add("blocks-that-are-exchanged", "18.2.4", &|s| {
        let [a, b] = [0, 1].map(|block: usize| s.blocks[block].stream.clone());
        let difference = xxh3_64(&a) ^ xxh3_64(&b);
        (s.blocks[0].stream, s.blocks[0].hash) = (b, difference);
        (s.blocks[1].stream, s.blocks[1].hash) = (a, difference);
    });
    add("block-longer-than-it-is", "18.2.4", &|s| s.blocks[0].longer = 1);
    add("last-block-longer-than-the-scene", "18.2.4", &|s| s.last().longer = 1);
    add("last-block-of-4-gib", "18.2.4", &|s| {
        let last = s.last();
        last.longer = u64::from(u32::MAX) - last.stream.len() as u64
    });
    add("block-of-no-byte", "18.2.4", &|s| {
        let last = s.last();
        last.longer = (last.stream.len() as u64).wrapping_neg();
    });
}

fn blocks(add: &mut Add) {
    add("block-of-another-hash", "18.2.4", &|s| s.blocks[0].hash = 1 << 63);
    add("block-changed", "18.2.4", &|s| {
        let block = &mut s.blocks[1];
        block.hash = xxh3_64(&block.stream);
        let last = block.stream.len() - 1;
        block.stream[last] ^= 1;
        block.hash ^= xxh3_64(&block.stream);
    });
    add("scene-without-its-blocks", "18.2.4", &|s| {
        s.short[1] = s.blocks.iter().map(|block| block.stream.len()).sum()
    });
    add("scene-cut-in-its-last-block", "18.2.4", &|s| s.short[1] = 9);
    add("scene-cut-by-a-byte", "18.2.4", &|s| s.short[1] = 1);
    add("scene-goes-on", "18.1.1", &|s| s.tails[1] = vec![0]);
    add("scene-with-a-block-more", "18.1.1", &|s| {
        s.tails[1] = s.blocks[0].stream.clone()
    });
    add("block-that-is-no-stream", "2.2.1", &|s| s.blocks[0].stream[0] = 0);
    add("block-that-is-a-scene", "2.2.1", &|s| s.flag(2));
    add("block-that-is-a-sequence", "2.2.1", &|s| s.flag(1));
    add("block-of-other-levels", "18.3.1", &|s| {
        let first = s.blocks[0].clone();
        let other = s.blocks.iter_mut().find(|block| block.level != first.level);
        let other = other.expect("blocks of several sizes");
        (other.stream, other.hash) = (first.stream, 0);
    });
    add("block-with-a-chunk-changed", "3.1.1", &|s| {
        let last = s.blocks[0].stream.len() - 1;
        s.blocks[0].stream[last] ^= 1
    });
    add("block-that-ends-early", "2.1.1", &|s| {
        s.blocks[0].stream.pop();
    });
    add("block-that-goes-on", "2.1.1", &|s| s.blocks[0].stream.push(0));
}

impl Scene {
    /// Takes a valid scene apart.
    fn of(bytes: &[u8]) -> Self {
        let scene = SceneReader::new(bytes, &Limits::unlimited()).expect("a scene");
        let entries = scene.blocks();
        let block = |(number, entry): (usize, &BlockEntry)| Block {
            level: entry.cube.level,
            gap: gap(number.checked_sub(1).map(|before| &entries[before]), entry.cube),
            points: entry.points.into(),
            voxels: entry.voxels.iter().map(|count| u64::from(*count)).collect(),
            stream: scene.block(number).expect("a block").to_vec(),
            longer: 0,
            hash: 0,
        };
        Scene {
            header: bytes[..scene.header().bytes() - 4].to_vec(),
            sum: 0,
            chunks: vec![Chunk::new(10, 0, 0, 0, &[])],
            units: 1,
            blocks: entries.iter().enumerate().map(block).collect(),
            more: 0,
            tails: Default::default(),
            short: [0; 2],
        }
    }

    fn last(&mut self) -> &mut Block {
        self.blocks.last_mut().expect("a block")
    }

    /// Cuts the scene after so many bytes.
    fn keep(&mut self, bytes: usize) {
        self.short[1] = self.bytes().len() - bytes;
    }

    /// Gives the first block's stream a critical flag.
    fn flag(&mut self, flags: u8) {
        let stream = &mut self.blocks[0].stream;
        stream[12] = flags;
        let end = 72 + 12 * (usize::from(stream[22] - stream[21]) + 1);
        let sum = crc32c::crc32c(&stream[..end]);
        stream[end..end + 4].copy_from_slice(&sum.to_le_bytes());
    }

    /// The scene, every checksum and hash made right.
    fn bytes(&self) -> Vec<u8> {
        let mut payload = vec![self.units];
        for block in &self.blocks {
            payload.push(block.level);
            match block.gap {
                // Zero in two bytes.
                u64::MAX => payload.extend([0x80, 0]),
                gap => payload.extend(varint(gap)),
            }
            payload.extend(varint(block.points));
            block.voxels.iter().for_each(|count| payload.extend(varint(*count)));
            payload.extend(varint((block.stream.len() as u64).wrapping_add(block.longer)));
            payload.extend((xxh3_64(&block.stream) ^ block.hash).to_le_bytes());
        }
        payload.extend(&self.tails[0]);
        payload.truncate(payload.len().saturating_sub(self.short[0]));
        let units = self.blocks.len() as i64 + self.more;
        let mut bytes = framed(&self.header, self.sum, &self.chunks, &payload, units);
        self.blocks.iter().for_each(|block| bytes.extend(&block.stream));
        bytes.extend(&self.tails[1]);
        bytes.truncate(bytes.len() - self.short[1]);
        bytes
    }
}

/// Cubes of a block's level between it and the one before.
fn gap(before: Option<&BlockEntry>, cube: Cube) -> u64 {
    let first = match before.map(|before| before.cube) {
        None => 0,
        Some(before) if before.level <= cube.level => before.keys(cube.level).end,
        Some(before) => (before.key >> (3 * (before.level - cube.level))) + 1,
    };
    cube.key - first
}
