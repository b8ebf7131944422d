//! Colours that bring what is drawn of a stream nearer to the cloud.
//!
//! Gaussians overlap, so that a picture of them is smoother than their colours. The encoder decodes its stream, blends the
//! Gaussians at points of the cloud, and moves the colours that it codes by the difference. What quantisation lost is in
//! that difference, too, where it would be seen.
//!
//! The blend at a point is a weighted mean of the Gaussians around it, whatever the view: on a surface, no order of
//! compositing is more likely than another. All arithmetic is f32 without `exp`, in a fixed order, so that these
//! colours are the same on every machine.

use std::ops::Range;

use rayon::prelude::*;

use super::shape::Shape;
use super::{Coded, EncoderInput, Tune};
use crate::cloud::ColouredVoxels;
use crate::colour::{Steps, Truth, Ycc};
use crate::decoder::{Advice, Decoder, Part};
use crate::error::Result;
use crate::gaussians::{Gaussians, HeadMap, HeadSet};
use crate::geometry::{KernelMap, SiblingMap, Voxels, morton};
use crate::limits::Limits;

/// Share of the difference that colours move by.
const SHARE: f32 = 0.5;
/// Weight, in points, that holds a colour where few points see its Gaussians.
const INERTIA: f32 = 0.8;
/// Least standard deviation across a Gaussian's plane, in voxels: points lie up to half a voxel beside the surface.
const THICKNESS: f32 = 0.75;
/// Least standard deviation in the plane, in voxels.
const NARROWEST: f32 = 0.1;
/// Opacity that is blended to that of the Gaussians, so that points that hardly any covers count less.
const BACKGROUND: f32 = 0.05;
/// Units of colours in a 255th.
const UNITS: f32 = 64.0;

/// A point of the surface.
struct Point {
    /// In voxels of the level.
    place: [f32; 3],
    /// In 255ths.
    colour: [f32; 3],
}

/// A Gaussian as points see it.
#[derive(Clone)]
struct Splat {
    /// In voxels of the level.
    place: [f32; 3],
    /// The axes, each divided by its standard deviation in voxels.
    axes: [[f32; 3]; 3],
    /// The squared distance from which on nothing is seen of it.
    reach: f32,
    opacity: f32,
    /// In 255ths.
    colour: [f32; 3],
}

/// What is drawn of a level, and the points that it should look like.
struct Surface<'a> {
    map: &'a SiblingMap,
    /// The Gaussians, voxel by voxel, and where those of each voxel begin.
    splats: Vec<Splat>,
    first_splat: Vec<u32>,
    /// The points in each voxel, likewise.
    points: Vec<Point>,
    first_point: Vec<u32>,
}

/// By how much the colours of a level's voxels move.
pub(super) struct Moves {
    keys: Vec<u64>,
    by: Vec<[f32; 3]>,
}

impl Moves {
    /// Adds Y, Co and Cg in 255ths, voxel by voxel.
    pub(super) fn follow(&mut self, more: impl IndexedParallelIterator<Item = [f32; 3]>) {
        self.by.par_iter_mut().zip(more).for_each(|(by, more)| {
            for (by, more) in by.iter_mut().zip(more) {
                *by += UNITS * more;
            }
        });
    }

    /// Adds them to the colours of these voxels; those that are not known stay.
    fn add(&self, voxels: &Voxels, values: &mut [Ycc]) {
        const LEAST: [f32; 3] = [0.0, -255.0 * UNITS, -255.0 * UNITS];
        values.par_iter_mut().zip(voxels.keys()).for_each(|(value, key)| {
            if let Ok(i) = self.keys.binary_search(key) {
                for t in 0..3 {
                    let moved = f32::from(value[t]) + self.by[i][t];
                    value[t] = moved.round().clamp(LEAST[t], 255.0 * UNITS) as i16;
                }
            }
        });
    }
}

