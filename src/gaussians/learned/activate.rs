//! Activation of the network's outputs to Gaussians.
//!
//! The 14 outputs of a Gaussian are, in this order: offset 3, scale 3, quaternion 4 (w first), opacity 1, colour 3. The
//! unit u is the voxel's edge for one Gaussian per voxel, and half of it for eight. The anchor is the centre of the
//! voxel or of its octant. position = anchor + u·tanh(offset), σ = u·softplus(scale − 0.31), rotation =
//! normalise(quaternion + (1, 0, 0, 0)), opacity = 1 for one, sigmoid(opacity + 2) for eight, colour = clamp(decoded
//! colour / 255 + colour, 0, 1).

use rayon::prelude::*;

use super::{LevelInput, RAW};
use crate::gaussians::{Frame, Gaussians};
use crate::geometry::Voxels;
use crate::layers::activations::{GROUP, Lane, normalised};
use crate::layers::activations::{sigmoid, softplus, tanh};

/// Voxels whose outputs are in memory at once: a multiple of 512, as layers require.
pub const PART: usize = 16_384;
/// Voxels per task.
const BLOCK: usize = 256;

const SCALE_BIAS: f32 = -0.31;
const OPACITY_BIAS: f32 = 2.0;
/// The output that gives an opacity of 1/255: ln(1/254) − 2. Fainter Gaussians are not drawn.
const FAINTEST: f32 = -5.537_334_3 - OPACITY_BIAS;

/// The Gaussians of a level, built part by part.
pub struct Drawing<'a> {
    voxels: &'a Voxels,
    colours: &'a [[u8; 3]],
    without: Option<&'a [bool]>,
    /// Gaussians per voxel.
    count: usize,
    pub gaussians: Gaussians,
}

/// One part's slices of the arrays of Gaussians.
struct Rows<'a> {
    position: &'a mut [[f32; 3]],
    scale: &'a mut [[f32; 3]],
    rotation: &'a mut [[f32; 4]],
    opacity: &'a mut [f32],
    colour: &'a mut [[f32; 3]],
}

impl<'a> Drawing<'a> {
    /// No Gaussians yet, with capacity for all if they are `kept`, else for a part. `blur` is in squares of half the
    /// unit.
    pub fn new(input: &LevelInput<'a>, count: usize, blur: f32, frame: Frame, kept: bool) -> Self {
        let voxels = input.octree.level(input.level);
        let half = 1.0 / (1u32 << (voxels.depth() + u8::from(count == 8))) as f32;
        let voxels_at_once = if kept { usize::MAX } else { PART };
        let all = input.range().len().min(voxels_at_once) * count;
        Drawing {
            voxels,
            colours: input.colours,
            without: input.without,
            count,
            gaussians: Gaussians {
                position: Vec::with_capacity(all),
                scale: Vec::with_capacity(all),
                rotation: Vec::with_capacity(all),
                opacity: Vec::with_capacity(all),
                colour: Vec::with_capacity(all),
                blur: blur * half * half,
                frame,
                ..Gaussians::default()
            },
        }
    }

    /// Appends the Gaussians of the voxels from `first` on, whose outputs are `raw`.
    pub fn add(&mut self, first: usize, raw: &[f32]) {
        let block = BLOCK * self.count * RAW;
        let (voxels, colours, count) = (self.voxels, self.colours, self.count);
        let drawn = Drawn {
            without: self.without,
            count,
        };
        let counts: Vec<usize> = raw
            .par_chunks(block)
            .enumerate()
            .map(|(b, raw)| {
                let voxel = first + b * BLOCK;
                let raw = raw.chunks_exact(RAW).enumerate();
                raw.filter(|(i, raw)| drawn.has(voxel + i / count, raw)).count()
            })
            .collect();
        let before = self.gaussians.len();
        let after = before + counts.iter().sum::<usize>();
        let Gaussians {
            position,
            scale,
            rotation,
            opacity,
            colour,
            ..
        } = &mut self.gaussians;
        position.resize(after, [0.0; 3]);
        scale.resize(after, [0.0; 3]);
        rotation.resize(after, [0.0; 4]);
        opacity.resize(after, 0.0);
        colour.resize(after, [0.0; 3]);
        let mut rest = Rows {
            position: &mut position[before..],
            scale: &mut scale[before..],
            rotation: &mut rotation[before..],
            opacity: &mut opacity[before..],
            colour: &mut colour[before..],
        };
        let mut tasks = Vec::with_capacity(counts.len());
        for (b, (raw, count)) in raw.chunks(block).zip(counts).enumerate() {
            let (rows, others) = rest.split_at(count);
            tasks.push((first + b * BLOCK, raw, rows));
            rest = others;
        }
        tasks.into_par_iter().for_each(|(first, raw, rows)| {
            rows.fill(voxels, colours, drawn, first, raw);
        });
    }
}

