//! Surfels: opaque discs in closed form, from the voxels of a level and their colours (`docs/format.md`, clause 6). No
//! network, no model file.
//!
//! A voxel's normal is the eigenvector with the smallest eigenvalue of the covariance of its neighbourhood
//! (`moments.rs`). The disc lies in the plane through the mean of the neighbourhood, which smooths the staircase of
//! voxels away. If the neighbourhood is not planar, the disc lies nearer to the voxel. Its radius follows from the
//! distance of a plane's voxels; its thickness is negligible, so that silhouettes do not grow. With fewer neighbours in
//! the plane the disc becomes rounder. [`PerVoxel::Four`] makes four smaller discs with colours along the local
//! gradient.
//!
//! Captures are sparse at their finest level (`sparsity.rs`). There, in blocks where many voxels lack neighbours, these
//! fit wider windows (`windows.rs`), whose discs are as large as the voxels are far apart; in other blocks, lone voxels
//! are noise and become faint. Nothing changes at levels that are not sparse.
//!
//! All sums are integer sums. The rest is IEEE f32 additions, multiplications, divisions and square roots in a fixed
//! order, so that the Gaussians are bit-exact on every machine and for any number of threads.

mod colours;
mod discs;
mod lanes;
mod moments;
mod normals;
mod passes;
mod sparsity;
#[cfg(test)]
mod tests;
mod windows;

use std::ops::Range;

use b2p_kernels::{Isa, zeros};
use rayon::prelude::*;

use super::{Frame, Gaussians};
use crate::geometry::{RowBuffer, SiblingMap, Voxels};
use discs::Disc;
use moments::Moments;
use sparsity::Sparsity;
pub use sparsity::{closing_size, is_for_surfels};
use windows::{Window, Windows};

/// Voxels per task, and per block whose sparsity is measured: part of the definition of surfels.
const BLOCK: usize = 1024;
/// Opacity of noise: little is seen of it, and all formats of Gaussians can say it.
const FAINT: f32 = 1.0 / 64.0;
/// [`Gaussians::blur`], in voxels squared.
const BLUR: f32 = 0.003;
/// Offset of the four discs along both axes of their plane from the centre of the single disc, in voxels.
const OFFSET: f32 = 0.25;
/// Radius of each of the four discs over that of the single disc.
const SHRINK: f32 = 0.6;

/// Number of discs per voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PerVoxel {
    /// One disc with the voxel's colour, for voxels that are small in the picture.
    #[default]
    One,
    /// Four discs with colours interpolated between neighbours, for voxels that are large in the picture. At level 8 of
    /// six 10-bit objects they gained 0.2 dB over whole pictures, 0.35 dB over the foreground and 2 points of
    /// SSIMULACRA2; at level 9 −0.3 dB, +0.2 dB and 0.5 points, for twice the time.
    Four,
}

impl PerVoxel {
    /// 1 or 4.
    pub fn count(self) -> usize {
        match self {
            PerVoxel::One => 1,
            PerVoxel::Four => 4,
        }
    }
}

/// Which voxels become surfels, and of what size.
#[derive(Debug, Clone, Copy)]
pub struct SurfelSelection<'a> {
    /// For every voxel whether it becomes surfels; `None` for all.
    pub only: Option<&'a [bool]>,
    /// Factor of the radii.
    pub size: f32,
    /// The voxels that are drawn at all, and what the sparsity of the level is known from; the others are neighbours of
    /// theirs. `None` for all.
    pub range: Option<&'a Range<usize>>,
}

impl SurfelSelection<'_> {
    /// All voxels, in the usual size.
    pub const ALL: SurfelSelection<'static> = SurfelSelection {
        only: None,
        size: 1.0,
        range: None,
    };

    fn has(&self, voxel: usize) -> bool {
        self.only.is_none_or(|only| only[voxel])
    }

    /// The voxels of the range, of so many.
    fn range(&self, voxels: usize) -> Range<usize> {
        self.range.cloned().unwrap_or(0..voxels)
    }
}

