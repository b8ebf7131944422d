//! The windows of all nodes of a brick at once.

use super::{Bricks, NOWHERE};
use crate::geometry::{ones, windows};

/// Of each of the 3³ tiles around one, the bricks that are next to it.
const SEEN: [u8; 27] = {
    let mut seen = [0; 27];
    let mut i = 0;
    while i < 27 {
        let mut octant = 0;
        while octant < 8 {
            let steps = [(i % 3, octant & 1), (i / 3 % 3, octant >> 1 & 1), (i / 9, octant >> 2)];
            let mut is_next = true;
            let mut axis = 0;
            while axis < 3 {
                let (step, half) = steps[axis];
                is_next &= step == 1 || (step == 0 && half == 1) || (step == 2 && half == 0);
                axis += 1;
            }
            seen[i] |= (is_next as u8) << octant;
            octant += 1;
        }
        i += 1;
    }
    seen
};

/// Windows of nodes of 2³ cells: the 4³ cells from one before the node on, as a mask by `x + 4y + 16z`. A brick has eight
/// nodes. It is fast to go from a brick to the next in the order of keys.
pub struct Windows<'a, const N: usize, C> {
    bricks: &'a Bricks,
    /// Of the number of a brick its cells, of several kinds.
    cells: C,
    /// The place of the tile that was looked at last.
    tile: [i32; 3],
    /// The cells of the bricks of that tile and around them, 4³ bricks, x fastest.
    block: [[u64; 64]; N],
    /// The place of the brick that was looked at last, among bricks, and its windows by octant.
    brick: [i32; 3],
    windows: [[u64; 8]; N],
}

impl<'a, const N: usize, C: Fn(usize) -> [u64; N]> Windows<'a, N, C> {
    pub fn new(bricks: &'a Bricks, cells: C) -> Self {
        Windows {
            bricks,
            cells,
            tile: [NOWHERE; 3],
            block: [[0; 64]; N],
            brick: [NOWHERE; 3],
            windows: [[0; 8]; N],
        }
    }

    /// The windows of each kind of the nodes of the brick at this place among bricks, by octant.
    #[inline]
    pub fn of_brick(&mut self, at: [i32; 3]) -> &[[u64; 8]; N] {
        if at != self.brick {
            self.brick = at;
            let tile = at.map(|x| x >> 1);
            if tile != self.tile {
                self.tile = tile;
                self.gather();
            }
            let first = (at[0] & 1) + 4 * (at[1] & 1) + 16 * (at[2] & 1);
            for (block, found) in self.block.iter().zip(&mut self.windows) {
                *found = windows(block, first as usize);
            }
        }
        &self.windows
    }

    /// Looks at the bricks around the tile.
    fn gather(&mut self) {
        self.block = [[0; 64]; N];
        for i in 0..27 {
            let step = [i % 3, i / 3 % 3, i / 9];
            let Some(tile) = self.bricks.tile([0, 1, 2].map(|axis| self.tile[axis] + step[axis] - 1)) else {
                continue;
            };
            let tile = &self.bricks.tiles[tile];
            // The first of its bricks in the block, and those that are there.
            let first = step
                .iter()
                .zip([1, 4, 16])
                .map(|(step, by)| by * (2 * step - 1))
                .sum::<i32>();
            for octant in ones(tile.there & SEEN[i as usize]) {
                let at = first + [0, 1, 4, 5, 16, 17, 20, 21][octant & 7];
                let cells = (self.cells)(tile.number(octant));
                for (block, cells) in self.block.iter_mut().zip(cells) {
                    block[at as usize & 63] = cells;
                }
            }
        }
    }
}
