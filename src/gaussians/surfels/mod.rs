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
mod walks;
mod windows;

use std::borrow::Cow;
use std::ops::Range;

use b2p_kernels::{Instructions, Isa, Work, zeros};
use rayon::prelude::*;

use super::{Frame, Gaussians};
use crate::geometry::{RowBuffer, SiblingMap, Voxels};
use colours::Gradients;
use discs::Disc;
use lanes::GROUP;
use moments::Moments;
use sparsity::Sparsity;
pub use sparsity::{closing_size, is_for_surfels};
pub use walks::BYTES as WALK_BYTES;
use windows::{Window, Windows};

/// Voxels of a block whose sparsity is measured: part of the definition of surfels.
const BLOCK: usize = 1024;
/// Voxels of a task: blocks. Larger ones have fewer voxels around them for each of their own.
pub const TASK: usize = 4 * BLOCK;
/// Voxels that are drawn at a time where surfels are not kept.
pub const PART: usize = 8 * TASK;
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

    #[inline(always)]
    fn has(&self, voxel: usize) -> bool {
        self.only.is_none_or(|only| only[voxel])
    }

    /// The voxels of the range, of so many.
    fn range(&self, voxels: usize) -> Range<usize> {
        self.range.cloned().unwrap_or(0..voxels)
    }
}

/// What surfels are made of.
#[derive(Debug, Clone, Copy)]
pub struct Surfels<'a> {
    pub isa: Isa,
    pub voxels: &'a Voxels,
    /// Their neighbours.
    pub map: &'a SiblingMap,
    /// One sRGB colour per voxel.
    pub colours: &'a [[u8; 3]],
    pub per_voxel: PerVoxel,
    pub choice: SurfelSelection<'a>,
    /// The cube's frame. Gaussians are in units of the cube.
    pub frame: Frame,
}

/// Makes the discs of `voxels`, voxel by voxel, as [`Surfels::all`] does.
///
/// # Panics
/// As [`Surfels::all`].
pub fn surfels(
    isa: Isa,
    voxels: &Voxels,
    map: &SiblingMap,
    colours: &[[u8; 3]],
    per_voxel: PerVoxel,
    choice: SurfelSelection<'_>,
    frame: Frame,
) -> Gaussians {
    let surfels = Surfels {
        isa,
        voxels,
        map,
        colours,
        per_voxel,
        choice,
        frame,
    };
    surfels.all()
}