/// Makes the discs of `voxels`, voxel by voxel.
///
/// `map` is that of the voxels, `colours` holds one sRGB colour per voxel. `frame` is the cube's frame;
/// the Gaussians are in cube-frame units.
///
/// # Panics
/// If `map`, `voxels`, `colours` and the choice differ in length, or the range has other voxels.
pub fn surfels(
    isa: Isa,
    voxels: &Voxels,
    map: &SiblingMap,
    colours: &[[u8; 3]],
    per_voxel: PerVoxel,
    choice: SurfelSelection<'_>,
    frame: Frame,
) -> Gaussians {
    assert_eq!(map.len(), voxels.len(), "one row of the map per voxel");
    assert_eq!(colours.len(), voxels.len(), "one colour per voxel");
    let only = choice.only.map_or(voxels.len(), <[bool]>::len);
    assert_eq!(only, voxels.len(), "one choice per voxel");
    let range = choice.range(voxels.len());
    let chosen = range.clone().filter(|&voxel| choice.has(voxel)).count();
    let degrees = map.degrees(range.clone());
    let sparse = sparsity::is_sparse(degrees.par_iter().map(|&degree| degree.into()));
    drop(degrees);
    let far = moments::after_all_steps(isa, voxels, map);
    let n = per_voxel.count();
    let count = chosen * n;
    let edge = 2.0 / (1u32 << voxels.depth()) as f32;
    let mut gaussians = Gaussians {
        blur: BLUR * edge * edge,
        position: zeros(count),
        scale: zeros(count),
        rotation: zeros(count),
        opacity: vec![1.0; count],
        colour: zeros(count),
        frame,
        ..Gaussians::default()
    };
    let tasks = Rows::of(&mut gaussians).tasks(range.clone(), n, choice);
    tasks.into_par_iter().for_each(|(first, rows)| {
        let last = (first + BLOCK).min(range.end);
        let coordinates: Vec<[u32; 3]> = (first..last).map(|i| voxels.coordinate(i)).collect();
        let far = &far[first..last];
        let mut masks = [0; BLOCK];
        let masks = &mut masks[..far.len()];
        map.masks(first, masks);
        let mut discs = isa.run(passes::Fit {
            coordinates: &coordinates,
            masks,
            far,
        });
        if sparse {
            fit_windows(isa, voxels, &coordinates, masks, far, &mut discs);
        }
        let (mut buffer, mut around) = (RowBuffer::new(), [].as_slice());
        let mut to = 0;
        for (j, (disc, &coordinate)) in discs.iter().zip(&coordinates).enumerate() {
            let place = j % RowBuffer::ROWS;
            if n > 1 && place == 0 {
                around = buffer.fill(map, first + j..last.min(first + j + RowBuffer::ROWS));
            }
            if !choice.has(first + j) {
                continue;
            }
            let parts = match per_voxel {
                PerVoxel::One => [(disc.centre, colours[first + j].map(f32::from)); 4],
                PerVoxel::Four => quarters(disc, &around[27 * place..][..27], colours, first + j),
            };
            let shrink = if n == 1 { 1.0 } else { SHRINK };
            let radius = disc.radius * shrink * choice.size * edge;
            for (offset, rgb) in parts.into_iter().take(n) {
                rows.position[to] = cube_point(coordinate, offset, edge);
                rows.scale[to] = [radius, radius, disc.thickness * edge];
                rows.rotation[to] = disc.rotation;
                rows.opacity[to] = disc.opacity;
                rows.colour[to] = rgb.map(|v| v / 255.0);
                to += 1;
            }
        }
    });
    gaussians
}

/// The arrays that surfels are written to.
struct Rows<'a> {
    position: &'a mut [[f32; 3]],
    scale: &'a mut [[f32; 3]],
    rotation: &'a mut [[f32; 4]],
    opacity: &'a mut [f32],
    colour: &'a mut [[f32; 3]],
}

impl<'a> Rows<'a> {
    fn of(gaussians: &'a mut Gaussians) -> Self {
        Rows {
            position: &mut gaussians.position,
            scale: &mut gaussians.scale,
            rotation: &mut gaussians.rotation,
            opacity: &mut gaussians.opacity,
            colour: &mut gaussians.colour,
        }
    }