impl EncoderInput<'_> {
    /// Whether streams with these steps are coded twice, the second time with [moves](EncoderInput::moves).
    pub(super) fn is_refined(&self, steps: Steps) -> bool {
        self.options.tune == Tune::Visual && !steps.is_lossless()
    }

    /// The colours that a stream with lossy colours approaches if these moves are added to the cloud's.
    pub(super) fn moved_truth(&self, top: u8, shape: Option<&Shape>, moves: &Moves) -> Truth {
        let octree = self.octree(shape);
        let ColouredVoxels { voxels, colours, .. } = self.cloud;
        let mut values = Truth::finest(voxels, colours, octree, top, false);
        moves.add(octree.level(top), &mut values);
        Truth::of_values(octree, self.trunk_depth(top), top, values, false)
    }

    /// By how much to move the colours that were coded, so that what is drawn will be nearer to the cloud.
    pub(super) fn moves(&self, coded: &Coded) -> Result<Moves> {
        let top = coded.top;
        let voxels = self.octree(coded.shape.as_deref()).level(top);
        let gaussians = self.drawn(coded)?;
        let map = self.finest_map(top, coded.shape.as_deref());
        let surface = Surface::new(self.cloud, voxels, &map, &gaussians);
        drop(gaussians);
        let mut by = surface.moves();
        if self.grey {
            by.iter_mut().for_each(|by| by[1..].fill(0.0));
        }
        let keys = voxels.keys().to_vec();
        Ok(Moves { keys, by })
    }

    /// The Gaussians that a decoder makes of the stream: of the best heads, if there are any.
    pub(super) fn drawn(&self, coded: &Coded) -> Result<Gaussians> {
        let mut decoder = Decoder::new().with_isa(self.isa).with_limits(Limits::unlimited());
        if let Some(heads) = self.options.heads.as_ref().filter(|_| coded.top > 0) {
            decoder = decoder.with_heads_model(heads.clone()).with_heads(HeadSet::Best);
        }
        let (level, shape) = (coded.top, coded.shape.as_deref());
        let octree = self.octree(shape);
        let map = self.finest_map(level, shape);
        let head_map = coded.layers.last().and_then(|layer| layer.head_map.as_ref());
        let surfels = head_map.and_then(|heads| heads.surfels(octree, level));
        let part = Part {
            octree,
            level,
            map: &map,
            above: level.checked_sub(1).map(|above| &self.maps[usize::from(above)]),
            colours: &coded.colours,
            range: 0..map.len(),
            chosen: None,
            surfels: surfels.as_deref(),
            advice: Advice {
                luma_step: coded.luma_step,
                all_surfels: head_map.is_some_and(HeadMap::is_all_surfels),
                sizes: head_map.map_or([1.0; 2], HeadMap::sizes),
                thickness: [0.0; 2],
            },
        };
        let header = self.header(level, |level| octree.level(level).len());
        decoder.draw(&header, &part, || coded.colours_above.clone())
    }
}

impl<'a> Surface<'a> {
    fn new(cloud: &ColouredVoxels, voxels: &Voxels, map: &'a SiblingMap, gaussians: &Gaussians) -> Self {
        let (splats, first_splat) = splats_of(voxels, gaussians);
        let (points, first_point) = points_of(cloud, voxels);
        Surface {
            map,
            splats,
            first_splat,
            points,
            first_point,
        }
    }

    /// What is missing at a point in the voxel with this row of the map: the difference of its colour to what is drawn
    /// there, and the factor that makes of a Gaussian's opacity there its share of the point.
    fn missing(&self, row: &[u32; 27], point: &Point) -> ([f32; 3], f32) {
        let (mut sum, mut total) = ([0.0; 3], 0.0);
        for_each_around(row, &self.first_splat, |i| {
            let splat = &self.splats[i];
            let weight = splat.weight(&point.place);
            total += weight;
            add(&mut sum, weight, &splat.colour);
        });
        let inverse = 1.0 / (total + BACKGROUND);
        // Of what no Gaussian covers, colours cannot make up for anything.
        let missing = std::array::from_fn(|c| (total * point.colour[c] - sum[c]) * inverse);
        (missing, inverse)
    }

