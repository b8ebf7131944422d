//! What a predicted frame says of its blocks, as bytes (`docs/format.md`, clause 17.5).

use super::moved::REACH;
use crate::coding::binary::{Coder, Decoder};
use crate::error::{Error, Result, Stage};
use crate::geometry::codec::guide::Mode;
use crate::geometry::morton;
use crate::limits::MAX_DEPTH;

/// Modes of a block at a level.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Modes {
    /// How its occupancies are predicted.
    pub geometry: Mode,
    /// How its colours are.
    pub colours: Mode,
}

/// The fixed fields at the start of a frame's motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Head {
    /// B: the blocks are the nodes of this level.
    pub block_level: u8,
    /// U: vectors are in voxels of this level.
    pub unit_level: u8,
    /// R: the levels after B and before this one are predicted from the moved previous frame of level R, all others
    /// from their own.
    pub reference_level: u8,
    /// Modes of the levels 1 to B.
    pub root: Modes,
    /// Vector of the levels 1 to B.
    pub vector: [i16; 3],
}

/// Vectors and modes of the blocks.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Blocks {
    /// The vector of each block.
    pub vectors: Vec<[i16; 3]>,
    /// The modes of each block at the levels B + 1, B + 2, …
    pub modes: Vec<Vec<Modes>>,
}

/// Bytes of a head.
const HEAD: usize = 10;
/// Magnitudes from here on have an escape.
const ESCAPE: usize = 14;

/// How errors name the motion of a level, whose place in the file is not known here.
const PLACE: &str = "motion of level ";

fn malformed(clause: &'static str, field: &'static str, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Bitstream, "motion of the frame", field, value, expected).breaks(clause)
}

/// The same error as one of the motion of this level.
pub(crate) fn of_level(error: Error, level: u8) -> Error {
    match error {
        Error::Malformed {
            field,
            value,
            expected,
            clause,
            ..
        } => Error::Malformed {
            stage: Stage::Bitstream,
            at: format!("{PLACE}{level}"),
            field,
            value,
            expected,
            clause,
        },
        error => error,
    }
}

/// The level whose motion an error blames.
pub(crate) fn level_of(error: &Error) -> Option<u8> {
    match error {
        Error::Malformed { at, .. } => at.strip_prefix(PLACE)?.parse().ok(),
        _ => None,
    }
}

fn mode_of(code: u8) -> Option<Mode> {
    [Mode::Intra, Mode::Inter, Mode::Skip].get(usize::from(code)).copied()
}

impl Head {
    /// Reads the head of a frame of the levels `base` to `top`. Returns it with the bytes behind it.
    ///
    /// # Errors
    /// [`Error::Malformed`].
    pub fn parse(bytes: &[u8], base: u8, top: u8) -> Result<(Head, &[u8])> {
        Self::parsed(bytes, base, top).map_err(|error| of_level(error, base))
    }

    fn parsed(bytes: &[u8], base: u8, top: u8) -> Result<(Head, &[u8])> {
        let Some((head, rest)) = bytes.split_at_checked(HEAD) else {
            let value = format!("{} bytes", bytes.len());
            return Err(malformed("17.5.1", "length of the motion", value, "10 or more"));
        };
        let (block_level, unit_level) = (head[0], head[1]);
        if block_level > base {
            return Err(malformed(
                "17.5.1",
                "level of the blocks",
                block_level,
                format!("at most {base}"),
            ));
        }
        if !(top..=MAX_DEPTH).contains(&unit_level) {
            let expected = format!("{top} to {MAX_DEPTH}");
            return Err(malformed("17.5.1", "level of the vectors", unit_level, expected));
        }
        let reference_level = head[2];
        let deepest = top.min(block_level + REACH);
        if !(block_level..=deepest).contains(&reference_level) {
            let expected = format!("{block_level} to {deepest}");
            return Err(malformed("17.5.1", "reference level", reference_level, expected));
        }
        let modes = (mode_of(head[3] & 15), mode_of(head[3] >> 4));
        let (Some(geometry), Some(colours)) = modes else {
            return Err(malformed(
                "17.5.1",
                "modes of the frame",
                head[3],
                "0 to 2 in each half",
            ));
        };
        let component = |i: usize| i16::from_le_bytes([head[4 + 2 * i], head[5 + 2 * i]]);
        let head = Head {
            block_level,
            unit_level,
            reference_level,
            root: Modes { geometry, colours },
            vector: [0, 1, 2].map(component),
        };
        head.check(head.vector)?;
        Ok((head, rest))
    }

    /// The head as bytes.
    pub fn to_bytes(self) -> Vec<u8> {
        let mut bytes = vec![
            self.block_level,
            self.unit_level,
            self.reference_level,
            self.root.geometry as u8 | (self.root.colours as u8) << 4,
        ];
        bytes.extend(self.vector.iter().flat_map(|x| x.to_le_bytes()));
        bytes
    }

