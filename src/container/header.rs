//! The header: everything a reader must know before it reserves memory.

use super::malformed;
use super::reader::Reader;
use crate::error::{Error, Result};
use crate::limits::{Limits, MAX_DEPTH};
use crate::placement::Placement;

/// The first bytes: not text, and changed by whatever changes line ends.
pub const MAGIC: [u8; 8] = [0x89, b'B', b'2', b'P', b'\r', b'\n', 0x1a, b'\n'];
/// The most voxels of a slice.
pub const MAX_SLICE_VOXELS: u32 = 16_384;
/// The most parents of a slice of colours in version 3.
pub const MAX_COLOUR_SLICE: u32 = 65_536;

/// The minor version that is written.
const MINOR: u16 = 0;

/// What differs between the versions of the format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Version 2: learned latents.
    Learned {
        /// The hash of the exact part of the model that they were coded with.
        model: [u8; 16],
    },
    /// Version 3: transform coefficients, which no model file is needed for.
    Transform {
        /// Parents per slice of colours, 1 to [`MAX_COLOUR_SLICE`].
        colour_slice: u32,
    },
}

impl Format {
    /// The major version.
    pub fn version(&self) -> u16 {
        match self {
            Format::Learned { .. } => 2,
            Format::Transform { .. } => 3,
        }
    }

    /// The most levels of a stream.
    fn max_levels(&self) -> u8 {
        match self {
            Format::Learned { .. } => 3,
            Format::Transform { .. } => MAX_DEPTH,
        }
    }

    /// Whether the finest level of the cloud, N, may be coded.
    fn codes_the_finest(&self) -> bool {
        matches!(self, Format::Transform { .. })
    }

    /// Bytes before the arrays.
    fn fixed(&self) -> usize {
        match self {
            Format::Learned { .. } => 84,
            Format::Transform { .. } => 72,
        }
    }
}

/// The major version of a stream that starts with these bytes; `None` if they are too few or none of a stream's.
pub fn version(bytes: &[u8]) -> Option<u16> {
    let rest = bytes.strip_prefix(&MAGIC)?;
    Some(u16::from_le_bytes([*rest.first()?, *rest.get(1)?]))
}

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
    /// How colours are coded: the version of the stream.
    pub format: Format,
    /// S: voxels per slice of the geometry and, in version 2, of the features.
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
    /// Bytes of the colours: in version 2, the features.
    pub colours: u32,
}

impl Section {
    /// Bytes of both.
    pub fn bytes(&self) -> u64 {
        u64::from(self.geometry) + u64::from(self.colours)
    }
}

impl Header {
    /// Reads the header from the start of a stream. Levels need not follow.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Unsupported`] for another version or unknown critical flags,
    /// [`Error::Malformed`] for what the format forbids, [`Error::LimitExceeded`].
    pub fn parse(bytes: &[u8], limits: &Limits) -> Result<Self> {
        let mut reader = Reader::new(bytes, 0);
        let mut format = read_version(&mut reader, bytes)?;
        let critical_flags = reader.u32("critical flags")?;
        let optional_flags = reader.u32("optional flags")?;
        let [bits, base, top, reserved] = reader.array("levels")?;
        // The checksum's place depends on these two, so they are looked at before it is.
        check_levels(&format, base, top)?;
        let levels = usize::from(top - base + 1);
        let points = reader.u64("points")?;
        let mut numbers = [0.0; 4];
        for number in &mut numbers {
            *number = reader.f64("placement")?;
        }
        let [x, y, z, voxel_size] = numbers;
        if let Format::Learned { model } = &mut format {
            *model = reader.array("model id")?;
        }
        let slice_voxels = reader.u32("slice size")?;
        if let Format::Transform { colour_slice } = &mut format {
            *colour_slice = reader.u32("slice size of the colours")?;
        }
        let voxels = (0..levels).map(|_| reader.u32("voxel counts"));
        let voxels = voxels.collect::<Result<Vec<u32>>>()?;
        let mut section = |_| -> Result<Section> {
            Ok(Section {
                geometry: reader.u32("section lengths")?,
                colours: reader.u32("section lengths")?,
            })
        };
        let sections = (0..levels).map(&mut section).collect::<Result<Vec<_>>>()?;
        check_sum(&mut reader, bytes)?;
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
            format,
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
        bytes.extend(self.format.version().to_le_bytes());
        bytes.extend(MINOR.to_le_bytes());
        bytes.extend(0u32.to_le_bytes());
        bytes.extend(self.optional_flags.to_le_bytes());
        bytes.extend([self.bits, self.base, self.top, 0]);
        bytes.extend(self.points.to_le_bytes());
        for number in self.placement.origin {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(self.placement.voxel_size.to_le_bytes());
        if let Format::Learned { model } = &self.format {
            bytes.extend(model);
        }
        bytes.extend(self.slice_voxels.to_le_bytes());
        if let Format::Transform { colour_slice } = &self.format {
            bytes.extend(colour_slice.to_le_bytes());
        }
        for count in &self.voxels {
            bytes.extend(count.to_le_bytes());
        }
        for section in &self.sections {
            bytes.extend(section.geometry.to_le_bytes());
            bytes.extend(section.colours.to_le_bytes());
        }
        bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
        bytes
    }

    /// Length of the header itself.
    pub fn bytes(&self) -> usize {
        self.format.fixed() + 12 * self.voxels.len() + 4
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
            rest => Err(malformed(end, "length of what follows the last section", rest, 0)),
        }
    }

