//! Spans of a level: consecutive voxels, and those around them that a network reads when it draws them.
//!
//! A network is evaluated span by span, so that its activations take memory for a span and not for the level. Results
//! do not depend on where spans end: an output row reads the same rows in the same order.

use std::ops::Range;

use b2p_kernels::{MadeRows, Plan, Taps, zeros};
use rayon::prelude::*;

use crate::geometry::{KernelMap, SiblingMap, Voxels};

/// Rows of a span with its halo where memory is short: smaller spans evaluate more of their voxels twice.
const LEAST_ROWS: u64 = 3 << 15;
/// Rows of a span with its halo where memory is not limited.
const MOST_ROWS: u64 = 1 << 20;
/// A span has a row for so many bytes of the memory limit.
const BYTES_PER_ROW: u64 = 4096;

/// Rows of a span with its halo, at most, where decoding may take so many bytes of memory.
pub fn span_rows(max_bytes: u64) -> usize {
    (max_bytes / BYTES_PER_ROW).clamp(LEAST_ROWS, MOST_ROWS) as usize
}

/// Voxels per task.
const BLOCK: usize = 1024;

/// A span and its halo: rows that a network is evaluated on.
pub struct Span<'a> {
    /// The voxels of the span.
    pub range: Range<usize>,
    /// Voxel of every row: those of the span, then ring by ring those around it.
    pub voxels: Vec<u32>,
    /// Number of rows that are at most so many steps away from the span.
    ends: Vec<usize>,
    map: SpanMap<'a>,
    plan: Plan,
}

/// The 3³ kernel map of a span's rows, without the last ring.
enum SpanMap<'a> {
    /// A whole level.
    Level(&'a SiblingMap),
    Part(KernelMap),
}

impl Span<'_> {
    /// Number of rows that are at most `steps` steps away from the span.
    pub fn rows(&self, steps: usize) -> usize {
        self.ends[steps]
    }

    /// The kernel map in the form of convolution layers.
    pub fn taps(&self) -> Taps<'_> {
        match &self.map {
            SpanMap::Level(map) => Taps::Made {
                volume: 27,
                rows: *map,
                plan: &self.plan,
            },
            SpanMap::Part(map) => Taps::Map {
                volume: 27,
                rows: map.rows(),
                plan: Some(&self.plan),
            },
        }
    }
}

/// Calls `each` with the spans of consecutive voxels of a level in order, each with a halo of `rings` rings. No span has
/// more than `most` rows, unless it is a single voxel; a level with so few voxels is one span without a halo.
///
/// # Errors
/// The first of `each`.
///
/// # Panics
/// If `map` is not the level's, or the level has no such voxels.
pub fn for_each_span<E>(
    voxels: &Voxels,
    map: &SiblingMap,
    wanted: Range<usize>,
    rings: usize,
    most: usize,
    mut each: impl FnMut(Span<'_>) -> Result<(), E>,
) -> Result<(), E> {
    let count = voxels.len();
    assert_eq!(map.len(), count, "the map must be that of the level");
    if count <= most && wanted == (0..count) {
        return each(Span {
            range: 0..count,
            voxels: (0..count as u32).collect(),
            ends: vec![count; rings + 1],
            map: SpanMap::Level(map),
            plan: Plan::new(count),
        });
    }
    let mut rows = Rows {
        map,
        places: vec![KernelMap::ABSENT; count],
    };
    // The next span is on top.
    let mut left = ranges(voxels.keys(), wanted, most * 2 / 3);
    left.reverse();
    while let Some(range) = left.pop() {
        match rows.span(range.clone(), rings, most) {
            Some(span) => each(span)?,
            None => {
                let middle = cut(voxels.keys(), &range, range.len().div_ceil(2));
                left.extend([middle..range.end, range.start..middle]);
            }
        }
    }
    Ok(())
}

/// Cuts a range of voxels into ranges of about the same size, at most `most` voxels each.
fn ranges(keys: &[u64], mut rest: Range<usize>, most: usize) -> Vec<Range<usize>> {
    let mut ranges = Vec::new();
    // A cut may be an eighth later than where it should be.
    let usual = (most * 7 / 8).max(1);
    for left in (1..=rest.len().div_ceil(usual)).rev() {
        let end = match left {
            1 => rest.end,
            _ => cut(keys, &rest, rest.len() / left),
        };
        if rest.start < end {
            ranges.push(rest.start..end);
        }
        rest.start = end;
    }
    ranges
}

/// Where to cut a range after about `length` voxels, an eighth more or fewer: between the largest cubes, for a small
/// halo. Both parts have a voxel, if the range has two.
fn cut(keys: &[u64], range: &Range<usize>, length: usize) -> usize {
    let slack = length / 8;
    let (low, high) = (range.start + length - slack, range.start + length + slack);
    let places = low.max(range.start + 1)..(high + 1).min(range.end);
    let best = places.max_by_key(|&i| {
        (
            keys[i - 1] ^ keys[i],
            std::cmp::Reverse(i.abs_diff(range.start + length)),
        )
    });
    best.unwrap_or(range.end)
}

/// What spans are made from.
struct Rows<'a> {
    map: &'a SiblingMap,
    /// For every voxel of the level its row in the halo of the span, [`KernelMap::ABSENT`] between spans.
    places: Vec<u32>,
}