    /// Checks that a vector is not longer than the cube along any axis.
    fn check(&self, vector: [i16; 3]) -> Result<()> {
        let side = 1i32 << self.unit_level;
        match vector.iter().all(|x| i32::from(*x).abs() <= side) {
            true => Ok(()),
            false => {
                let (value, expected) = (format!("{vector:?}"), format!("−{side} to {side}"));
                Err(malformed("17.5.3", "motion vector", value, expected))
            }
        }
    }

    /// Reads vectors and modes of the blocks `keys`: `parts` are the bytes behind the head, then those of each level
    /// after `base`.
    ///
    /// # Errors
    /// [`Error::Malformed`].
    pub fn blocks(&self, base: u8, keys: &[u64], parts: &[&[u8]]) -> Result<Blocks> {
        let count = keys.len();
        let mut blocks = Blocks::default();
        let mut models = Models::new();
        for (level, part) in (base..).zip(parts) {
            let mut read = || {
                let mut coder = Decoder::new(part);
                let levels = if level == base { base - self.block_level } else { 1 };
                if level == base {
                    let mut vectors = vec![[0; 3]; count];
                    models.code_vectors(&mut coder, self.vector, keys, &mut vectors)?;
                    for vector in &vectors {
                        self.check(*vector)?;
                    }
                    blocks.vectors = vectors;
                }
                for _ in 0..levels {
                    let mut modes = vec![Modes::default(); count];
                    models.code_modes(&mut coder, blocks.modes.last().map(Vec::as_slice), &mut modes)?;
                    blocks.modes.push(modes);
                }
                coder.finish(PLACE)
            };
            read().map_err(|error| of_level(error, level))?;
        }
        Ok(blocks)
    }

    /// The motion of the level `base` and of each level after it, as bytes.
    ///
    /// # Errors
    /// [`Error::Malformed`] if a number has no code.
    #[cfg(feature = "encoder")]
    pub fn write(&self, base: u8, keys: &[u64], blocks: &Blocks) -> Result<Vec<Vec<u8>>> {
        let first = usize::from(base - self.block_level);
        let mut models = Models::new();
        let mut parts = Vec::new();
        let mut above: Option<&[Modes]> = None;
        for part in 0..=blocks.modes.len() - first {
            let mut coder = crate::coding::binary::Encoder::default();
            if part == 0 {
                models.code_vectors(&mut coder, self.vector, keys, &mut blocks.vectors.clone())?;
            }
            let levels = if part == 0 {
                0..first
            } else {
                first + part - 1..first + part
            };
            for modes in &blocks.modes[levels] {
                models.code_modes(&mut coder, above, &mut modes.clone())?;
                above = Some(modes);
            }
            let mut bytes = if part == 0 { self.to_bytes() } else { Vec::new() };
            bytes.extend(coder.finish());
            parts.push(bytes);
        }
        Ok(parts)
    }
}

/// A probability that adapts.
#[derive(Debug, Clone, Copy)]
struct Bit(u16);

impl Bit {
    fn code(&mut self, coder: &mut impl Coder, bit: bool) -> bool {
        let bit = coder.code(bit, u32::from(self.0).clamp(256, 65_280));
        self.0 = match bit {
            true => self.0 + ((u16::MAX - self.0) >> 4),
            false => self.0 - (self.0 >> 4),
        };
        bit
    }
}

/// Adaptive probabilities of a frame's motion.
struct Models {
    /// Whether a vector differs from its prediction, by whether the one before did, and by how sure the prediction is.
    differs: [[Bit; 3]; 2],
    /// Of a component: whether it differs, its sign, and whether its magnitude is greater.
    component: [[Bit; 2 + ESCAPE]; 3],
    /// Whether a mode is not 0, and then whether it is 2: by kind, mode at the level above, and mode of the block before.
    modes: [[[[Bit; 2]; 3]; 4]; 2],
}

impl Models {
    fn new() -> Self {
        let even = Bit(1 << 15);
        Models {
            differs: [[even; 3]; 2],
            component: [[even; 2 + ESCAPE]; 3],
            modes: [[[[even; 2]; 3]; 4]; 2],
        }
    }

    /// Codes the vectors of the blocks `keys`, each from those of its neighbours, the first from `vector`.
    fn code_vectors(
        &mut self,
        coder: &mut impl Coder,
        vector: [i16; 3],
        keys: &[u64],
        vectors: &mut [[i16; 3]],
    ) -> Result<()> {
        let mut differed = false;
        for i in 0..keys.len() {
            let (predicted, sure) = predicted(keys, &vectors[..i], vector);
            let target = vectors[i];
            differed = self.differs[usize::from(differed)][sure].code(coder, target != predicted);
            let mut found = predicted;
            if differed {
                for axis in 0..3 {
                    let difference = i32::from(target[axis]) - i32::from(predicted[axis]);
                    let difference = self.code_component(coder, axis, difference)?;
                    let sum = i16::try_from(i32::from(predicted[axis]) + difference);
                    found[axis] =
                        sum.map_err(|_| malformed("17.5.3", "motion vector", difference, "a sum of 16 bits"))?;
                }
            }
            vectors[i] = found;
        }
        Ok(())
    }

