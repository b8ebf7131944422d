//! The network by its definition, in f64 and with voxels found by their coordinates: what tests hold the real one
//! against.
//!
//! Shares with it the list of modules and layers (`structure.rs`) and nothing else.

mod neighbours;

use std::collections::HashMap;

use b2p_kernels::f16;

use super::shape::Upsample;
use super::structure::{Convert, Encoder, Entropy, Exact, Generate, Reconstruct, Squeeze};
use super::{ROLES, Shape};
use crate::gaussians::Heads;
use crate::layers::{Element, Inception, ResBlock, Spec, Tensors};

/// One row of channels per voxel.
pub(super) type Rows = Vec<Vec<f64>>;

/// Voxels, and where each one is.
pub(super) struct Sites {
    pub voxels: Vec<[i32; 3]>,
    index: HashMap<[i32; 3], usize>,
}

impl Sites {
    pub fn new(voxels: Vec<[i32; 3]>) -> Self {
        let index = voxels.iter().enumerate().map(|(i, v)| (*v, i)).collect();
        Sites { voxels, index }
    }

    /// All eight children of every voxel.
    pub fn children(&self) -> Sites {
        let child = |v: &[i32; 3], o: i32| [2 * v[0] + o % 2, 2 * v[1] + o / 2 % 2, 2 * v[2] + o / 4];
        Sites::new(
            self.voxels
                .iter()
                .flat_map(|v| (0..8).map(move |o| child(v, o)))
                .collect(),
        )
    }
}

/// Where the taps of a layer reach.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Reach {
    /// The voxel itself.
    Here,
    /// −1, 0, 1 along each axis, x fastest.
    Around,
    /// 0, 1 along each axis, x fastest.
    Ahead,
    /// The parent, through the tap of one's octant.
    Up,
}

impl Reach {
    fn of(self, k: i32, v: [i32; 3]) -> Option<[i32; 3]> {
        match self {
            Reach::Here => Some(v),
            Reach::Around => Some([v[0] + k % 3 - 1, v[1] + k / 3 % 3 - 1, v[2] + k / 9 - 1]),
            Reach::Ahead => Some([v[0] + k % 2, v[1] + k / 2 % 2, v[2] + k / 4]),
            Reach::Up => (v[0] % 2 + 2 * (v[1] % 2) + 4 * (v[2] % 2) == k).then(|| v.map(|c| c / 2)),
        }
    }
}

/// A layer's numbers, as the file has them.
pub(super) struct Layer {
    spec: Spec,
    weights: Vec<f64>,
    finish: Finish,
}

enum Finish {
    Plain { bias: Vec<f32> },
    Invariant { gain: Vec<f32>, bias: Vec<f32> },
    Shifted { bias: Vec<i32>, shift: Vec<u8> },
    Scaled { gain: Vec<f32>, bias: Vec<f32> },
}

/// How the exact zone's layers are evaluated; the others know one way.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Mode {
    /// In integers, as defined.
    Whole,
    /// Without rounding and clamping: the real function that the integers approximate.
    Real,
}

impl Layer {
    fn finish(&self, (mode, limit): (Mode, f64), o: usize, sum: f64, energy: f64) -> f64 {
        match &self.finish {
            Finish::Plain { bias } => (sum + f64::from(bias[o])).clamp(-limit, limit),
            Finish::Invariant { gain, bias } => {
                let value = sum * f64::from(gain[o]) / (energy + 1e-8).sqrt();
                (value + f64::from(bias[o])).clamp(-limit, limit)
            }
            // Sums of integers are exact in f64 up to 2^53.
            Finish::Shifted { bias, shift } => match mode {
                Mode::Whole => ((sum as i64 + i64::from(bias[o])) >> shift[o]).clamp(-2047, 2047) as f64,
                Mode::Real => {
                    let half = if shift[o] > 0 {
                        f64::from(1 << (shift[o] - 1))
                    } else {
                        0.0
                    };
                    (sum + f64::from(bias[o]) - half) / 2f64.powi(shift[o].into())
                }
            },
            Finish::Scaled { gain, bias } => match mode {
                Mode::Whole => {
                    let scale = gain[o] / (energy.max(1.0) as f32).sqrt();
                    let value = sum as f32 * scale + bias[o];
                    f64::from(value.round_ties_even().clamp(-2047.0, 2047.0))
                }
                Mode::Real => sum * f64::from(gain[o]) / energy.max(1.0).sqrt() + f64::from(bias[o]),
            },
        }
    }

    /// What a sum with a residual becomes.
    fn bound(&self, (mode, limit): (Mode, f64), value: f64) -> f64 {
        match (&self.finish, mode) {
            (Finish::Plain { .. } | Finish::Invariant { .. }, _) => value.clamp(-limit, limit),
            (Finish::Shifted { .. } | Finish::Scaled { .. }, Mode::Whole) => value.clamp(-2047.0, 2047.0),
            (_, Mode::Real) => value,
        }
    }
}

fn relu(mut rows: Rows) -> Rows {
    rows.iter_mut().flatten().for_each(|v| *v = v.max(0.0));
    rows
}

