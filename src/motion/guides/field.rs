//! The motion of a level's nodes: that of the blocks, or parts, which they lie in (`docs/format.md`, clause 17.6).

use crate::motion::payload::Modes;

/// The motion of a level's nodes.
pub(super) struct Field<'a> {
    /// Keys of the blocks.
    pub keys: &'a [u64],
    /// Bits from the key of a node to that of its block.
    pub down: u32,
    pub blocks: Vec<Block>,
}

/// The motion of a block at a level.
#[derive(Debug, Clone, Copy)]
pub(super) struct Block {
    pub modes: Modes,
    /// Its vector in voxels of the level, rounded to the nearest, halves up.
    pub shift: [i32; 3],
    /// The same rounded down, and what is left of it, in units of 1/16.
    pub low: [i32; 3],
    pub part: [i32; 3],
}

impl Block {
    /// A block whose vector is in voxels of level `unit`.
    pub fn new(modes: Modes, vector: [i16; 3], unit: u8, level: u8) -> Self {
        let down = u32::from(unit - level);
        let half = if down == 0 { 0 } else { 1i32 << (down - 1) };
        let vector = vector.map(i32::from);
        Block {
            modes,
            shift: vector.map(|x| (x + half) >> down),
            low: vector.map(|x| x >> down),
            part: vector.map(|x| ((x << 4) >> down) & 15),
        }
    }

    /// The same modes without motion.
    fn stop(&mut self) {
        (self.shift, self.low, self.part) = ([0; 3], [0; 3], [0; 3]);
    }
}

impl Field<'_> {
    /// The same modes without motion.
    pub fn stopped(mut self) -> Self {
        self.blocks.iter_mut().for_each(Block::stop);
        self
    }

    /// Finds the blocks of nodes.
    pub fn cursor(&self) -> Cursor<'_> {
        Cursor { field: self, block: 0 }
    }
}

/// Finds the blocks of nodes, fast where a node is in the block of the one before.
pub(super) struct Cursor<'a> {
    field: &'a Field<'a>,
    /// The block found last.
    block: usize,
}

impl Cursor<'_> {
    /// The block of the node with this key.
    #[inline]
    pub fn at(&mut self, key: u64) -> &Block {
        let Field { keys, down, blocks } = self.field;
        let key = key >> down;
        if keys[self.block] != key {
            self.block = keys.partition_point(|block| *block < key);
        }
        &blocks[self.block]
    }
}

/// Where the voxel at this place was in the previous frame.
#[inline]
pub(super) fn moved(at: [i32; 3], shift: [i32; 3]) -> [i32; 3] {
    [at[0] - shift[0], at[1] - shift[1], at[2] - shift[2]]
}
