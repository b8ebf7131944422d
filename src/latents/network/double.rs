//! Gaussian generation in double precision: what the other precisions are measured against.

use b2p_kernels::reference::tap;
use b2p_kernels::{Isa, Output, Taps, add_products};

use super::Model;
use crate::error::Result;
use crate::gaussians::Heads;
use crate::geometry::KernelMap;
use crate::layers::Stored;
use crate::layers::{Conv, Pool};

/// A layer of the close zone whose rows are doubles; its weights are those of the file.
struct Double {
    cin: usize,
    cout: usize,
    /// [taps, in, out].
    weights: Vec<f64>,
    bias: Vec<f64>,
    /// Of a geometry-invariant layer: the gains, and of each tap and output the sum of the squared weights.
    invariant: Option<(Vec<f64>, Vec<f64>)>,
}

impl Double {
    fn new(stored: &Stored) -> Self {
        let (cin, cout) = (stored.spec.cin, stored.spec.cout);
        let weights: Vec<f64> = stored.weights.iter().map(|w| w.to_f64()).collect();
        let reals = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<_>>();
        let energies = || {
            let mut energies = vec![0.0; stored.spec.volume * cout];
            for (row, weights) in weights.chunks_exact(cout).enumerate() {
                let tap = row / cin;
                for (energy, w) in energies[tap * cout..].iter_mut().zip(weights) {
                    *energy += w * w;
                }
            }
            energies
        };
        Double {
            cin,
            cout,
            bias: reals(&stored.bias),
            invariant: stored.gain.as_ref().map(|gain| (reals(gain), energies())),
            weights,
        }
    }

    fn rows<T>(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[f64],
        first: usize,
        output: Output<'_, T, f64>,
        store: impl Fn(f64) -> T,
    ) {
        let (cin, cout) = (self.cin, self.cout);
        let (mut sums, mut energies) = (vec![0.0; cout], vec![0.0; cout]);
        for (row, out) in output.rows.chunks_exact_mut(output.stride).enumerate() {
            sums.fill(0.0);
            energies.fill(0.0);
            for k in 0..taps.volume() {
                let Some(from) = tap(&taps, first + row, k) else {
                    continue;
                };
                let weights = &self.weights[k * cin * cout..][..cin * cout];
                add_products(isa, &input[from * cin..][..cin], weights, &mut sums);
                if let Some((_, of_taps)) = &self.invariant {
                    for (energy, of_tap) in energies.iter_mut().zip(&of_taps[k * cout..]) {
                        *energy += of_tap;
                    }
                }
            }
            for (o, out) in out[output.column..][..cout].iter_mut().enumerate() {
                let scale = match &self.invariant {
                    Some((gain, _)) => gain[o] / (energies[o] + 1e-8).sqrt(),
                    None => 1.0,
                };
                let added = output
                    .residual
                    .map_or(0.0, |all| all[row * output.stride + output.column + o]);
                let value = sums[o] * scale + self.bias[o] + added;
                *out = store(if output.relu { value.max(0.0) } else { value });
            }
        }
    }
}

impl Conv for Double {
    type Value = f64;

    fn cout(&self) -> usize {
        self.cout
    }

    fn run(&self, isa: Isa, taps: Taps<'_>, input: &[f64], first: usize, output: Output<'_, f64>) {
        self.rows(isa, taps, input, first, output, |value| value);
    }

    fn run_f32(&self, isa: Isa, taps: Taps<'_>, input: &[f64], first: usize, output: Output<'_, f32, f64>) {
        self.rows(isa, taps, input, first, output, |value| value as f32);
    }
}

#[doc(hidden)]
impl Model {
    /// As [`Model::generate_with`], with the weights of the file and everything else in double precision, rounded to
    /// `f32` at the end: slow, and what [`super::Precision`]s are measured against.
    ///
    /// # Errors
    /// As [`Model::generate_with`].
    ///
    /// # Panics
    /// If `g` and `map` disagree in length.
    pub fn generate_in_double(&self, heads: Heads, role: usize, g: &[i16], map: &KernelMap) -> Result<Vec<f32>> {
        let generator = self.generator(role, heads)?;
        self.check(g, self.shape.channels, map);
        let step = f64::from(self.g_scale[role]);
        let g: Vec<f64> = g.iter().map(|&q| f64::from(q) * step).collect();
        let layers = generator.of_layers(Double::new);
        Ok(self.run_generator(&mut Pool::new(), &layers, &g, map, map.len().max(1)))
    }
}