    /// By how much the Y, Co and Cg of each voxel should change for the points to be drawn as they are.
    fn moves(&self) -> Vec<[f32; 3]> {
        let voxels = 0..self.map.len();
        let missing: Vec<([f32; 3], f32)> = voxels
            .clone()
            .into_par_iter()
            .flat_map_iter(|voxel| {
                let points = &self.points[range(&self.first_point, voxel)];
                let row = self.map.row(voxel);
                points.iter().map(move |point| self.missing(&row, point))
            })
            .collect();
        let of_voxel = |voxel: usize| {
            let (mut sum, mut total) = ([0.0; 3], INERTIA);
            let row = self.map.row(voxel);
            for splat in &self.splats[range(&self.first_splat, voxel)] {
                for_each_around(&row, &self.first_point, |at| {
                    let weight = splat.weight(&self.points[at].place);
                    if weight > 0.0 {
                        let (missing, inverse) = &missing[at];
                        total += weight * inverse;
                        add(&mut sum, weight * inverse, missing);
                    }
                });
            }
            difference(sum.map(|x| SHARE * UNITS * x / total))
        };
        voxels.into_par_iter().map(of_voxel).collect()
    }
}

/// Calls `f` with the Gaussians of the voxels in a row of the map, or their points: those whose starts are `first`.
#[inline(always)]
fn for_each_around(row: &[u32; 27], first: &[u32], mut f: impl FnMut(usize)) {
    for &v in row {
        if v != KernelMap::ABSENT {
            range(first, v as usize).for_each(&mut f);
        }
    }
}

impl Splat {
    fn of(gaussians: &Gaussians, i: usize, voxels_per_unit: f32) -> Splat {
        let [w, x, y, z] = gaussians.rotation[i];
        let blur = gaussians.blur;
        let mut sigma = gaussians.scale[i].map(|s| ((s * s + blur).sqrt() * voxels_per_unit).max(NARROWEST));
        let least = (1..3).fold(0, |least, k| if sigma[k] < sigma[least] { k } else { least });
        sigma[least] = sigma[least].max(THICKNESS);
        let greatest = sigma.into_iter().fold(0.0, f32::max);
        let axes = [
            [
                1.0 - 2.0 * (y * y + z * z),
                2.0 * (x * y + w * z),
                2.0 * (x * z - w * y),
            ],
            [
                2.0 * (x * y - w * z),
                1.0 - 2.0 * (x * x + z * z),
                2.0 * (y * z + w * x),
            ],
            [
                2.0 * (x * z + w * y),
                2.0 * (y * z - w * x),
                1.0 - 2.0 * (x * x + y * y),
            ],
        ];
        Splat {
            place: gaussians.position[i].map(|x| (x + 1.0) * voxels_per_unit),
            axes: std::array::from_fn(|k| axes[k].map(|x| x / sigma[k])),
            reach: 8.0 * greatest * greatest,
            opacity: gaussians.opacity[i],
            colour: gaussians.colour[i].map(|x| 255.0 * x),
        }
    }

    /// The opacity at a place: `(1 − d²/8)⁴` is about `exp(−d²/2)`.
    #[inline(always)]
    fn weight(&self, place: &[f32; 3]) -> f32 {
        let [x, y, z] = [
            place[0] - self.place[0],
            place[1] - self.place[1],
            place[2] - self.place[2],
        ];
        if x * x + y * y + z * z >= self.reach {
            return 0.0;
        }
        let [a, b, c] = &self.axes;
        let a = a[0] * x + a[1] * y + a[2] * z;
        let b = b[0] * x + b[1] * y + b[2] * z;
        let c = c[0] * x + c[1] * y + c[2] * z;
        let base = (1.0 - (a * a + b * b + c * c) / 8.0).max(0.0);
        self.opacity * (base * base) * (base * base)
    }
}

#[inline(always)]
fn add(sum: &mut [f32; 3], weight: f32, values: &[f32; 3]) {
    for (sum, value) in sum.iter_mut().zip(values) {
        *sum += weight * value;
    }
}

/// Where the entries of a voxel are.
fn range(first: &[u32], voxel: usize) -> Range<usize> {
    first[voxel] as usize..first[voxel + 1] as usize
}

/// Where the entries of each voxel begin, of so many entries each, and where the last end.
fn starts(counts: impl Iterator<Item = u32>) -> Vec<u32> {
    let mut sum = 0;
    let ends = counts.map(|count| {
        sum += count;
        sum
    });
    std::iter::once(0).chain(ends).collect()
}

