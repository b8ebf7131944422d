//! What JSON and archives need.

use std::io::{Cursor, Read, Write};

use b2p::gaussians::Frame;
use b2p::{Limits, Placement, Result, Up};
use serde_json::{Value, json};
use zip::ZipArchive;
use zip::result::ZipError;

use super::Format;
use super::bytes::malformed;

/// Sizes of files that the headers of an archive need 64 bits for, and their own headers.
const LARGE: u64 = (1 << 32) - (1 << 16);

/// The name of the axis that pointed up.
const TURNED: &str = "turned_from";

/// A ZIP archive in memory.
pub(super) struct Archive<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    limits: Limits,
    /// Bytes of the files that have been taken out.
    taken: u64,
}

impl<'a> Archive<'a> {
    pub fn open(bytes: &'a [u8], limits: &Limits) -> Result<Self> {
        let archive = ZipArchive::new(Cursor::new(bytes));
        let archive = archive.map_err(|e| malformed("the end", "ZIP archive", e, "a whole archive"))?;
        Ok(Archive {
            archive,
            limits: limits.clone(),
            taken: 0,
        })
    }

    /// A file of the archive; `None` if it is not there.
    pub fn get(&mut self, name: &str) -> Result<Option<Vec<u8>>> {
        let file = match self.archive.by_name(name) {
            Ok(file) => file,
            Err(ZipError::FileNotFound) => return Ok(None),
            Err(e) => {
                return Err(malformed(
                    name,
                    "entry of the ZIP archive",
                    e,
                    "stored or deflated data",
                ));
            }
        };
        let size = file.size();
        self.taken = self.taken.saturating_add(size);
        self.limits
            .check_bytes("size of the files in the archive", self.taken)?;
        let mut bytes = Vec::new();
        let done = file.take(size).read_to_end(&mut bytes);
        done.map_err(|e| malformed(name, "entry of the ZIP archive", e, "whole data"))?;
        Ok(Some(bytes))
    }

    /// A file that must be there.
    pub fn need(&mut self, name: &str) -> Result<Vec<u8>> {
        let expected = || {
            malformed(
                "the ZIP archive",
                format!("file {name}"),
                "absent",
                "a file of this name",
            )
        };
        self.get(name)?.ok_or_else(expected)
    }
}

/// The format of a ZIP archive by the names of its files.
pub(super) fn kind_of_archive(bytes: &[u8]) -> Option<Format> {
    let archive = ZipArchive::new(Cursor::new(bytes)).ok()?;
    if archive.index_for_name("meta.json").is_some() {
        return Some(Format::Sog);
    }
    archive.index_for_name("positions.npy").is_some().then_some(Format::Npz)
}

/// Writes a ZIP archive of files that are not compressed further.
pub(super) struct ArchiveWriter<'a> {
    zip: zip::ZipWriter<zip::write::StreamWriter<&'a mut dyn Write>>,
}

impl<'a> ArchiveWriter<'a> {
    pub fn new(to: &'a mut dyn Write) -> Self {
        ArchiveWriter {
            zip: zip::ZipWriter::new_stream(to),
        }
    }

    /// Begins a file of about `size` bytes.
    pub fn start(&mut self, name: &str, size: u64) -> std::io::Result<&mut dyn Write> {
        let options = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored)
            .large_file(size >= LARGE);
        self.zip.start_file(name, options)?;
        Ok(&mut self.zip)
    }

    pub fn finish(self) -> std::io::Result<()> {
        self.zip.finish()?;
        Ok(())
    }
}

/// The cube for formats that hold JSON, its offset, and the axis that pointed up before the scene was turned.
pub(super) fn frame_to_json(frame: Frame, up: Option<Up>) -> Value {
    let Frame { bits, placement } = frame;
    let mut value = json!({
        "bits": bits,
        "origin": placement.origin,
        "voxel_size": placement.voxel_size,
        "offset": frame.offset(),
    });
    if let Some(up) = up {
        value[TURNED] = up.to_string().into();
    }
    value
}

/// The axis of [`frame_to_json`].
pub(super) fn up_from_json(value: &Value) -> Option<Up> {
    value[TURNED].as_str()?.parse().ok()
}

/// Reads what [`frame_to_json`] wrote: the cube and the offset. What does not parse is ignored, as are offsets beyond
/// single precision.
pub(super) fn frame_from_json(value: &Value) -> (Option<Frame>, [f64; 3]) {
    let offset = three(&value["offset"]).filter(|o| o.iter().all(|x| (*x as f32).is_finite()));
    let frame = || {
        let frame = Frame {
            bits: value["bits"].as_u64()?.try_into().ok()?,
            placement: Placement {
                origin: three(&value["origin"])?,
                voxel_size: value["voxel_size"].as_f64()?,
            },
        };
        frame.is_valid().then_some(frame)
    };
    (frame(), offset.unwrap_or_default())
}

/// Three finite numbers.
pub(super) fn three(value: &Value) -> Option<[f64; 3]> {
    let [x, y, z] = value.as_array()?.as_slice() else {
        return None;
    };
    let numbers = [x.as_f64()?, y.as_f64()?, z.as_f64()?];
    numbers.iter().all(|x| x.is_finite()).then_some(numbers)
}
