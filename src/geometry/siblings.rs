//! Kernel maps of whole levels, in a quarter of the memory: siblings share a window (`docs/format.md`, clause 2.4).
//!
//! The neighbours of up to eight siblings lie in a window of 4³ positions around them. A [`SiblingMap`] stores which of
//! these are occupied, and the voxels there. Each voxel lies in at most eight windows, so that it takes 32 bytes and a
//! parent 14; a row of a [`KernelMap`] takes 108. Rows are made when they are read.

use std::ops::Range;

use b2p_kernels::MadeRows;
use rayon::prelude::*;

use super::{KernelMap, windows};

/// Parents of a block. The places of their windows fit 16 bits.
const BLOCK: usize = 1024;

/// The neighbours of every voxel of a level under a 3³ kernel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SiblingMap {
    /// Number of voxels.
    len: usize,
    /// Each has [`BLOCK`] parents, but for the last.
    blocks: Vec<Block>,
}

/// The windows of consecutive parents.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Block {
    /// The first child of each parent.
    first_child: Box<[u32]>,
    /// The occupied positions of each parent's window.
    there: Box<[u64]>,
    /// Where each parent's voxels begin in `voxels`.
    start: Box<[u16]>,
    /// The voxels of all windows, one window after the other, by position.
    voxels: Box<[u32]>,
}

/// What lies around siblings: 4³ positions, x fastest. Octant 0 is at (1, 1, 1).
pub struct Window {
    /// The positions that are occupied.
    there: u64,
    /// The voxel at each position, [`KernelMap::ABSENT`] where none is.
    voxels: [u32; 64],
}

/// Positions of the eight siblings.
const OWN: u64 = 0b11_0011 << 21 | 0b11_0011 << 37;
/// Position of the child in octant 0.
const FIRST: u32 = 21;

/// The positions of siblings of this occupancy, less [`FIRST`].
const SPREAD: [u64; 256] = {
    let mut spread = [0; 256];
    let mut mask = 0;
    while mask < 256 {
        let mut o = 0;
        while o < 8 {
            let place = (o & 1) + 4 * (o >> 1 & 1) + 16 * (o >> 2);
            spread[mask] |= ((mask as u64) >> o & 1) << place;
            o += 1;
        }
        mask += 1;
    }
    spread
};

/// Of each position the neighbour of the parent that it lies in, as the [`place`] of its offset, and the octants before
/// it there.
const PLACE: [(u8, u8); 64] = {
    let mut places = [(0, 0); 64];
    let mut i = 0;
    while i < 64 {
        let (x, y, z) = (i & 3, i >> 2 & 3, i >> 4);
        let neighbour = ((x + 1) >> 1) + 4 * ((y + 1) >> 1) + 16 * ((z + 1) >> 1);
        let octant = ((x + 1) & 1) + 2 * ((y + 1) & 1) + 4 * ((z + 1) & 1);
        places[i] = (neighbour as u8, ((1u32 << octant) - 1) as u8);
        i += 1;
    }
    places
};

/// Of each position of a window of parents the brick of 4³ children that it lies in, of 3³ in 4³, and where its children
/// begin there. The siblings are the brick in the middle.
const BRICK: [(u8, u8); 64] = {
    let mut bricks = [(0, 0); 64];
    let mut i = 0;
    while i < 64 {
        let (x, y, z) = ((i & 3) + 1, (i >> 2 & 3) + 1, (i >> 4) + 1);
        let brick = (x >> 1) + 4 * (y >> 1) + 16 * (z >> 1);
        let first = 2 * ((x & 1) + 4 * (y & 1) + 16 * (z & 1));
        bricks[i] = (brick as u8, first as u8);
        i += 1;
    }
    bricks
};

/// How many octants are in a mask.
const COUNT: [u8; 256] = {
    let mut counts = [0; 256];
    let mut mask = 0;
    while mask < 256 {
        counts[mask] = (mask as u8).count_ones() as u8;
        mask += 1;
    }
    counts
};

/// Positions of the set bits of a mask, ascending.
#[inline(always)]
fn ones(mut mask: u64) -> impl Iterator<Item = u32> {
    std::iter::from_fn(move || {
        let position = mask.trailing_zeros();
        (mask != 0).then(|| {
            mask &= mask - 1;
            position
        })
    })
}

