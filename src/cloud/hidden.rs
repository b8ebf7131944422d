//! Which points can be seen from outside: those that light reaches from there.
//!
//! A ball of empty cells rolls around the cloud, and into it where an opening is wide enough: through doors and windows
//! of a building, not through pinholes of a surface. Where it comes there is light, which spreads through narrower
//! openings for [`DEPTH`] cells. A point is hidden if there is no light next to its cell.

use rayon::prelude::*;

use super::select::bounds;
use super::voxelise::{self, Levels};
use crate::geometry::morton;

/// The deepest level of cells: 512 along the longest side.
const FINEST: u8 = 9;
/// Cells that light reaches behind an opening of one or two cells.
const DEPTH: usize = 12;
/// Empty cells around the cloud: room for the ball, and one that no neighbour of a cell lies beyond.
const MARGIN: usize = 4;

/// Which points can be seen from outside. All can, if the points do not form a surface.
pub(super) fn not_hidden(positions: &[[f64; 3]]) -> Vec<bool> {
    let (low, high) = bounds(positions);
    let grid = voxelise::fit(low, high, morton::MAX_DEPTH);
    let keys: Vec<u64> = positions.par_iter().map(|p| voxelise::fitted_key(p, &grid)).collect();
    let mut sorted = keys.clone();
    sorted.par_sort_unstable();
    let levels = Levels::of(sorted.into_iter());
    let Some(closed) = levels.closed(levels.voxels(morton::MAX_DEPTH), morton::MAX_DEPTH) else {
        return vec![true; positions.len()];
    };
    let shift = 3 * (morton::MAX_DEPTH - FINEST.min(closed - 1));
    let cell = |key: &u64| morton::decode(key >> shift).map(|x| x as usize + MARGIN);
    let lit = lit(keys.iter().map(cell));
    keys.par_iter().map(|key| lit.has(cell(key))).collect()
}

/// The cells next to which there is light, of a grid with these cells occupied.
fn lit(occupied: impl Iterator<Item = [usize; 3]> + Clone) -> Cells {
    let mut size = [0; 3];
    for cell in occupied.clone() {
        size = [0, 1, 2].map(|axis| size[axis].max(cell[axis] + 1));
    }
    let mut solid = Cells::none(size.map(|end| end + MARGIN));
    occupied.for_each(|cell| solid.set(cell));
    // Centres of balls of 3³ empty cells.
    let centres = solid.grown(Neighbours::All).complement();
    let mut light = centres.connected_to([1; 3]).grown(Neighbours::All);
    let empty = solid.complement();
    for _ in 0..DEPTH {
        light = light.grown(Neighbours::Faces).and(&empty);
    }
    light.grown(Neighbours::All)
}

/// Cells around a cell.
#[derive(Debug, Clone, Copy)]
enum Neighbours {
    /// The six that share a face with it.
    Faces,
    /// All 26.
    All,
}

/// A set of cells of a grid, a bit for each.
#[derive(Clone)]
struct Cells {
    size: [usize; 3],
    /// Words of a row along x.
    words: usize,
    /// Rows by z, then y.
    bits: Vec<u64>,
}

impl Cells {
    fn none(size: [usize; 3]) -> Self {
        let words = size[0].div_ceil(64);
        Cells {
            size,
            words,
            bits: vec![0; words * size[1] * size[2]],
        }
    }

    fn place(&self, [x, y, z]: [usize; 3]) -> (usize, u64) {
        ((z * self.size[1] + y) * self.words + x / 64, 1 << (x % 64))
    }

    fn has(&self, cell: [usize; 3]) -> bool {
        let (word, bit) = self.place(cell);
        self.bits[word] & bit != 0
    }

    fn set(&mut self, cell: [usize; 3]) {
        let (word, bit) = self.place(cell);
        self.bits[word] |= bit;
    }

    /// All other cells. Those beyond the end of a row belong to neither.
    fn complement(&self) -> Self {
        let mut other = self.clone();
        let last = u64::MAX >> ((64 - self.size[0] % 64) % 64);
        for row in other.bits.chunks_exact_mut(self.words) {
            row.iter_mut().for_each(|word| *word = !*word);
            row[self.words - 1] &= last;
        }
        other
    }

