//! A crop of a cloud with its octree levels, and its file.

use std::fmt::Write as _;

use b2p::geometry::{Voxels, morton};

use super::whole;
use crate::random::Random;
use crate::raster::View;
use crate::sample::{Grid, Sampled, Sampler, VoxelBox};

/// A crop's voxels at the finest level and the three above it, relative to the crop's origin.
#[derive(Debug, Clone, PartialEq)]
pub struct Crop {
    /// Voxels of roles 3 (finest), 2, 1 and 0.
    pub levels: [Voxels; 4],
    /// Colours of the finest voxels.
    pub rgb: Vec<[u8; 3]>,
}

/// Where to cut: a cube around a random point of the surface, at a multiple of 8 voxels, within the grid.
pub(super) fn place(sampler: &Sampler, grid: &Grid, points: u64, crop: u32, random: &mut Random) -> VoxelBox {
    let side = 1u32 << grid.bits;
    if side <= crop {
        return whole(grid);
    }
    let centre = sampler.point(random.below(points.max(1)));
    let low = centre.map(|x| {
        let jitter = random.range(-0.2, 0.2) * f64::from(crop);
        let low = (x + jitter) - f64::from(crop) / 2.0;
        // A negative place saturates at 0.
        ((low / 8.0).round() as u32 * 8).min(side - crop)
    });
    VoxelBox {
        low,
        high: low.map(|x| x + crop),
    }
}

/// Whether a crop has neither too little to learn from nor more than a training step can hold: 6,000 to 70,000 voxels
/// of 128³.
pub(super) fn is_sensible(voxels: usize, crop: u32) -> bool {
    let area = (crop as usize).pow(2);
    (voxels * 128 * 128 >= 6_000 * area) && (voxels * 128 * 128 <= 70_000 * area)
}

impl Crop {
    /// Shifts voxels by `origin` (multiples of 8) and finds the levels above.
    pub fn new(cloud: &Sampled, origin: [u32; 3]) -> Self {
        let mut voxels: Vec<(u64, [u8; 3])> = cloud
            .keys
            .iter()
            .zip(&cloud.rgb)
            .map(|(&key, &rgb)| {
                let v = morton::decode(key);
                (morton::encode(std::array::from_fn(|a| v[a] - origin[a])), rgb)
            })
            .collect();
        voxels.sort_unstable();
        let finest = Voxels::from_sorted(morton::MAX_DEPTH, voxels.iter().map(|v| v.0).collect());
        let second = finest.parents();
        let third = second.parents();
        let coarsest = third.parents();
        Crop {
            levels: [finest, second, third, coarsest],
            rgb: voxels.iter().map(|v| v.1).collect(),
        }
    }

    /// The mean of the voxels' centres.
    pub fn centroid(&self) -> [f64; 3] {
        let finest = &self.levels[0];
        let mut sum = [0u64; 3];
        for i in 0..finest.len() {
            let v = finest.coordinate(i);
            for (s, x) in sum.iter_mut().zip(v) {
                *s += u64::from(x);
            }
        }
        sum.map(|s| s as f64 / finest.len().max(1) as f64 + 0.5)
    }

    /// The sample's file, as [`super`] describes it.
    pub(super) fn to_safetensors(
        &self,
        name: &str,
        bits: u8,
        views: &[View],
        pictures: &[Vec<[u8; 4]>],
        size: u32,
    ) -> Vec<u8> {
        let mut tensors: Vec<Tensor> = Vec::new();
        for (i, level) in self.levels.iter().enumerate() {
            let role = 3 - i;
            let flat: Vec<i32> = (0..level.len())
                .flat_map(|v| level.coordinate(v))
                .map(|x| x as i32)
                .collect();
            tensors.push(Tensor::new(format!("xyz.{role}"), "I32", vec![level.len(), 3], &flat));
            if role > 0 {
                let parents = level.parent_indices();
                tensors.push(Tensor::new(
                    format!("parent.{role}"),
                    "I32",
                    vec![level.len()],
                    &parents,
                ));
            }
        }
        tensors.push(Tensor::new("rgb".into(), "U8", vec![self.rgb.len(), 3], &self.rgb));
        let cameras: Vec<f32> = views.iter().flat_map(camera_row).collect();
        tensors.push(Tensor::new("camera".into(), "F32", vec![views.len(), 16], &cameras));
        let side = size as usize;
        tensors.push(Tensor::new(
            "image".into(),
            "U8",
            vec![pictures.len(), side, side, 4],
            &pictures.concat(),
        ));
        assemble(name, bits, size, tensors)
    }
}

/// Rotation row-major, translation, fx, fy, cx, cy.
fn camera_row(view: &View) -> [f32; 16] {
    let mut row = [0.0; 16];
    let numbers = view
        .rotation
        .as_flattened()
        .iter()
        .chain(&view.translation)
        .chain(&view.focal)
        .chain(&view.centre);
    for (slot, &x) in row.iter_mut().zip(numbers) {
        *slot = x as f32;
    }
    row
}

struct Tensor {
    name: String,
    kind: &'static str,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Tensor {
    fn new<T: bytemuck::NoUninit>(name: String, kind: &'static str, shape: Vec<usize>, data: &[T]) -> Self {
        Tensor {
            name,
            kind,
            shape,
            bytes: bytemuck::cast_slice(data).to_vec(),
        }
    }
}

/// Puts a safetensors file together; by hand, because the library writes metadata in an order that changes from run to
/// run.
fn assemble(name: &str, bits: u8, size: u32, mut tensors: Vec<Tensor>) -> Vec<u8> {
    // Wider items first keeps every tensor aligned to its items.
    tensors.sort_by_key(|t| t.kind == "U8");
    let quoted = serde_json::Value::from(name);
    let mut header = format!("{{\"__metadata__\":{{\"name\":{quoted},\"bits\":\"{bits}\",\"size\":\"{size}\"}}");
    let mut offset = 0;
    for t in &tensors {
        let end = offset + t.bytes.len();
        // Writing to a string cannot fail.
        let _ = write!(
            header,
            ",\"{}\":{{\"dtype\":\"{}\",\"shape\":{:?},\"data_offsets\":[{offset},{end}]}}",
            t.name, t.kind, t.shape
        );
        offset = end;
    }
    header.push('}');
    while !header.len().is_multiple_of(8) {
        header.push(' ');
    }
    let mut file = (header.len() as u64).to_le_bytes().to_vec();
    file.reserve(header.len() + offset);
    file.extend_from_slice(header.as_bytes());
    for t in &tensors {
        file.extend_from_slice(&t.bytes);
    }
    file
}
