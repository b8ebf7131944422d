//! Which ellipses touch which square of the picture, nearest first.
//!
//! The order of drawing is sorted once ([`Order`]), by the bits of the depth, which for positive floats is the order of the depths,
//! without loss, and then by index. The ellipses are
//! then dealt out, keeping that order, to rows of tiles ([`Rows`]), and within a row to its tiles ([`Lists`]). Only the lists of
//! the rows being drawn exist at a time: an ellipse that fills the picture costs one entry per row of tiles, and one per tile
//! only while a row is drawn.

use crate::error::{Error, Result};
use crate::limits::Limits;
use crate::projection::Bounds;

/// Side of a tile in pixels.
pub const TILE: u32 = 16;

/// Indices of ellipses, the nearest first; ties by index.
#[derive(Debug, Default)]
pub struct Order {
    /// The depth's bits above, the index below.
    keys: Vec<u64>,
    sorted: Vec<u64>,
}

/// Bits of a depth that one pass of the sort looks at: 4096 counters fit the first cache.
const DIGIT: u32 = 12;

impl Order {
    /// Bytes per ellipse.
    pub const BYTES: u64 = 2 * size_of::<u64>() as u64;

    /// Sorts `depth`, whose numbers must be positive; the memory is reused.
    ///
    /// # Errors
    /// [`Error::Unsupported`] if there are 2³² or more.
    pub fn sort(&mut self, depth: &[f32]) -> Result<()> {
        if u32::try_from(depth.len()).is_err() {
            return Err(Error::Unsupported {
                what: "a picture of 2^32 or more visible Gaussians",
                detail: format!("there are {}", depth.len()),
            });
        }
        let bits = |z: &f32| z.to_bits();
        let least = depth.iter().map(bits).min().unwrap_or(0);
        let span = depth.iter().map(bits).max().unwrap_or(0) - least;
        self.keys.clear();
        let key = |(i, z): (usize, &f32)| u64::from(z.to_bits() - least) << 32 | i as u64;
        self.keys.extend(depth.iter().enumerate().map(key));
        self.sorted.resize(depth.len(), 0);
        // A radix sort, the least digit first, of the bits in which the depths differ. It is stable, and the indices ascend.
        for shift in (0..u32::BITS - span.leading_zeros()).step_by(DIGIT as usize) {
            let digit = |key: u64| (key >> (32 + shift)) as usize & ((1 << DIGIT) - 1);
            let mut next = [0u32; 1 << DIGIT];
            for &key in &self.keys {
                next[digit(key)] += 1;
            }
            let mut total = 0;
            for next in &mut next {
                total += std::mem::replace(next, total);
            }
            for &key in &self.keys {
                let next = &mut next[digit(key)];
                self.sorted[*next as usize] = key;
                *next += 1;
            }
            std::mem::swap(&mut self.keys, &mut self.sorted);
        }
        Ok(())
    }

    /// The indices.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = u32> {
        self.keys.iter().map(|&key| key as u32)
    }
}

/// For every row of tiles, the ellipses that touch it, in the order of drawing.
#[derive(Debug, Default)]
pub struct Rows {
    /// Row `r` holds `ids[starts[r]..starts[r + 1]]`.
    starts: Vec<usize>,
    ids: Vec<u32>,
    pairs: u64,
}

impl Rows {
    /// Deals the ellipses out to the rows of tiles of a picture `height` pixels high; the memory is reused.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`] before anything is reserved, if `reserved` bytes, these entries, and the [`Lists`] of as many rows as
    /// there are threads are together more than `limits` allow.
    pub fn deal(
        &mut self,
        order: &Order,
        bounds: &[Bounds],
        height: u32,
        reserved: u64,
        limits: &Limits,
    ) -> Result<()> {
        let rows = height.div_ceil(TILE) as usize;
        let mut counts = vec![(0, 0u64); rows];
        for b in bounds {
            let (left, right) = tiles(b.x0, b.x1);
            let (first, end) = tiles(b.y0, b.y1);
            for (entries, pairs) in &mut counts[first..end] {
                *entries += 1;
                *pairs += (right - left) as u64;
            }
        }
        let mut entries = 0;
        self.starts.clear();
        self.starts.push(0);
        for (count, _) in &counts {
            entries += count;
            self.starts.push(entries);
        }
        self.pairs = counts.iter().map(|(_, pairs)| pairs).sum();
        let largest = counts.iter().map(|(_, pairs)| *pairs).max().unwrap_or(0);
        let at_once = rayon::current_num_threads().min(rows) as u64;
        let bytes = size_of::<u32>() as u64 * (entries as u64 + at_once * largest);
        limits.check_bytes("bytes to draw the picture", reserved.saturating_add(bytes))?;
        self.ids.resize(entries, 0);
        let mut next = self.starts[..rows].to_vec();
        for id in order.iter() {
            let b = &bounds[id as usize];
            let (first, end) = tiles(b.y0, b.y1);
            for next in &mut next[first..end] {
                self.ids[*next] = id;
                *next += 1;
            }
        }
        Ok(())
    }

