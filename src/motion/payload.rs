//! What a predicted frame says of its motion, as bytes (`docs/format.md`, clauses 17.5 and 17.10.1).

use super::lattice::DEPTHS;
#[cfg(feature = "encoder")]
use super::lattice::Lattice;
use super::models::{Groups, Models};
use super::moved::REACH;
use super::warp::LEAST;
use crate::coding::binary::Decoder;
use crate::container::Reader;
#[cfg(feature = "encoder")]
use crate::container::put_varint;
use crate::error::{Error, Result, Stage};
use crate::geometry::codec::guide::Mode;
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
    /// Whether the nodes of level B + 1, the *parts* of blocks, have vectors and modes of their own for the levels after
    /// theirs.
    pub divided: bool,
    /// Whether the colours of the levels 1 to B + 1 are predicted from the frame moved by parts, as far as parts are known
    /// then.
    pub moves_coarse: bool,
    /// Whether the frame is predicted from the previous one as a lattice warps it; then blocks have no vectors.
    pub warped: bool,
    /// Whether the voxels of a warped frame start from the surface near them.
    pub smooth: bool,
    /// U: vectors are in voxels of this level.
    pub unit_level: u8,
    /// R: the levels after B and before this one are predicted from the moved previous frame of level R, all others
    /// from their own. If the frame is warped, all are predicted from what level R = M makes.
    pub reference_level: u8,
    /// Modes of the levels 1 to B.
    pub root: Modes,
    /// Vector of the levels 1 to B.
    pub vector: [i16; 3],
}

/// Vectors and modes of the blocks, or of their parts.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Blocks {
    /// The vector of each.
    pub vectors: Vec<[i16; 3]>,
    /// The modes of each at the level after its own, and the levels that follow; of divided blocks at that level only.
    pub modes: Vec<Vec<Modes>>,
}

/// Bytes of a head.
const HEAD: usize = 10;
/// Bits of the first byte: blocks are divided, or of a warped frame, voxels start from the surface; colours of coarse
/// levels are predicted from the frame moved by parts; the frame is warped.
const DIVIDED: u8 = 0x80;
const SMOOTH: u8 = DIVIDED;
const MOVES_COARSE: u8 = 0x40;
const WARPED: u8 = 0x20;

/// How errors name the motion of a level, whose place in the file is not known here.
const PLACE: &str = "motion of level ";

