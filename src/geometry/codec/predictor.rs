//! Codes the occupancy of one voxel after the other: the network, its learning, and the arithmetic coder at work together.
//!
//! For each child the network's logit, in units of 1/64, is `(bias + Σ hidden·output) >> 12` of the child's octant (`i32`, wrapping), brought within ±720, its
//! probability `squash` of that. The probability that the child is there is this one where the logit is ±384 or beyond, and else what the `mixer`
//! makes of the logit and of what the slice has shown in like surroundings.
//!
//! The output layer learns from what surprises the network alone. With its probability and `error = 65536·bit − probability`, if `|error| ≥ 4096`, and
//! `e = error / 64` towards zero, each weight of the octant grows by `((hidden·e >> 16) + 1) >> 1` (saturating `i16`), its bias by
//! `4·e` (wrapping `i32`).

use super::coder::Coder;
use super::mixer::Mixer;
use super::neighbourhood::Neighbourhood;
use super::network::Network;
use super::surroundings::Surroundings;
use crate::coding::ONE;
use crate::coding::probability::{LIMIT, squash};
use crate::geometry::ones;
use b2p_kernels::Instructions;
use b2p_kernels::hidden::{self, Row};

/// Σ hidden·output is in units of 2^−12 of the logit's.
const SHIFT: u32 = 12;
/// The logit from which the network is left alone: it seldom errs there, and half of all children are such.
const CERTAIN: i32 = 384;
/// The smallest error worth learning from.
const SURPRISE: i32 = 4096;

/// The state of one entropy stream.
#[derive(Debug)]
pub(super) struct Predictor<I> {
    instructions: I,
    network: &'static Network,
    mixer: Mixer<I>,
    output: [Row; 8],
    bias: [i32; 8],
}

impl<I: Instructions> Predictor<I> {
    /// That of a slice of so many parents.
    pub fn new(instructions: I, parents: usize) -> Self {
        let network = Network::get();
        Predictor {
            instructions,
            network,
            mixer: Mixer::new(instructions, parents),
            output: network.output,
            bias: network.bias,
        }
    }

    /// Codes the occupancy of a voxel that has these neighbours, by the indices `row`; `known` are the occupancies of the slice, whose first voxel
    /// has the index `first`, up to it at least. An encoder takes `occupancy`, never zero, and returns it; a decoder
    /// returns what it read, also never zero: if seven children are missing, the eighth is there and not coded.
    #[inline(always)]
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        neighbours: Neighbourhood,
        row: &[u32],
        first: usize,
        known: &[u8],
        occupancy: u8,
    ) -> u8 {
        let (network, mut around) = (self.network, Surroundings::new());
        let (mut rows, mut count) = ([network.presence(0); 2 * 26 + 2 * 19], 0);
        for k in ones(neighbours.there & !neighbours.earlier) {
            rows[count] = network.presence(k);
            count += 1;
            around.add_presence(k);
        }
        for k in ones(neighbours.earlier) {
            let mask = known[row[k] as usize - first];
            rows[count..][..2].copy_from_slice(&network.children(k, mask));
            count += 2;
            around.add_children(k, mask);
        }
        for rest in &network.rest {
            if neighbours.earlier >> rest.k & 1 == 1 {
                rows[count] = rest.row(known[row[rest.k] as usize - first]);
                count += 1;
            }
        }
        around.sum_up(neighbours);
        let facts = hidden::add_up(self.instructions, &rows[..count]);
        let mut coded = 0u8;
        for octant in 0..8 {
            if octant == 7 && coded == 0 {
                return 0x80;
            }
            let node = 1 << octant | usize::from(coded);
            let row = self.network.node(node);
            let sum = hidden::sum(self.instructions, &facts, row, &self.output[octant]);
            let sum = self.bias[octant].wrapping_add(sum);
            let logit = (sum >> SHIFT).clamp(-LIMIT, LIMIT);
            let network = squash(logit);
            let wanted = occupancy >> octant & 1 == 1;
            let bit = if logit.abs() < CERTAIN {
                let mixed = self.mixer.predict(logit, around.contexts(octant, node));
                let bit = coder.code(wanted, mixed.one);
                self.mixer.learn(&mixed, network, bit);
                bit
            } else {
                coder.code(wanted, network)
            };
            // The next child waits for a guess, not for the coder: it is seldom wrong.
            let guess = logit >= 0;
            around.learn(octant, guess);
            coded |= u8::from(guess) << octant;
            if bit != guess {
                std::hint::cold_path();
                around.unlearn(octant);
                coded ^= 1 << octant;
            }
            let truth = if bit { ONE as i32 } else { 0 };
            let error = truth - network as i32;
            if error.abs() >= SURPRISE {
                let e = error / 64;
                self.bias[octant] = self.bias[octant].wrapping_add(4 * e);
                hidden::learn(self.instructions, &facts, row, e as i16, &mut self.output[octant]);
            }
        }
        coded
    }
}
