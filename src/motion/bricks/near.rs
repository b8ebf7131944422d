//! Queries of which each is near the one before.

use super::{Bricks, NOWHERE, Tile, X_BELOW, Y_BELOW};

/// The 3³ tiles around a place. They are kept from one query to the next.
#[derive(Debug, Clone)]
pub struct Near<'a> {
    bricks: &'a Bricks,
    /// The place of the first of them.
    base: [i32; 3],
    /// A bit for each that has been looked up.
    known: u32,
    found: [Option<&'a Tile>; 27],
    /// The brick that was looked up last: its place among bricks, and its number.
    last: ([i32; 3], Option<usize>),
}

impl<'a> Near<'a> {
    pub(super) fn new(bricks: &'a Bricks) -> Self {
        Near {
            bricks,
            base: [NOWHERE; 3],
            known: 0,
            found: [None; 27],
            last: ([NOWHERE; 3], None),
        }
    }

    /// Goes to the tiles around this place.
    #[inline]
    pub fn go(&mut self, at: [i32; 3]) {
        let base = at.map(|x| (x >> 3) - 1);
        if base != self.base {
            (self.base, self.known) = (base, 0);
        }
    }

    /// The tile this many steps from the first one, 0 to 2 along each axis.
    #[inline]
    fn tile(&mut self, step: [i32; 3]) -> Option<&'a Tile> {
        let slot = ((step[0] + 3 * step[1] + 9 * step[2]) as usize).min(26);
        if self.known >> slot & 1 == 0 {
            self.known |= 1 << slot;
            let number = self.bricks.tile([0, 1, 2].map(|axis| self.base[axis] + step[axis]));
            self.found[slot] = number.map(|number| &self.bricks.tiles[number]);
        }
        self.found[slot]
    }

    /// The number of the brick at this place among bricks, if it has voxels. Fast if it is the one before.
    #[inline]
    fn brick(&mut self, at: [i32; 3]) -> Option<usize> {
        if at != self.last.0 {
            self.last = (at, self.find(at));
        }
        self.last.1
    }

    fn find(&mut self, at: [i32; 3]) -> Option<usize> {
        let steps = |base: [i32; 3]| [0, 1, 2].map(|axis| (at[axis] >> 1).wrapping_sub(base[axis]));
        let mut step = steps(self.base);
        if step.iter().any(|x| !(0..3).contains(x)) {
            self.go(at.map(|x| x << 2));
            step = steps(self.base);
        }
        self.tile(step)?.brick(at)
    }

    /// The number of the voxel at this place, if there is one.
    #[inline]
    pub fn index(&mut self, at: [i32; 3]) -> Option<usize> {
        let brick = self.brick(at.map(|x| x >> 2))?;
        self.bricks.bricks[brick].index(at)
    }

    /// The 4³ cells from this place on, as a mask by `x + 4y + 16z`.
    pub fn window(&mut self, at: [i32; 3]) -> u64 {
        let bricks = self.bricks;
        self.window_of(at, |brick| bricks.cells(brick))
    }

    /// The same of cells that a function tells of each brick.
    #[inline]
    pub fn window_of(&mut self, at: [i32; 3], cells: impl Fn(usize) -> u64) -> u64 {
        self.go(at.map(|x| x + 1));
        let first = at.map(|x| x >> 2);
        let [ox, oy, oz] = at.map(|x| (x & 3) as usize);
        let mut window = 0;
        for i in 0..8 {
            let [dx, dy, dz] = [i & 1, i >> 1 & 1, i >> 2];
            if (dx == 1 && ox == 0) || (dy == 1 && oy == 0) || (dz == 1 && oz == 0) {
                continue;
            }
            let Some(brick) = self.find([first[0] + dx, first[1] + dy, first[2] + dz]) else {
                continue;
            };
            let cells = cells(brick);
            let cells = match dx {
                0 => (cells & !X_BELOW[ox]) >> ox,
                _ => (cells & X_BELOW[ox]) << (4 - ox),
            };
            let cells = match dy {
                0 => (cells & !Y_BELOW[oy]) >> (4 * oy),
                _ => (cells & Y_BELOW[oy]) << (4 * (4 - oy)),
            };
            window |= match dz {
                0 => cells >> (16 * oz),
                _ => cells << (16 * (4 - oz)),
            };
        }
        window
    }
}
