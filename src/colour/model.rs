//! Probabilities of coefficients: contexts mixed in the logistic domain.
//!
//! Every binary decision about a magnitude is seen in [`CONTEXTS`] contexts, each with a *slot* that holds the probability of a 1 and how often it was met.
//! Three sets of weights, chosen by different circumstances, are added up and mix what the slots say. All numbers are integers; logits are in units of 1/64.

use crate::coding::probability::{STRETCH, squash};
use crate::coding::{ONE, binary::Coder};

/// Contexts of a decision about a magnitude.
const CONTEXTS: usize = 8;
/// Contexts of a sign.
const SIGN_CONTEXTS: usize = 4;
/// Decisions of a magnitude that contexts tell apart: whether it is 0, 1, …
pub(super) const BINS: usize = 7;
/// From this magnitude on the rest is an Exp-Golomb code.
const ESCAPE: i32 = 18;
/// The most ones that such a code begins with.
const MAX_PREFIX: u32 = 20;
/// Lanes of a mixer: contexts, the logistic unit's logit, a constant, zeros.
const LANES: usize = 16;
const UNIT: usize = CONTEXTS;
const BIAS: usize = CONTEXTS + 1;
/// The largest magnitude of a weight: three sets of ten products stay within 32 bits.
const HEAVIEST: i32 = 1 << 16;
/// Inputs of the logistic unit.
pub(super) const FEATURES: usize = 12;

/// How often a slot was met at most, in its low bits; the probability above them, in units of 2⁻²².
const COUNT_BITS: u32 = 10;
const MOST: u32 = 120;

/// How fast a slot follows after so many decisions, in units of 2⁻¹⁶: `65536·5 / (5·count + 8)`, rounded down.
static RATE: [u32; MOST as usize + 1] = {
    let mut table = [0; MOST as usize + 1];
    let mut count = 0;
    while count < table.len() {
        table[count] = 65536 * 5 / (5 * count as u32 + 8);
        count += 1;
    }
    table
};

/// How far to trust a slot after so many decisions, in units of 1/256: `256·(10·count + 2) / (10·count + 17)`, rounded down.
static TRUST: [i32; MOST as usize + 1] = {
    let mut table = [0; MOST as usize + 1];
    let mut count = 0;
    while count < table.len() {
        table[count] = 256 * (10 * count as i32 + 2) / (10 * count as i32 + 17);
        count += 1;
    }
    table
};

#[inline(always)]
fn said(slot: u32) -> i32 {
    let one = slot >> (COUNT_BITS + 10);
    (i32::from(STRETCH[one as usize]) * TRUST[(slot & ((1 << COUNT_BITS) - 1)) as usize]) >> 8
}

#[inline(always)]
fn learn_slot(slot: &mut u32, bit: bool) {
    let (one, count) = (*slot >> COUNT_BITS, *slot & ((1 << COUNT_BITS) - 1));
    let rate = u64::from(RATE[count as usize]);
    let one = if bit {
        one + ((u64::from((1 << 22) - 1 - one) * rate) >> 16) as u32
    } else {
        one - ((u64::from(one) * rate) >> 16) as u32
    };
    *slot = one << COUNT_BITS | (count + 1).min(MOST);
}

const NEW: u32 = 1 << (21 + COUNT_BITS);

/// Circumstances of one coefficient of one channel, as numbers of classes.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Circumstances {
    /// 0 to 2: Y, Co, Cg.
    pub channel: usize,
    /// 0 to 6.
    pub slot: usize,
    /// 0 to 2.
    pub axis: usize,
    /// Children of the node, 2 to 8.
    pub children: usize,
    /// |q| of Y and of Co of the same coefficient, up to 3.
    pub luma: usize,
    pub other: usize,
    /// |q| of the same slot in the blocks at x − 1, y − 1 and z − 1, each up to 2, added up: 0 to 6.
    pub beside: usize,
    /// Logarithms of features, in eighths of an octave from about −8: see `block`.
    pub energy: i32,
    pub gradient: i32,
    pub predicted: i32,
    pub block: i32,
    pub parents: i32,
    pub across: i32,
    /// How heavy the join is: 0 to 3.
    pub heavy: usize,
    /// Inputs of the logistic unit.
    pub features: [i32; FEATURES],
    /// Classes of what the sign may follow.
    pub sign: SignCircumstances,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct SignCircumstances {
    /// Classes of the prediction, 0 to 8, and of how both predictions differ.
    pub predicted: usize,
    pub shift: usize,
    /// Signs (0 none, 1 plus, 2 minus) of Y and Co of the same coefficient: luma + 3·other.
    pub others: usize,
    /// Signs of the same slot in three blocks: 0 to 26.
    pub beside: usize,
}

const SIZES: [usize; CONTEXTS] = [
    3 * 7 * 7,
    9 * 9,
    14 * 3 * 4,
    7 * 7 * 4 * 4,
    48,
    4 * 4 * 8 * 7,
    24 * 3 * 4 * 4,
    9 * 9 * 4,
];
const KINDS: usize = 3 * BINS;