pub(super) fn malformed(
    clause: &'static str,
    field: &'static str,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
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
        let [moves_coarse, warped] = [MOVES_COARSE, WARPED].map(|bit| head[0] & bit != 0);
        let [divided, smooth] = [!warped, warped].map(|meant| meant && head[0] & DIVIDED != 0);
        let (block_level, unit_level) = (head[0] & !(DIVIDED | MOVES_COARSE | WARPED), head[1]);
        if moves_coarse && !divided {
            let (value, expected) = ("of blocks that are not divided", "divided blocks");
            return Err(malformed("17.5.1", "coarse colours that move", value, expected));
        }
        // Vectors of parts are read with level L, if coarser levels need them.
        let deepest = i16::from(base) - i16::from(divided) - i16::from(moves_coarse);
        if i16::from(block_level) > deepest {
            return Err(malformed(
                "17.5.1",
                "level of the blocks",
                block_level,
                format!("at most {deepest}"),
            ));
        }
        if !(top..=MAX_DEPTH).contains(&unit_level) {
            let expected = format!("{top} to {MAX_DEPTH}");
            return Err(malformed("17.5.1", "level of the vectors", unit_level, expected));
        }
        let reference_level = head[2];
        let (first, deepest) = match warped {
            true => (top, top),
            false => (
                block_level + if moves_coarse { 2 } else { 0 },
                top.min(block_level + REACH),
            ),
        };
        if !(first..=deepest).contains(&reference_level) {
            let expected = format!("{first} to {deepest}");
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
            divided,
            moves_coarse,
            warped,
            smooth,
            unit_level,
            reference_level,
            root: Modes { geometry, colours },
            vector: [0, 1, 2].map(component),
        };
        head.check(head.vector)?;
        if warped && head.vector != [0; 3] {
            let value = format!("{:?}", head.vector);
            return Err(malformed("17.5.1", "vector of a warped frame", value, "0"));
        }
        Ok((head, rest))
    }

    /// The head as bytes.
    pub fn to_bytes(self) -> Vec<u8> {
        let mut bytes = vec![
            self.block_level
                | if self.divided { DIVIDED } else { 0 }
                | if self.moves_coarse { MOVES_COARSE } else { 0 }
                | if self.warped { WARPED } else { 0 }
                | if self.smooth { SMOOTH } else { 0 },
            self.unit_level,
            self.reference_level,
            self.root.geometry as u8 | (self.root.colours as u8) << 4,
        ];
        bytes.extend(self.vector.iter().flat_map(|x| x.to_le_bytes()));
        bytes
    }

    /// Reads the lattice of a warped frame from the bytes behind the head: its level, the weight from which on cells are
    /// voxels, and its words. Returns them with the bytes behind.
    ///
    /// # Errors
    /// [`Error::Malformed`].
    pub fn lattice<'a>(&self, base: u8, bytes: &'a [u8]) -> Result<([u8; 2], &'a [u8], &'a [u8])> {
        let malformed =
            |field, value: String, expected: String| of_level(malformed("17.10.1", field, value, expected), base);
        let top = self.reference_level;
        let [least, most] = [DEPTHS[1], DEPTHS[0]].map(|depth| i16::from(top) - i16::from(depth));
        let levels = least.max(0)..=most;
        let Some((&level, rest)) = bytes
            .split_first()
            .filter(|(level, _)| levels.contains(&i16::from(**level)))
        else {
            let value = bytes.first().map_or("none".into(), u8::to_string);
            let expected = format!("{} to {}", levels.start(), levels.end());
            return Err(malformed("level of the lattice", value, expected));
        };
        let Some((&least, rest)) = rest.split_first().filter(|(least, _)| **least >= LEAST) else {
            let value = rest.first().map_or("none".into(), u8::to_string);
            return Err(malformed("least weight of voxels", value, format!("{LEAST} or more")));
        };
        let mut reader = Reader::new(rest, 0);
        let length = reader.varint("bytes of the lattice").map_err(|error| match error {
            Error::Truncated { .. } => malformed("bytes of the lattice", "none".into(), "a number".into()),
            error => of_level(error, base),
        })?;
        let rest = &rest[reader.at()..];
        let Some((words, rest)) = rest.split_at_checked(length as usize) else {
            let expected = format!("at most {}", rest.len());
            return Err(malformed("bytes of the lattice", length.to_string(), expected));
        };
        Ok(([level, least], words, rest))
    }

    /// Checks that a vector is not longer than the cube along any axis.
    pub(super) fn check(&self, vector: [i16; 3]) -> Result<()> {
        let side = 1i32 << self.unit_level;
        match vector.iter().all(|x| i32::from(*x).abs() <= side) {
            true => Ok(()),
            false => {
                let (value, expected) = (format!("{vector:?}"), format!("−{side} to {side}"));
                Err(malformed("17.5.3", "motion vector", value, expected))
            }
        }
    }

    /// Whether modes of this level are those of parts.
    pub fn is_of_parts(&self, level: u8) -> bool {
        self.divided && level > self.block_level + 1
    }

    /// Reads vectors and modes of the blocks `keys`: `sections` are the bytes behind the head, then those of each level
    /// after `base`.
    ///
    /// # Errors
    /// [`Error::Malformed`].
    pub fn blocks(&self, base: u8, keys: &[u64], sections: &[&[u8]]) -> Result<Blocks> {
        Ok(self.read(base, [keys, &[]], sections)?.0)
    }

    /// Reads vectors and modes of the parts `parts` of the blocks `keys`, which are divided.
    ///
    /// # Errors
    /// [`Error::Malformed`].
    pub fn parts(&self, base: u8, [keys, parts]: [&[u64]; 2], sections: &[&[u8]]) -> Result<Blocks> {
        Ok(self.read(base, [keys, parts], sections)?.1)
    }

    /// Reads blocks, and their parts if there are some.
    fn read(&self, base: u8, [keys, part_keys]: [&[u64]; 2], sections: &[&[u8]]) -> Result<(Blocks, Blocks)> {
        let (mut blocks, mut parts) = (Blocks::default(), Blocks::default());
        let mut models = Models::new(self.divided || self.warped);
        let mut level = self.block_level + 1;
        for (section, bytes) in (base..).zip(sections) {
            let mut read = || {
                let mut coder = Decoder::new(bytes);
                if section == base {
                    blocks.vectors = vec![[0; 3]; keys.len()];
                }
                if section == base && !self.warped {
                    models.code_vectors(&mut coder, self.vector, keys, &mut blocks.vectors)?;
                    blocks.vectors.iter().try_for_each(|vector| self.check(*vector))?;
                }
                for level in std::mem::replace(&mut level, section + 1)..=section {
                    if !self.is_of_parts(level) {
                        let mut modes = vec![Modes::default(); keys.len()];
                        models.code_modes(&mut coder, blocks.modes.last().map(Vec::as_slice), &mut modes)?;
                        blocks.modes.push(modes);
                        continue;
                    }
                    if part_keys.is_empty() {
                        return Ok(());
                    }
                    let groups = Groups::new(keys, &blocks.vectors);
                    if parts.modes.is_empty() {
                        parts.vectors = vec![[0; 3]; part_keys.len()];
                        models.code_parts(&mut coder, groups, part_keys, &mut parts.vectors)?;
                        parts.vectors.iter().try_for_each(|vector| self.check(*vector))?;
                    }
                    let above = above(groups, &blocks, part_keys, &parts);
                    let mut modes = vec![Modes::default(); part_keys.len()];
                    models.code_modes(&mut coder, Some(&above), &mut modes)?;
                    parts.modes.push(modes);
                }
                coder.finish(PLACE)
            };
            read().map_err(|error| of_level(error, section))?;
        }
        Ok((blocks, parts))
    }

    /// The motion of the level `base` and of each level after it, as bytes: of the blocks `keys[0]`, and of their parts
    /// `keys[1]` if they are divided. A warped frame needs a lattice, too ([`Head::put_lattice`]).
    ///
    /// # Errors
    /// [`Error::Malformed`] if a number has no code.
    #[cfg(feature = "encoder")]
    pub fn write(&self, base: u8, keys: [&[u64]; 2], [blocks, parts]: [&Blocks; 2]) -> Result<Vec<Vec<u8>>> {
        let mut models = Models::new(self.divided || self.warped);
        let first = self.block_level + 1;
        let top = self.block_level + (blocks.modes.len() + parts.modes.len()) as u8;
        let groups = Groups::new(keys[0], &blocks.vectors);
        let mut sections = Vec::new();
        for section in base..=top.max(base) {
            let mut coder = crate::coding::binary::Encoder::default();
            if section == base && !self.warped {
                models.code_vectors(&mut coder, self.vector, keys[0], &mut blocks.vectors.clone())?;
            }
            let from = if section == base { first } else { section };
            for level in from..=section {
                let i = usize::from(level - first);
                if !self.is_of_parts(level) {
                    let above = i.checked_sub(1).map(|i| blocks.modes[i].as_slice());
                    models.code_modes(&mut coder, above, &mut blocks.modes[i].clone())?;
                    continue;
                }
                let before = Blocks {
                    vectors: Vec::new(),
                    modes: parts.modes[..i - 1].to_vec(),
                };
                if i == 1 {
                    models.code_parts(&mut coder, groups, keys[1], &mut parts.vectors.clone())?;
                }
                let above = above(groups, blocks, keys[1], &before);
                models.code_modes(&mut coder, Some(&above), &mut parts.modes[i - 1].clone())?;
            }
            let mut bytes = if section == base { self.to_bytes() } else { Vec::new() };
            bytes.extend(coder.finish());
            sections.push(bytes);
        }
        Ok(sections)
    }

    /// Adds a lattice, and the least weight of voxels, to the motion of the base level.
    ///
    /// # Errors
    /// [`Error::Malformed`] if a number has no code.
    #[cfg(feature = "encoder")]
    pub fn put_lattice(motion: &mut Vec<u8>, lattice: &Lattice, least: u8) -> Result<()> {
        let words = lattice.write()?;
        let mut bytes = vec![lattice.levels().len() as u8 - 1, least];
        put_varint(&mut bytes, words.len() as u32);
        bytes.extend(words);
        motion.splice(HEAD..HEAD, bytes);
        Ok(())
    }
}

/// The modes of parts at the level above the one that is read: those of their blocks first.
fn above(groups: Groups, blocks: &Blocks, part_keys: &[u64], parts: &Blocks) -> Vec<Modes> {
    match (parts.modes.last(), blocks.modes.last()) {
        (Some(modes), _) => modes.clone(),
        (None, Some(modes)) => groups.of(part_keys).map(|block| modes[block]).collect(),
        (None, None) => vec![Modes::default(); part_keys.len()],
    }
}

#[cfg(all(test, feature = "encoder"))]
mod tests;
