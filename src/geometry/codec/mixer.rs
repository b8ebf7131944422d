//! Adaptive probabilities, mixed in the logistic domain. Integers only.

/// Models that are mixed.
pub(super) const MODELS: usize = 7;

/// `round(4096 / (1 + e^(−x)))` for x = −8, −7.5, …, 8, kept inside 1..=4095.
const LOGISTIC: [i32; 33] = [
    1, 2, 4, 6, 10, 17, 28, 45, 74, 120, 194, 311, 488, 747, 1102, 1546, 2048, 2550, 2994, 3349,
    3608, 3785, 3902, 3976, 4022, 4051, 4068, 4079, 4086, 4090, 4092, 4094, 4095,
];

/// The logistic function of `x / 256`, in units of 1/4096, between neighbouring entries of [`LOGISTIC`] in a straight line.
fn squash(x: i32) -> i32 {
    let x = x.clamp(-2047, 2047) + 2048;
    let (i, part) = ((x >> 7) as usize, x & 127);
    (LOGISTIC[i] * (128 - part) + LOGISTIC[i + 1] * part + 64) >> 7
}

/// The inverse of [`squash`]: for every probability in units of 1/4096 the least `x` whose logistic reaches it.
pub(super) struct Stretch(Box<[i16; 4096]>);

impl Stretch {
    pub fn new() -> Self {
        let mut table = Box::new([0; 4096]);
        let mut next = 0;
        for x in -2047..=2047 {
            let p = squash(x) as usize;
            for entry in &mut table[next.min(p + 1)..=p] {
                *entry = x as i16;
            }
            next = next.max(p + 1);
        }
        for entry in &mut table[next..] {
            *entry = 2047;
        }
        Stretch(table)
    }

    fn of(&self, p: u32) -> i32 {
        self.0[(p >> 4) as usize].into()
    }
}

/// A probability that learns: 22 bits of it, and 10 bits that count what it saw.
#[derive(Clone, Copy)]
pub(super) struct Counter(u32);

impl Counter {
    pub const START: Counter = Counter(1 << 31);
    /// From this count on it forgets as fast as it learns.
    const LIMIT: u32 = 160;

    /// In units of 1/65536.
    fn probability(self) -> u32 {
        self.0 >> 16
    }

    fn learn(&mut self, bit: bool, reciprocals: &[u32]) {
        let (count, p) = (self.0 & 1023, (self.0 >> 10) as i64);
        let target = if bit { (1 << 22) - 1 } else { 0 };
        let p = p + (((target - p) * i64::from(reciprocals[count as usize])) >> 16);
        self.0 = (p as u32) << 10
            | if count < Self::LIMIT {
                count + 1
            } else {
                count
            };
    }
}

/// Predicts bits from the counters of their contexts, and learns from them.
pub(super) struct Mixer {
    stretch: Stretch,
    reciprocals: Vec<u32>,
    counters: Vec<Counter>,
    weights: Vec<[i32; MODELS]>,
}

impl Mixer {
    /// `contexts` counters in all, and `sets` sets of weights.
    pub fn new(contexts: usize, sets: usize) -> Self {
        Mixer {
            stretch: Stretch::new(),
            // 1 / (n + 1.5), in units of 2^-16.
            reciprocals: (0..=Counter::LIMIT)
                .map(|n| (1 << 17) / (2 * n + 3))
                .collect(),
            counters: vec![Counter::START; contexts],
            weights: vec![[(1 << 16) * 2 / 7; MODELS]; sets],
        }
    }

    /// Passes `code` the probability of a 1, in units of 1/65536, and learns from the bit it gives back.
    #[inline]
    pub fn bit(
        &mut self,
        contexts: &[usize; MODELS],
        set: usize,
        code: impl FnOnce(u32) -> bool,
    ) -> bool {
        let inputs: [i32; MODELS] =
            std::array::from_fn(|m| self.stretch.of(self.counters[contexts[m]].probability()));
        let weights = &mut self.weights[set];
        let dot: i64 = inputs
            .iter()
            .zip(weights.iter())
            .map(|(&i, &w)| i64::from(i) * i64::from(w))
            .sum();
        let p = squash((dot >> 16).clamp(-2047, 2047) as i32);
        let bit = code((p as u32 * 16).clamp(16, 65_520));
        let error = ((i32::from(bit) << 12) - p) * 12;
        for (weight, input) in weights.iter_mut().zip(inputs) {
            *weight += (input * error + (1 << 15)) >> 16;
        }
        for &context in contexts {
            self.counters[context].learn(bit, &self.reciprocals);
        }
        bit
    }
}
