//! Adaptive probabilities of vectors and modes (`docs/format.md`, clauses 17.5.2 to 17.5.4, 17.9 and 17.10.3).

use super::payload::{Modes, malformed};
use crate::coding::binary::Coder;
use crate::error::Result;
use crate::geometry::codec::guide::Mode;
use crate::geometry::morton;

/// Magnitudes from here on have an escape.
const ESCAPE: usize = 14;

/// A probability that adapts.
#[derive(Debug, Clone, Copy)]
struct Bit {
    one: u16,
    /// Decisions so far, up to [`MOST`]; [`UNCOUNTED`] where all change the probability alike.
    count: u8,
}

/// Decisions that are counted.
const MOST: u8 = 30;
const UNCOUNTED: u8 = u8::MAX;

impl Bit {
    fn code(&mut self, coder: &mut impl Coder, bit: bool) -> bool {
        let bit = coder.code(bit, u32::from(self.one).clamp(256, 65_280));
        let target = if bit { u16::MAX } else { 0 };
        if self.count == UNCOUNTED {
            self.one = match bit {
                true => self.one + ((target - self.one) >> 4),
                false => self.one - (self.one >> 4),
            };
            return bit;
        }
        let change = 2 * (i32::from(target) - i32::from(self.one)) / (2 * i32::from(self.count) + 3);
        self.one = (i32::from(self.one) + change) as u16;
        self.count = MOST.min(self.count + 1);
        bit
    }
}

/// Probabilities of a component: whether it differs, its sign, and whether its magnitude is greater.
type Component = [Bit; 2 + ESCAPE];

/// Adaptive probabilities of a frame's motion.
pub(super) struct Models {
    /// Whether decisions are counted and modes follow from both kinds above, as where blocks are divided.
    counted: bool,
    /// Whether a vector differs from its prediction, by whether the one before did, and by how sure the prediction is.
    differs: [[Bit; 3]; 2],
    /// Whether it is each of the vectors around it, where blocks are divided.
    alike: [Bit; NEARBY],
    /// Components of the difference.
    component: [Component; 3],
    /// Whether a mode is not 0, and then whether it is 2: by kind, by the modes that it follows from, and by that of the
    /// block before.
    modes: [[[[Bit; 2]; 3]; 12]; 2],
    /// Whether parts of a block have other vectors, by how many there are, and by whether those of the block before have.
    several: [[Bit; 2]; 4],
    /// Whether a part of such a block has another vector than the block, by what the part before has.
    other: [Bit; 3],
    /// Whether it is each of the vectors near it.
    same: [Bit; NEARBY],
    /// Components of the difference if it is none of them.
    apart: [Component; 3],
    /// Whether the vector of a corner of a lattice differs from its prediction, by its level and by those near it, and
    /// components of the difference.
    bends: [[Bit; 3]; 3],
    bend: [[Component; 3]; 3],
}

/// Vectors around a block, and near a part, that it may have.
const NEARBY: usize = 6;

/// Divided blocks and their vectors.
#[derive(Debug, Clone, Copy)]
pub struct Groups<'a> {
    keys: &'a [u64],
    vectors: &'a [[i16; 3]],
}

impl<'a> Groups<'a> {
    /// The blocks `keys` with these vectors.
    pub fn new(keys: &'a [u64], vectors: &'a [[i16; 3]]) -> Self {
        Groups { keys, vectors }
    }

    /// The vector of a block.
    pub fn vector(&self, block: usize) -> [i16; 3] {
        self.vectors[block]
    }

    /// The numbers of the blocks of these parts, both in the order of keys.
    pub fn of(self, parts: &[u64]) -> impl Iterator<Item = usize> {
        let mut block = 0;
        parts.iter().map(move |part| {
            while block + 1 < self.keys.len() && self.keys[block] < part >> 3 {
                block += 1;
            }
            block
        })
    }

