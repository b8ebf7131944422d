//! Codes the occupancy of one voxel after the other: the network, its learning, and the arithmetic coder at work together.
//!
//! For each child the logit, in units of 1/64, is `(bias + Σ hidden·output) >> 12` of the child's octant (`i32`, wrapping), the
//! probability that the child is there `squash` of it.
//!
//! The output layer learns from what surprised it. With `error = 65536·bit − probability`, if `|error| ≥ 4096`, and
//! `e = error / 64` towards zero, each weight of the octant grows by `((hidden·e >> 16) + 1) >> 1` (saturating `i16`), its bias by
//! `4·e` (wrapping `i32`).

use super::coder::{Coder, ONE};
use super::network::{Network, Row};
use super::probability::squash;

/// Σ hidden·output is in units of 2^−12 of the logit's.
const SHIFT: u32 = 12;
/// The smallest error worth learning from.
const SURPRISE: i32 = 4096;

/// The state of one entropy stream.
#[derive(Debug)]
pub(super) struct Predictor {
    pub network: &'static Network,
    output: [Row; 8],
    bias: [i32; 8],
}

impl Predictor {
    pub fn new() -> Self {
        let network = Network::get();
        Predictor {
            network,
            output: network.output,
            bias: network.bias,
        }
    }

    /// Codes the occupancy of a voxel of which `facts` are known. An encoder takes `occupancy`, never zero, and returns it; a decoder
    /// returns what it read, also never zero: if seven children are missing, the eighth is there and not coded.
    #[inline(always)]
    pub fn code(&mut self, coder: &mut impl Coder, facts: &Row, occupancy: u8) -> u8 {
        let mut coded = 0u8;
        for octant in 0..8 {
            if octant == 7 && coded == 0 {
                return 0x80;
            }
            let hidden = self.network.hidden(facts, 1 << octant | usize::from(coded));
            let sum = self.bias[octant].wrapping_add(dot(&hidden, &self.output[octant]));
            let one = squash(sum >> SHIFT);
            let bit = coder.code(occupancy >> octant & 1 == 1, one);
            coded |= u8::from(bit) << octant;
            let error = if bit {
                (ONE - one) as i32
            } else {
                -(one as i32)
            };
            if error.abs() >= SURPRISE {
                self.learn(octant, &hidden, (error / 64) as i16);
            }
        }
        coded
    }

    #[inline(always)]
    fn learn(&mut self, octant: usize, hidden: &Row, e: i16) {
        self.bias[octant] = self.bias[octant].wrapping_add(4 * i32::from(e));
        for (weight, &unit) in self.output[octant].iter_mut().zip(hidden) {
            let step = ((i32::from(unit) * i32::from(e)) >> 16) as i16;
            *weight = weight.saturating_add((step + 1) >> 1);
        }
    }
}

#[inline(always)]
fn dot(a: &Row, b: &Row) -> i32 {
    a.iter().zip(b).fold(0i32, |sum, (&a, &b)| {
        sum.wrapping_add(i32::from(a) * i32::from(b))
    })
}