    /// First voxel and rows of every block.
    fn tasks(mut self, voxels: Range<usize>, per_voxel: usize, choice: SurfelSelection<'_>) -> Vec<(usize, Rows<'a>)> {
        let mut tasks = Vec::with_capacity(voxels.len().div_ceil(BLOCK));
        for first in voxels.clone().step_by(BLOCK) {
            let block = first..(first + BLOCK).min(voxels.end);
            let count = per_voxel * block.filter(|&voxel| choice.has(voxel)).count();
            let (rows, rest) = self.split_at(count);
            tasks.push((first, rows));
            self = rest;
        }
        tasks
    }

    fn split_at(self, count: usize) -> (Rows<'a>, Rows<'a>) {
        let (position, positions) = self.position.split_at_mut(count);
        let (scale, scales) = self.scale.split_at_mut(count);
        let (rotation, rotations) = self.rotation.split_at_mut(count);
        let (opacity, opacities) = self.opacity.split_at_mut(count);
        let (colour, colours) = self.colour.split_at_mut(count);
        let rows = Rows {
            position,
            scale,
            rotation,
            opacity,
            colour,
        };
        let rest = Rows {
            position: positions,
            scale: scales,
            rotation: rotations,
            opacity: opacities,
            colour: colours,
        };
        (rows, rest)
    }
}

/// Fits the discs of voxels that lack neighbours to the windows around them, if the block is open, and makes noise
/// faint. Dense parts have some such voxels, in thin bars, and windows would close the gaps between bars.
fn fit_windows(
    isa: Isa,
    voxels: &Voxels,
    coordinates: &[[u32; 3]],
    masks: &[u32],
    far: &[Moments],
    discs: &mut [Disc],
) {
    let block = Sparsity::of_block(far.iter().map(|moments| moments[0]));
    for (disc, moments) in discs.iter_mut().zip(far) {
        if block.is_noise(moments[0]) {
            disc.opacity = FAINT;
        }
    }
    let mut search = Windows::new(voxels);
    let wanted = (0..discs.len()).filter(|&j| block.wants_window(far[j][0]));
    let found: Vec<(usize, Window)> = wanted
        .filter_map(|j| Some((j, search.around(coordinates[j])?)))
        .collect();
    if found.is_empty() {
        return;
    }
    let masks: Vec<_> = found.iter().map(|&(j, _)| masks[j]).collect();
    let windows: Vec<_> = found.iter().map(|&(_, window)| window).collect();
    let fitted = isa.run(passes::FitWindows {
        masks: &masks,
        windows: &windows,
    });
    for ((j, _), disc) in found.into_iter().zip(fitted) {
        discs[j] = disc;
    }
}

/// The point `offset` voxels from a voxel's centre, in the cube frame. `edge` is the voxel's edge. Centres are exact up
/// to level 20.
fn cube_point(coordinate: [u32; 3], offset: [f32; 3], edge: f32) -> [f32; 3] {
    std::array::from_fn(|axis| {
        let centre = (f64::from(coordinate[axis]) + 0.5) * f64::from(edge) - 1.0;
        centre as f32 + offset[axis] * edge
    })
}

/// Centres relative to the voxel's centre, in voxels, and colours in 0..=255 of the four discs that replace a voxel's
/// disc.
fn quarters(disc: &Disc, row: &[u32], colours: &[[u8; 3]], voxel: usize) -> [([f32; 3], [f32; 3]); 4] {
    let [u, v] = colours::plane(disc);
    let [along_u, along_v] = colours::gradient(row, colours, voxel, [u, v]);
    let own = colours[voxel].map(f32::from);
    let far = OFFSET * disc.spacing;
    [(-far, -far), (far, -far), (-far, far), (far, far)].map(|(a, b)| {
        let offset = [0, 1, 2].map(|axis| disc.centre[axis] + a * u[axis] + b * v[axis]);
        let rgb = [0, 1, 2].map(|c| own[c] + a * along_u[c] + b * along_v[c]);
        (offset, rgb.map(|v| v.clamp(0.0, 255.0)))
    })
}