const STARTS: [usize; CONTEXTS + 1] = {
    let mut starts = [0; CONTEXTS + 1];
    let mut i = 0;
    while i < CONTEXTS {
        starts[i + 1] = starts[i] + SIZES[i] * KINDS;
        i += 1;
    }
    starts
};
const SIGN_SIZES: [usize; SIGN_CONTEXTS] = [9 * 3, 9 * 7, 27 * 3, 9 * 9];
const SIGN_STARTS: [usize; SIGN_CONTEXTS + 1] = {
    let mut starts = [0; SIGN_CONTEXTS + 1];
    let mut i = 0;
    while i < SIGN_CONTEXTS {
        starts[i + 1] = starts[i] + SIGN_SIZES[i] * 3;
        i += 1;
    }
    starts
};
const UNIT_CLASSES: usize = 12;

/// A class from 0 to `classes − 1` of a logarithm, each `width` eighths of an octave wide.
#[inline(always)]
fn class(log: i32, width: i32, classes: i32) -> usize {
    (log / width).clamp(0, classes - 1) as usize
}

type Lanes = [i32; LANES];

/// What a slice has learned of coefficients.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Model {
    slots: Vec<u32>,
    signs: Vec<u32>,
    /// Weights by kind; by kind and class of the unit's logit; by kind, axis and what other channels are.
    by_kind: Vec<Lanes>,
    by_unit: Vec<Lanes>,
    by_others: Vec<Lanes>,
    sign_weights: [[i32; 8]; 3],
    /// The logistic unit of each channel, and how often it has learned.
    units: [[i32; FEATURES]; 3],
    learned: [u32; 3],
    /// Sums of products of what luma and each chroma brought, for predicting the one from the other.
    pub cross: [Cross; 2],
}

/// How a chroma follows luma.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Cross {
    pub product: i64,
    pub square: i64,
}

/// One prediction of a decision, to be learned from.
pub(super) struct Mixed {
    at: [usize; CONTEXTS],
    inputs: Lanes,
    sets: [usize; 3],
    /// In units of 2⁻¹⁶.
    pub one: u32,
}

impl Model {
    /// Bytes of memory that it takes.
    pub const BYTES: usize = (STARTS[CONTEXTS] + SIGN_STARTS[SIGN_CONTEXTS]) * size_of::<u32>()
        + KINDS * (1 + UNIT_CLASSES + 12) * size_of::<Lanes>()
        + size_of::<Model>();

    /// Nothing, to take the place of one that has been taken out.
    pub fn empty() -> Model {
        Model {
            slots: Vec::new(),
            signs: Vec::new(),
            by_kind: Vec::new(),
            by_unit: Vec::new(),
            by_others: Vec::new(),
            sign_weights: [[0; 8]; 3],
            units: [[0; FEATURES]; 3],
            learned: [0; 3],
            cross: [Cross::default(); 2],
        }
    }

    pub fn new() -> Model {
        let mut weights = [0; LANES];
        weights[..CONTEXTS].fill(6554);
        weights[UNIT] = 6554;
        Model {
            slots: vec![NEW; STARTS[CONTEXTS]],
            signs: vec![NEW; SIGN_STARTS[SIGN_CONTEXTS]],
            by_kind: vec![weights; KINDS],
            by_unit: vec![weights; KINDS * UNIT_CLASSES],
            by_others: vec![weights; KINDS * 12],
            sign_weights: [[24_000, 24_000, 24_000, 24_000, 0, 0, 0, 0]; 3],
            units: [[0; FEATURES]; 3],
            learned: [0; 3],
            cross: [Cross::default(); 2],
        }
    }

    /// The logit that the channel's logistic unit makes of the features.
    #[inline(always)]
    pub fn prepare(&self, c: &Circumstances) -> i32 {
        let sum = self.units[c.channel]
            .iter()
            .zip(c.features)
            .fold(0i32, |sum, (w, x)| sum.wrapping_add(w.wrapping_mul(x)));
        (sum >> 16).clamp(-640, 640)
    }

