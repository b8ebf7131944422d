//! The network in floats, its gradient, and its weights as the codec reads them.

use b2p::geometry::codec::network::{FEATURES, NODES, SIZE, WIDTH};
use rayon::prelude::*;

use super::Samples;
use crate::random::Random;

/// Rows: the features', the children's (node 1 first), the outputs'; then the eight output biases.
const OUTPUT: usize = FEATURES + NODES;
const BIAS: usize = (OUTPUT + 8) * WIDTH;
const PARAMETERS: usize = BIAS + 8;

/// Samples per step, and per task.
const BATCH: usize = 2048;
const SHARD: usize = 256;

/// The codec's units: logits of 1/64, output sums of 2^−12 of that.
const LOGIT: f32 = 64.0 * 4096.0;

type Row = [f32; WIDTH];

/// The network while it learns (Adam).
#[derive(Debug)]
pub struct Network {
    parameters: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
    steps: i32,
    random: Random,
}

impl Network {
    /// With random weights.
    pub fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let mut parameters = vec![0.0; PARAMETERS];
        for (i, parameter) in parameters[..BIAS].iter_mut().enumerate() {
            let is_node = (FEATURES..OUTPUT).contains(&(i / WIDTH));
            *parameter = random.normal() as f32 * if is_node { 0.3 } else { 0.15 };
        }
        Network {
            parameters,
            mean: vec![0.0; PARAMETERS],
            square: vec![0.0; PARAMETERS],
            steps: 0,
            random,
        }
    }

    /// One step on samples of clouds drawn at random; returns their mean length in bits.
    pub fn step(&mut self, clouds: &[Samples], rate: f32) -> f64 {
        let batch: Vec<(&[u8], u8)> = (0..BATCH)
            .map(|_| {
                let cloud = &clouds[self.random.below(clouds.len() as u64) as usize];
                cloud.get(self.random.below(cloud.len() as u64) as usize)
            })
            .collect();
        let shards: Vec<(f64, Vec<f32>)> = batch
            .par_chunks(SHARD)
            .map(|shard| {
                let mut gradient = vec![0.0; PARAMETERS];
                let bits = shard
                    .iter()
                    .map(|&(features, occupancy)| self.learn(features, occupancy, &mut gradient))
                    .sum();
                (bits, gradient)
            })
            .collect();
        self.descend(&shards, rate);
        shards.iter().map(|(bits, _)| bits).sum::<f64>() / BATCH as f64
    }

    fn row(&self, row: usize) -> &Row {
        row_of(&self.parameters, row)
    }

    /// The length of the code of one sample, whose gradient is added to `gradient`.
    fn learn(&self, features: &[u8], occupancy: u8, gradient: &mut [f32]) -> f64 {
        let mut sum = [0.0; WIDTH];
        for &feature in features {
            let row = self.row(feature.into());
            (0..WIDTH).for_each(|unit| sum[unit] += row[unit]);
        }
        let mut back = [0.0; WIDTH];
        let mut nats = 0.0;
        for octant in 0..8 {
            let below = usize::from(occupancy) & ((1 << octant) - 1);
            if octant == 7 && below == 0 {
                break;
            }
            let node = FEATURES + (1 << octant | below) - 1;
            let row = self.row(node);
            let hidden: Row = std::array::from_fn(|unit| (sum[unit] + row[unit]).max(0.0));
            let output = self.row(OUTPUT + octant);
            let logit = dot(&hidden, output) + self.parameters[BIAS + octant];
            let bit = occupancy >> octant & 1 == 1;
            let against = if bit { -logit } else { logit };
            nats += f64::from(against.max(0.0) + (-against.abs()).exp().ln_1p());

            let error = 1.0 / (1.0 + (-logit).exp()) - f32::from(u8::from(bit));
            let own: Row = std::array::from_fn(|unit| if hidden[unit] > 0.0 { error * output[unit] } else { 0.0 });
            add(row_of_mut(gradient, OUTPUT + octant), &hidden.map(|h| error * h));
            add(row_of_mut(gradient, node), &own);
            add(&mut back, &own);
            gradient[BIAS + octant] += error;
        }
        for &feature in features {
            add(row_of_mut(gradient, feature.into()), &back);
        }
        nats / std::f64::consts::LN_2
    }

    fn descend(&mut self, shards: &[(f64, Vec<f32>)], rate: f32) {
        const MEAN: f32 = 0.9;
        const SQUARE: f32 = 0.999;
        self.steps += 1;
        let rate = rate / (1.0 - MEAN.powi(self.steps));
        let correction = 1.0 / (1.0 - SQUARE.powi(self.steps));
        for i in 0..PARAMETERS {
            let sum: f32 = shards.iter().map(|(_, gradient)| gradient[i]).sum();
            let gradient = sum / BATCH as f32;
            self.mean[i] = MEAN * self.mean[i] + (1.0 - MEAN) * gradient;
            self.square[i] = SQUARE * self.square[i] + (1.0 - SQUARE) * gradient * gradient;
            self.parameters[i] -= rate * self.mean[i] / ((self.square[i] * correction).sqrt() + 1e-8);
        }
    }

    /// `weights.bin`. Each hidden unit is scaled so that its largest weight is 127; its output weights undo that.
    pub fn weights(&self) -> Vec<u8> {
        let scale: Row = std::array::from_fn(|unit| {
            let weights = (0..OUTPUT).map(|row| self.row(row)[unit].abs());
            127.0 / weights.fold(1e-6, f32::max)
        });
        let mut bytes = Vec::with_capacity(SIZE);
        for row in 0..OUTPUT {
            let row = self.row(row);
            bytes.extend((0..WIDTH).map(|unit| (row[unit] * scale[unit]).round() as i8 as u8));
        }
        for octant in 0..8 {
            let row = self.row(OUTPUT + octant);
            let weights = (0..WIDTH).map(|unit| (row[unit] / scale[unit] * LOGIT).round() as i16);
            bytes.extend(weights.flat_map(i16::to_le_bytes));
        }
        for bias in &self.parameters[BIAS..] {
            bytes.extend(((bias * LOGIT).round() as i32).to_le_bytes());
        }
        bytes
    }
}

