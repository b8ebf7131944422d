//! Codes the occupancy of one voxel after the other: network, mixer and arithmetic coder (`docs/format.md`, clauses 4.5
//! and 4.8).
//!
//! For each child the network's logit, in units of 1/64, is `(bias + Σ hidden·output) >> 12` of the child's octant
//! (`i32`, wrapping), clamped to ±720. Its probability is `squash` of that. Where the logit is within ±383, the child
//! is coded with the probability of the `mixer`; else with that of the network.
//!
//! The output layer adapts to prediction errors of the network. With `error = 65536·bit − probability`, if `|error| ≥
//! 4096`, and `e = error / 64` towards zero, each weight of the octant grows by `((hidden·e >> 16) + 1) >> 1`
//! (saturating `i16`), its bias by `4·e` (wrapping `i32`).

use super::coder::Coder;
use super::contexts::Contexts;
use super::guide::{Guide, Refiner, Window};
use super::mixer::Mixer;
use super::neighbourhood::Neighbourhood;
use super::network::Network;
#[cfg(feature = "encoder")]
use super::optimise::{self, Surface};
use crate::coding::ONE;
use crate::coding::probability::{LIMIT, squash};
use crate::geometry::ones;
use b2p_kernels::Instructions;
use b2p_kernels::hidden::{self, Row};

/// Fractional bits of Σ hidden·output, relative to the logit.
const SHIFT: u32 = 12;
/// From this |logit| on the mixer is bypassed: the network seldom errs there, and half of all children are such.
const CERTAIN: i32 = 384;
/// Minimum |error| to which the output layer adapts.
const MIN_ERROR: i32 = 4096;

/// The state of one entropy stream.
#[derive(Debug)]
pub(super) struct Predictor<I> {
    instructions: I,
    network: &'static Network,
    mixer: Mixer<I>,
    output: [Row; 8],
    bias: [i32; 8],
    /// What a previous frame is used with.
    refiner: Option<Refiner>,
}

impl<I: Instructions> Predictor<I> {
    /// The initial state of a slice of `parents` parents.
    pub fn new(instructions: I, parents: usize, guide: Option<Guide<'_>>) -> Self {
        let network = Network::get();
        Predictor {
            instructions,
            network,
            mixer: Mixer::new(instructions, parents),
            output: network.output,
            bias: network.bias,
            refiner: guide.map(|guide| Refiner::new(guide.near.is_some())),
        }
    }

    /// The input of the hidden layer and the contexts of a voxel, before any of its children is known. The arguments are
    /// those of [`Predictor::code`].
    #[inline(always)]
    fn gather(&self, neighbours: Neighbourhood, row: &[u32], first: usize, occupancies: &[u8]) -> (Row, Contexts) {
        let (network, mut contexts) = (self.network, Contexts::new());
        let (mut rows, mut count) = ([network.presence(0); 2 * 26 + 2 * 19], 0);
        for k in ones(neighbours.there & !neighbours.known) {
            rows[count] = network.presence(k);
            count += 1;
            contexts.add_presence(k);
        }
        for k in ones(neighbours.known) {
            let mask = occupancies[row[k] as usize - first];
            rows[count..][..2].copy_from_slice(&network.children(k, mask));
            count += 2;
            contexts.add_children(k, mask);
        }
        for remainder in &network.remainders {
            if neighbours.known >> remainder.k & 1 == 1 {
                rows[count] = remainder.row(occupancies[row[remainder.k] as usize - first]);
                count += 1;
            }
        }
        contexts.set_faces(neighbours);
        (hidden::add_up(self.instructions, &rows[..count]), contexts)
    }

