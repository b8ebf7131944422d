//! The header: everything a reader must know before it reserves memory.

use super::malformed;
use super::reader::Reader;
use crate::error::{Error, Result};
use crate::limits::{Limits, MAX_DEPTH};
use crate::placement::Placement;

/// The first bytes: not text, and changed by whatever changes line ends.
pub const MAGIC: [u8; 8] = [0x89, b'B', b'2', b'P', b'\r', b'\n', 0x1a, b'\n'];
/// Major and minor version that this crate writes.
pub const VERSION: (u16, u16) = (2, 0);
/// The most voxels of a slice.
pub const MAX_SLICE_VOXELS: u32 = 16_384;

/// A stream has at most so many levels.
const MAX_LEVELS: u8 = 3;
/// Bytes before the arrays.
const FIXED: usize = 84;

/// The header of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// Flags that a reader may ignore.
    pub optional_flags: u32,
    /// N: the cloud's voxels are those of this level.
    pub bits: u8,
    /// L: the level whose latents are coded without prediction.
    pub base: u8,
    /// M: the last level.
    pub top: u8,
    /// Occupied voxels at level N.
    pub points: u64,
    /// Where the cube lies in the world.
    pub placement: Placement,
    /// The hash of the model's exact part.
    pub model: [u8; 16],
    /// S: voxels per slice.
    pub slice_voxels: u32,
    /// Voxels of level L, …, M.
    pub voxels: Vec<u32>,
    /// Bytes of level L, …, M.
    pub sections: Vec<Section>,
}

/// How long a level's sections are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Section {
    /// Bytes of the geometry.
    pub geometry: u32,
    /// Bytes of the features.
    pub features: u32,
}

impl Section {
    /// Bytes of both.
    pub fn bytes(&self) -> u64 {
        u64::from(self.geometry) + u64::from(self.features)
    }
}

impl Header {
    /// Reads the header from the start of a stream. Levels need not follow.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Unsupported`] for another version or unknown critical flags,
    /// [`Error::Malformed`] for what the format forbids, [`Error::LimitExceeded`].
    pub fn parse(bytes: &[u8], limits: &Limits) -> Result<Self> {
        let known = bytes.len().min(MAGIC.len());
        if bytes[..known] != MAGIC[..known] {
            let found = format!("{:02x?}", &bytes[..known]);
            return Err(malformed(0, "magic", found, format!("{MAGIC:02x?}")));
        }
        let mut reader = Reader::new(bytes, 0);
        reader.take(MAGIC.len(), "magic")?;
        let major = reader.u16("version")?;
        reader.u16("version")?;
        if major != VERSION.0 {
            return Err(Error::Unsupported {
                what: "this stream version",
                detail: format!("found {major}, {} would do", VERSION.0),
            });
        }
        let critical_flags = reader.u32("critical flags")?;
        let optional_flags = reader.u32("optional flags")?;
        let [bits, base, top, reserved] = reader.array("levels")?;
        // The checksum's place depends on these two, so they are looked at before it is.
        check_levels(base, top)?;
        let levels = usize::from(top - base + 1);
        let points = reader.u64("points")?;
        let mut numbers = [0.0; 4];
        for number in &mut numbers {
            *number = reader.f64("placement")?;
        }
        let [x, y, z, voxel_size] = numbers;
        let model = reader.array("model id")?;
        let slice_voxels = reader.u32("slice size")?;
        let mut voxels = Vec::with_capacity(levels);
        for _ in 0..levels {
            voxels.push(reader.u32("voxel counts")?);
        }
        let mut sections = Vec::with_capacity(levels);
        for _ in 0..levels {
            sections.push(Section {
                geometry: reader.u32("section lengths")?,
                features: reader.u32("section lengths")?,
            });
        }
        let found = crc32c::crc32c(&bytes[..reader.at()]);
        let expected = reader.u32("header checksum")?;
        if found != expected {
            return Err(Error::ChecksumMismatch {
                what: "the header".into(),
                offset: 0,
                expected,
                found,
            });
        }
        if critical_flags != 0 {
            return Err(Error::Unsupported {
                what: "this stream",
                detail: format!("it needs the unknown features {critical_flags:#010x}"),
            });
        }
        if reserved != 0 {
            return Err(malformed(23, "reserved byte", reserved, 0));
        }
        let header = Header {
            optional_flags,
            bits,
            base,
            top,
            points,
            placement: Placement {
                origin: [x, y, z],
                voxel_size,
            },
            model,
            slice_voxels,
            voxels,
            sections,
        };
        header.check(limits)?;
        Ok(header)
    }

