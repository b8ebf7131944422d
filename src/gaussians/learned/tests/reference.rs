//! The network as its definition reads: f64, neighbours looked up by their coordinates.

use std::collections::BTreeMap;

use super::{LevelInput, Made, RAW};
use crate::gaussians::Gaussians;
use crate::geometry::Voxels;

type Rows = Vec<Vec<f64>>;
/// How large the outputs of layers get, by the layers' names.
pub type Ranges = BTreeMap<String, f64>;

/// A level's voxels and where each is.
struct Level<'a> {
    voxels: &'a Voxels,
    places: BTreeMap<[i64; 3], usize>,
}

impl Level<'_> {
    fn new(voxels: &Voxels) -> Level<'_> {
        let place = |i| (voxels.coordinate(i).map(i64::from), i);
        let places = (0..voxels.len()).map(place).collect();
        Level { voxels, places }
    }
}

impl Made {
    fn values(&self, name: &str) -> Vec<f64> {
        let (_, values) = &self.tensors[name];
        values.iter().map(|v| v.to_f64()).collect()
    }

    fn conv3(&self, name: &str, level: &Level<'_>, x: &Rows) -> Rows {
        let weights = self.values(&format!("{name}.weight"));
        let bias = self.values(&format!("{name}.bias"));
        let row = |i: usize| {
            let at = level.voxels.coordinate(i).map(i64::from);
            let mut out = bias.clone();
            for k in 0..27 {
                let offset = [k % 3, k / 3 % 3, k / 9].map(|step| step as i64 - 1);
                let place = [0, 1, 2].map(|a| at[a] + offset[a]);
                let Some(&q) = level.places.get(&place) else {
                    continue;
                };
                multiply(&x[q], &weights[k * x[q].len() * bias.len()..], &mut out);
            }
            out
        };
        (0..level.voxels.len()).map(row).collect()
    }

    fn blocks(&self, side: &str, level: &Level<'_>, mut x: Rows, seen: &mut Ranges) -> Rows {
        let count = self.blocks[usize::from(side == "child")];
        note(seen, format!("{side}.in"), &x);
        for i in 0..count {
            let inner = relu(self.conv3(&format!("{side}.{i}.a"), level, &x));
            note(seen, format!("{side}.{i}.a"), &inner);
            x = relu(sum(&x, &self.conv3(&format!("{side}.{i}.b"), level, &inner)));
            note(seen, format!("{side}.{i}.b"), &x);
        }
        x
    }
}

fn note(seen: &mut Ranges, layer: String, rows: &Rows) {
    let largest = rows.iter().flatten().fold(0.0f64, |most, v| most.max(v.abs()));
    seen.insert(layer, largest);
}

/// Adds `x · weights` to `out`.
fn multiply(x: &[f64], weights: &[f64], out: &mut [f64]) {
    for (x, weights) in x.iter().zip(weights.chunks(out.len())) {
        for (out, w) in out.iter_mut().zip(weights) {
            *out += w * x;
        }
    }
}

fn relu(mut rows: Rows) -> Rows {
    rows.iter_mut().flatten().for_each(|v| *v = v.max(0.0));
    rows
}

fn sum(a: &Rows, b: &Rows) -> Rows {
    let add = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(a, b)| a + b).collect();
    a.iter().zip(b).map(add).collect()
}

fn luma_chroma([r, g, b]: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = [r, g, b].map(f64::from);
    let luma = (r + 2.0 * g + b) / 4.0;
    [luma / 128.0 - 1.0, (r - b) / 128.0, (g - (r + b) / 2.0) / 128.0]
}

fn raw(made: &Made, input: &LevelInput<'_>, seen: &mut Ranges) -> Rows {
    let octree = input.octree;
    let above = Level::new(octree.level(input.level - 1));
    let here = Level::new(octree.level(input.level));
    let s = f64::from(input.luma_step).log2() / 4.0;
    let parents = octree.occupancy(input.level - 1).iter().zip(input.colours_above);
    let parents = parents.map(|(mask, &colour)| {
        let bits = (0..8).map(|octant| f64::from(mask >> octant & 1));
        bits.chain(luma_chroma(colour)).chain([s]).collect()
    });
    let h = relu(made.conv3("parent.in", &above, &parents.collect()));
    let h = made.blocks("parent", &above, h, seen);

    let of = |i: usize| above.places[&here.voxels.coordinate(i).map(|v| i64::from(v / 2))];
    let children = input.colours.iter().enumerate().map(|(i, &colour)| {
        let (own, parent) = (luma_chroma(colour), luma_chroma(input.colours_above[of(i)]));
        let change = (0..3).map(|c| 4.0 * (own[c] - parent[c]));
        change.chain(own).chain([s]).collect()
    });
    let up = made.values("up.weight");
    let up: Rows = (0..here.voxels.len())
        .map(|i| {
            let [x, y, z] = here.voxels.coordinate(i).map(|v| v as usize % 2);
            let mut out = vec![0.0; made.channels];
            let weights = &up[(x + 2 * y + 4 * z) * made.channels * made.channels..];
            multiply(&h[of(i)], weights, &mut out);
            out
        })
        .collect();
    let x = relu(sum(&made.conv3("child.in", &here, &children.collect()), &up));
    let x = made.blocks("child", &here, x, seen);
    made.conv3("out", &here, &x)
}

/// The Gaussians of a level, none left out, and how large activations get.
pub fn gaussians(made: &Made, input: &LevelInput<'_>) -> (Gaussians, Ranges) {
    let voxels = input.octree.level(input.level);
    let k = made.set.1;
    let voxel = 2.0 / f64::from(1u32 << input.level);
    let unit = if k == 8 { voxel / 2.0 } else { voxel };
    let mut out = Gaussians::default();
    let mut seen = Ranges::new();
    for (i, raw) in raw(made, input, &mut seen).iter().enumerate() {
        let corner = voxels.coordinate(i).map(|v| f64::from(v) * voxel - 1.0);
        let decoded = input.colours[i].map(|v| f64::from(v) / 255.0);
        for (octant, raw) in raw.chunks(RAW).enumerate() {
            let bit = |axis: usize| (octant >> axis & 1) as f64;
            let anchor = |axis: usize| {
                if k == 8 { (0.5 + bit(axis)) * unit } else { unit / 2.0 }
            };
            let axes = [0, 1, 2];
            let position = axes.map(|a| corner[a] + anchor(a) + unit * raw[a].tanh());
            let scale = axes.map(|a| unit * (raw[3 + a] - 0.31).exp().ln_1p());
            let q = [raw[6] + 1.0, raw[7], raw[8], raw[9]];
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let opacity = if k == 8 {
                1.0 / (1.0 + (-raw[10] - 2.0).exp())
            } else {
                1.0
            };
            out.position.push(position.map(|v| v as f32));
            out.scale.push(scale.map(|v| v as f32));
            out.rotation.push(q.map(|v| (v / norm) as f32));
            out.opacity.push(opacity as f32);
            let colour = axes.map(|c| (decoded[c] + raw[11 + c]).clamp(0.0, 1.0));
            out.colour.push(colour.map(|v| v as f32));
        }
    }
    (out, seen)
}
