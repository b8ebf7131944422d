//! The container: reads and writes `.b2p` streams of versions 2 and 3.
//!
//! `docs/format.md` specifies the format: the header in clause 2.2, the chunks of version 3 in clause 3, those of
//! version 2 in clause 8. A stream is a header, then for every level from L to M a geometry section and a colour
//! section. So a prefix that ends after a level is a valid, coarser stream. Version 3 codes colours as transform
//! coefficients ([`crate::colour`]) and needs no model file. Version 2 codes latents ([`crate::latents`]), which decode
//! only with the model that they were coded with.
//!
//! - [`Header`] is parsed first. It states all counts and lengths, so limits are checked before memory is allocated.
//! - [`Stream`] splits a stream into its complete levels, and verifies order, counts and checksums of the chunks.
//! - [`Writer`] builds a stream level by level.
//! - `feed` keeps a stream that arrives in parts, and returns which level can be decoded next.

mod axes;
mod chunk;
pub(crate) mod feed;
mod header;
mod reader;
mod scan;
pub mod scene;
pub mod sequence;
mod stream;
mod transform;
mod writer;

pub use axes::{axes, axes_bytes, source_bytes, source_points, with_axes, with_source};
pub use chunk::ChunkKind;
pub use header::{Format, Header, MAGIC, MAX_COLOUR_SLICE, MAX_SLICE_VOXELS, Section, version};
pub use reader::{Reader, put_varint};
pub use scan::{Note, Scan, ScannedChunk};
pub use stream::{Geometry, Level, Slice, Stream};
pub use transform::{ColourLevel, Colours, MAX_TRUNK_VOXELS, Trunk};
pub use writer::Writer;

use crate::error::{Error, Stage};

/// The error for data at byte `offset` that violates a clause of the format.
fn malformed(
    clause: &'static str,
    offset: impl std::fmt::Display,
    field: impl ToString,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(Stage::Bitstream, format!("byte {offset}"), field, value, expected).breaks(clause)
}

#[cfg(test)]
mod tests;