    /// The header's bytes.
    pub fn write(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(self.bytes());
        bytes.extend(MAGIC);
        bytes.extend(VERSION.0.to_le_bytes());
        bytes.extend(VERSION.1.to_le_bytes());
        bytes.extend(0u32.to_le_bytes());
        bytes.extend(self.optional_flags.to_le_bytes());
        bytes.extend([self.bits, self.base, self.top, 0]);
        bytes.extend(self.points.to_le_bytes());
        for number in self.placement.origin {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(self.placement.voxel_size.to_le_bytes());
        bytes.extend(self.model);
        bytes.extend(self.slice_voxels.to_le_bytes());
        for count in &self.voxels {
            bytes.extend(count.to_le_bytes());
        }
        for section in &self.sections {
            bytes.extend(section.geometry.to_le_bytes());
            bytes.extend(section.features.to_le_bytes());
        }
        bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
        bytes
    }

    /// Length of the header itself.
    pub fn bytes(&self) -> usize {
        FIXED + 12 * self.voxels.len() + 4
    }

    /// Length of the stream up to and with `level`: what a reader must fetch to decode that level.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn prefix_bytes(&self, level: u8) -> Result<u64> {
        let last = self.index(level)?;
        let sections: u64 = self.sections[..=last].iter().map(Section::bytes).sum();
        Ok(self.bytes() as u64 + sections)
    }

    /// Length of the whole stream.
    pub fn stream_bytes(&self) -> u64 {
        let sections: u64 = self.sections.iter().map(Section::bytes).sum();
        self.bytes() as u64 + sections
    }

    /// Sees that nothing follows the last section in a stream of `length` bytes.
    ///
    /// # Errors
    /// [`Error::Malformed`] if something does.
    pub fn check_end(&self, length: u64) -> Result<()> {
        let end = self.stream_bytes();
        match length.saturating_sub(end) {
            0 => Ok(()),
            rest => Err(malformed(
                end,
                "length of what follows the last section",
                rest,
                0,
            )),
        }
    }

    /// How many voxels `level` has.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn voxels(&self, level: u8) -> Result<u32> {
        Ok(self.voxels[self.index(level)?])
    }

    /// Sees that the stream was made with the model of that id.
    ///
    /// # Errors
    /// [`Error::ModelMismatch`] if it was not.
    pub fn check_model(&self, loaded: &[u8; 16]) -> Result<()> {
        if self.model == *loaded {
            return Ok(());
        }
        let hex = |id: &[u8; 16]| id.iter().map(|b| format!("{b:02x}")).collect();
        Err(Error::ModelMismatch {
            expected: hex(&self.model),
            found: hex(loaded),
        })
    }

    /// Position of a level in `voxels` and `sections`.
    pub(super) fn index(&self, level: u8) -> Result<usize> {
        if (self.base..=self.top).contains(&level) {
            return Ok(usize::from(level - self.base));
        }
        Err(Error::Usage(format!(
            "the stream has the levels {} to {}, not {level}",
            self.base, self.top
        )))
    }

    /// Whether the format and `limits` allow all of this.
    pub(super) fn check(&self, limits: &Limits) -> Result<()> {
        let (bits, base, top) = (self.bits, self.base, self.top);
        check_levels(base, top)?;
        if !(1..=MAX_DEPTH).contains(&bits) || top >= bits {
            let expected = format!("{} to {MAX_DEPTH}", u32::from(top) + 1);
            return Err(malformed(20, "bit depth", bits, expected));
        }
        limits.check_depth("bit depth of the stream", bits)?;
        if !self.placement.is_valid() {
            let value = format!("{:?}", self.placement);
            return Err(malformed(
                32,
                "placement",
                value,
                "finite, the size positive",
            ));
        }
        if !(1..=MAX_SLICE_VOXELS).contains(&self.slice_voxels) {
            let expected = format!("1 to {MAX_SLICE_VOXELS}");
            return Err(malformed(80, "slice size", self.slice_voxels, expected));
        }
        let levels = usize::from(top - base + 1);
        let lengths = (self.voxels.len(), self.sections.len());
        if lengths != (levels, levels) {
            let value = format!("{lengths:?}");
            return Err(malformed(FIXED, "voxel counts and sections", value, levels));
        }
        let mut allowed = 1..=1u64 << (3 * base);
        for (i, &count) in self.voxels.iter().enumerate() {
            let count = u64::from(count);
            if !allowed.contains(&count) {
                let field = format!("voxel count of level {}", usize::from(base) + i);
                let expected = format!("{} to {}", allowed.start(), allowed.end());
                return Err(malformed(FIXED + 4 * i, field, count, expected));
            }
            limits.check_points("voxel count of a level", count)?;
            allowed = count..=8 * count;
        }
        let finest = *allowed.start();
        let most = u128::from(finest) << (3 * (bits - top));
        if self.points < finest || u128::from(self.points) > most {
            let expected = format!("{finest} to {most}");
            return Err(malformed(24, "points", self.points, expected));
        }
        limits.check_points("points of the stream", self.points)
    }
}

fn check_levels(base: u8, top: u8) -> Result<()> {
    if base > top || top - base >= MAX_LEVELS || top >= MAX_DEPTH {
        let deepest = MAX_DEPTH - 1;
        let expected = format!("1 to {MAX_LEVELS} levels, none deeper than {deepest}");
        return Err(malformed(
            21,
            "levels",
            format!("{base} to {top}"),
            expected,
        ));
    }
    Ok(())
}
