//! Model files of heads. Everything is checked before use.

use std::collections::BTreeMap;

use b2p_kernels::{LIMIT, f16};
use serde::Deserialize;

use super::network::{Generator, Net, Steps};
use super::{HeadsModel, RAW, Set};
use crate::error::{Error, Result, Stage};
use crate::gaussians::Heads;
use crate::layers::{ResBlock, Spec, Stored, Tensors, malformed, missing};

/// Input channels of a parent and of a child.
pub const INPUTS: [usize; 2] = [12, 7];
/// Maximum channels of a network, and residual blocks per side.
const MOST: (usize, usize) = (256, 16);
/// Maximum blur, in squares of half the unit.
const WIDEST: f64 = 16.0;
/// Maximum range: times [`HEADROOM`] it still fits f16.
const LARGEST: f64 = 32_768.0;
/// Minimum range: far below that of any network with f16 weights.
const LEAST: f64 = 1e-6;
/// Activations may exceed the range, which is their 99.99 % quantile over the calibration data.
const HEADROOM: f64 = 1.5;

#[derive(Deserialize)]
struct Description {
    version: u32,
    blur: f64,
    sets: BTreeMap<String, Shape>,
}

/// Topology of a network.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Shape {
    pub channels: usize,
    pub parent_blocks: usize,
    pub child_blocks: usize,
    /// Gaussians per voxel: 1 or 8.
    pub gaussians: usize,
    ranges: BTreeMap<String, f64>,
}

/// Loads a model from the content of its file.
pub(super) fn model(bytes: &[u8]) -> Result<HeadsModel> {
    let tensors = Tensors::new(bytes)?;
    let json = tensors.metadata("b2p-heads");
    let json = json.ok_or_else(|| wrong("b2p-heads", "missing", "the heads' description"))?;
    let description: Description =
        serde_json::from_str(json).map_err(|error| wrong("b2p-heads", error, "a description of heads"))?;
    let Description { version, blur, sets } = description;
    if version != 1 {
        let detail = format!("version {version}, this program reads version 1");
        return Err(missing("this file of heads", detail));
    }
    if !(0.0..=WIDEST).contains(&blur) {
        return Err(wrong("blur", blur, format!("0 to {WIDEST}")));
    }
    let mut generators = Vec::with_capacity(Heads::ALL.len() * 2);
    for (name, shape) in sets {
        let set = named(&name)?;
        shape.check(&name, set)?;
        let steps = shape.steps(&name)?;
        let net = shape.net(&name, &tensors)?;
        generators.push((set, Generator::new(shape, steps, net)));
    }
    Ok(HeadsModel {
        blur: blur as f32,
        generators: generators.into(),
    })
}

/// Parses the name of a set, such as `best.8`.
fn named(name: &str) -> Result<Set> {
    let all = Heads::ALL.into_iter().flat_map(|heads| [(heads, 1), (heads, 8)]);
    let mut named = all.filter(|(heads, k)| format!("{heads}.{k}") == name);
    let expected = "best.1, best.8, quick.1 or quick.8";
    named.next().ok_or_else(|| wrong("set", name, expected))
}

impl Shape {
    fn check(&self, name: &str, (_, gaussians): Set) -> Result<()> {
        let (channels, blocks) = MOST;
        for (field, value, least, most) in [
            ("channels", self.channels, 1, channels),
            ("parent_blocks", self.parent_blocks, 0, blocks),
            ("child_blocks", self.child_blocks, 0, blocks),
            ("gaussians", self.gaussians, gaussians, gaussians),
        ] {
            if !(least..=most).contains(&value) {
                let expected = format!("{least} to {most}");
                return Err(wrong(&format!("{field} of {name}"), value, expected));
            }
        }
        Ok(())
    }

    /// Scale of the activations of `layers`: their largest range with headroom, divided by [`LIMIT`].
    fn step(&self, set: &str, layers: &[String]) -> Result<f32> {
        let mut most = 0.0f64;
        for layer in layers {
            let field = format!("range {layer} of {set}");
            let range = self.ranges.get(layer).copied();
            let range = range.ok_or_else(|| wrong(&field, "missing", "there"))?;
            if !(LEAST..=LARGEST).contains(&range) {
                return Err(wrong(&field, range, format!("{LEAST} to {LARGEST}")));
            }
            most = most.max(range);
        }
        Ok((most * HEADROOM / f64::from(LIMIT)) as f32)
    }

    /// Scales of all layers' outputs. The residual sums of a side share one scale.
    fn steps(&self, set: &str) -> Result<Steps> {
        let side = |side: &str, blocks: usize| -> Result<_> {
            let sums = (0..blocks).map(|i| format!("{side}.{i}.b"));
            let sums: Vec<_> = sums.chain([format!("{side}.in")]).collect();
            let inner = (0..blocks).map(|i| self.step(set, &[format!("{side}.{i}.a")]));
            Ok((self.step(set, &sums)?, inner.collect::<Result<_>>()?))
        };
        Ok(Steps {
            parent: side("parent", self.parent_blocks)?,
            child: side("child", self.child_blocks)?,
        })
    }

    /// Reads the layers of a network.
    fn net(&self, set: &str, tensors: &Tensors<'_>) -> Result<Net<Stored>> {
        let c = self.channels;
        let layer = |name: String, volume, cin, cout| {
            let name = format!("{set}.{name}");
            stored(
                tensors,
                Spec {
                    name,
                    volume,
                    cin,
                    cout,
                    invariant: false,
                },
            )
        };
        let side = |side: &str, blocks: usize| -> Result<Vec<_>> {
            let block = |i| -> Result<_> {
                Ok(ResBlock {
                    c1: layer(format!("{side}.{i}.a"), 27, c, c)?,
                    c2: layer(format!("{side}.{i}.b"), 27, c, c)?,
                    relu: true,
                })
            };
            (0..blocks).map(block).collect()
        };
        Ok(Net {
            parent_in: layer("parent.in".into(), 27, INPUTS[0], c)?,
            parent: side("parent", self.parent_blocks)?,
            up: layer("up".into(), 8, c, c)?,
            child_in: layer("child.in".into(), 27, INPUTS[1], c)?,
            child: side("child", self.child_blocks)?,
            out: layer("out".into(), 27, c, RAW * self.gaussians)?,
        })
    }
}

/// Reads a layer of f16 weights and biases. The layer with a matrix per octant has no biases.
fn stored(tensors: &Tensors<'_>, spec: Spec) -> Result<Stored> {
    let finite = |tensor: &str, extents: &[usize]| -> Result<Vec<f16>> {
        let values: Vec<f16> = tensors.get(tensor, extents)?;
        match values.iter().find(|value| !value.is_finite()) {
            Some(value) => Err(malformed(tensor, "entry", value, "a finite number")),
            None => Ok(values),
        }
    };
    let Spec { volume, cin, cout, .. } = spec;
    let weights = finite(&format!("{}.weight", spec.name), &[volume, cin, cout])?;
    let bias = match volume {
        27 => finite(&format!("{}.bias", spec.name), &[cout])?,
        _ => vec![f16::ZERO; cout],
    };
    Ok(Stored {
        bias: bias.iter().map(|b| b.to_f32()).collect(),
        weights,
        gain: None,
        spec,
    })
}

fn wrong(field: &str, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Gaussians, "metadata b2p-heads", field, value, expected)
}