/// The difference of Y, Co and Cg that one of red, green and blue makes.
pub(super) fn difference([r, g, b]: [f32; 3]) -> [f32; 3] {
    let co = r - b;
    let t = b + co / 2.0;
    let cg = g - t;
    [t + cg / 2.0, co, cg]
}

/// The Gaussians as points see them, voxel by voxel, and where those of each voxel begin. Those that are far from any
/// voxel are left out.
fn splats_of(voxels: &Voxels, gaussians: &Gaussians) -> (Vec<Splat>, Vec<u32>) {
    let voxels_per_unit = (1u32 << voxels.depth()) as f32 / 2.0;
    let splat = |i: usize| Splat::of(gaussians, i, voxels_per_unit);
    let all: Vec<Splat> = (0..gaussians.len()).into_par_iter().map(splat).collect();
    if all.len() == voxels.len() {
        let first = (0..=all.len() as u32).collect();
        return (all, first);
    }
    let owners = all.par_iter().map(|splat| owner(voxels, splat.place));
    let mut order: Vec<(u32, u32)> = owners
        .enumerate()
        .filter_map(|(i, owner)| Some((owner? as u32, i as u32)))
        .collect();
    order.par_sort_unstable();
    let mut counts = vec![0; voxels.len()];
    order.iter().for_each(|(owner, _)| counts[*owner as usize] += 1);
    let sorted = order.into_par_iter().map(|(_, i)| all[i as usize].clone());
    (sorted.collect(), starts(counts.into_iter()))
}

/// The voxel that a place is in, or the nearest around that.
pub(super) fn owner(voxels: &Voxels, place: [f32; 3]) -> Option<usize> {
    let side = 1i64 << voxels.depth();
    let home = place.map(|x| x.floor().clamp(-2.0, side as f32 + 2.0) as i64);
    let find = |at: [i64; 3]| {
        let inside = at.iter().all(|x| (0..side).contains(x));
        let key = || morton::encode(at.map(|x| x as u32));
        inside.then(|| voxels.keys().binary_search(&key()).ok())?
    };
    find(home).or_else(|| {
        let around = (0..27i64).map(|k| [k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1]);
        let near = around.filter_map(|offset| {
            let at: [i64; 3] = std::array::from_fn(|i| home[i] + offset[i]);
            let off = |i: usize| at[i] as f32 + 0.5 - place[i];
            let distance = (0..3).map(|i| off(i) * off(i)).sum::<f32>();
            Some((distance, find(at)?))
        });
        near.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, voxel)| voxel)
    })
}

/// Points of the cloud in the voxels of a level, voxel by voxel, and where those of each voxel begin: means of the cloud's
/// voxels in each voxel of the level below, if there is one.
fn points_of(cloud: &ColouredVoxels, voxels: &Voxels) -> (Vec<Point>, Vec<u32>) {
    let deeper = cloud.voxels.depth() - voxels.depth();
    let shift = 3 * deeper.saturating_sub(1);
    let keys = cloud.voxels.keys();
    let groups = |key: u64| {
        let mut rest = cloud.voxels.within(key, 3 * deeper);
        std::iter::from_fn(move || {
            let first = rest.start;
            let group = keys.get(first).filter(|_| first < rest.end)? >> shift;
            let count = keys[rest.clone()].iter().take_while(|key| *key >> shift == group);
            rest.start += count.count();
            Some(first..rest.start)
        })
    };
    let point = |group: Range<usize>| {
        let count = group.len() as f32;
        let size = 1.0 / (1u32 << deeper) as f32;
        let mut sums = [[0.0; 3]; 2];
        for i in group {
            let place = morton::decode(keys[i]).map(|x| x as f32 + 0.5);
            for c in 0..3 {
                sums[0][c] += place[c];
                sums[1][c] += f32::from(cloud.colours[i][c]);
            }
        }
        Point {
            place: sums[0].map(|sum| sum / count * size),
            colour: sums[1].map(|sum| sum / count),
        }
    };
    let counts: Vec<u32> = voxels
        .keys()
        .par_iter()
        .map(|key| groups(*key).count() as u32)
        .collect();
    let points = voxels.keys().par_iter();
    let points = points.flat_map_iter(|key| groups(*key).map(point));
    (points.collect(), starts(counts.into_iter()))
}

#[cfg(test)]
mod tests;
