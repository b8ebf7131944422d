//! The header: all that a reader must know before it allocates memory (`docs/format.md`, clause 2.2).

use super::malformed;
use super::reader::Reader;
use crate::error::{Error, Result, feature};
use crate::limits::{Limits, MAX_DEPTH};
use crate::placement::Placement;

/// The first bytes of a stream. They are not text, and detect conversion of line ends.
pub const MAGIC: [u8; 8] = [0x89, b'B', b'2', b'P', b'\r', b'\n', 0x1a, b'\n'];
/// Maximum number of voxels of a slice.
pub const MAX_SLICE_VOXELS: u32 = 16_384;
/// Maximum number of parents of a slice of colours (version 3).
pub const MAX_COLOUR_SLICE: u32 = 65_536;

/// The minor version written.
const MINOR: u16 = 0;
/// The critical flag of a sequence of frames, whose header counts the most of any frame (clause 17.1).
const SEQUENCE: u32 = 1;
/// The critical flag of a scene of blocks, whose header counts all of them (clause 18.1).
const SCENE: u32 = 2;

/// Version of the format, with the fields that only it has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Version 2: learned latents.
    Learned {
        /// Identity of the model that they were coded with: a hash of its exact part.
        model: [u8; 16],
    },
    /// Version 3: transform coefficients, decoded without a model file.
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

    /// Maximum number of levels of a stream.
    fn max_levels(&self) -> u8 {
        match self {
            Format::Learned { .. } => 3,
            Format::Transform { .. } => MAX_DEPTH,
        }
    }

    /// Whether the finest level of the cloud, N, can be coded.
    fn codes_finest_level(&self) -> bool {
        matches!(self, Format::Transform { .. })
    }

    /// Bytes of the header before its arrays.
    fn fixed_bytes(&self) -> usize {
        match self {
            Format::Learned { .. } => 84,
            Format::Transform { .. } => 72,
        }
    }
}

/// The major version of a stream that starts with these bytes. `None` if they are too few, or not the start of a
/// stream.
pub fn version(bytes: &[u8]) -> Option<u16> {
    let rest = bytes.strip_prefix(&MAGIC)?;
    Some(u16::from_le_bytes([*rest.first()?, *rest.get(1)?]))
}

/// The header of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// Flags that a reader may ignore.
    #[doc(hidden)]
    pub optional_flags: u32,
    /// N: the cloud's voxels are those of this level.
    pub bits: u8,
    /// L: the first level that has a colour section.
    pub base: u8,
    /// M: the last level.
    pub top: u8,
    /// Number of occupied voxels of level N.
    pub points: u64,
    /// Placement of the cube in the world.
    pub placement: Placement,
    /// The version, which defines how colours are coded.
    pub format: Format,
    /// S: voxels per slice of the geometry and, in version 2, of the features.
    pub slice_voxels: u32,
    /// Number of voxels of level L, …, M.
    pub voxels: Vec<u32>,
    /// Section lengths of level L, …, M.
    #[doc(hidden)]
    pub sections: Vec<Section>,
}

/// Lengths of a level's sections, in bytes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Section {
    /// Bytes of the geometry section.
    pub geometry: u32,
    /// Bytes of the colour section.
    pub colours: u32,
}

impl Section {
    /// Bytes of both sections.
    #[doc(hidden)]
    pub fn bytes(&self) -> u64 {
        u64::from(self.geometry) + u64::from(self.colours)
    }
}

impl Header {
    /// Parses the header at the start of `bytes`. The levels need not follow.
    ///
    /// # Errors
    /// [`Error::Truncated`], [`Error::ChecksumMismatch`], [`Error::Unsupported`] for another version or unknown
    /// critical flags, [`Error::Malformed`] for values that the format forbids, [`Error::LimitExceeded`].
    pub fn parse(bytes: &[u8], limits: &Limits) -> Result<Self> {
        Self::parse_flagged(bytes, limits, 0)
    }

