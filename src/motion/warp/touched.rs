//! Which voxels give weight to which tile of cells.

use std::collections::HashMap;
use std::ops::Range;

use rayon::prelude::*;

use super::TILE;
use super::places::Place;
use crate::geometry::morton;

/// The most tiles that a voxel touches.
const MOST: usize = 8;
/// Voxels per task.
const CHUNK: usize = 1 << 10;

/// The voxels that give weight to each tile.
pub(super) struct Touched {
    /// Of each chunk of voxels their numbers in the chunk, by tiles.
    chunks: Vec<Vec<u16>>,
    /// In the order of tiles.
    pub(super) runs: Vec<Run>,
}

/// Voxels of a chunk that touch a tile.
pub(super) struct Run {
    pub(super) tile: u64,
    chunk: usize,
    pub(super) range: Range<usize>,
}

/// Tiles along an axis that the voxels of a chunk mostly touch.
const NEAR: i32 = 4;
const METS: usize = (NEAR * NEAR * NEAR) as usize;

/// The tiles that the voxels of a chunk touch, in the order in which they are met.
struct Tiles {
    places: Vec<[i32; 3]>,
    numbers: HashMap<[i32; 3], usize>,
    /// The number of the tile that was met last, of those with the same remainders modulo [`NEAR`].
    met: [usize; METS],
    /// How many voxels touch each.
    counts: Vec<usize>,
    /// For each touch the tile's number here and the voxel's in the chunk.
    touches: Vec<(u16, u16)>,
}

impl Tiles {
    fn new() -> Self {
        Tiles {
            places: Vec::new(),
            numbers: HashMap::new(),
            met: [0; METS],
            counts: Vec::new(),
            touches: Vec::with_capacity(2 * CHUNK),
        }
    }

    /// Of one voxel after the other.
    #[inline]
    fn touch(&mut self, tile: [i32; 3], voxel: usize) {
        let [x, y, z] = tile.map(|x| x & (NEAR - 1));
        let met = &mut self.met[(x + NEAR * (y + NEAR * z)) as usize];
        if self.places.get(*met) != Some(&tile) {
            *met = *self.numbers.entry(tile).or_insert_with(|| {
                self.places.push(tile);
                self.counts.push(0);
                self.places.len() - 1
            });
        }
        self.counts[*met] += 1;
        self.touches.push((*met as u16, voxel as u16));
    }

    /// The voxels by tiles, and where those of each tile are.
    fn sorted(self, chunk: usize) -> (Vec<u16>, Vec<Run>) {
        let mut end = 0;
        let runs = { self.places.iter().zip(&self.counts) }.map(|(place, count)| {
            let tile = morton::encode(place.map(|x| x as u32));
            let range = end..end + count;
            end = range.end;
            Run { tile, chunk, range }
        });
        let runs: Vec<Run> = runs.collect();
        let mut next: Vec<usize> = runs.iter().map(|run| run.range.start).collect();
        let mut voxels = vec![0; self.touches.len()];
        for (tile, voxel) in self.touches {
            voxels[next[usize::from(tile)]] = voxel;
            next[usize::from(tile)] += 1;
        }
        (voxels, runs)
    }
}

impl Touched {
    /// Bytes of memory per voxel at most.
    pub(super) const fn bytes_per_voxel() -> usize {
        MOST * (size_of::<(u16, u16)>() + size_of::<u16>() + size_of::<Run>())
    }

    /// Of voxels at these places, of level `top`.
    pub(super) fn new(places: &[Place], top: u8) -> Self {
        let tiles = 1i32 << u32::from(top).saturating_sub(TILE);
        let of_chunk = |(chunk, places): (usize, &[Place])| {
            let mut found = Tiles::new();
            for (i, place) in places.iter().enumerate() {
                let first = place.map(|x| x >> (4 + TILE));
                // The last cell that has weight.
                let end = place.map(|x| (x + 15) >> (4 + TILE));
                if first == end {
                    if first.iter().all(|x| (0..tiles).contains(x)) {
                        found.touch(first, i);
                    }
                    continue;
                }
                for z in first[2]..=end[2] {
                    for y in first[1]..=end[1] {
                        for x in first[0]..=end[0] {
                            if [x, y, z].iter().all(|x| (0..tiles).contains(x)) {
                                found.touch([x, y, z], i);
                            }
                        }
                    }
                }
            }
            found.sorted(chunk)
        };
        let found: Vec<_> = places.par_chunks(CHUNK).enumerate().map(of_chunk).collect();
        let (chunks, runs): (Vec<Vec<u16>>, Vec<Vec<Run>>) = found.into_iter().unzip();
        let mut runs: Vec<Run> = runs.into_iter().flatten().collect();
        runs.sort_unstable_by_key(|run| (run.tile, run.chunk));
        Touched { chunks, runs }
    }

    /// The numbers of a run's voxels.
    pub(super) fn voxels(&self, run: &Run) -> impl Iterator<Item = usize> {
        let first = run.chunk * CHUNK;
        let touched = &self.chunks[run.chunk][run.range.clone()];
        touched.iter().map(move |touched| first + usize::from(*touched))
    }
}