impl Surfels<'_> {
    /// Makes the discs of all chosen voxels, voxel by voxel.
    ///
    /// # Panics
    /// If the map, the voxels, the colours and the choice differ in length, or the range has other voxels.
    pub fn all(&self) -> Gaussians {
        let range = self.checked_range();
        let sparse = self.is_sparse(range.clone());
        // Summing over the whole level takes more memory and less time.
        let moments = moments::after_all_steps(self.isa, self.voxels, self.map);
        self.of(range, sparse, Some(&moments))
    }

    /// Makes the same discs in parts of at most [`PART`] voxels, and calls `each` with one after the other. There is one
    /// at least.
    ///
    /// # Errors
    /// The first of `each`.
    ///
    /// # Panics
    /// As [`Surfels::all`].
    pub fn in_parts<E>(&self, mut each: impl FnMut(Gaussians) -> Result<(), E>) -> Result<(), E> {
        let range = self.checked_range();
        let sparse = self.is_sparse(range.clone());
        for first in range.clone().step_by(PART) {
            each(self.of(first..range.end.min(first + PART), sparse, None))?;
        }
        Ok(())
    }

    fn checked_range(&self) -> Range<usize> {
        let count = self.voxels.len();
        assert_eq!(self.map.len(), count, "one row of the map per voxel");
        assert_eq!(self.colours.len(), count, "one colour per voxel");
        let only = self.choice.only.map_or(count, <[bool]>::len);
        assert_eq!(only, count, "one choice per voxel");
        self.choice.range(count)
    }

    fn is_sparse(&self, range: Range<usize>) -> bool {
        sparsity::is_sparse(self.map, range)
    }

    /// The discs of chosen voxels of a range that starts with a block of the level's range. `moments` are those of all
    /// voxels after all steps, if they are known.
    fn of(&self, range: Range<usize>, sparse: bool, moments: Option<&[Moments]>) -> Gaussians {
        let n = self.per_voxel.count();
        let count = n * range.clone().filter(|&voxel| self.choice.has(voxel)).count();
        let edge = self.edge();
        let mut gaussians = Gaussians {
            blur: BLUR * edge * edge,
            position: zeros(count),
            scale: zeros(count),
            rotation: zeros(count),
            opacity: vec![1.0; count],
            colour: zeros(count),
            frame: self.frame,
            ..Gaussians::default()
        };
        let tasks = Rows::of(&mut gaussians).tasks(range.clone(), TASK, n, self.choice);
        tasks.into_par_iter().for_each(|(first, rows)| {
            let task = first..range.end.min(first + TASK);
            // Blocks are drawn by what lies around them: what nobody wants is not fitted.
            if rows.opacity.is_empty() {
                return;
            }
            let far = match moments {
                Some(moments) => Cow::Borrowed(&moments[task.clone()]),
                None => Cow::Owned(walks::after_all_steps(self.isa, self.voxels, self.map, task.clone())),
            };
            let blocks = rows.tasks(task.clone(), BLOCK, n, self.choice);
            for ((first, rows), far) in blocks.into_iter().zip(far.chunks(BLOCK)) {
                self.draw(first, far, sparse, rows);
            }
        });
        gaussians
    }

    /// The edge of a voxel.
    #[inline(always)]
    fn edge(&self) -> f32 {
        2.0 / (1u32 << self.voxels.depth()) as f32
    }

    /// Draws a block of voxels, whose moments after all steps are `far`.
    fn draw(&self, first: usize, far: &[Moments], sparse: bool, rows: Rows<'_>) {
        let coordinates: Vec<[u32; 3]> = (first..first + far.len()).map(|i| self.voxels.coordinate(i)).collect();
        let mut masks = [0; BLOCK];
        let masks = &mut masks[..far.len()];
        self.map.masks(first, masks);
        let mut discs = self.isa.run(passes::Fit {
            coordinates: &coordinates,
            masks,
            far,
        });
        if sparse {
            fit_windows(self.isa, self.voxels, &coordinates, masks, far, &mut discs);
        }
        self.isa.run(Placed {
            surfels: self,
            first,
            coordinates: &coordinates,
            masks,
            discs: &discs,
            rows,
        });
    }
}

/// Writes the Gaussians of a block of voxels, whose discs are known.
struct Placed<'a, 'b> {
    surfels: &'a Surfels<'a>,
    /// The first voxel.
    first: usize,
    coordinates: &'a [[u32; 3]],
    /// Which places of the voxels' rows are occupied.
    masks: &'a [u32],
    discs: &'a [Disc],
    rows: Rows<'b>,
}