    /// Vectors that are likely for a part which has not that of its block: of the parts `before` it in the block, then of
    /// the blocks that touch it. Each is there once, at most [`NEARBY`].
    pub fn nearby(&self, block: usize, part: u64, before: &[[i16; 3]]) -> Vec<[i16; 3]> {
        let mut found: Vec<[i16; 3]> = Vec::new();
        let mut add = |vector: [i16; 3]| {
            if vector != self.vectors[block] && !found.contains(&vector) && found.len() < NEARBY {
                found.push(vector);
            }
        };
        before.iter().rev().for_each(|vector| add(*vector));
        let at = morton::decode(self.keys[block]).map(|x| x as i32);
        // Faces before edges and corners.
        for steps in [1, 2, 4, 3, 5, 6, 7] {
            let place = [0, 1, 2].map(|axis| {
                let side = if part >> axis & 1 == 1 { 1 } else { -1 };
                at[axis] + if steps >> axis & 1 == 1 { side } else { 0 }
            });
            if place.iter().all(|x| *x >= 0)
                && let Ok(other) = self.keys.binary_search(&morton::encode(place.map(|x| x as u32)))
            {
                add(self.vectors[other]);
            }
        }
        found
    }
}

impl Models {
    pub fn new(counted: bool) -> Self {
        let even = Bit {
            one: 1 << 15,
            count: if counted { 0 } else { UNCOUNTED },
        };
        Models {
            counted,
            differs: [[even; 3]; 2],
            alike: [even; NEARBY],
            component: [[even; 2 + ESCAPE]; 3],
            modes: [[[[even; 2]; 3]; 12]; 2],
            several: [[even; 2]; 4],
            other: [even; 3],
            same: [even; NEARBY],
            apart: [[even; 2 + ESCAPE]; 3],
            bends: [[even; 3]; 3],
            bend: [[[even; 2 + ESCAPE]; 3]; 3],
        }
    }

    /// Codes the vectors of the blocks `keys`; the first is predicted by `start`.
    pub fn code_vectors(
        &mut self,
        coder: &mut impl Coder,
        start: [i16; 3],
        keys: &[u64],
        vectors: &mut [[i16; 3]],
    ) -> Result<()> {
        let mut differed = false;
        for i in 0..keys.len() {
            let target = vectors[i];
            let (predicted, sure) = predicted(keys, &vectors[..i], start);
            differed = self.differs[usize::from(differed)][sure].code(coder, target != predicted);
            vectors[i] = predicted;
            if !differed {
                continue;
            }
            let around = if self.counted {
                around(keys, &vectors[..i], predicted)
            } else {
                Vec::new()
            };
            vectors[i] = match code_same(&mut self.alike, coder, &around, target) {
                Some(vector) => vector,
                None => code_difference(&mut self.component, coder, predicted, target)?,
            };
        }
        Ok(())
    }

    /// Codes the vectors of the parts `keys` of `blocks`.
    pub fn code_parts(
        &mut self,
        coder: &mut impl Coder,
        blocks: Groups,
        keys: &[u64],
        vectors: &mut [[i16; 3]],
    ) -> Result<()> {
        let numbers: Vec<usize> = blocks.of(keys).collect();
        let (mut first, mut several) = (0, false);
        for numbers in numbers.chunk_by(|a, b| a == b) {
            let (block, parts) = (numbers[0], first..first + numbers.len());
            first = parts.end;
            let common = blocks.vectors[block];
            let differ = vectors[parts.clone()].iter().any(|vector| *vector != common);
            several = self.several[numbers.len().min(4) - 1][usize::from(several)].code(coder, differ);
            if several {
                self.code_block(coder, (blocks, block), &keys[parts.clone()], &mut vectors[parts])?;
            } else {
                vectors[parts].fill(common);
            }
        }
        Ok(())
    }