impl SiblingMap {
    /// Bytes of memory of a voxel, at most: in each of the windows that it lies in.
    pub(crate) const BYTES_PER_VOXEL: u64 = 8 * size_of::<u32>() as u64;
    /// Bytes of memory of a voxel of the level above.
    pub(crate) const BYTES_PER_PARENT: u64 = (size_of::<u32>() + size_of::<u64>() + size_of::<u16>()) as u64;

    /// The map of level 0, which has one voxel.
    pub fn root() -> Self {
        let block = Block {
            first_child: [0].into(),
            there: [1 << FIRST].into(),
            start: [0].into(),
            voxels: [0].into(),
        };
        SiblingMap {
            len: 1,
            blocks: vec![block],
        }
    }

    /// The map of the children of the voxels of `map`, given the occupancy and the first child of each.
    ///
    /// # Panics
    /// If the numbers of voxels differ.
    pub(super) fn of_children(map: &SiblingMap, occupancy: &[u8], first_child: &[u32]) -> Self {
        assert_eq!(map.len(), occupancy.len(), "one occupancy per voxel");
        assert_eq!(map.len(), first_child.len(), "one first child per voxel");
        let blocks = first_child.par_chunks(BLOCK).enumerate();
        let blocks = blocks.map(|(i, firsts)| Block::new(map, i * BLOCK, firsts, occupancy, first_child));
        SiblingMap {
            len: occupancy.iter().map(|mask| mask.count_ones() as usize).sum(),
            blocks: blocks.collect(),
        }
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no voxels.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The window around the children of voxel `parent` of the level above.
    #[inline(always)]
    pub fn window(&self, parent: usize) -> Window {
        self.blocks[parent / BLOCK].window(parent % BLOCK)
    }

    /// The row of voxel `i`, as a [`KernelMap`] has it. Those of consecutive voxels are better made in a
    /// [`RowBuffer`].
    ///
    /// # Panics
    /// If there is no such voxel.
    pub fn row(&self, i: usize) -> [u32; 27] {
        let mut row = [0; 27];
        self.fill(i, &mut row);
        row
    }

    /// The map with a row for every voxel.
    pub fn table(&self) -> KernelMap {
        let mut rows = b2p_kernels::zeros(27 * self.len);
        rows.par_chunks_mut(27 * BLOCK)
            .enumerate()
            .for_each(|(i, rows)| self.fill(i * BLOCK, rows));
        KernelMap::new(27, rows)
    }

    /// Writes of the voxels from `first` on which places of their rows are occupied: bit `k` for offset `k`.
    ///
    /// # Panics
    /// If there are not so many voxels.
    pub fn masks(&self, first: usize, masks: &mut [u32]) {
        assert!(first + masks.len() <= self.len, "voxels beyond the last");
        let mut masks = masks.iter_mut();
        for (block, parent, children) in self.parents(first) {
            if masks.len() == 0 {
                return;
            }
            for (position, mask) in ones(children).zip(&mut masks) {
                let there = block.there[parent] >> corner(octant(position));
                let lines = (0..9).map(|line| (there >> place(3 * line) & 7) << (3 * line));
                *mask = lines.sum::<u64>() as u32;
            }
        }
    }

    /// The number of neighbours of each of the voxels `range`, itself included.
    ///
    /// # Panics
    /// If there are no such voxels.
    pub fn degrees(&self, range: Range<usize>) -> Vec<u8> {
        let mut degrees = vec![0; range.len()];
        degrees.par_chunks_mut(BLOCK).enumerate().for_each(|(i, degrees)| {
            let mut masks = [0; BLOCK];
            let masks = &mut masks[..degrees.len()];
            self.masks(range.start + i * BLOCK, masks);
            for (degree, mask) in degrees.iter_mut().zip(masks) {
                *degree = mask.count_ones() as u8;
            }
        });
        degrees
    }

    /// The voxels from `first` on, each in the window that it shares with its siblings.
    #[inline(always)]
    pub fn windows(&self, first: usize) -> Windows<'_> {
        Windows {
            parents: self.parents(first),
            window: Window::EMPTY,
            left: 0,
        }
    }

