//! Codes the occupancy of one voxel after the other: the network, its learning, and the arithmetic coder at work together.
//!
//! For each child the network's logit, in units of 1/64, is `(bias + Σ hidden·output) >> 12` of the child's octant (`i32`, wrapping), brought within ±720, its
//! probability `squash` of that. The probability that the child is there is this one where the logit is ±384 or beyond, and else what the `mixer`
//! makes of the logit and of what the slice has shown in like surroundings.
//!
//! The output layer learns from what surprises the network alone. With its probability and `error = 65536·bit − probability`, if `|error| ≥ 4096`, and
//! `e = error / 64` towards zero, each weight of the octant grows by `((hidden·e >> 16) + 1) >> 1` (saturating `i16`), its bias by
//! `4·e` (wrapping `i32`).

use super::coder::{Coder, ONE};
use super::mixer::Mixer;
use super::network::{Network, Row, WIDTH, visit};
use super::probability::{LIMIT, squash};
use super::surroundings::Surroundings;
use crate::geometry::KernelMap;
use std::ops::Range;

/// Σ hidden·output is in units of 2^−12 of the logit's.
const SHIFT: u32 = 12;
/// The logit from which the network is left alone: it seldom errs there, and half of all children are such.
const CERTAIN: i32 = 384;
/// The smallest error worth learning from.
const SURPRISE: i32 = 4096;

/// The state of one entropy stream.
#[derive(Debug)]
pub(super) struct Predictor {
    network: &'static Network,
    mixer: Mixer,
    output: [Row; 8],
    bias: [i32; 8],
}

impl Predictor {
    /// That of a slice of so many parents.
    pub fn new(parents: usize) -> Self {
        let network = Network::get();
        Predictor {
            network,
            mixer: Mixer::new(parents),
            output: network.output,
            bias: network.bias,
        }
    }

    /// Codes the occupancy of the voxel `here` of the voxels `slice`, whose 3³ kernel map is `map`; `known` are the occupancies of the slice up to it
    /// at least. An encoder takes `occupancy`, never zero, and returns it; a decoder
    /// returns what it read, also never zero: if seven children are missing, the eighth is there and not coded.
    #[inline(always)]
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        map: &KernelMap,
        slice: &Range<usize>,
        here: usize,
        known: &[u8],
        occupancy: u8,
    ) -> u8 {
        let (mut facts, mut around) = ([0; WIDTH], Surroundings::new());
        // A list first: what follows is too much to be compiled into each call from `visit`.
        let (mut neighbours, mut count) = ([(0, None); 27], 0);
        visit(map.row(here), slice, here, known, |k, children| {
            neighbours[count] = (k, children);
            count += 1;
        });
        for &(k, children) in &neighbours[..count] {
            self.network.add(&mut facts, k, children);
            around.add(k, children.map(|(_, mask)| mask));
        }
        around.look_beyond(map, here);
        let mut coded = 0u8;
        for octant in 0..8 {
            if octant == 7 && coded == 0 {
                return 0x80;
            }
            let node = 1 << octant | usize::from(coded);
            let hidden = self.network.hidden(&facts, node);
            let sum = self.bias[octant].wrapping_add(dot(&hidden, &self.output[octant]));
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
            around.learn(octant, bit);
            coded |= u8::from(bit) << octant;
            let truth = if bit { ONE as i32 } else { 0 };
            let error = truth - network as i32;
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
