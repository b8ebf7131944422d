//! Where a lattice moves voxels (`docs/format.md`, clauses 17.10.4 and 17.10.9).

use rayon::prelude::*;

use super::surface::offset;
use crate::geometry::ones;
use crate::motion::bricks::Windows;
use crate::motion::lattice::{Corners, Lattice};
use crate::motion::previous::PreviousLevel;

/// A place in sixteenths of a voxel.
pub(super) type Place = [i32; 3];

/// Bricks per task.
const BRICKS: usize = 512;

/// Where each voxel of `previous` moves to. If `smooth`, those that do not move by whole voxels start from the surface.
pub(super) fn places(previous: &PreviousLevel, lattice: &Lattice, [top, unit]: [u8; 2], smooth: bool) -> Vec<Place> {
    let corners = lattice.finest();
    // Cells of a node along an axis, as a shift.
    let depth = top + 1 - lattice.levels().len() as u8;
    let field = Field {
        corners,
        depth,
        shift: u32::from(3 * (depth + 1) + unit - top),
    };
    let bricks: Vec<_> = previous.bricks.each().collect();
    let of_chunk = |bricks: &[([u32; 3], u64, usize)]| {
        let mut places = Vec::with_capacity(bricks.len() * 16);
        let mut node = Node::default();
        let mut windows = Windows::new(&previous.bricks, |brick| [previous.bricks.cells(brick)]);
        for (place, mask, _) in bricks {
            for key in ones(*mask) {
                let [x, y, z] = [0, 1, 2].map(|axis| (key as u32 >> axis & 1) | (key as u32 >> (axis + 2) & 2));
                let at = [4 * place[0] + x, 4 * place[1] + y, 4 * place[2] + z];
                let mut to = field.moved(&mut node, at);
                if smooth && to.iter().any(|x| x & 15 != 0) {
                    let [windows] = windows.of_brick(place.map(|x| x as i32));
                    // From one cell before the voxel on.
                    let window = windows[key >> 3] >> ((x & 1) + 4 * (y & 1) + 16 * (z & 1));
                    let offset = offset(window);
                    to = [0, 1, 2].map(|axis| to[axis] + offset[axis]);
                }
                places.push(to);
            }
        }
        places
    };
    let chunks: Vec<Vec<Place>> = bricks.par_chunks(BRICKS).map(of_chunk).collect();
    chunks.concat()
}

/// A field of vectors between the corners of nodes.
struct Field<'a> {
    corners: &'a Corners,
    /// A node has this many levels of voxels.
    depth: u8,
    /// From sums of weighted vectors to sixteenths of a voxel.
    shift: u32,
}

/// A node that was looked up, with the vectors of its corners.
#[derive(Default)]
struct Node {
    place: Option<[u32; 3]>,
    vectors: [[i64; 3]; 8],
    still: bool,
}

impl Field<'_> {
    /// Where the voxel at this place moves to. `node` is the one of the voxel before.
    #[inline]
    fn moved(&self, node: &mut Node, at: [u32; 3]) -> Place {
        let place = at.map(|x| x >> self.depth);
        if node.place != Some(place) {
            node.place = Some(place);
            for (i, vector) in node.vectors.iter_mut().enumerate() {
                let step = [i & 1, i >> 1 & 1, i >> 2].map(|x| x as u32);
                let corner = self.corners.number([0, 1, 2].map(|axis| place[axis] + step[axis]));
                *vector = self.corners.vectors[corner].map(i64::from);
            }
            node.still = node.vectors == [[0; 3]; 8];
        }
        if node.still {
            return at.map(|x| 16 * x as i32);
        }
        let side = 2i64 << self.depth;
        let offset = [0, 1, 2].map(|axis| 2 * i64::from(at[axis] - (place[axis] << self.depth)) + 1);
        let mut sums = [0i64; 3];
        for (i, vector) in node.vectors.iter().enumerate() {
            let weight = |axis: usize| match i >> axis & 1 {
                1 => offset[axis],
                _ => side - offset[axis],
            };
            let weight = weight(0) * weight(1) * weight(2);
            (0..3).for_each(|axis| sums[axis] += weight * vector[axis]);
        }
        let half = 1i64 << (self.shift - 1);
        [0, 1, 2].map(|axis| 16 * at[axis] as i32 + ((16 * sums[axis] + half) >> self.shift) as i32)
    }
}