impl Rows<'_> {
    /// The span of a range; `None` if it has several voxels and more than `most` rows.
    fn span(&mut self, range: Range<usize>, rings: usize, most: usize) -> Option<Span<'static>> {
        let (mut rows, edge) = self.own(&range);
        let mut voxels: Vec<u32> = Vec::with_capacity(most);
        voxels.extend(range.start as u32..range.end as u32);
        let mut ends = vec![voxels.len()];
        let mut ring = self.around(&edge, &range, most);
        while ends.len() <= rings && (range.len() == 1 || voxels.len() + ring.len() <= most) {
            for (place, &voxel) in (voxels.len() as u32..).zip(&ring) {
                self.places[voxel as usize] = place;
            }
            voxels.extend(&ring);
            ends.push(voxels.len());
            if ends.len() <= rings {
                ring = self.around(&ring, &range, most);
            }
        }
        let fits = ends.len() > rings;
        if fits {
            // Rows of the span that read its halo, then those of the halo but for the last ring.
            let inner = ends[rings - 1];
            rows.resize(27 * inner, KernelMap::ABSENT);
            for &voxel in &edge {
                let row = voxel as usize - range.start;
                self.place_row(voxel, &range, &mut rows[27 * row..][..27]);
            }
            let halo = &voxels[range.len()..inner];
            let tasks = rows[27 * range.len()..].par_chunks_exact_mut(27).with_min_len(BLOCK);
            tasks
                .zip(halo)
                .for_each(|(row, &voxel)| self.place_row(voxel, &range, row));
        }
        for &voxel in &voxels[range.len()..] {
            self.places[voxel as usize] = KernelMap::ABSENT;
        }
        fits.then(|| Span {
            range,
            plan: Plan::new(rows.len() / 27),
            map: SpanMap::Part(KernelMap::new(27, rows)),
            voxels,
            ends,
        })
    }

    /// The kernel map of a range, without what lies outside, and the voxels that have neighbours outside, ascending.
    fn own(&self, range: &Range<usize>) -> (Vec<u32>, Vec<u32>) {
        let (first, count) = (range.start as u32, range.len() as u32);
        let mut rows = zeros(27 * range.len());
        let tasks = rows.par_chunks_mut(27 * BLOCK).enumerate();
        let edges = tasks.map(|(block, rows)| {
            let mut edge: Vec<u32> = Vec::new();
            self.map.fill(range.start + block * BLOCK, rows);
            for (voxel, row) in (first + (block * BLOCK) as u32..).zip(rows.chunks_exact_mut(27)) {
                let mut outside = false;
                for to in row {
                    let (q, place) = (*to, to.wrapping_sub(first));
                    let inside = place < count;
                    *to = if inside { place } else { KernelMap::ABSENT };
                    outside |= !inside & (q != KernelMap::ABSENT);
                }
                if outside {
                    edge.push(voxel);
                }
            }
            edge
        });
        let edges: Vec<Vec<u32>> = edges.collect();
        (rows, edges.concat())
    }

    /// The row of a voxel of the level, in the span of a range.
    fn place(&self, voxel: u32, range: &Range<usize>) -> u32 {
        match range.contains(&(voxel as usize)) {
            true => voxel - range.start as u32,
            false => self.places.get(voxel as usize).copied().unwrap_or(KernelMap::ABSENT),
        }
    }

    /// Writes a voxel's row of the span's kernel map.
    fn place_row(&self, voxel: u32, range: &Range<usize>, row: &mut [u32]) {
        for (to, q) in row.iter_mut().zip(self.map.row(voxel as usize)) {
            *to = self.place(q, range);
        }
    }

    /// The neighbours of voxels that have no row yet, ascending. If they are more than `most`, some may be missing.
    fn around(&self, voxels: &[u32], range: &Range<usize>, most: usize) -> Vec<u32> {
        let new = |voxels: &[u32]| {
            let rows = voxels.iter().flat_map(|&voxel| self.map.row(voxel as usize));
            let new = rows.filter(|&q| q != KernelMap::ABSENT && self.place(q, range) == KernelMap::ABSENT);
            let mut new: Vec<u32> = new.collect();
            new.sort_unstable();
            new.dedup();
            new
        };
        let mut around: Vec<u32> = Vec::new();
        // A few tasks at a time, so that what several of them find takes little memory.
        for voxels in voxels.chunks(16 * BLOCK) {
            let found: Vec<Vec<u32>> = voxels.par_chunks(BLOCK).map(new).collect();
            around.extend(found.iter().flatten());
            around.sort_unstable();
            around.dedup();
            if around.len() > most {
                break;
            }
        }
        around
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, morton};
    use b2p_kernels::reference;
    use proptest::prelude::*;
    use std::convert::Infallible;

    /// The voxels of a level that are at most so many steps from those of a range, by definition.
    fn near(map: &SiblingMap, range: Range<usize>, steps: usize) -> Vec<u32> {
        let mut near: Vec<u32> = (range.start as u32..range.end as u32).collect();
        for _ in 0..steps {
            let rows = near.iter().flat_map(|&voxel| map.row(voxel as usize));
            near = rows.filter(|&q| q != KernelMap::ABSENT).collect();
            near.sort_unstable();
            near.dedup();
        }
        near
    }

    fn check(voxels: Voxels, rings: usize, most: usize) {
        let count = voxels.len();
        check_some(&voxels, 0..count, rings, most);
        check_some(&voxels, count / 3..count / 2, rings, most);
    }

    fn check_some(voxels: &Voxels, wanted: Range<usize>, rings: usize, most: usize) {
        let octree = Octree::new(voxels.clone()).unwrap();
        let (map, voxels) = (octree.sibling_map(octree.depth()), octree.level(octree.depth()));
        let mut next = wanted.start;
        let done: Result<(), Infallible> = for_each_span(voxels, &map, wanted.clone(), rings, most, |span| {
            let Span { range, voxels, .. } = &span;
            assert_eq!(range.start, next, "spans follow one another");
            next = range.end;
            assert!(
                range.len() == 1 || voxels.len() <= most,
                "{} of {most} rows",
                voxels.len()
            );
            assert!(voxels[..range.len()].iter().map(|&v| v as usize).eq(range.clone()));
            for steps in 0..=rings {
                let mut rows = voxels[..span.rows(steps)].to_vec();
                rows.sort_unstable();
                let expected = near(&map, range.clone(), steps);
                // A level in one span has no halo: all of it is there.
                assert!(rows == expected || rows.len() == map.len(), "{steps} steps");
            }
            for (row, &voxel) in voxels[..span.rows(rings - 1)].iter().enumerate() {
                let taps = span.taps();
                let found = (0..27).map(|k| reference::tap(&taps, row, k));
                let found = found.map(|row| {
                    row.and_then(|row| voxels.get(row).copied())
                        .unwrap_or(KernelMap::ABSENT)
                });
                assert!(found.eq(map.row(voxel as usize)), "row {row}");
            }
            Ok(())
        });
        let Ok(()) = done;
        assert_eq!(next, wanted.end, "spans cover what is wanted");
    }

    proptest! {
        #[test]
        fn spans_hold_their_voxels_and_all_that_are_near(
            keys in prop::collection::vec(0u64..1 << 12, 1..600),
            rings in 1usize..5,
            most in 1usize..300,
        ) {
            check(Voxels::new(4, keys), rings, most);
        }
    }

    #[test]
    fn spans_of_solids_and_of_lone_voxels_stay_below_the_rows_asked_for() {
        check(Voxels::new(5, (0..1 << 15).collect()), 6, 9000);
        let far = (0..2000u64).map(|i| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1);
        check(Voxels::new(21, far.collect()), 6, 100);
    }

    #[test]
    fn a_surface_has_spans_of_about_the_size_asked_for() {
        let bowl = (0..1u32 << 16).map(|i| {
            let [x, y] = [i % 256, i / 256];
            morton::encode([x, y, (x * x + y * y) / 512])
        });
        let octree = Octree::new(Voxels::new(8, bowl.collect())).unwrap();
        let mut spans = 0;
        let (voxels, map) = (octree.level(8), octree.sibling_map(8));
        let done: Result<(), Infallible> = for_each_span(voxels, &map, 0..voxels.len(), 6, 12_000, |_| {
            spans += 1;
            Ok(())
        });
        let Ok(()) = done;
        assert!((6..=12).contains(&spans), "{spans} spans of 65,536 voxels");
    }
}
