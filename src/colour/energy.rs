//! Local coefficient energy, a context of the next level (`docs/format.md`, clause 5.9).

use b2p_kernels::{Instructions, Isa, Work};
use rayon::prelude::*;

use super::block::Nodes;
use crate::geometry::{KernelMap, RowBuffer, SiblingMap};

/// Offsets of the neighbours that share a face, as indices into a 3³ row.
const FACES: [usize; 6] = [4, 10, 12, 14, 16, 22];
/// Offsets of the neighbours that share only an edge.
const EDGES: [usize; 12] = [1, 3, 5, 7, 9, 11, 15, 17, 19, 21, 23, 25];
/// Offsets of the neighbours that share only a corner.
const CORNERS: [usize; 8] = [0, 2, 6, 8, 18, 20, 24, 26];

/// Coefficient energies of a level's nodes, smoothed over their neighbours and copied to each child.
pub(super) fn spread_energies(isa: Isa, nodes: Nodes<'_>, energies: &[[u8; 3]]) -> Vec<[u8; 3]> {
    /// Nodes per task.
    const BLOCK: usize = 2048;
    // The last one stands for absent neighbours.
    let mut padded = vec![[0; 4]; energies.len() + 1];
    for (to, &[y, co, cg]) in padded.iter_mut().zip(energies) {
        *to = [y.into(), co.into(), cg.into(), 1];
    }
    let count = |masks: &[u8]| masks.iter().map(|mask| mask.count_ones() as usize).sum::<usize>();
    let mut spread = vec![[0; 3]; count(nodes.masks)];
    let mut tasks = Vec::with_capacity(nodes.masks.len().div_ceil(BLOCK));
    let mut rest = &mut spread[..];
    for (i, masks) in nodes.masks.chunks(BLOCK).enumerate() {
        let (out, after) = rest.split_at_mut(count(masks));
        tasks.push((i * BLOCK, masks, out));
        rest = after;
    }
    let energies = &padded[..];
    tasks.into_par_iter().for_each(|(first, masks, out)| {
        isa.run(Smooth {
            energies,
            map: nodes.map,
            first,
            masks,
            out,
        })
    });
    spread
}

/// Smooths the energies of consecutive nodes and copies them to their children.
struct Smooth<'a> {
    /// Energies of Y, Co and Cg, and 1, of every node, then zeros.
    energies: &'a [[u16; 4]],
    map: &'a SiblingMap,
    /// The first of the nodes.
    first: usize,
    masks: &'a [u8],
    out: &'a mut [[u8; 3]],
}

impl Work for Smooth<'_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let Smooth {
            energies,
            map,
            first,
            masks,
            out,
        } = self;
        let mut out = out.iter_mut();
        let mut buffer = RowBuffer::new();
        for (first, masks) in (first..).step_by(RowBuffer::ROWS).zip(masks.chunks(RowBuffer::ROWS)) {
            let rows = buffer.fill(map, first..first + masks.len());
            for (row, mask) in rows.chunks_exact(27).zip(masks) {
                let mut sums = [0u32; 4];
                // By the number of coordinates in which a neighbour differs: itself, by a face, an edge, a corner.
                add_energies(energies, row, &[KernelMap::CENTRE], 40, &mut sums);
                add_energies(energies, row, &FACES, 15, &mut sums);
                add_energies(energies, row, &EDGES, 7, &mut sums);
                add_energies(energies, row, &CORNERS, 3, &mut sums);
                let [y, co, cg, weight] = sums;
                let smoothed = [y, co, cg].map(|sum| (sum / weight.max(1)) as u8);
                for _ in 0..mask.count_ones() {
                    if let Some(to) = out.next() {
                        *to = smoothed;
                    }
                }
            }
        }
    }
}

/// Adds the weighted energies, and the weight, of the neighbours at these offsets. The last of `energies` stands for
/// absent neighbours.
#[inline(always)]
fn add_energies<const N: usize>(
    energies: &[[u16; 4]],
    row: &[u32],
    offsets: &[usize; N],
    weight: u32,
    sums: &mut [u32; 4],
) {
    let absent = energies.len() - 1;
    let mut unweighted = [0u16; 4];
    for &k in offsets {
        // No branch: the presence of neighbours is unpredictable.
        let energies = &energies[absent.min(row[k] as usize)];
        for i in 0..4 {
            unweighted[i] += energies[i];
        }
    }
    for i in 0..4 {
        sums[i] += weight * u32::from(unweighted[i]);
    }
}