    /// The parents of the voxels from `first` on.
    #[inline(always)]
    fn parents(&self, first: usize) -> Parents<'_> {
        if first >= self.len {
            return Parents {
                blocks: &[],
                next: 0,
                skipped: 0,
            };
        }
        // The last block and parent that do not begin after the voxel are its own.
        let own = self
            .blocks
            .partition_point(|block| block.first_child[0] as usize <= first)
            - 1;
        let firsts = &self.blocks[own].first_child;
        let next = firsts.partition_point(|&child| child as usize <= first) - 1;
        Parents {
            blocks: &self.blocks[own..],
            next,
            skipped: first - firsts[next] as usize,
        }
    }
}

/// Parents one after the other: the block and the place of each, and the positions of its children.
struct Parents<'a> {
    blocks: &'a [Block],
    /// The place of the next one in the first of the blocks.
    next: usize,
    /// How many of its children are left out.
    skipped: usize,
}

impl<'a> Iterator for Parents<'a> {
    type Item = (&'a Block, usize, u64);

    #[inline(always)]
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            let (block, rest) = self.blocks.split_first()?;
            let parent = self.next;
            if parent == block.there.len() {
                (self.blocks, self.next) = (rest, 0);
                continue;
            }
            self.next += 1;
            let mut children = block.there[parent] & OWN;
            for _ in 0..std::mem::take(&mut self.skipped) {
                children &= children - 1;
            }
            return Some((block, parent, children));
        }
    }
}

/// Voxels of a level one after the other, each in the window that it shares with its siblings.
pub struct Windows<'a> {
    parents: Parents<'a>,
    window: Window,
    /// Positions of the siblings that come next.
    left: u64,
}

impl Windows<'_> {
    /// Goes to the next voxel, and returns the window that shows its neighbours, and where its row begins there: the
    /// voxel at offset `k` is [`place`]`(k)` further on. `None` after the last voxel.
    #[inline(always)]
    pub fn next(&mut self) -> Option<(&Window, usize)> {
        while self.left == 0 {
            let (block, parent, children) = self.parents.next()?;
            block.show(parent, &mut self.window);
            self.left = children;
        }
        let position = self.left.trailing_zeros();
        self.left &= self.left - 1;
        Some((&self.window, corner(octant(position))))
    }
}

impl MadeRows for SiblingMap {
    fn fill(&self, first: usize, rows: &mut [u32]) {
        assert!(first + rows.len() / 27 <= self.len, "rows beyond the last voxel");
        let mut rows = rows.chunks_exact_mut(27);
        for (block, parent, children) in self.parents(first) {
            if rows.len() == 0 {
                return;
            }
            let window = block.window(parent);
            for (position, row) in ones(children).zip(&mut rows) {
                window.copy_row(octant(position), row);
            }
        }
    }
}

/// The octant at a position of a sibling.
#[inline(always)]
fn octant(position: u32) -> usize {
    let place = position - FIRST;
    (place & 1 | place >> 1 & 2 | place >> 2 & 4) as usize
}

/// Positions from the first of a child's row to its last.
pub const AROUND: usize = place(26) + 1;

/// Where the voxel at offset `k` of a child's row is in the window, from the first of that row on.
pub const fn place(k: usize) -> usize {
    k % 3 + 4 * (k / 3 % 3) + 16 * (k / 9)
}

/// Where the row of a child begins in the window.
#[inline(always)]
fn corner(octant: usize) -> usize {
    (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2)
}