    /// Parses the header of a sequence of frames.
    ///
    /// # Errors
    /// Those of [`Header::parse`], and [`Error::Unsupported`] for a stream of one frame.
    #[doc(hidden)]
    pub fn parse_sequence(bytes: &[u8], limits: &Limits) -> Result<Self> {
        Self::parse_flagged(bytes, limits, SEQUENCE)
    }

    /// Parses the header of a scene of blocks. `limits` on points hold for each block, not for their sum.
    ///
    /// # Errors
    /// Those of [`Header::parse`], and [`Error::Unsupported`] for a stream of one frame.
    #[doc(hidden)]
    pub fn parse_scene(bytes: &[u8], limits: &Limits) -> Result<Self> {
        Self::parse_flagged(bytes, &limits.clone().with_max_points(u64::MAX), SCENE)
    }

    /// Whether bytes start like a sequence of frames. What follows may be damaged.
    #[doc(hidden)]
    pub fn is_of_sequence(bytes: &[u8]) -> bool {
        Self::has_flags(bytes, SEQUENCE)
    }

    /// Whether bytes start like a scene of blocks. What follows may be damaged.
    #[doc(hidden)]
    pub fn is_of_scene(bytes: &[u8]) -> bool {
        Self::has_flags(bytes, SCENE)
    }

    fn has_flags(bytes: &[u8], expected: u32) -> bool {
        let flags = bytes.get(12..16).and_then(|flags| flags.try_into().ok());
        version(bytes) == Some(3) && flags.map(u32::from_le_bytes) == Some(expected)
    }