    /// Parents per slice of colours; in version 2, as of the geometry.
    pub fn colour_slice(&self) -> u32 {
        match self.format {
            Format::Learned { .. } => self.slice_voxels,
            Format::Transform { colour_slice } => colour_slice,
        }
    }

    /// Where the sections of `level` start.
    pub(super) fn start(&self, level: u8) -> Result<u64> {
        match self.index(level)? {
            0 => Ok(self.bytes() as u64),
            _ => self.prefix_bytes(level - 1),
        }
    }

    /// The voxels of the level before `level`; of the base level, the root.
    pub(super) fn parents(&self, level: u8) -> Result<u64> {
        match self.index(level)? {
            0 => Ok(1),
            index => Ok(self.voxels[index - 1].into()),
        }
    }

    /// How many voxels `level` has.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn voxels(&self, level: u8) -> Result<u32> {
        Ok(self.voxels[self.index(level)?])
    }

    /// The id of the model that the stream was coded with, hexadecimal; none in version 3.
    pub fn model(&self) -> Option<String> {
        match &self.format {
            Format::Learned { model } => Some(hex(model)),
            Format::Transform { .. } => None,
        }
    }

    /// Sees that the stream was made with the model of that id.
    ///
    /// # Errors
    /// [`Error::ModelMismatch`] if it was made with another, [`Error::Unsupported`] if it was made with none, being of version 3.
    pub fn check_model(&self, loaded: &[u8; 16]) -> Result<()> {
        match &self.format {
            Format::Learned { model } if model == loaded => Ok(()),
            Format::Learned { model } => Err(Error::ModelMismatch {
                expected: hex(model),
                found: hex(loaded),
            }),
            Format::Transform { .. } => Err(Error::Unsupported {
                what: "this stream",
                detail: "it has version 3, which has no learned latents; version 2 would do".into(),
            }),
        }
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
        check_levels(&self.format, base, top)?;
        let least = top + u8::from(!self.format.codes_the_finest());
        if !(1..=MAX_DEPTH).contains(&bits) || bits < least {
            let expected = format!("{} to {MAX_DEPTH}", least.max(1));
            return Err(malformed(20, "bit depth", bits, expected));
        }
        limits.check_depth("bit depth of the stream", bits)?;
        if !self.placement.is_valid() {
            let value = format!("{:?}", self.placement);
            return Err(malformed(32, "placement", value, "finite, the size positive"));
        }
        self.check_slices()?;
        let fixed = self.format.fixed();
        let levels = usize::from(top - base + 1);
        let lengths = (self.voxels.len(), self.sections.len());
        if lengths != (levels, levels) {
            let value = format!("{lengths:?}");
            return Err(malformed(fixed, "voxel counts and sections", value, levels));
        }
        let mut allowed = 1..=1u64 << (3 * base);
        for (i, &count) in self.voxels.iter().enumerate() {
            let count = u64::from(count);
            if !allowed.contains(&count) {
                let field = format!("voxel count of level {}", usize::from(base) + i);
                let expected = format!("{} to {}", allowed.start(), allowed.end());
                return Err(malformed(fixed + 4 * i, field, count, expected));
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

    fn check_slices(&self) -> Result<()> {
        let at = self.format.fixed() - 4;
        let check = |at, field, value, most| match (1..=most).contains(&value) {
            true => Ok(()),
            false => Err(malformed(at, field, value, format!("1 to {most}"))),
        };
        match self.format {
            Format::Learned { .. } => check(at, "slice size", self.slice_voxels, MAX_SLICE_VOXELS),
            Format::Transform { colour_slice } => {
                check(at - 4, "slice size", self.slice_voxels, MAX_SLICE_VOXELS)?;
                let field = "slice size of the colours";
                check(at, field, colour_slice, MAX_COLOUR_SLICE)
            }
        }
    }
}

fn hex(id: &[u8; 16]) -> String {
    id.iter().map(|b| format!("{b:02x}")).collect()
}

/// Reads magic and version: a format whose model or slice size is yet to be read.
fn read_version(reader: &mut Reader, bytes: &[u8]) -> Result<Format> {
    let known = bytes.len().min(MAGIC.len());
    if bytes[..known] != MAGIC[..known] {
        let found = format!("{:02x?}", &bytes[..known]);
        return Err(malformed(0, "magic", found, format!("{MAGIC:02x?}")));
    }
    reader.take(MAGIC.len(), "magic")?;
    let major = reader.u16("version")?;
    reader.u16("version")?;
    match major {
        2 => Ok(Format::Learned { model: [0; 16] }),
        3 => Ok(Format::Transform { colour_slice: 0 }),
        _ => Err(Error::Unsupported {
            what: "this stream version",
            detail: format!("found {major}, 2 or 3 would do"),
        }),
    }
}

/// Reads the checksum of all that was read before.
fn check_sum(reader: &mut Reader, bytes: &[u8]) -> Result<()> {
    let found = crc32c::crc32c(&bytes[..reader.at()]);
    let expected = reader.u32("header checksum")?;
    if found == expected {
        return Ok(());
    }
    Err(Error::ChecksumMismatch {
        what: "the header".into(),
        offset: 0,
        expected,
        found,
    })
}

fn check_levels(format: &Format, base: u8, top: u8) -> Result<()> {
    let most = format.max_levels();
    let deepest = MAX_DEPTH - u8::from(!format.codes_the_finest());
    if base > top || top - base >= most || top > deepest {
        let expected = format!("1 to {most} levels, none deeper than {deepest}");
        return Err(malformed(21, "levels", format!("{base} to {top}"), expected));
    }
    Ok(())
}