/// Which Gaussians are drawn.
#[derive(Clone, Copy)]
struct Drawn<'a> {
    without: Option<&'a [bool]>,
    count: usize,
}

impl Drawn<'_> {
    fn has(&self, voxel: usize, raw: &[f32]) -> bool {
        (self.count == 1 || raw[10] >= FAINTEST) && self.without.is_none_or(|without| !without[voxel])
    }
}

impl<'a> Rows<'a> {
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
        let others = Rows {
            position: positions,
            scale: scales,
            rotation: rotations,
            opacity: opacities,
            colour: colours,
        };
        (rows, others)
    }

    /// Activates the outputs of the voxels from `first` on, `count` Gaussians each, and skips those that are too faint.
    fn fill(self, voxels: &Voxels, colours: &[[u8; 3]], drawn: Drawn<'_>, first: usize, raw: &[f32]) {
        let count = drawn.count;
        let unit = 2.0 / (1u64 << voxels.depth()) as f32 / if count == 8 { 2.0 } else { 1.0 };
        let mut to = 0;
        for (g, raw) in raw.chunks(GROUP * RAW).enumerate() {
            let group = Group::new(raw, count == 8);
            for (j, raw) in raw.chunks_exact(RAW).enumerate() {
                let gaussian = g * GROUP + j;
                let (voxel, octant) = (first + gaussian / count, gaussian % count);
                if !drawn.has(voxel, raw) {
                    continue;
                }
                let anchor = anchor(voxels.coordinate(voxel), octant, count);
                let decoded = colours[voxel].map(|v| f32::from(v) / 255.0);
                for axis in 0..3 {
                    let centre = (anchor[axis] * f64::from(unit) - 1.0) as f32;
                    self.position[to][axis] = centre + group.offset[axis][j] * unit;
                    self.scale[to][axis] = group.scale[axis][j] * unit;
                    let colour = decoded[axis] + group.colour[axis][j];
                    self.colour[to][axis] = colour.clamp(0.0, 1.0);
                }
                self.rotation[to] = group.rotation.map(|component| component[j]);
                self.opacity[to] = group.opacity[j];
                to += 1;
            }
        }
    }
}

/// Origin of a Gaussian's offset, in units.
fn anchor(voxel: [u32; 3], octant: usize, count: usize) -> [f64; 3] {
    std::array::from_fn(|axis| match count {
        8 => f64::from(2 * voxel[axis] + (octant as u32 >> axis & 1)) + 0.5,
        _ => f64::from(voxel[axis]) + 0.5,
    })
}

/// Activated outputs of a group of Gaussians. Offsets and scales are in units; `colour` is added to the decoded colour.
struct Group {
    offset: [Lane; 3],
    scale: [Lane; 3],
    rotation: [Lane; 4],
    opacity: Lane,
    colour: [Lane; 3],
}

impl Group {
    /// Activates up to [`GROUP`] Gaussians. Missing ones are activated from zeros.
    fn new(raw: &[f32], translucent: bool) -> Group {
        let mut lanes: [Lane; RAW] = [[0.0; GROUP]; RAW];
        for (j, raw) in raw.chunks_exact(RAW).enumerate() {
            for (lane, &raw) in lanes.iter_mut().zip(raw) {
                lane[j] = raw;
            }
        }
        let three = |first: usize| [lanes[first], lanes[first + 1], lanes[first + 2]];
        let rotation = [lanes[6].map(|w| w + 1.0), lanes[7], lanes[8], lanes[9]];
        Group {
            offset: three(0).map(|lane| lane.map(tanh)),
            scale: three(3).map(|lane| lane.map(|x| softplus(x + SCALE_BIAS))),
            rotation: normalised(rotation),
            opacity: match translucent {
                true => lanes[10].map(|x| sigmoid(x + OPACITY_BIAS)),
                false => [1.0; GROUP],
            },
            colour: three(11),
        }
    }
}
