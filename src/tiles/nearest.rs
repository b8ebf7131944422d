//! The ellipses of one tile in the order of drawing, as far as they are wanted.

use std::sync::atomic::{AtomicU64, Ordering};

/// So many are simply sorted.
const FEW: usize = 64;
/// Handed out are multiples of this, but for the last: vectors are full then.
const HANDFUL: usize = 32;
/// So many are shown before they are handed out.
const COMING: usize = 3 * HANDFUL;
/// So many handfuls at least.
const HANDFULS: usize = 2;
/// The most buckets: their counters fit the first cache.
const MOST_BUCKETS: usize = 2048;

/// Sorts tiles one after the other, reusing its memory.
#[derive(Debug, Default)]
pub struct Nearest {
    ends: Vec<u32>,
    keys: Vec<u64>,
    buckets: bool,
}

impl Nearest {
    /// Takes a tile's `entries` and puts them in buckets of depth.
    pub fn take(&mut self, entries: &[AtomicU64]) {
        let read = || entries.iter().map(|e| e.load(Ordering::Relaxed));
        self.keys.clear();
        if self.keys.capacity() < entries.len() {
            self.keys = Vec::with_capacity(entries.len());
        }
        self.buckets = entries.len() > FEW;
        if !self.buckets {
            self.keys.extend(read());
            return;
        }
        let depth = |key: u64| (key >> 32) as u32;
        let (mut least, mut most) = (u32::MAX, 0);
        for key in read() {
            least = least.min(depth(key));
            most = most.max(depth(key));
        }
        let buckets = (entries.len() / 4).next_power_of_two().min(MOST_BUCKETS);
        let bits = u32::BITS - (most - least).leading_zeros();
        let shift = bits.saturating_sub(buckets.trailing_zeros());
        let bucket = |key: u64| ((depth(key) - least) >> shift) as usize & (buckets - 1);
        self.ends.clear();
        self.ends.resize(buckets, 0);
        for key in read() {
            self.ends[bucket(key)] += 1;
        }
        let mut total = 0;
        for end in &mut self.ends {
            total += std::mem::replace(end, total);
        }
        self.keys.resize(entries.len(), 0);
        for key in read() {
            let next = &mut self.ends[bucket(key)];
            self.keys[*next as usize] = key;
            *next += 1;
        }
    }

    /// Hands out the keys of the tile taken last, nearest first, some at a time, as long as `draw` says to go on. With each it is
    /// shown, before they are sorted, most of those that come next; it begins with these alone.
    pub fn each(&mut self, mut draw: impl FnMut(&[u64], &[u64]) -> bool) {
        let coming = |keys: &[u64], first: usize| first..keys.len().min(first + COMING);
        draw(&[], &self.keys[coming(&self.keys, 0)]);
        if !self.buckets {
            sort(&mut self.keys);
            draw(&self.keys, &[]);
            return;
        }
        let (mut first, mut sorted) = (0, 0);
        for &end in &self.ends {
            let end = end as usize;
            sort(&mut self.keys[sorted..end]);
            sorted = end;
            if sorted - first >= HANDFULS * HANDFUL {
                let whole = sorted - (sorted - first) % HANDFUL;
                let next = &self.keys[coming(&self.keys, whole)];
                if !draw(&self.keys[first..whole], next) {
                    return;
                }
                first = whole;
            }
        }
        if first < sorted {
            draw(&self.keys[first..sorted], &[]);
        }
    }
}

/// Most buckets hold a few.
#[inline]
fn sort(keys: &mut [u64]) {
    if keys.len() > 12 {
        keys.sort_unstable();
        return;
    }
    for end in 1..keys.len() {
        let key = keys[end];
        let mut at = end;
        while at > 0 && keys[at - 1] > key {
            keys[at] = keys[at - 1];
            at -= 1;
        }
        keys[at] = key;
    }
}
