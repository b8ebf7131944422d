//! Heads of version 3 in double precision, from their definition ([`b2p::gaussians::learned`]) and the model file
//! alone.

use std::collections::BTreeMap;

use b2p::error::Stage;
use b2p::gaussians::learned::{LevelInput, Set};
use b2p::gaussians::{Frame, Gaussians};
use b2p::geometry::KernelMap;
use b2p::{Error, Result};
use rayon::prelude::*;
use safetensors::SafeTensors;
use serde::Deserialize;

/// Outputs of a Gaussian.
const RAW: usize = 14;

#[derive(Deserialize)]
struct Description {
    blur: f64,
    sets: BTreeMap<String, Shape>,
}

#[derive(Deserialize)]
struct Shape {
    parent_blocks: usize,
    child_blocks: usize,
    gaussians: usize,
}

/// Rows of as many channels each.
struct Rows {
    channels: usize,
    values: Vec<f64>,
}

/// One of a model's networks.
struct Net<'a> {
    set: String,
    file: SafeTensors<'a>,
}

fn wrong(detail: impl ToString) -> Error {
    Error::Malformed {
        stage: Stage::Network,
        at: "model file".into(),
        field: "heads".into(),
        value: detail.to_string(),
        expected: "a file of heads".into(),
        clause: None,
    }
}

/// The number with these bits, in half precision.
fn half(bits: u16) -> f64 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023) / 1024.0);
    match exponent {
        0 => sign * fraction * 2f64.powi(-14),
        31 => sign * f64::INFINITY,
        _ => sign * (1.0 + fraction) * 2f64.powi(exponent - 15),
    }
}

/// The Gaussians that a model's heads make of a level. Of eight of a voxel, those with an opacity below 1/255 are left
/// out, and so are voxels that have none.
///
/// # Errors
/// [`Error::Malformed`] if the file is none of heads, or has no such set.
pub fn generate(file: &[u8], set: Set, input: &LevelInput<'_>, frame: Frame) -> Result<Gaussians> {
    let (_, metadata) = SafeTensors::read_metadata(file).map_err(wrong)?;
    let own = metadata.metadata().as_ref().and_then(|own| own.get("b2p-heads"));
    let own = own.ok_or_else(|| wrong("no description"))?;
    let Description { blur, sets } = serde_json::from_str(own).map_err(wrong)?;
    let name = format!("{}.{}", set.0, set.1);
    let shape = sets.get(&name).ok_or_else(|| wrong(format!("no {name}")))?;
    let net = Net {
        set: name,
        file: SafeTensors::deserialize(file).map_err(wrong)?,
    };
    let raw = net.outputs(shape, input)?;
    Ok(activated(&raw, shape.gaussians, blur, input, frame))
}