fn row_of(parameters: &[f32], row: usize) -> &Row {
    let row = parameters[row * WIDTH..].first_chunk();
    row.expect("parameters are whole rows")
}

fn row_of_mut(parameters: &mut [f32], row: usize) -> &mut Row {
    let row = parameters[row * WIDTH..].first_chunk_mut();
    row.expect("parameters are whole rows")
}

fn add(sum: &mut Row, row: &Row) {
    (0..WIDTH).for_each(|unit| sum[unit] += row[unit]);
}

fn dot(a: &Row, b: &Row) -> f32 {
    let mut lanes = [0.0; 16];
    for (a, b) in a.chunks_exact(16).zip(b.chunks_exact(16)) {
        (0..16).for_each(|lane| lanes[lane] += a[lane] * b[lane]);
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::occupancy::shapes;

    #[test]
    fn the_gradient_is_the_slope_of_the_length() {
        let mut network = Network::new(3);
        let (features, occupancy) = ([0u8, 30, 33, 190], 0b1001_0110);
        let mut gradient = vec![0.0; PARAMETERS];
        network.learn(&features, occupancy, &mut gradient);
        let mut unused = vec![0.0; PARAMETERS];
        for i in (0..PARAMETERS).filter(|&i| gradient[i].abs() > 0.05).step_by(97) {
            let at = network.parameters[i];
            let mut length = |value| {
                network.parameters[i] = value;
                network.learn(&features, occupancy, &mut unused) * std::f64::consts::LN_2
            };
            let slope = (length(at + 1e-3) - length(at - 1e-3)) / 2e-3;
            network.parameters[i] = at;
            assert!((slope - f64::from(gradient[i])).abs() < 0.02 + 0.05 * slope.abs());
        }
    }

    #[test]
    fn it_learns_and_its_weights_have_the_codecs_size() {
        let clouds: Vec<_> = shapes(1, &mut Random::new(5))
            .into_iter()
            .map(|shape| Samples::new(shape).unwrap())
            .collect();
        let mut network = Network::new(1);
        let first = network.step(&clouds, 0.004);
        let last = (0..30).map(|_| network.step(&clouds, 0.004)).last().unwrap();
        assert!(last < 0.7 * first, "{first} {last}");
        assert_eq!(network.weights().len(), SIZE);
    }
}