    /// The probability of decision `bin`, given [`Model::prepare`]'s logit.
    #[inline(always)]
    pub fn predict(&self, c: &Circumstances, unit: i32, bin: usize) -> Mixed {
        let kind = c.channel * BINS + bin;
        let both = usize::from(c.luma > 0) * 2 + usize::from(c.other > 0);
        let fine = ((unit + 640) * 48 / 1281) as usize;
        let places = [
            (c.axis * 7 + c.children - 2) * 7 + c.beside,
            class(c.gradient, 8, 9) * 9 + class(c.predicted, 8, 9),
            (class(c.predicted, 5, 14) * 3 + c.axis) * 4 + c.heavy,
            ((class(c.energy, 8, 7) * 7 + class(c.gradient, 10, 7)) * 4 + c.luma) * 4 + c.other,
            fine,
            ((c.luma * 4 + c.other) * 8 + class(c.block, 8, 8)) * 7 + c.beside,
            ((fine / 2 * 3 + c.axis) * 4 + (c.children - 2).min(3)) * 4 + both,
            (class(c.parents, 8, 9) * 9 + class(c.across, 8, 9)) * 4 + both,
        ];
        let (mut at, mut inputs) = ([0; CONTEXTS], [0; LANES]);
        for i in 0..CONTEXTS {
            at[i] = STARTS[i] + kind * SIZES[i] + places[i];
            inputs[i] = said(self.slots[at[i]]);
        }
        inputs[UNIT] = unit / 2;
        inputs[BIAS] = 64;
        let sets = [kind, kind * UNIT_CLASSES + fine / 4, kind * 12 + c.axis * 4 + both];
        let weights = [&self.by_kind[sets[0]], &self.by_unit[sets[1]], &self.by_others[sets[2]]];
        let mut sum = 0i32;
        for lane in 0..LANES {
            let weight = weights[0][lane] + weights[1][lane] + weights[2][lane];
            sum = sum.wrapping_add(weight.wrapping_mul(inputs[lane]));
        }
        let one = squash(sum >> 16).clamp(24, ONE - 24);
        Mixed { at, inputs, sets, one }
    }

    #[inline(always)]
    fn learn(&mut self, mixed: &Mixed, bit: bool) {
        let error = if bit { ONE as i32 } else { 0 } - mixed.one as i32;
        for at in mixed.at {
            learn_slot(&mut self.slots[at], bit);
        }
        let sets = [
            &mut self.by_kind[mixed.sets[0]],
            &mut self.by_unit[mixed.sets[1]],
            &mut self.by_others[mixed.sets[2]],
        ];
        for weights in sets {
            for (weight, input) in weights.iter_mut().zip(mixed.inputs) {
                let step = (error * input * LEARN + (1 << 15)) >> 16;
                *weight = (*weight + step).clamp(-HEAVIEST, HEAVIEST);
            }
        }
    }

    #[inline(always)]
    fn learn_unit(&mut self, c: &Circumstances, unit: i32, bit: bool) {
        let t = c.channel;
        let error = if bit { ONE as i32 } else { 0 } - squash(unit) as i32;
        self.learned[t] = (self.learned[t] + 1).min(1 << 12);
        let rate = UNIT_RATE + (UNIT_FAST >> (self.learned[t] >> 6).min(12));
        for (weight, x) in self.units[t].iter_mut().zip(c.features) {
            *weight += ((error >> 4) * x * rate) >> 8;
            *weight = (*weight).clamp(-(1 << 20), 1 << 20);
        }
    }

    #[inline(always)]
    fn sign_places(c: &Circumstances) -> [usize; SIGN_CONTEXTS] {
        let s = &c.sign;
        let places = [
            s.predicted * 3 + c.axis,
            s.others * 7 + c.slot,
            s.beside * 3 + c.axis,
            s.shift * 9 + s.predicted,
        ];
        let mut at = [0; SIGN_CONTEXTS];
        for i in 0..SIGN_CONTEXTS {
            at[i] = SIGN_STARTS[i] + c.channel * SIGN_SIZES[i] + places[i];
        }
        at
    }

    #[inline(always)]
    fn sign<C: Coder>(&mut self, coder: &mut C, c: &Circumstances, negative: bool) -> bool {
        let at = Model::sign_places(c);
        let mut inputs = [0; SIGN_CONTEXTS];
        for i in 0..SIGN_CONTEXTS {
            inputs[i] = said(self.signs[at[i]]);
        }
        let weights = &mut self.sign_weights[c.channel];
        let sum = (0..SIGN_CONTEXTS).fold(0i32, |sum, i| sum.wrapping_add(weights[i] * inputs[i]));
        let one = squash(sum >> 16).clamp(24, ONE - 24);
        let bit = coder.code(negative, one);
        let error = if bit { ONE as i32 } else { 0 } - one as i32;
        for i in 0..SIGN_CONTEXTS {
            let step = (error * inputs[i] * 10 + (1 << 15)) >> 16;
            weights[i] = (weights[i] + step).clamp(-HEAVIEST, HEAVIEST);
            learn_slot(&mut self.signs[at[i]], bit);
        }
        bit
    }

    /// Codes a coefficient: an encoder `value`, a decoder what it reads.
    #[inline(always)]
    pub fn code<C: Coder>(&mut self, coder: &mut C, c: &Circumstances, value: i32) -> i32 {
        let unit = self.prepare(c);
        let wanted = value.abs();
        let mut magnitude = 0;
        while magnitude < ESCAPE {
            let bin = (magnitude as usize).min(BINS - 1);
            let mixed = self.predict(c, unit, bin);
            let more = coder.code(wanted > magnitude, mixed.one);
            self.learn(&mixed, more);
            if magnitude == 0 {
                self.learn_unit(c, unit, more);
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

/// Learning rates, in units that [`Model::learn`] and [`Model::learn_unit`] tell.
const LEARN: i32 = 7;
const UNIT_RATE: i32 = 4;
const UNIT_FAST: i32 = 64;

/// Codes a number from 0 on as an Exp-Golomb code of even decisions.
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