impl Net<'_> {
    fn values(&self, name: &str) -> Result<Vec<f64>> {
        let tensor = self.file.tensor(&format!("{}.{name}", self.set)).map_err(wrong)?;
        let pairs = tensor.data().chunks_exact(2);
        Ok(pairs.map(|b| half(u16::from_le_bytes([b[0], b[1]]))).collect())
    }

    /// A layer, with ReLU; `plus` is added before.
    fn conv(&self, name: &str, map: &KernelMap, x: &Rows, plus: Option<&Rows>) -> Result<Rows> {
        let mut out = self.linear(name, map, x, plus)?;
        out.values.par_iter_mut().for_each(|v| *v = v.max(0.0));
        Ok(out)
    }

    fn linear(&self, name: &str, map: &KernelMap, x: &Rows, plus: Option<&Rows>) -> Result<Rows> {
        let weights = self.values(&format!("{name}.weight"))?;
        let bias = self.values(&format!("{name}.bias"))?;
        let channels = bias.len();
        let mut values = vec![0.0; map.len() * channels];
        values.par_chunks_exact_mut(channels).enumerate().for_each(|(i, out)| {
            match plus {
                Some(plus) => {
                    let own = &plus.values[i * channels..][..channels];
                    out.iter_mut().zip(&bias).zip(own).for_each(|((o, b), p)| *o = b + p);
                }
                None => out.copy_from_slice(&bias),
            }
            let taps = map.row(i).iter().enumerate();
            for (k, &q) in taps.filter(|(_, q)| **q != KernelMap::ABSENT) {
                let from = &x.values[q as usize * x.channels..][..x.channels];
                multiply(from, &weights[k * x.channels * channels..], out);
            }
        });
        Ok(Rows { channels, values })
    }

    fn blocks(&self, side: &str, count: usize, map: &KernelMap, mut x: Rows) -> Result<Rows> {
        for i in 0..count {
            let inner = self.conv(&format!("{side}.{i}.a"), map, &x, None)?;
            x = self.conv(&format!("{side}.{i}.b"), map, &inner, Some(&x))?;
        }
        Ok(x)
    }

    fn outputs(&self, shape: &Shape, input: &LevelInput<'_>) -> Result<Rows> {
        let step = f64::from(input.luma_step.clamp(1.0, 65_536.0)).log2() / 4.0;
        let occupancy = input.octree.occupancy(input.level - 1);
        let parents = occupancy.iter().zip(input.colours_above).flat_map(|(mask, &colour)| {
            let bits = (0..8).map(move |octant| f64::from(mask >> octant & 1));
            bits.chain(luma_chroma(colour)).chain([step])
        });
        let parents = Rows {
            channels: 12,
            values: parents.collect(),
        };
        let (map, above) = (input.map.table(), input.above.table());
        let h = self.conv("parent.in", &above, &parents, None)?;
        let h = self.blocks("parent", shape.parent_blocks, &above, h)?;

        let voxels = input.octree.level(input.level);
        let (of, octants) = (voxels.parent_indices(), voxels.octants());
        let children = input.colours.iter().zip(&of).flat_map(|(&colour, &parent)| {
            let (own, parent) = (luma_chroma(colour), luma_chroma(input.colours_above[parent as usize]));
            let change = (0..3).map(move |c| 4.0 * (own[c] - parent[c]));
            change.chain(own).chain([step])
        });
        let children = Rows {
            channels: 7,
            values: children.collect(),
        };
        let (weights, channels) = (self.values("up.weight")?, h.channels);
        let mut up = vec![0.0; voxels.len() * channels];
        up.par_chunks_exact_mut(channels).enumerate().for_each(|(i, out)| {
            let from = &h.values[of[i] as usize * channels..][..channels];
            let octant = usize::from(octants[i]);
            multiply(from, &weights[octant * channels * channels..], out);
        });
        let up = Rows { channels, values: up };
        let x = self.conv("child.in", &map, &children, Some(&up))?;
        let x = self.blocks("child", shape.child_blocks, &map, x)?;
        self.linear("out", &map, &x, None)
    }
}

/// Adds `x · weights` to `out`.
fn multiply(x: &[f64], weights: &[f64], out: &mut [f64]) {
    for (x, weights) in x.iter().zip(weights.chunks_exact(out.len())) {
        for (out, w) in out.iter_mut().zip(weights) {
            *out += w * x;
        }
    }
}

fn luma_chroma([r, g, b]: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = [r, g, b].map(f64::from);
    [
        (r + 2.0 * g + b) / 512.0 - 1.0,
        (r - b) / 128.0,
        (g - (r + b) / 2.0) / 128.0,
    ]
}