    /// Codes the vectors of the parts `keys` of a block, of which some have another than the block.
    fn code_block(
        &mut self,
        coder: &mut impl Coder,
        (blocks, block): (Groups, usize),
        keys: &[u64],
        vectors: &mut [[i16; 3]],
    ) -> Result<()> {
        let common = blocks.vectors[block];
        let mut before = 0;
        for part in 0..keys.len() {
            let target = vectors[part];
            let other = self.other[before].code(coder, target != common);
            before = 1 + usize::from(other);
            if !other {
                vectors[part] = common;
                continue;
            }
            let nearby = blocks.nearby(block, keys[part], &vectors[..part]);
            vectors[part] = match code_same(&mut self.same, coder, &nearby, target) {
                Some(vector) => vector,
                None => code_difference(&mut self.apart, coder, common, target)?,
            };
        }
        Ok(())
    }

    /// Codes the vector of a corner of a lattice.
    pub fn code_corner(
        &mut self,
        coder: &mut impl Coder,
        [kind, near]: [usize; 2],
        predicted: [i16; 3],
        target: [i16; 3],
    ) -> Result<[i16; 3]> {
        match self.bends[kind][near].code(coder, target != predicted) {
            true => code_difference(&mut self.bend[kind], coder, predicted, target),
            false => Ok(predicted),
        }
    }

    /// Codes the modes of all blocks at a level. `above` are those at the level above, if they have some.
    pub fn code_modes(&mut self, coder: &mut impl Coder, above: Option<&[Modes]>, modes: &mut [Modes]) -> Result<()> {
        let mut before = Modes::default();
        for (i, modes) in modes.iter_mut().enumerate() {
            let [geometry, colours] =
                above.map_or([3, 3], |above| [above[i].geometry as usize, above[i].colours as usize]);
            // Modes follow from both modes above, and those of colours from that of occupancies, too.
            let context = if !self.counted || above.is_none() {
                geometry
            } else {
                geometry + 4 * colours
            };
            let geometry = self.code_mode(coder, [0, context, before.geometry as usize], modes.geometry);
            let context = if self.counted {
                colours + 4 * (geometry as usize)
            } else {
                colours
            };
            let colours = self.code_mode(coder, [1, context, before.colours as usize], modes.colours);
            *modes = Modes { geometry, colours };
            before = *modes;
        }
        Ok(())
    }

    fn code_mode(&mut self, coder: &mut impl Coder, [kind, context, before]: [usize; 3], mode: Mode) -> Mode {
        let [some, skip] = &mut self.modes[kind][context][before];
        if !some.code(coder, mode != Mode::Intra) {
            return Mode::Intra;
        }
        match skip.code(coder, mode == Mode::Skip) {
            true => Mode::Skip,
            false => Mode::Inter,
        }
    }
}

/// Vectors of the blocks before a block that touch it, other than `predicted`: of those at faces, then at edges, then at
/// corners. Each is there once, at most [`NEARBY`].
fn around(keys: &[u64], vectors: &[[i16; 3]], predicted: [i16; 3]) -> Vec<[i16; 3]> {
    let at = morton::decode(keys[vectors.len()]).map(|x| x as i32);
    let mut found: Vec<[i16; 3]> = Vec::new();
    for touching in 1..=3 {
        for step in 0..27 {
            let step = [step / 9 - 1, step / 3 % 3 - 1, step % 3 - 1];
            let place = [0, 1, 2].map(|axis| at[axis] + step[axis]);
            if step.iter().filter(|x| **x != 0).count() != touching || place.iter().any(|x| *x < 0) {
                continue;
            }
            let key = morton::encode(place.map(|x| x as u32));
            if let Ok(i) = keys[..vectors.len()].binary_search(&key)
                && vectors[i] != predicted
                && !found.contains(&vectors[i])
                && found.len() < NEARBY
            {
                found.push(vectors[i]);
            }
        }
    }
    found
}