    /// Parses a header whose critical flags must be `expected`.
    fn parse_flagged(bytes: &[u8], limits: &Limits, expected: u32) -> Result<Self> {
        let mut reader = Reader::new(bytes, 0);
        let mut format = read_version(&mut reader, bytes)?;
        let critical_flags = reader.u32("critical flags")?;
        let optional_flags = reader.u32("optional flags")?;
        let [bits, base, top, reserved] = reader.array("levels")?;
        // The position of the checksum depends on `base` and `top`, so they are checked first.
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
        check_flags(critical_flags, expected)?;
        if reserved != 0 {
            return Err(malformed("2.2.1", 23, "reserved byte", reserved, 0));
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

    /// Serialises the header.
    #[doc(hidden)]
    pub fn write(&self) -> Vec<u8> {
        self.write_flagged(0)
    }

    /// Serialises the header of a sequence of frames.
    #[doc(hidden)]
    pub fn write_sequence(&self) -> Vec<u8> {
        self.write_flagged(SEQUENCE)
    }

    /// Serialises the header of a scene of blocks.
    #[doc(hidden)]
    pub fn write_scene(&self) -> Vec<u8> {
        self.write_flagged(SCENE)
    }

    fn write_flagged(&self, critical_flags: u32) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(self.bytes());
        bytes.extend(MAGIC);
        bytes.extend(self.format.version().to_le_bytes());
        bytes.extend(MINOR.to_le_bytes());
        bytes.extend(critical_flags.to_le_bytes());
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

    /// Length of the header in bytes.
    pub fn bytes(&self) -> usize {
        self.format.fixed_bytes() + 12 * self.voxels.len() + 4
    }

    /// Length of the stream up to and including `level`, in bytes: the prefix that decodes to that level.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    #[doc(hidden)]
    pub fn prefix_bytes(&self, level: u8) -> Result<u64> {
        let last = self.index(level)?;
        let sections: u64 = self.sections[..=last].iter().map(Section::bytes).sum();
        Ok(self.bytes() as u64 + sections)
    }

    /// Length of the whole stream in bytes.
    pub fn stream_bytes(&self) -> u64 {
        let sections: u64 = self.sections.iter().map(Section::bytes).sum();
        self.bytes() as u64 + sections
    }

    /// Checks that nothing follows the last section in a stream of `length` bytes.
    ///
    /// # Errors
    /// [`Error::Malformed`] if bytes follow.
    #[doc(hidden)]
    pub fn check_end(&self, length: u64) -> Result<()> {
        let end = self.stream_bytes();
        match length.saturating_sub(end) {
            0 => Ok(()),
            rest => Err(malformed(
                "2.1.1",
                end,
                "number of bytes after the last section",
                rest,
                0,
            )),
        }
    }

    /// Byte offset of the checksum of the header that starts here, if its length can be known.
    pub(crate) fn checksum_at(bytes: &[u8]) -> Option<usize> {
        let format = read_version(&mut Reader::new(bytes, 0), bytes).ok()?;
        let levels = bytes.get(22)?.checked_sub(*bytes.get(21)?)?;
        Some(format.fixed_bytes() + 12 * (usize::from(levels) + 1))
    }

    /// Parents per slice of colours; in version 2, that of the geometry.
    #[doc(hidden)]
    pub fn colour_slice(&self) -> u32 {
        match self.format {
            Format::Learned { .. } => self.slice_voxels,
            Format::Transform { colour_slice } => colour_slice,
        }
    }

    /// Byte offset of the sections of `level`.
    pub(super) fn start(&self, level: u8) -> Result<u64> {
        match self.index(level)? {
            0 => Ok(self.bytes() as u64),
            _ => self.prefix_bytes(level - 1),
        }
    }

    /// Number of voxels of the level above `level`; 1, the root, for the base level.
    pub(super) fn parents(&self, level: u8) -> Result<u64> {
        match self.index(level)? {
            0 => Ok(1),
            index => Ok(self.voxels[index - 1].into()),
        }
    }

    /// Number of voxels of `level`.
    ///
    /// # Errors
    /// [`Error::Usage`] if the stream has no such level.
    pub fn voxels(&self, level: u8) -> Result<u32> {
        Ok(self.voxels[self.index(level)?])
    }

    /// Identity of the model that the stream was coded with, in hexadecimal. `None` in version 3.
    pub fn model(&self) -> Option<String> {
        match &self.format {
            Format::Learned { model } => Some(hex(model)),
            Format::Transform { .. } => None,
        }
    }

    /// Checks that the stream was coded with the model of identity `loaded`.
    ///
    /// # Errors
    /// [`Error::ModelMismatch`] if it was coded with another model, [`Error::Unsupported`] if it has version 3.
    #[doc(hidden)]
    pub fn check_model(&self, loaded: &[u8; 16]) -> Result<()> {
        match &self.format {
            Format::Learned { model } if model == loaded => Ok(()),
            Format::Learned { model } => Err(Error::ModelMismatch {
                expected: hex(model),
                found: hex(loaded),
            }),
            Format::Transform { .. } => Err(Error::Unsupported {
                what: "this stream",
                detail: "it has version 3, which has no latents; version 2 is required".into(),
            }),
        }
    }

    /// Index of a level in `voxels` and `sections`.
    pub(super) fn index(&self, level: u8) -> Result<usize> {
        if (self.base..=self.top).contains(&level) {
            return Ok(usize::from(level - self.base));
        }
        Err(Error::Usage(format!(
            "the stream has the levels {} to {}, not {level}",
            self.base, self.top
        )))
    }

    /// Checks all fields against the format and `limits`.
    pub(super) fn check(&self, limits: &Limits) -> Result<()> {
        let (bits, base, top) = (self.bits, self.base, self.top);
        check_levels(&self.format, base, top)?;
        let min_bits = top + u8::from(!self.format.codes_finest_level());
        if !(1..=MAX_DEPTH).contains(&bits) || bits < min_bits {
            let expected = format!("{} to {MAX_DEPTH}", min_bits.max(1));
            return Err(malformed("2.2.2", 20, "bit depth", bits, expected));
        }
        limits.check_depth("bit depth of the stream", bits)?;
        if !self.placement.is_valid() {
            let value = format!("{:?}", self.placement);
            return Err(malformed(
                "2.2.3",
                32,
                "placement",
                value,
                "finite numbers and a voxel size above 0",
            ));
        }
        self.check_slices()?;
        let fixed_bytes = self.format.fixed_bytes();
        let levels = usize::from(top - base + 1);
        let lengths = (self.voxels.len(), self.sections.len());
        if lengths != (levels, levels) {
            let value = format!("{lengths:?}");
            return Err(malformed(
                "2.2.2",
                fixed_bytes,
                "voxel counts and sections",
                value,
                levels,
            ));
        }
        let mut allowed = 1..=1u64 << (3 * base);
        for (i, &count) in self.voxels.iter().enumerate() {
            let count = u64::from(count);
            if !allowed.contains(&count) {
                let field = format!("voxel count of level {}", usize::from(base) + i);
                let expected = format!("{} to {}", allowed.start(), allowed.end());
                return Err(malformed("2.2.2", fixed_bytes + 4 * i, field, count, expected));
            }
            limits.check_points("voxel count of a level", count)?;
            allowed = count..=8 * count;
        }
        let finest = *allowed.start();
        let max = u128::from(finest) << (3 * (bits - top));
        if self.points < finest || u128::from(self.points) > max {
            let expected = format!("{finest} to {max}");
            return Err(malformed("2.2.2", 24, "points", self.points, expected));
        }
        limits.check_points("points of the stream", self.points)
    }

    fn check_slices(&self) -> Result<()> {
        let at = self.format.fixed_bytes() - 4;
        let check = |at, field, value, max| match (1..=max).contains(&value) {
            true => Ok(()),
            false => Err(malformed("2.2.1", at, field, value, format!("1 to {max}"))),
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

/// Checks the critical flags of a stream of which `expected` are.
fn check_flags(found: u32, expected: u32) -> Result<()> {
    let kind = |flags| match flags {
        SEQUENCE => "a sequence of frames",
        SCENE => "a scene of blocks",
        _ => "a single frame",
    };
    if found == expected {
        return Ok(());
    }
    let detail = match found {
        0 | SEQUENCE | SCENE => format!("it is {}, where {} is expected", kind(found), kind(expected)),
        _ => {
            let known = SEQUENCE | SCENE;
            format!("the critical flags are {found:#010x}, of which this version knows one of {known:#010x} alone")
        }
    };
    let what = if found == 0 { "this stream" } else { feature::FLAGS };
    Err(Error::Unsupported { what, detail })
}

fn hex(id: &[u8; 16]) -> String {
    id.iter().map(|b| format!("{b:02x}")).collect()
}

/// Reads magic and version: a format whose model or slice size is yet to be read.
fn read_version(reader: &mut Reader, bytes: &[u8]) -> Result<Format> {
    let known = bytes.len().min(MAGIC.len());
    if bytes[..known] != MAGIC[..known] {
        let found = format!("{:02x?}", &bytes[..known]);
        return Err(malformed("2.2.1", 0, "magic", found, format!("{MAGIC:02x?}")));
    }
    reader.take(MAGIC.len(), "magic")?;
    let major = reader.u16("version")?;
    reader.u16("version")?;
    match major {
        2 => Ok(Format::Learned { model: [0; 16] }),
        3 => Ok(Format::Transform { colour_slice: 0 }),
        _ => Err(Error::Unsupported {
            what: feature::VERSION,
            detail: format!("found version {major}, supported are 2 and 3"),
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
        clause: "2.2.1",
    })
}

fn check_levels(format: &Format, base: u8, top: u8) -> Result<()> {
    let max = format.max_levels();
    let deepest = MAX_DEPTH - u8::from(!format.codes_finest_level());
    if base > top || top - base >= max || top > deepest {
        let expected = format!("1 to {max} levels, none deeper than {deepest}");
        return Err(malformed("2.2.2", 21, "levels", format!("{base} to {top}"), expected));
    }
    Ok(())
}