/// Side by side.
pub(super) fn concat(left: &Rows, right: &Rows) -> Rows {
    left.iter()
        .zip(right)
        .map(|(a, b)| a.iter().chain(b).copied().collect())
        .collect()
}

/// All modules of a model, to be evaluated in one mode.
pub(super) struct Oracle {
    pub shape: Shape,
    pub mode: Mode,
    /// How far from 0 activations outside of the exact zone get.
    limit: f64,
    pub exact: Exact<Layer>,
    pub generators: Vec<Generate<Layer>>,
    pub encoder: Encoder<Layer>,
    pub g_scale: Vec<f32>,
    pub c_scale: Vec<f32>,
}

impl Oracle {
    pub fn new(bytes: &[u8], mode: Mode) -> Self {
        let tensors = Tensors::new(bytes).unwrap();
        let shape = tensors.shape().unwrap();
        let mut integers = |spec: Spec| {
            let list = |suffix: &str| format!("{}.{suffix}", spec.name);
            let weights = all::<i16>(&tensors, &list("weight"))
                .into_iter()
                .map(f64::from)
                .collect();
            let finish = match spec.invariant {
                true => Finish::Scaled {
                    gain: all(&tensors, &list("gain")),
                    bias: all(&tensors, &list("bias")),
                },
                false => Finish::Shifted {
                    bias: all(&tensors, &list("bias")),
                    shift: all(&tensors, &list("shift")),
                },
            };
            Ok(Layer { spec, weights, finish })
        };
        let exact = shape.exact(&mut integers).unwrap();
        let mut reals = |spec: Spec| {
            let list = |suffix: &str| format!("{}.{suffix}", spec.name);
            let weights = all::<f16>(&tensors, &list("weight"))
                .into_iter()
                .map(f64::from)
                .collect();
            let bias = all(&tensors, &list("bias"));
            let finish = match spec.invariant {
                true => Finish::Invariant {
                    gain: all(&tensors, &list("gain")),
                    bias,
                },
                false => Finish::Plain { bias },
            };
            Ok(Layer { spec, weights, finish })
        };
        Oracle {
            exact,
            generators: shape.generators(&mut reals).unwrap(),
            encoder: shape.encoder(&mut reals).unwrap(),
            g_scale: all(&tensors, "g_scale"),
            c_scale: all(&tensors, "c_scale"),
            mode,
            limit: f64::INFINITY,
            shape,
        }
    }

    /// With activations outside of the exact zone that saturate there, as those of Gaussian generation in integers do.
    pub fn saturating(self, limit: f64) -> Self {
        Oracle { limit, ..self }
    }

    fn layer(&self, layer: &Layer, reach: Reach, from: &Sites, to: &Sites, x: &Rows) -> Rows {
        let Spec { volume, cin, cout, .. } = layer.spec;
        let row = |v: &[i32; 3]| {
            let sources: Vec<(usize, &Vec<f64>)> = (0..volume)
                .filter_map(|k| Some((k, &x[*from.index.get(&reach.of(k as i32, *v)?)?])))
                .collect();
            let channel = |o: usize| {
                let (mut sum, mut energy) = (0.0, 0.0);
                for &(k, x) in &sources {
                    assert_eq!(x.len(), cin);
                    for (c, x) in x.iter().enumerate() {
                        let w = layer.weights[(k * cin + c) * cout + o];
                        sum += w * x;
                        energy += w * w;
                    }
                }
                layer.finish((self.mode, self.limit), o, sum, energy)
            };
            (0..cout).map(channel).collect()
        };
        to.voxels.iter().map(row).collect()
    }

    fn here(&self, layer: &Layer, at: &Sites, x: &Rows) -> Rows {
        self.layer(layer, Reach::Here, at, at, x)
    }

    fn around(&self, layer: &Layer, at: &Sites, x: &Rows) -> Rows {
        self.layer(layer, Reach::Around, at, at, x)
    }

    fn add(&self, last: &Layer, x: &Rows, y: Rows, end: bool) -> Rows {
        let sum = |(x, y): (&Vec<f64>, Vec<f64>)| {
            x.iter()
                .zip(y)
                .map(|(x, y)| last.bound((self.mode, self.limit), x + y))
                .collect()
        };
        let rows = x.iter().zip(y).map(sum).collect();
        if end { relu(rows) } else { rows }
    }

    fn inceptions(&self, blocks: &[Inception<Layer>], at: &Sites, x: Rows) -> Rows {
        blocks.iter().fold(x, |x, block| {
            let a = relu(self.around(&block.a1, at, &x));
            let a = self.around(&block.a2, at, &a);
            let b = relu(self.here(&block.b1, at, &x));
            let b = relu(self.around(&block.b2, at, &b));
            let b = self.here(&block.b3, at, &b);
            self.add(&block.b3, &x, concat(&a, &b), block.relu)
        })
    }

    fn res_blocks(&self, blocks: &[ResBlock<Layer>], at: &Sites, x: Rows) -> Rows {
        blocks.iter().fold(x, |x, block| {
            let y = relu(self.around(&block.c1, at, &x));
            let y = self.around(&block.c2, at, &y);
            self.add(&block.c2, &x, y, block.relu)
        })
    }