fn activated(raw: &Rows, count: usize, blur: f64, input: &LevelInput<'_>, frame: Frame) -> Gaussians {
    let voxels = input.octree.level(input.level);
    let voxel = 2.0 / f64::from(1u32 << input.level);
    let unit = if count == 8 { voxel / 2.0 } else { voxel };
    let axes = [0, 1, 2];
    let mut out = Gaussians {
        blur: (blur * (unit / 2.0).powi(2)) as f32,
        frame,
        ..Gaussians::default()
    };
    for (i, raw) in raw.values.chunks_exact(count * RAW).enumerate() {
        if input.without.is_some_and(|without| without[i]) {
            continue;
        }
        let corner = voxels.coordinate(i).map(|v| f64::from(v) * voxel - 1.0);
        let decoded = input.colours[i].map(|v| f64::from(v) / 255.0);
        for (octant, raw) in raw.chunks_exact(RAW).enumerate() {
            let opacity = if count == 8 {
                1.0 / (1.0 + (-raw[10] - 2.0).exp())
            } else {
                1.0
            };
            if opacity < 1.0 / 255.0 {
                continue;
            }
            let anchor = |axis: usize| match count {
                8 => 0.5 + f64::from(octant as u32 >> axis & 1),
                _ => 0.5,
            };
            let position = axes.map(|a| corner[a] + unit * (anchor(a) + raw[a].tanh()));
            let scale = axes.map(|a| unit * (raw[3 + a] - 0.31).exp().ln_1p());
            let q = [raw[6] + 1.0, raw[7], raw[8], raw[9]];
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let colour = axes.map(|c| (decoded[c] + raw[11 + c]).clamp(0.0, 1.0));
            out.position.push(position.map(|v| v as f32));
            out.scale.push(scale.map(|v| v as f32));
            out.rotation.push(q.map(|v| (v / norm) as f32));
            out.opacity.push(opacity as f32);
            out.colour.push(colour.map(|v| v as f32));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::gaussians::Heads;
    use b2p::gaussians::learned::HeadsModel;
    use b2p::geometry::{Octree, Voxels, morton};
    use b2p::layers::Precision;
    use b2p::{Isa, embedded};

    #[test]
    fn halves_are_read_as_the_standard_defines_them() {
        for (bits, value) in [
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x3555, 0.333_251_953_125),
            (0x0001, 2f64.powi(-24)),
            (0x7bff, 65_504.0),
        ] {
            assert_eq!(half(bits), value);
        }
    }

    /// The networks of the program in f16 come near to what double precision says, with one Gaussian a voxel and with
    /// eight, and in both there are as many.
    #[test]
    fn networks_in_f16_are_near_to_double_precision() {
        let places = (0..8u32.pow(3)).map(|i| [i % 8, i / 8 % 8, i / 64]);
        let shell = places.filter(|at| at.iter().map(|v| (2 * v).abs_diff(7).pow(2)).sum::<u32>().abs_diff(36) < 20);
        let octree = Octree::new(Voxels::new(3, shell.map(morton::encode).collect())).unwrap();
        let (map, above) = (octree.sibling_map(3), octree.sibling_map(2));
        let colour = |i: usize| [37 * i, 91 * i, 11 * i].map(|v| (v % 256) as u8);
        let colours: Vec<_> = (0..octree.level(3).len()).map(colour).collect();
        let colours_above: Vec<_> = (0..octree.level(2).len()).map(colour).collect();
        let without: Vec<bool> = (0..colours.len()).map(|i| i % 7 == 3).collect();
        let input = LevelInput {
            octree: &octree,
            level: 3,
            map: &map,
            above: &above,
            colours: &colours,
            colours_above: &colours_above,
            luma_step: 8.0,
            without: Some(&without),
            range: None,
        };
        let model = HeadsModel::from_bytes(embedded::HEADS).unwrap();
        for set in [(Heads::Best, 1), (Heads::Best, 8), (Heads::Quick, 1), (Heads::Quick, 8)] {
            let frame = Frame::default();
            let f16 = model
                .generate(Isa::detect(), Precision::F16, set, input, frame)
                .unwrap();
            let double = generate(embedded::HEADS, set, &input, frame).unwrap();
            assert_eq!((f16.len(), f16.blur), (double.len(), double.blur), "{set:?}");
            let apart = |a: &[[f32; 3]], b: &[[f32; 3]]| {
                let pairs = a.as_flattened().iter().zip(b.as_flattened());
                pairs.fold(0.0f32, |most, (a, b)| most.max((a - b).abs()))
            };
            assert!(apart(&f16.position, &double.position) < 4e-3, "{set:?}");
            assert!(apart(&f16.scale, &double.scale) < 4e-3, "{set:?}");
            assert!(apart(&f16.colour, &double.colour) < 2e-2, "{set:?}");
        }
    }
}
