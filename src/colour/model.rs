//! Adaptive probability model of coefficients: context mixing in the logistic domain (`docs/format.md`, clause 5.8).
//!
//! A magnitude is coded in unary, by binary decisions. Each decision is predicted from [`CONTEXTS`] contexts. Each
//! context selects a *slot*, which holds an adaptive probability of a 1 and a count of its updates. A logistic unit
//! adds a prediction from continuous features. A mixer combines the logits of all with the sum of three weight vectors,
//! each selected by a part of the context. All numbers are integers; logits are in units of 1/64.

use b2p_kernels::Instructions;
use b2p_kernels::coefficients::{
    CONTEXTS, COUNT_BITS, LANES, Lanes, MAX_COUNT, MAX_WEIGHT, Mixed, Slots, adapt, adapt_unit, dot, mix,
};

use crate::coding::probability::{STRETCH, squash};
use crate::coding::{ONE, binary::Coder};

/// Number of contexts of a sign.
const SIGN_CONTEXTS: usize = 4;
/// Number of decisions of a magnitude with probabilities of their own: > 0, > 1, …; the last one serves all that
/// follow.
pub(super) const BINS: usize = 7;
/// Least probability of either outcome of a decision, in units of 2⁻¹⁶: where steps are coarse, nearly all are 0.
const FLOOR: u32 = 4;
/// From this magnitude on, the remainder is an Exp-Golomb code.
const ESCAPE: i32 = 18;
/// Maximum number of leading ones of such a code.
const MAX_PREFIX: u32 = 20;
/// Lane of a mixer for half the logit of the logistic unit. The next one is a constant.
const UNIT_LANE: usize = CONTEXTS;
/// Number of inputs of the logistic unit. Zeros follow in its lanes.
pub(super) const FEATURES: usize = 12;

/// Adaptation rate of a slot by its count, in units of 2⁻¹⁶: `65536·5 / (5·count + 8)`, rounded down.
static RATE: [u32; MAX_COUNT as usize + 1] = {
    let mut table = [0; MAX_COUNT as usize + 1];
    let mut count = 0;
    while count < table.len() {
        table[count] = 65536 * 5 / (5 * count as u32 + 8);
        count += 1;
    }
    table
};

/// Factor of a slot's logit by its count, in units of 1/256: `256·(10·count + 2) / (10·count + 17)`, rounded down.
static CONFIDENCE: [i32; MAX_COUNT as usize + 1] = {
    let mut table = [0; MAX_COUNT as usize + 1];
    let mut count = 0;
    while count < table.len() {
        table[count] = 256 * (10 * count as i32 + 2) / (10 * count as i32 + 17);
        count += 1;
    }
    table
};

/// The mixer's input from a slot: its logit, attenuated while its count is low.
#[inline(always)]
fn slot_input(slot: u32) -> i32 {
    let one = slot >> (COUNT_BITS + 10);
    (i32::from(STRETCH[one as usize]) * CONFIDENCE[(slot & ((1 << COUNT_BITS) - 1)) as usize]) >> 8
}

/// Moves a slot's probability towards `bit` and increments its count.
#[inline(always)]
fn adapt_slot(slot: &mut u32, bit: bool) {
    let (one, count) = (*slot >> COUNT_BITS, *slot & ((1 << COUNT_BITS) - 1));
    let rate = u64::from(RATE[count as usize]);
    let one = if bit {
        one + ((u64::from((1 << 22) - 1 - one) * rate) >> 16) as u32
    } else {
        one - ((u64::from(one) * rate) >> 16) as u32
    };
    *slot = one << COUNT_BITS | (count + 1).min(MAX_COUNT);
}

/// Probability 1/2, count 0.
const INITIAL_SLOT: u32 = 1 << (21 + COUNT_BITS);

/// Context of one coefficient (`docs/format.md`, 5.7.4).
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CoefficientContext {
    /// Channel: 0 Y, 1 Co, 2 Cg.
    pub channel: usize,
    /// Slot of the transform, 0 to 6.
    pub slot: usize,
    /// Axis of the slot: 0 x, 1 y, 2 z.
    pub axis: usize,
    /// Number of children of the node, 2 to 8.
    pub children: usize,
    /// Levels from the children's to the stream's last, at most 3.
    pub height: usize,
    /// `min(|q|, 3)` of Y in the same slot, 0 while Y is coded.
    pub luma: usize,
    /// `min(|q|, 3)` of Co in the same slot, 0 until it is coded.
    pub co: usize,
    /// Sum of `min(|q|, 2)` of the same slot and channel in the blocks at z − 1, y − 1 and x − 1: 0 to 6.
    pub neighbour_magnitudes: usize,
    /// Local coefficient energy. This and the next five are logarithms in eighths of an octave (`node::log_class`).
    pub energy: i32,
    /// Mean absolute difference to the face neighbours.
    pub gradient: i32,
    /// Magnitude of the prediction that includes children coded before.
    pub near: i32,
    /// Mean magnitude of this channel in the node's slots coded so far; 60 if there are none.
    pub block: i32,
    /// Magnitude of the prediction from the level above alone.
    pub far: i32,
    /// Magnitude of luma's prediction; for luma the greater of the chroma channels'.
    pub cross_channel: i32,
    /// Class of the slot's scale `√(vw / (v + w))`: 0 to 3.
    pub weight_class: usize,
    /// Inputs of the logistic unit.
    pub features: Lanes,
    /// Context of the sign.
    pub sign: SignContext,
}

