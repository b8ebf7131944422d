//! The ellipses of one tile in the order of drawing.

use std::sync::atomic::{AtomicU64, Ordering};

/// So many are simply sorted.
const FEW: usize = 128;
/// The most bits that are sorted by in one pass, if there are fewer than [`MANY`], and if not: counters fit the first
/// cache.
const DIGITS: [u32; 2] = [8, 11];
const MANY: usize = 1024;
/// So many are handed out at a time: vectors are full then.
const HANDFUL: usize = 64;

/// Sorts tiles one after the other, reusing its memory.
#[derive(Debug, Default)]
pub struct Nearest {
    keys: Vec<u64>,
    /// Where the keys go in a pass.
    spare: Vec<u64>,
    ends: Vec<u32>,
}

impl Nearest {
    /// Bytes that are needed for each entry of the fullest tile.
    pub const BYTES: u64 = 2 * size_of::<u64>() as u64;

    /// Takes a tile's `entries`, of which those of equal depth are in order, and puts all of them in order: by digits
    /// of the depth less the least, the lowest first, in passes that keep the order of equals.
    pub fn take(&mut self, entries: &[AtomicU64]) {
        let count = entries.len();
        self.keys.clear();
        self.keys.reserve_exact(count);
        let read = entries.iter().map(|e| e.load(Ordering::Relaxed));
        self.keys.extend(read);
        if count <= FEW {
            self.keys.sort_unstable();
            return;
        }
        let depth = |key: u64| (key >> u32::BITS) as u32;
        let depths = || self.keys.iter().map(|key| depth(*key));
        let least = depths().fold(u32::MAX, u32::min);
        let most = depths().fold(0, u32::max);
        let bits = u32::BITS - (most - least).leading_zeros();
        let passes = bits.div_ceil(DIGITS[usize::from(count >= MANY)]);
        if passes == 0 {
            return;
        }
        let digit_bits = bits.div_ceil(passes);
        let values = 1 << digit_bits;
        let digit = |key: u64, pass: usize| {
            let shift = pass as u32 * digit_bits;
            (depth(key) - least) as usize >> shift & (values - 1)
        };
        self.ends.clear();
        self.ends.resize(passes as usize * values, 0);
        for (pass, ends) in self.ends.chunks_exact_mut(values).enumerate() {
            for &key in &self.keys {
                ends[digit(key, pass)] += 1;
            }
            let mut total = 0;
            for end in ends {
                total += std::mem::replace(end, total);
            }
        }
        self.spare.clear();
        self.spare.reserve_exact(count);
        self.spare.resize(count, 0);
        for (pass, ends) in self.ends.chunks_exact_mut(values).enumerate() {
            for &key in &self.keys {
                let next = &mut ends[digit(key, pass)];
                self.spare[*next as usize] = key;
                *next += 1;
            }
            std::mem::swap(&mut self.keys, &mut self.spare);
        }
    }

    /// Hands out the keys of the tile taken last, nearest first, some at a time, as long as `draw` says to go on. With
    /// each it is shown those that come next; it begins with these alone.
    pub fn each(&self, mut draw: impl FnMut(&[u64], &[u64]) -> bool) {
        let mut now = &self.keys[..0];
        let mut rest = &self.keys[..];
        loop {
            let (next, after) = rest.split_at(rest.len().min(HANDFUL));
            if !draw(now, next) || next.is_empty() {
                return;
            }
            (now, rest) = (next, after);
        }
    }
}