    /// Codes the occupancy of a voxel. `neighbours` is its neighbourhood and `row` its row of the kernel map.
    /// `occupancies` are those of the slice, from its first voxel, of index `first`, at least up to this one. `window` is
    /// what a previous frame has there.
    ///
    /// An encoder codes `occupancy`, never 0, and returns it. A decoder ignores it and returns what it decoded, also
    /// never 0: if seven children are absent, the eighth is implied and not coded.
    #[inline(always)]
    pub fn code(
        &mut self,
        coder: &mut impl Coder,
        neighbours: Neighbourhood,
        row: &[u32],
        first: usize,
        occupancies: &[u8],
        occupancy: u8,
        window: Option<Window>,
    ) -> u8 {
        let network = self.network;
        let (features, mut contexts) = self.gather(neighbours, row, first, occupancies);
        let mut coded = 0u8;
        for octant in 0..8 {
            if octant == 7 && coded == 0 {
                return 0x80;
            }
            let node = 1 << octant | usize::from(coded);
            let row = network.node(node);
            let sum = hidden::sum(self.instructions, &features, row, &self.output[octant]);
            let sum = self.bias[octant].wrapping_add(sum);
            let logit = (sum >> SHIFT).clamp(-LIMIT, LIMIT);
            let network = squash(logit);
            let target = occupancy >> octant & 1 == 1;
            let refiner = window.and_then(|window| Some((window, self.refiner.as_mut()?)));
            let bit = if logit.abs() < CERTAIN {
                let mixed = self.mixer.predict(logit, contexts.hashes(octant, node));
                let bit = match refiner {
                    None => coder.code(target, mixed.one),
                    Some((window, refiner)) => refiner.code(coder, window, octant, coded, mixed.logit(), target),
                };
                self.mixer.adapt(&mixed, network, bit);
                bit
            } else {
                match refiner {
                    None => coder.code(target, network),
                    Some((window, refiner)) => refiner.code(coder, window, octant, coded, logit, target),
                }
            };
            // Speculate on the bit, so that the next child's features do not wait for the coder. It is seldom wrong.
            let guess = logit >= 0;
            contexts.set_child(octant, guess);
            coded |= u8::from(guess) << octant;
            if bit != guess {
                std::hint::cold_path();
                contexts.flip_child(octant);
                coded ^= 1 << octant;
            }
            let truth = if bit { ONE as i32 } else { 0 };
            let error = truth - network as i32;
            if error.abs() >= MIN_ERROR {
                let e = error / 64;
                self.bias[octant] = self.bias[octant].wrapping_add(4 * e);
                hidden::learn(self.instructions, &features, row, e as i16, &mut self.output[octant]);
            }
        }
        coded
    }

    /// The occupancy of a voxel that minimises distortion + λ · rate, never 0. The arguments are those of
    /// [`Predictor::code`]; `lambda` is that of [`Distortion`](super::optimise::Distortion).
    #[cfg(feature = "encoder")]
    #[inline(always)]
    pub fn choose(
        &self,
        neighbours: Neighbourhood,
        row: &[u32],
        first: usize,
        occupancies: &[u8],
        surface: &Surface,
        lambda: u32,
        window: Option<Window>,
    ) -> u8 {
        let lengths = optimise::code_lengths();
        let (features, contexts) = self.gather(neighbours, row, first, occupancies);
        let mut beam = optimise::Beam::new(contexts);
        let mut next = Vec::with_capacity(beam.candidates.capacity());
        for octant in 0..8 {
            let truth = surface.mask >> octant & 1 == 1;
            for candidate in &beam.candidates {
                let mut step = |bit: bool, bits: u32| {
                    let mut child = *candidate;
                    child.mask |= u8::from(bit) << octant;
                    child.bits += bits;
                    child.least += surface.least(octant, bit);
                    child.contexts.set_child(octant, bit);
                    next.push(child);
                };
                if octant == 7 && candidate.mask == 0 {
                    step(true, 0);
                    continue;
                }
                let one = self.probability(&features, &candidate.contexts, octant, candidate.mask, window);
                step(truth, optimise::bits(lengths, one, truth));
                let other = optimise::bits(lengths, one, !truth);
                if optimise::may_differ(other) {
                    step(!truth, other);
                }
            }
            std::mem::swap(&mut beam.candidates, &mut next);
            next.clear();
            beam.prune(lambda);
        }
        beam.best(surface, lambda)
    }

    /// The probability, in units of 2⁻¹⁶, of the child in `octant`. `coded` are the children in lower octants.
    #[cfg(feature = "encoder")]
    #[inline(always)]
    fn probability(
        &self,
        features: &Row,
        contexts: &Contexts,
        octant: usize,
        coded: u8,
        window: Option<Window>,
    ) -> u32 {
        let node = 1 << octant | usize::from(coded);
        let row = self.network.node(node);
        let sum = hidden::sum(self.instructions, features, row, &self.output[octant]);
        let logit = (self.bias[octant].wrapping_add(sum) >> SHIFT).clamp(-LIMIT, LIMIT);
        let refiner = window.and_then(|window| Some((window, self.refiner.as_ref()?)));
        if logit.abs() >= CERTAIN {
            return match refiner {
                None => squash(logit),
                Some((window, refiner)) => refiner.probability(window, octant, coded, logit),
            };
        }
        let mixed = self.mixer.predict(logit, contexts.hashes(octant, node));
        match refiner {
            None => mixed.one,
            Some((window, refiner)) => refiner.probability(window, octant, coded, mixed.logit()),
        }
    }
}