    pub fn upsample(&self, role: usize, parents: &Sites, children: &Sites, g: &Rows) -> Rows {
        match (self.shape.upsample, &self.exact.up) {
            (Upsample::Learned, Some(up)) => self.layer(&up[role - 1], Reach::Up, parents, children, g),
            _ => children
                .voxels
                .iter()
                .map(|v| g[parents.index[&v.map(|c| c / 2)]].clone())
                .collect(),
        }
    }

    /// Means in sixteenths, and scale indices.
    pub fn entropy(&self, role: usize, at: &Sites, c: &Rows) -> (Rows, Rows) {
        let Entropy {
            conv_in,
            blocks,
            mu,
            sigma,
        } = self.exact.pem[role - 1].as_ref().unwrap();
        let x = relu(self.around(conv_in, at, c));
        let x = self.inceptions(blocks, at, x);
        let mut sigma = self.here(sigma, at, &x);
        sigma.iter_mut().flatten().for_each(|s| *s = s.clamp(0.0, 63.0));
        (self.here(mu, at, &x), sigma)
    }

    pub fn reconstruct(&self, role: usize, at: &Sites, latents: &Rows, c: Option<&Rows>) -> Rows {
        let Some(Reconstruct { lin1, blocks, lin2 }) = &self.exact.fr[role] else {
            return c.unwrap().clone();
        };
        let unit = f64::from(1 << self.shape.latent_shift);
        let y: Rows = latents
            .iter()
            .map(|y| y.iter().map(|y| (y * unit).clamp(-2047.0, 2047.0)).collect())
            .collect();
        let x = c.map_or_else(|| y.clone(), |c| concat(&y, c));
        let x = relu(self.here(lin1, at, &x));
        self.here(lin2, at, &self.inceptions(blocks, at, x))
    }

    /// From features in integer steps to raw numbers.
    pub fn generate(&self, heads: Heads, role: usize, at: &Sites, g: &Rows) -> Rows {
        let Generate {
            head,
            conv_in,
            before,
            layer4,
            after,
            conv_out,
        } = self
            .generators
            .iter()
            .find(|gg| (gg.head.role, gg.head.heads) == (role, heads))
            .unwrap();
        let scale = f64::from(self.g_scale[role]);
        let g: Rows = g.iter().map(|g| g.iter().map(|q| q * scale).collect()).collect();
        let x = relu(self.around(conv_in, at, &g));
        let x = self.res_blocks(before, at, x);
        if head.children == 8 {
            let children = at.children();
            let x = self.layer(layer4, Reach::Up, at, &children, &x);
            self.around(conv_out, &children, &self.res_blocks(after, &children, x))
        } else {
            let x = self.layer(layer4, Reach::Ahead, at, at, &x);
            self.around(conv_out, at, &self.res_blocks(after, at, x))
        }
    }

    /// The features of the coded levels, finest first; `levels[0]` is the one that has colours.
    pub fn features(&self, levels: &[&Sites], colours: &Rows) -> Vec<Rows> {
        let centred: Rows = colours.iter().map(|c| c.iter().map(|c| c - 0.5).collect()).collect();
        let mut x = self.convert(&self.encoder.fc[ROLES], levels[0], &centred);
        let mut out = Vec::new();
        for i in 1..levels.len() {
            let pooled = pool(levels[i - 1], levels[i], &x);
            x = self.convert(&self.encoder.fc[levels.len() - 1 - i], levels[i], &pooled);
            out.push(x.clone());
        }
        out
    }

    fn convert(&self, fc: &Convert<Layer>, at: &Sites, x: &Rows) -> Rows {
        let x = self.around(&fc.conv_in, at, x);
        self.around(&fc.conv_out, at, &self.inceptions(&fc.blocks, at, x))
    }

    /// Latents before they are clamped and rounded; the context in integer steps.
    pub fn squeeze(&self, role: usize, at: &Sites, f: &Rows, c: Option<&Rows>) -> Rows {
        let Squeeze { lin1, lin2 } = self.encoder.fs[role].as_ref().unwrap();
        let scale = f64::from(self.c_scale[role]);
        let x = match c {
            None => f.clone(),
            Some(c) => concat(f, &c.iter().map(|c| c.iter().map(|q| q * scale).collect()).collect()),
        };
        self.here(lin2, at, &relu(self.here(lin1, at, &x)))
    }
}

fn all<T: Element>(tensors: &Tensors, name: &str) -> Vec<T> {
    tensors.list(name).unwrap()
}

/// The mean of the children that are there.
fn pool(children: &Sites, parents: &Sites, x: &Rows) -> Rows {
    let mut sums = vec![(0.0, vec![0.0; x[0].len()]); parents.voxels.len()];
    for (v, x) in children.voxels.iter().zip(x) {
        let (count, sum) = &mut sums[parents.index[&v.map(|c| c / 2)]];
        *count += 1.0;
        sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
    }
    sums.into_iter()
        .map(|(count, sum)| sum.into_iter().map(|s| s / count).collect())
        .collect()
}