    fn and(mut self, others: &Cells) -> Self {
        let pairs = self.bits.par_iter_mut().zip(&others.bits);
        pairs.for_each(|(word, other)| *word &= other);
        self
    }

    /// These cells and these neighbours of each. Those beyond the border of the grid do not exist.
    fn grown(&self, neighbours: Neighbours) -> Self {
        let [width, height, depth] = self.size;
        let words = self.words;
        let last = u64::MAX >> ((64 - width % 64) % 64);
        let mut grown = self.clone();
        let rows = grown.bits.par_chunks_exact_mut(words);
        rows.zip(self.bits.par_chunks_exact(words)).for_each(|(to, row)| {
            for (i, to) in to.iter_mut().enumerate() {
                *to |= row[i] << 1 | if i > 0 { row[i - 1] >> 63 } else { 0 };
                *to |= row[i] >> 1 | row.get(i + 1).map_or(0, |after| after << 63);
            }
            to[words - 1] &= last;
        });
        // Words `apart` from each other are neighbours along an axis, in parts of so many words.
        for (apart, part) in [(words, words * height), (words * height, words * height * depth)] {
            let so_far;
            let from = match neighbours {
                Neighbours::Faces => self,
                Neighbours::All => {
                    so_far = grown.clone();
                    &so_far
                }
            };
            let parts = grown.bits.par_chunks_exact_mut(part);
            parts.zip(from.bits.par_chunks_exact(part)).for_each(|(to, from)| {
                for (i, to) in to.iter_mut().enumerate() {
                    *to |= if i >= apart { from[i - apart] } else { 0 };
                    *to |= from.get(i + apart).unwrap_or(&0);
                }
            });
        }
        grown
    }

    /// The cells that can be reached from one of them over faces.
    fn connected_to(&self, first: [usize; 3]) -> Self {
        let mut reached = Cells::none(self.size);
        if !self.has(first) {
            return reached;
        }
        reached.set(first);
        let (words, [_, height, depth]) = (self.words, self.size);
        let mut waiting = vec![first[2] * height + first[1]];
        let mut waits = vec![false; height * depth];
        while let Some(row) = waiting.pop() {
            waits[row] = false;
            let range = row * words..(row + 1) * words;
            spread(&mut reached.bits[range.clone()], &self.bits[range.clone()]);
            let (y, z) = (row % height, row / height);
            let beside = [
                (y > 0).then(|| row - 1),
                (y + 1 < height).then(|| row + 1),
                (z > 0).then(|| row - height),
                (z + 1 < depth).then(|| row + height),
            ];
            for next in beside.into_iter().flatten() {
                let mut is_new = false;
                for (i, from) in range.clone().enumerate() {
                    let to = next * words + i;
                    let new = reached.bits[from] & self.bits[to] & !reached.bits[to];
                    reached.bits[to] |= new;
                    is_new |= new != 0;
                }
                if is_new && !std::mem::replace(&mut waits[next], true) {
                    waiting.push(next);
                }
            }
        }
        reached
    }
}