    /// The ellipses of row `row`, nearest first.
    pub fn row(&self, row: usize) -> &[u32] {
        &self.ids[self.starts[row]..self.starts[row + 1]]
    }

    /// Pairs of an ellipse and a tile that it may touch, in the whole picture.
    pub fn pairs(&self) -> u64 {
        self.pairs
    }
}

/// For every tile of one row, the ellipses that touch it, in the order of drawing.
#[derive(Debug, Default)]
pub struct Lists {
    starts: Vec<usize>,
    ids: Vec<u32>,
    next: Vec<usize>,
}

impl Lists {
    /// Deals the ellipses `row` out to the tiles of a picture `width` pixels wide; the memory is reused.
    pub fn deal(&mut self, row: &[u32], bounds: &[Bounds], width: u32) {
        let columns = width.div_ceil(TILE) as usize;
        // Each ellipse is counted where it begins and discounted where it ends; running sums then give every tile's count.
        self.next.clear();
        self.next.resize(columns + 1, 0);
        for &id in row {
            let b = &bounds[id as usize];
            let (first, end) = tiles(b.x0, b.x1);
            self.next[first] = self.next[first].wrapping_add(1);
            self.next[end] = self.next[end].wrapping_sub(1);
        }
        self.starts.clear();
        self.starts.push(0);
        let (mut count, mut total) = (0usize, 0usize);
        for next in &mut self.next[..columns] {
            count = count.wrapping_add(*next);
            *next = total;
            total += count;
            self.starts.push(total);
        }
        self.ids.resize(total, 0);
        for &id in row {
            let b = &bounds[id as usize];
            let (first, end) = tiles(b.x0, b.x1);
            for next in &mut self.next[first..end] {
                self.ids[*next] = id;
                *next += 1;
            }
        }
    }

    /// The ellipses of tile `column`, nearest first.
    pub fn tile(&self, column: usize) -> &[u32] {
        &self.ids[self.starts[column]..self.starts[column + 1]]
    }
}

/// The tiles that the pixels `first..end` (not empty) lie in.
fn tiles(first: u32, end: u32) -> (usize, usize) {
    ((first / TILE) as usize, end.div_ceil(TILE) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(depth: &[f32]) -> Order {
        let mut order = Order::default();
        order.sort(depth).unwrap();
        order
    }

    fn bounds(x0: u32, x1: u32, y0: u32, y1: u32) -> Bounds {
        Bounds { x0, y0, x1, y1 }
    }

    #[test]
    fn the_nearest_comes_first_and_ties_keep_the_order_of_the_input() {
        let depth = [2.0, 1.0, 1e6, 2.0, f32::MIN_POSITIVE, 1.0 + f32::EPSILON];
        let ids: Vec<u32> = order(&depth).iter().collect();
        assert_eq!(ids, [4, 1, 5, 0, 3, 2]);
    }

    #[test]
    fn every_tile_lists_just_the_ellipses_whose_bounds_touch_it_nearest_first() {
        // A small generator: the shapes need no quality, only variety.
        let mut state = 1u32;
        let mut random = |n: u32| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) % n
        };
        let (width, height) = (83, 50);
        let bounds: Vec<Bounds> = (0..300)
            .map(|_| {
                let (x0, y0) = (random(width), random(height));
                let (w, h) = (1 + random(width - x0), 1 + random(height - y0));
                bounds(x0, x0 + w, y0, y0 + h)
            })
            .collect();
        let depth: Vec<f32> = bounds.iter().map(|_| 1.0 + random(40) as f32).collect();
        let order = order(&depth);
        let mut rows = Rows::default();
        rows.deal(&order, &bounds, height, 0, &Limits::default())
            .unwrap();
        let mut pairs = 0;
        for row in 0..height.div_ceil(TILE) {
            let mut lists = Lists::default();
            lists.deal(rows.row(row as usize), &bounds, width);
            for column in 0..width.div_ceil(TILE) {
                let (x, y) = (column * TILE, row * TILE);
                let expected: Vec<u32> = order
                    .iter()
                    .filter(|&id| {
                        let b = &bounds[id as usize];
                        b.x0 < x + TILE && b.x1 > x && b.y0 < y + TILE && b.y1 > y
                    })
                    .collect();
                pairs += expected.len() as u64;
                assert_eq!(lists.tile(column as usize), expected);
            }
        }
        assert_eq!(rows.pairs(), pairs);
    }

    #[test]
    fn lists_over_the_limit_are_refused_before_they_are_made() {
        let bounds = vec![bounds(0, 160, 0, 16); 101];
        let order = order(&[1.0; 101]);
        // One entry of the only row, and ten of its tiles, each.
        let needed = 101 * 11 * 4;
        let deal = |reserved, max_bytes| {
            let limits = Limits {
                max_bytes,
                ..Limits::default()
            };
            let mut rows = Rows::default();
            rows.deal(&order, &bounds, 16, reserved, &limits)
        };
        deal(100, needed + 100).unwrap();
        let error = deal(100, needed + 99).unwrap_err();
        assert!(matches!(error, Error::LimitExceeded { needed: n, .. } if n == needed + 100));
    }
}