/// Context of a sign.
#[derive(Debug, Clone, Copy)]
pub(super) struct SignContext {
    /// Class of the prediction that includes children coded before: 0 to 8, 4 near 0.
    pub near: usize,
    /// Class of the difference between both predictions: 0 to 8, 4 near 0.
    pub shift: usize,
    /// Signs (0 zero, 1 plus, 2 minus) of Y and Co in the same slot: `Y + 3·Co`.
    pub channels: usize,
    /// Signs of the same slot and channel in the three neighbouring blocks, in base 3: 0 to 26.
    pub neighbours: usize,
}

/// Number of slots of each context, for one decision.
const CONTEXT_SIZES: [usize; CONTEXTS] = [
    4 * 3 * 7 * 7,
    9 * 9,
    14 * 3 * 4,
    7 * 7 * 4 * 4,
    48,
    4 * 4 * 8 * 7,
    24 * 3 * 4 * 4,
    9 * 9 * 4,
];
/// Number of decisions: [`BINS`] of each channel.
const DECISIONS: usize = 3 * BINS;

/// Index of each context's first slot, and the number of all slots.
const CONTEXT_STARTS: [usize; CONTEXTS + 1] = {
    let mut starts = [0; CONTEXTS + 1];
    let mut i = 0;
    while i < CONTEXTS {
        starts[i + 1] = starts[i] + CONTEXT_SIZES[i] * DECISIONS;
        i += 1;
    }
    starts
};
/// Number of slots of each sign context, for one channel.
const SIGN_SIZES: [usize; SIGN_CONTEXTS] = [4 * 9 * 3, 9 * 7, 27 * 3, 9 * 9];
/// Index of each sign context's first slot, and the number of all.
const SIGN_STARTS: [usize; SIGN_CONTEXTS + 1] = {
    let mut starts = [0; SIGN_CONTEXTS + 1];
    let mut i = 0;
    while i < SIGN_CONTEXTS {
        starts[i + 1] = starts[i] + SIGN_SIZES[i] * 3;
        i += 1;
    }
    starts
};
/// Number of classes of the unit's logit that select mixer weights.
const LOGIT_CLASSES: usize = 12;

/// Class of a logarithm of at least 0: 0 to `classes − 1`, each `width` eighths of an octave wide.
#[inline(always)]
fn class(log: i32, width: u32, classes: u32) -> usize {
    (log as u32 / width).min(classes - 1) as usize
}

/// Adaptive state of the coefficient coder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Model {
    /// Slots of magnitude decisions.
    slots: Vec<u32>,
    /// Slots of signs.
    signs: Vec<u32>,
    /// Mixer weights by decision.
    by_decision: Vec<Lanes>,
    /// Mixer weights by decision and class of the unit's logit.
    by_logit: Vec<Lanes>,
    /// Mixer weights by decision, axis, and which channels of the slot are not 0.
    by_channels: Vec<Lanes>,
    /// Mixer weights of signs by channel.
    sign_weights: [[i32; 8]; 3],
    /// Weights of the logistic unit of each channel.
    units: [Lanes; 3],
    /// Number of adaptations of each unit, at most 4096.
    adaptations: [u32; 3],
    /// Regressions of Co and Cg on Y.
    pub chroma_from_luma: [ChromaFromLuma; 2],
}

/// Decaying sums for the linear regression of a chroma channel on luma.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct ChromaFromLuma {
    /// Sum of luma · chroma.
    pub product: i64,
    /// Sum of luma².
    pub square: i64,
}

/// Prediction of one decision, with what [`Model::adapt`] needs afterwards.
pub(super) struct Prediction {
    at: [usize; CONTEXTS],
    mixed: Mixed,
    sets: [usize; 3],
    /// Probability of a 1 in units of 2⁻¹⁶.
    pub one: u32,
}

/// What all decisions of a magnitude share.
pub(super) struct Magnitude {
    /// Logit of the channel's logistic unit, −640 to 640.
    unit: i32,
    /// Of every context, the slot of the first decision of a group of [`CONTEXT_SIZES`].
    offsets: [usize; CONTEXTS],
    /// The second and third set of mixer weights of the first decision.
    sets: [usize; 2],
    first_decision: usize,
}