/// Spreads `reached` along a row, as far as the row is `open`.
fn spread(reached: &mut [u64], open: &[u64]) {
    for forwards in [true, false] {
        let mut carry = false;
        for k in 0..open.len() {
            let i = if forwards { k } else { open.len() - 1 - k };
            let [mut from, mut way] = [reached[i], open[i]];
            let (first, last) = if forwards { (1, 1 << 63) } else { (1 << 63, 1) };
            from |= if carry { first & way } else { 0 };
            // Six steps, each twice as far as the one before.
            for step in 0..6 {
                let by = 1 << step;
                if forwards {
                    from |= way & (from << by);
                    way &= way << by;
                } else {
                    from |= way & (from >> by);
                    way &= way >> by;
                }
            }
            reached[i] = from;
            carry = from & last != 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points of a sphere around the origin, but for a cap of it around +z.
    fn sphere(radius: f64, open: f64) -> Vec<[f64; 3]> {
        let count = 60_000;
        let point = |i: usize| {
            let z = 1.0 - (2 * i + 1) as f64 / f64::from(count);
            let (sin, cos) = (2.399963 * i as f64).sin_cos();
            let across = (1.0 - z * z).sqrt();
            [radius * across * cos, radius * across * sin, radius * z]
        };
        (0..count as usize)
            .map(point)
            .filter(|p| p[2] < radius * open.cos() || open == 0.0)
            .collect()
    }

    fn seen_inside(open: f64) -> f64 {
        let shell = sphere(1.0, open);
        let inner = sphere(0.5, 0.0);
        let keep = not_hidden(&[shell.clone(), inner].concat());
        assert!(keep[..shell.len()].iter().all(|keep| *keep));
        let inner = &keep[shell.len()..];
        inner.iter().filter(|keep| **keep).count() as f64 / inner.len() as f64
    }

    #[test]
    fn what_a_closed_surface_surrounds_is_hidden() {
        assert_eq!(seen_inside(0.0), 0.0);
    }

    #[test]
    fn what_lies_behind_a_wide_opening_is_seen() {
        assert_eq!(seen_inside(0.3), 1.0);
    }

    #[test]
    fn what_lies_far_behind_a_narrow_opening_is_hidden() {
        assert_eq!(seen_inside(0.01), 0.0);
    }

    #[test]
    fn points_that_form_no_surface_are_all_seen() {
        let points: Vec<[f64; 3]> = (0..2_000)
            .map(|i| [12.9898, 78.233, 37.719].map(|x: f64| (x * f64::from(i)).sin() * 43758.5 % 1.0))
            .collect();
        assert!(not_hidden(&points).iter().all(|keep| *keep));
        assert_eq!(not_hidden(&[[1.0, 2.0, 3.0]]), [true]);
        assert_eq!(not_hidden(&[]), Vec::<bool>::new());
    }

    /// A grid of cells that are in a set at random, seven of eight.
    fn random(size: [usize; 3]) -> Cells {
        let mut cells = Cells::none(size);
        let mut state = 1u64;
        for_each(size, |cell| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            if state >> 61 != 0 {
                cells.set(cell);
            }
        });
        cells
    }

    fn for_each(size: [usize; 3], mut f: impl FnMut([usize; 3])) {
        for z in 0..size[2] {
            for y in 0..size[1] {
                (0..size[0]).for_each(|x| f([x, y, z]));
            }
        }
    }

    /// The cells around a cell that are inside of a grid and whose offset, from 0 to 2 along each axis, is wanted.
    fn around(cell: [usize; 3], size: [usize; 3], wanted: impl Fn([usize; 3]) -> bool) -> Vec<[usize; 3]> {
        let offsets = (0..27)
            .map(|k| [k % 3, k / 3 % 3, k / 9])
            .filter(|offset| wanted(*offset));
        let place = offsets.map(|offset| [0, 1, 2].map(|axis| (cell[axis] + offset[axis]).wrapping_sub(1)));
        place
            .filter(|place| (0..3).all(|axis| place[axis] < size[axis]))
            .collect()
    }

    fn is_face(offset: [usize; 3]) -> bool {
        offset.iter().filter(|x| **x != 1).count() <= 1
    }

    #[test]
    fn growing_adds_the_neighbours_of_every_cell() {
        for size in [[1, 1, 1], [63, 3, 4], [64, 4, 3], [130, 5, 2]] {
            let full = random(size).complement();
            type Wanted = fn([usize; 3]) -> bool;
            let wanted: [(Neighbours, Wanted); 2] = [(Neighbours::Faces, is_face), (Neighbours::All, |_| true)];
            for (neighbours, wanted) in wanted {
                let grown = full.grown(neighbours);
                for_each(size, |cell| {
                    let expected = around(cell, size, wanted).into_iter().any(|near| full.has(near));
                    assert_eq!(grown.has(cell), expected, "{neighbours:?} {size:?} {cell:?}");
                });
            }
        }
    }

    #[test]
    fn what_is_connected_is_what_a_plain_search_finds() {
        for size in [[1, 1, 1], [64, 6, 5], [131, 7, 6]] {
            for open in [random(size), random(size).complement()] {
                let mut found = Cells::none(size);
                let mut waiting = vec![[0; 3]];
                while let Some(cell) = waiting.pop() {
                    if open.has(cell) && !found.has(cell) {
                        found.set(cell);
                        waiting.extend(around(cell, size, is_face));
                    }
                }
                assert!(open.connected_to([0; 3]).bits == found.bits, "{size:?}");
            }
        }
    }
}
