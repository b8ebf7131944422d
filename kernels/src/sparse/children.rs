//! The 3³ neighbours of voxels' children, from those of the voxels: a child's neighbour lies in its parent or in one of
//! its parent's 26 neighbours, and the neighbours of all eight siblings fill a window of 4³ positions around them.

use super::taps::ABSENT;

/// For every position of the window, x fastest: the parent's neighbour it lies in and its octant there.
const WINDOW: [(u8, u8); 64] = {
    let mut window = [(0, 0); 64];
    let mut i = 0;
    while i < 64 {
        // Window position 0..4 along an axis is child coordinate −1..2: parent offset −1, 0, 0, 1 and octant bit 1, 0,
        // 1, 0.
        let (x, y, z) = (i & 3, i >> 2 & 3, i >> 4);
        window[i] = (
            (((x + 1) >> 1) + 3 * ((y + 1) >> 1) + 9 * ((z + 1) >> 1)) as u8,
            (((x + 1) & 1) + 2 * ((y + 1) & 1) + 4 * ((z + 1) & 1)) as u8,
        );
        i += 1;
    }
    window
};

/// The indices of the voxels in the window around the children of a voxel with these 27 neighbours; `child` tells those
/// of a voxel's child in an octant.
///
/// # Panics
/// If there are fewer than 27.
#[inline(always)]
pub fn window(neighbours: &[u32], child: impl Fn(u32, u32) -> u32) -> [u32; 64] {
    WINDOW.map(|(neighbour, octant)| match neighbours[usize::from(neighbour)] {
        ABSENT => ABSENT,
        q => child(q, octant.into()),
    })
}

/// Writes the 27 positions of the window around the child in `octant`.
///
/// # Panics
/// If there is no room for them.
#[inline(always)]
pub fn copy_row(window: &[u32; 64], octant: usize, row: &mut [u32]) {
    let corner = (octant & 1) + 4 * (octant >> 1 & 1) + 16 * (octant >> 2);
    for (line, run) in row[..27].chunks_exact_mut(3).enumerate() {
        let start = corner + 4 * (line % 3) + 16 * (line / 3);
        run.copy_from_slice(&window[start..start + 3]);
    }
}

/// Which of the 27 positions of the window around the child in `octant` are occupied.
#[inline(always)]
pub(crate) fn copy_mask(window: &[u32; 64], octant: usize) -> u64 {
    let mut row = [0; 27];
    copy_row(window, octant, &mut row);
    let bits = row.iter().enumerate();
    bits.fold(0, |mask, (k, &q)| mask | u64::from(q != ABSENT) << k)
}

/// Writes the rows of some children, `rows.len() / 27` from `first` on, of all eight children of voxels with these
/// neighbours, 27 each: the child in octant `o` of voxel `i` has index `8i + o`.
pub(crate) fn rows_of_all(neighbours: &[u32], first: usize, rows: &mut [u32]) {
    let mut at = first;
    let mut rest = rows;
    while !rest.is_empty() {
        let (voxel, octant) = (at / 8, at % 8);
        let window = window(&neighbours[voxel * 27..][..27], |q, octant| q << 3 | octant);
        let count = (8 - octant).min(rest.len() / 27);
        let (here, after) = rest.split_at_mut(count * 27);
        for (octant, row) in (octant..8).zip(here.chunks_exact_mut(27)) {
            copy_row(&window, octant, row);
        }
        at += count;
        rest = after;
    }
}