impl Block {
    /// The windows of the parents from `first` on, with these first children. `map` is theirs.
    fn new(map: &SiblingMap, first: usize, firsts: &[u32], occupancy: &[u8], first_child: &[u32]) -> Block {
        let mut there = Vec::with_capacity(firsts.len());
        let mut start = Vec::with_capacity(firsts.len());
        let mut voxels = Vec::with_capacity(32 * firsts.len());
        for (block, grandparent, siblings) in map.parents(first) {
            let left = firsts.len() - there.len();
            if left == 0 {
                break;
            }
            // What is around the siblings: of each position, the children and the first of them.
            let Window {
                there: around,
                voxels: parents,
            } = block.window(grandparent);
            let (mut masks, mut children, mut bricks) = ([0u8; 64], [0u32; 64], [0u64; 64]);
            for position in ones(around) {
                let position = position as usize & 63;
                let parent = parents[position] as usize;
                (masks[position], children[position]) = (occupancy[parent], first_child[parent]);
                let (brick, first) = BRICK[position];
                bricks[usize::from(brick) & 63] |= SPREAD[usize::from(masks[position])] << first;
            }
            let windows = windows(&bricks, 0);
            for octant in ones(siblings).map(octant).take(left) {
                let seen = windows[octant];
                start.push(voxels.len() as u16);
                there.push(seen);
                for position in ones(seen) {
                    let (neighbour, before) = PLACE[position as usize & 63];
                    let parent = (corner(octant) + usize::from(neighbour)) & 63;
                    let rank = COUNT[usize::from(masks[parent] & before)];
                    voxels.push(children[parent] + u32::from(rank));
                }
            }
        }
        Block {
            first_child: firsts.into(),
            there: there.into(),
            start: start.into(),
            voxels: voxels.as_slice().into(),
        }
    }

    #[inline(always)]
    fn window(&self, parent: usize) -> Window {
        let mut window = Window::EMPTY;
        self.show(parent, &mut window);
        window
    }

    /// Makes `window` that of this parent.
    #[inline(always)]
    fn show(&self, parent: usize, window: &mut Window) {
        window.there = self.there[parent];
        window.voxels = Window::EMPTY.voxels;
        let voxels = &self.voxels[usize::from(self.start[parent])..];
        for (position, &voxel) in ones(window.there).zip(voxels) {
            window.voxels[position as usize & 63] = voxel;
        }
    }
}

impl Window {
    /// Nothing.
    pub const EMPTY: Window = Window {
        there: 0,
        voxels: [KernelMap::ABSENT; 64],
    };

    /// The voxel at each position, and which positions are occupied. Of no meaning where none is.
    #[inline(always)]
    pub fn voxels(&self) -> (&[u32; 64], u64) {
        (&self.voxels, self.there)
    }

    /// Whether the neighbour at offset `k` of the row of the child in `octant` is there.
    #[inline(always)]
    pub fn has(&self, octant: usize, k: usize) -> bool {
        self.there >> (corner(octant) + place(k)) & 1 != 0
    }

    /// The voxels around the child in `octant`: the one at offset `k` of its row is at [`place`]`(k)`.
    #[inline(always)]
    pub fn around(&self, octant: usize) -> &[u32; AROUND] {
        self.from(corner(octant))
    }

    /// The voxels around the child whose row begins at `corner`, likewise.
    #[inline(always)]
    pub fn from(&self, corner: usize) -> &[u32; AROUND] {
        match self.voxels[corner..corner + AROUND].try_into() {
            Ok(around) => around,
            Err(_) => unreachable!("the length is that of the type"),
        }
    }

    #[inline(always)]
    fn copy_row(&self, octant: usize, row: &mut [u32]) {
        // Four at a time: what is one too many, the next three replace.
        let (row, start) = (&mut row[..27], corner(octant));
        for line in 0..8 {
            row[3 * line..][..4].copy_from_slice(&self.voxels[start + place(3 * line)..][..4]);
        }
        row[24..].copy_from_slice(&self.voxels[start + place(24)..][..3]);
    }
}

/// Room for rows of consecutive voxels.
pub struct RowBuffer([u32; 27 * Self::ROWS]);

impl RowBuffer {
    /// Rows that there is room for: few enough that they stay in the fastest cache.
    pub const ROWS: usize = 128;

    /// Room for rows.
    #[allow(clippy::new_without_default)]
    pub fn new() -> Self {
        RowBuffer([0; 27 * Self::ROWS])
    }

    /// The rows of the voxels `range` of a map, one after the other, as a [`KernelMap`] has them.
    ///
    /// # Panics
    /// If these are more than [`RowBuffer::ROWS`], or the map has no such voxels.
    #[inline(always)]
    pub fn fill(&mut self, map: &SiblingMap, range: Range<usize>) -> &[u32] {
        let rows = &mut self.0[..27 * range.len()];
        map.fill(range.start, rows);
        rows
    }
}

#[cfg(test)]
mod tests;