impl Work for Placed<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<I: Instructions>(self, _: I) {
        let (surfels, first, rows) = (self.surfels, self.first, self.rows);
        let (map, colours, n) = (surfels.map, surfels.colours, surfels.per_voxel.count());
        let last = first + self.discs.len();
        let edge = surfels.edge();
        let shrink = if n == 1 { 1.0 } else { SHRINK };
        let (mut buffer, mut around) = (RowBuffer::new(), [].as_slice());
        let mut gradients = None;
        let mut taken = 0;
        for (j, (disc, &coordinate)) in self.discs.iter().zip(self.coordinates).enumerate() {
            let place = j % RowBuffer::ROWS;
            if n > 1 && place == 0 {
                around = buffer.fill(map, first + j..last.min(first + j + RowBuffer::ROWS));
            }
            if j % GROUP == 0 {
                gradients = None;
            }
            if !surfels.choice.has(first + j) {
                continue;
            }
            if n > 1 && gradients.is_none() {
                let group = j / GROUP * GROUP..self.discs.len().min((j / GROUP + 1) * GROUP);
                let rows = &around[27 * (group.start % RowBuffer::ROWS)..];
                let (discs, masks) = (&self.discs[group.clone()], &self.masks[group.clone()]);
                gradients = Some(Gradients::new(discs, masks, rows, colours, first + group.start));
            }
            let own = with_floats(colours[first + j]);
            let (places, rgb) = match &gradients {
                None => ([[disc.centre[0]; 4], [disc.centre[1]; 4], [disc.centre[2]; 4]], own),
                Some(gradients) => quarters(disc, gradients, j % GROUP, own),
            };
            let centre = cube_centre(coordinate, edge);
            let radius = disc.radius * shrink * surfels.choice.size * edge;
            let (places, rgb) = (moved(places, centre, edge), shares(rgb));
            let to = taken..taken + n;
            let positions = rows.position[to.clone()].iter_mut().zip(&mut rows.colour[to.clone()]);
            for (part, (position, colour)) in positions.enumerate() {
                *position = [places[0][part], places[1][part], places[2][part]];
                *colour = [rgb[0][part], rgb[1][part], rgb[2][part]];
            }
            rows.scale[to.clone()].fill([radius, radius, disc.thickness * edge]);
            rows.rotation[to.clone()].fill(disc.rotation);
            rows.opacity[to.clone()].fill(disc.opacity);
            taken = to.end;
        }
    }
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

    /// First voxel and rows of every task of so many voxels.
    fn tasks(
        mut self,
        voxels: Range<usize>,
        size: usize,
        per_voxel: usize,
        choice: SurfelSelection<'_>,
    ) -> Vec<(usize, Rows<'a>)> {
        let mut tasks = Vec::with_capacity(voxels.len().div_ceil(size));
        for first in voxels.clone().step_by(size) {
            let task = first..(first + size).min(voxels.end);
            let count = per_voxel * task.filter(|&voxel| choice.has(voxel)).count();
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

/// A voxel's centre in the cube frame. `edge` is the voxel's edge. Centres are exact up to level 20.
#[inline(always)]
fn cube_centre(coordinate: [u32; 3], edge: f32) -> [f32; 3] {
    coordinate.map(|x| ((f64::from(x) + 0.5) * f64::from(edge) - 1.0) as f32)
}

/// Three components of the four discs of a voxel.
type Quarters = [[f32; 4]; 3];

/// The same colour four times.
#[inline(always)]
fn with_floats([r, g, b]: [u8; 3]) -> Quarters {
    [[f32::from(r); 4], [f32::from(g); 4], [f32::from(b); 4]]
}

/// Centres relative to the voxel's centre, in voxels, and colours in 0..=255 of the four discs that replace a voxel's
/// disc. The voxel's colour is `own`, and it is at place `j` of its group.
#[inline(always)]
fn quarters(disc: &Disc, gradients: &Gradients, j: usize, own: Quarters) -> (Quarters, Quarters) {
    let ([u, v], [along_u, along_v]) = (&gradients.axes, &gradients.along);
    let far = OFFSET * disc.spacing;
    let (a, b) = ([-far, far, -far, far], [-far, -far, far, far]);
    let (mut places, mut rgb) = ([[0.0; 4]; 3], [[0.0; 4]; 3]);
    for k in 0..3 {
        let (u, v, along_u, along_v) = (u[k][j], v[k][j], along_u[k][j], along_v[k][j]);
        for part in 0..4 {
            places[k][part] = disc.centre[k] + a[part] * u + b[part] * v;
            rgb[k][part] = (own[k][part] + a[part] * along_u + b[part] * along_v).clamp(0.0, 255.0);
        }
    }
    (places, rgb)
}

/// Places in the cube frame, of places in voxels from a voxel's centre.
#[inline(always)]
fn moved(mut places: Quarters, centre: [f32; 3], edge: f32) -> Quarters {
    for (places, centre) in places.iter_mut().zip(centre) {
        for place in places {
            *place = centre + *place * edge;
        }
    }
    places
}

/// Colours in 0..=1, of colours in 0..=255.
#[inline(always)]
fn shares(mut rgb: Quarters) -> Quarters {
    for value in rgb.as_flattened_mut() {
        *value /= 255.0;
    }
    rgb
}