impl Model {
    /// Bytes of memory of a model.
    pub const BYTES: usize = (CONTEXT_STARTS[CONTEXTS] + SIGN_STARTS[SIGN_CONTEXTS]) * size_of::<u32>()
        + DECISIONS * (1 + LOGIT_CLASSES + 12) * size_of::<Lanes>()
        + size_of::<Model>();

    /// A model without slots, which cannot code.
    pub fn empty() -> Model {
        Model {
            slots: Vec::new(),
            signs: Vec::new(),
            by_decision: Vec::new(),
            by_logit: Vec::new(),
            by_channels: Vec::new(),
            sign_weights: [[0; 8]; 3],
            units: [[0; LANES]; 3],
            adaptations: [0; 3],
            chroma_from_luma: [ChromaFromLuma::default(); 2],
        }
    }

    /// The initial model.
    pub fn new() -> Model {
        let mut weights = [0; LANES];
        weights[..CONTEXTS].fill(6554);
        weights[UNIT_LANE] = 6554;
        Model {
            slots: vec![INITIAL_SLOT; CONTEXT_STARTS[CONTEXTS]],
            signs: vec![INITIAL_SLOT; SIGN_STARTS[SIGN_CONTEXTS]],
            by_decision: vec![weights; DECISIONS],
            by_logit: vec![weights; DECISIONS * LOGIT_CLASSES],
            by_channels: vec![weights; DECISIONS * 12],
            sign_weights: [[24_000, 24_000, 24_000, 24_000, 0, 0, 0, 0]; 3],
            units: [[0; LANES]; 3],
            adaptations: [0; 3],
            chroma_from_luma: [ChromaFromLuma::default(); 2],
        }
    }

    /// Prepares the decisions of a magnitude.
    #[inline(always)]
    pub fn magnitude<I: Instructions>(&self, simd: I, c: &CoefficientContext) -> Magnitude {
        let unit = (dot(simd, &self.units[c.channel], &c.features) >> 16).clamp(-640, 640);
        let significant = usize::from(c.luma > 0) * 2 + usize::from(c.co > 0);
        let logit_class = ((unit + 640) as u32 * 48 / 1281) as usize;
        Magnitude {
            unit,
            offsets: [
                ((c.height * 3 + c.axis) * 7 + c.children - 2) * 7 + c.neighbour_magnitudes,
                class(c.gradient, 8, 9) * 9 + class(c.near, 8, 9),
                (class(c.near, 5, 14) * 3 + c.axis) * 4 + c.weight_class,
                ((class(c.energy, 8, 7) * 7 + class(c.gradient, 10, 7)) * 4 + c.luma) * 4 + c.co,
                logit_class,
                ((c.luma * 4 + c.co) * 8 + class(c.block, 8, 8)) * 7 + c.neighbour_magnitudes,
                ((logit_class / 2 * 3 + c.axis) * 4 + (c.children - 2).min(3)) * 4 + significant,
                (class(c.far, 8, 9) * 9 + class(c.cross_channel, 8, 9)) * 4 + significant,
            ],
            sets: [logit_class / 4, c.axis * 4 + significant],
            first_decision: c.channel * BINS,
        }
    }

    /// Predicts decision `bin` of a magnitude.
    #[inline(always)]
    pub fn predict<I: Instructions>(&self, simd: I, magnitude: &Magnitude, bin: usize) -> Prediction {
        let decision = magnitude.first_decision + bin;
        let (mut at, mut slots): (_, Slots) = ([0; CONTEXTS], [0; CONTEXTS]);
        for i in 0..CONTEXTS {
            at[i] = CONTEXT_STARTS[i] + decision * CONTEXT_SIZES[i] + magnitude.offsets[i];
            slots[i] = self.slots[at[i]];
        }
        let [by_logit, by_channels] = magnitude.sets;
        let sets = [
            decision,
            decision * LOGIT_CLASSES + by_logit,
            decision * 12 + by_channels,
        ];
        let weights = [
            &self.by_decision[sets[0]],
            &self.by_logit[sets[1]],
            &self.by_channels[sets[2]],
        ];
        let mixed = mix(simd, &slots, [magnitude.unit / 2, BIAS], &STRETCH, weights);
        let one = squash(mixed.sum >> 16).clamp(FLOOR, ONE - FLOOR);
        Prediction { at, mixed, sets, one }
    }

    /// Updates slots and mixer weights with the coded `bit`.
    #[inline(always)]
    fn adapt<I: Instructions>(&mut self, simd: I, prediction: &Prediction, bit: bool) {
        let error = if bit { ONE as i32 } else { 0 } - prediction.one as i32;
        let sets = [
            &mut self.by_decision[prediction.sets[0]],
            &mut self.by_logit[prediction.sets[1]],
            &mut self.by_channels[prediction.sets[2]],
        ];
        let slots = adapt(simd, &prediction.mixed, error, bit, sets);
        for (at, slot) in prediction.at.into_iter().zip(slots) {
            self.slots[at] = slot;
        }
    }