/// Codes which of these vectors one is. `None` if it is none of them.
fn code_same(models: &mut [Bit], coder: &mut impl Coder, vectors: &[[i16; 3]], target: [i16; 3]) -> Option<[i16; 3]> {
    let mut both = vectors.iter().zip(models);
    both.find_map(|(vector, same)| same.code(coder, *vector == target).then_some(*vector))
}

/// Codes a vector as its difference from another one.
fn code_difference(
    models: &mut [Component; 3],
    coder: &mut impl Coder,
    from: [i16; 3],
    target: [i16; 3],
) -> Result<[i16; 3]> {
    let mut found = from;
    for axis in 0..3 {
        let difference = i32::from(target[axis]) - i32::from(from[axis]);
        let difference = code_component(&mut models[axis], coder, difference)?;
        let sum = i16::try_from(i32::from(from[axis]) + difference);
        found[axis] = sum.map_err(|_| malformed("17.5.3", "motion vector", difference, "a sum of 16 bits"))?;
    }
    Ok(found)
}

fn code_component(model: &mut Component, coder: &mut impl Coder, value: i32) -> Result<i32> {
    let [differs, sign, more @ ..] = model;
    if !differs.code(coder, value != 0) {
        return Ok(0);
    }
    let negative = sign.code(coder, value < 0);
    let target = value.unsigned_abs();
    let mut magnitude = 1u32;
    for bit in more.iter_mut() {
        if !bit.code(coder, target > magnitude) {
            break;
        }
        magnitude += 1;
    }
    if magnitude == 1 + ESCAPE as u32 {
        magnitude += code_escape(coder, target.saturating_sub(magnitude))?;
    }
    Ok(if negative {
        -(magnitude as i32)
    } else {
        magnitude as i32
    })
}

/// The prediction of a block's vector from those before it, `vectors`, and how sure it is: 0 if no neighbour is there, 1
/// if neighbours differ, 2 if all are alike. Blocks are those of the nodes `keys`. The prediction is the median of the
/// neighbours before along each axis; of two of them it is the first, and of none the vector before, or `start`.
pub fn predicted(keys: &[u64], vectors: &[[i16; 3]], start: [i16; 3]) -> ([i16; 3], usize) {
    let at = morton::decode(keys[vectors.len()]);
    let mut around = [[0; 3]; 3];
    let mut count = 0;
    for axis in 0..3 {
        let mut place = at;
        let Some(before) = place[axis].checked_sub(1) else {
            continue;
        };
        place[axis] = before;
        // All of them have lower keys.
        if let Ok(i) = keys[..vectors.len()].binary_search(&morton::encode(place)) {
            around[count] = vectors[i];
            count += 1;
        }
    }
    let alike = around[..count].iter().all(|vector| *vector == around[0]);
    let median = |axis: usize| {
        let [a, b, c] = around.map(|vector: [i16; 3]| vector[axis]);
        a.max(b).min(a.min(b).max(c))
    };
    let vector = match count {
        0 => vectors.last().copied().unwrap_or(start),
        3 => [0, 1, 2].map(median),
        _ => around[0],
    };
    (vector, if count == 0 { 0 } else { 1 + usize::from(alike) })
}

/// Codes a number of up to 16 bits: one less than the bits of the number and 1, then these bits, all even.
fn code_escape(coder: &mut impl Coder, value: u32) -> Result<u32> {
    let target = value + 1;
    let mut bits = 0;
    while coder.code(target >> (bits + 1) != 0, 1 << 15) {
        bits += 1;
        if bits > 16 {
            return Err(malformed(
                "17.5.3",
                "escape of a motion vector",
                "17 bits",
                "at most 16",
            ));
        }
    }
    let mut number = 1u32;
    for bit in (0..bits).rev() {
        number = 2 * number + u32::from(coder.code(target >> bit & 1 == 1, 1 << 15));
    }
    Ok(number - 1)
}