    fn code_component(&mut self, coder: &mut impl Coder, axis: usize, value: i32) -> Result<i32> {
        let [differs, sign, more @ ..] = &mut self.component[axis];
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

    /// Codes the modes of all blocks at a level. `above` are those at the level above, if they have some.
    fn code_modes(&mut self, coder: &mut impl Coder, above: Option<&[Modes]>, modes: &mut [Modes]) -> Result<()> {
        let mut before = Modes::default();
        for (i, modes) in modes.iter_mut().enumerate() {
            let above = above.map(|above| above[i]);
            let mut code = |kind: usize, above: Option<Mode>, before: Mode, mode: Mode| {
                let above = above.map_or(3, |mode| mode as usize);
                let [some, skip] = &mut self.modes[kind][above][before as usize];
                if !some.code(coder, mode != Mode::Intra) {
                    return Mode::Intra;
                }
                match skip.code(coder, mode == Mode::Skip) {
                    true => Mode::Skip,
                    false => Mode::Inter,
                }
            };
            *modes = Modes {
                geometry: code(0, above.map(|m| m.geometry), before.geometry, modes.geometry),
                colours: code(1, above.map(|m| m.colours), before.colours, modes.colours),
            };
            before = *modes;
        }
        Ok(())
    }
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

#[cfg(all(test, feature = "encoder"))]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn head(block_level: u8) -> Head {
        Head {
            block_level,
            unit_level: 12,
            reference_level: block_level + 1,
            root: Modes {
                geometry: Mode::Skip,
                colours: Mode::Inter,
            },
            vector: [0, -3, 4096],
        }
    }

    fn modes() -> impl Strategy<Value = Modes> {
        (0u8..3, 0u8..3).prop_map(|(geometry, colours)| Modes {
            geometry: mode_of(geometry).unwrap_or_default(),
            colours: mode_of(colours).unwrap_or_default(),
        })
    }

    proptest! {
        #[test]
        fn motion_is_read_as_it_was_written(
            vectors in prop::collection::vec(prop::array::uniform3(-4096i16..=4096), 1..40),
            all in prop::collection::vec(prop::collection::vec(modes(), 40), 2..6),
        ) {
            let (base, top) = (6, 6 + all.len() as u8 - 2);
            let head = head(4);
            let modes = all.iter().map(|modes| modes[..vectors.len()].to_vec()).collect();
            let vectors_len = vectors.len();
            let blocks = Blocks { vectors, modes };
            let keys: Vec<u64> = (0..vectors_len as u64).map(|i| i * i / 2 + i).collect();
            let parts = head.write(base, &keys, &blocks).unwrap();
            prop_assert_eq!(parts.len(), usize::from(top - base) + 1);
            let (read, first) = Head::parse(&parts[0], base, top).unwrap();
            prop_assert_eq!(read, head);
            let mut behind: Vec<&[u8]> = parts.iter().map(Vec::as_slice).collect();
            behind[0] = first;
            prop_assert_eq!(read.blocks(base, &keys, &behind).unwrap(), blocks);
        }

        #[test]
        fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..80), count in 1usize..50) {
            if let Ok((head, rest)) = Head::parse(&bytes, 6, 9)
                && let Ok(blocks) = head.blocks(6, &(0..count as u64).collect::<Vec<_>>(), &[rest])
            {
                prop_assert_eq!(blocks.vectors.len(), count);
            }
        }
    }

    #[test]
    fn vectors_longer_than_the_cube_and_levels_out_of_range_are_refused() {
        let clause = |head: Head| {
            let parsed = Head::parse(&head.to_bytes(), 6, 9).map(|(head, _)| head);
            parsed.map_err(|error| error.clause())
        };
        assert!(clause(head(6)).is_ok());
        assert_eq!(clause(head(7)).err(), Some(Some("17.5.1")));
        let far = Head {
            vector: [0, 0, 4097],
            ..head(5)
        };
        assert_eq!(clause(far).err(), Some(Some("17.5.3")));
        for unit_level in [8, 22] {
            let other = Head { unit_level, ..head(5) };
            assert_eq!(clause(other).err(), Some(Some("17.5.1")));
        }
        for reference_level in [4, 10] {
            let other = Head {
                reference_level,
                ..head(5)
            };
            assert_eq!(clause(other).err(), Some(Some("17.5.1")));
        }
        let short = Head::parse(&[0; 9], 6, 9).expect_err("too short");
        assert_eq!(short.clause(), Some("17.5.1"));
    }
}