    /// Updates the logistic unit with the coded `bit` of the first decision.
    #[inline(always)]
    fn adapt_unit<I: Instructions>(&mut self, simd: I, c: &CoefficientContext, unit: i32, bit: bool) {
        let t = c.channel;
        let error = if bit { ONE as i32 } else { 0 } - squash(unit) as i32;
        self.adaptations[t] = (self.adaptations[t] + 1).min(1 << 12);
        let rate = UNIT_RATE + (UNIT_RATE_START >> (self.adaptations[t] >> 6).min(12));
        adapt_unit(simd, &mut self.units[t], &c.features, [error >> 4, rate], 1 << 20);
    }

    /// Indices of the slots of a sign.
    #[inline(always)]
    fn sign_slots(c: &CoefficientContext) -> [usize; SIGN_CONTEXTS] {
        let s = &c.sign;
        let offsets = [
            (c.height * 9 + s.near) * 3 + c.axis,
            s.channels * 7 + c.slot,
            s.neighbours * 3 + c.axis,
            s.shift * 9 + s.near,
        ];
        let mut at = [0; SIGN_CONTEXTS];
        for i in 0..SIGN_CONTEXTS {
            at[i] = SIGN_STARTS[i] + c.channel * SIGN_SIZES[i] + offsets[i];
        }
        at
    }

    /// Codes a sign and adapts to it.
    #[inline(always)]
    fn sign<C: Coder>(&mut self, coder: &mut C, c: &CoefficientContext, negative: bool) -> bool {
        let at = Model::sign_slots(c);
        let mut inputs = [0; SIGN_CONTEXTS];
        for i in 0..SIGN_CONTEXTS {
            inputs[i] = slot_input(self.signs[at[i]]);
        }
        let weights = &mut self.sign_weights[c.channel];
        let sum = (0..SIGN_CONTEXTS).fold(0i32, |sum, i| sum.wrapping_add(weights[i] * inputs[i]));
        let one = squash(sum >> 16).clamp(FLOOR, ONE - FLOOR);
        let bit = coder.code(negative, one);
        let error = if bit { ONE as i32 } else { 0 } - one as i32;
        for i in 0..SIGN_CONTEXTS {
            let step = (error * inputs[i] * 10 + (1 << 15)) >> 16;
            weights[i] = (weights[i] + step).clamp(-MAX_WEIGHT, MAX_WEIGHT);
            adapt_slot(&mut self.signs[at[i]], bit);
        }
        bit
    }

    /// Codes a coefficient and adapts to it. An encoder codes and returns `value`; a decoder ignores it and returns the
    /// decoded coefficient.
    #[inline(always)]
    pub fn code<I: Instructions, C: Coder>(
        &mut self,
        simd: I,
        coder: &mut C,
        c: &CoefficientContext,
        value: i32,
    ) -> i32 {
        let decisions = self.magnitude(simd, c);
        let wanted = value.abs();
        let mut magnitude = 0;
        while magnitude < ESCAPE {
            let bin = (magnitude as usize).min(BINS - 1);
            let prediction = self.predict(simd, &decisions, bin);
            let more = coder.code(wanted > magnitude, prediction.one);
            self.adapt(simd, &prediction, more);
            if magnitude == 0 {
                self.adapt_unit(simd, c, decisions.unit, more);
            }
            if !more {
                break;
            }
            magnitude += 1;
        }
        if magnitude == 0 {
            return 0;
        }
        if magnitude == ESCAPE {
            magnitude += escape(coder, wanted - ESCAPE);
        }
        if self.sign(coder, c, value < 0) {
            -magnitude
        } else {
            magnitude
        }
    }
}

/// The constant input of a mixer.
const BIAS: i32 = 64;
/// Final learning rate of the logistic unit ([`Model::adapt_unit`]).
const UNIT_RATE: i32 = 4;
/// Addition to that rate at first, halved every 64 adaptations.
const UNIT_RATE_START: i32 = 64;

/// Codes a number of at least 0 as an Exp-Golomb code of equiprobable decisions.
#[inline(never)]
fn escape<C: Coder>(coder: &mut C, value: i32) -> i32 {
    let value = (value.max(0) + 1) as u32;
    let bits = value.ilog2();
    let mut prefix = 0;
    while prefix < MAX_PREFIX && coder.code(prefix < bits, ONE / 2) {
        prefix += 1;
    }
    let mut read = 1u32;
    for place in (0..prefix).rev() {
        read = read << 1 | u32::from(coder.code(value >> place & 1 == 1, ONE / 2));
    }
    (read - 1) as i32
}
