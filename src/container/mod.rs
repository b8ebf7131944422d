//! The container: `.b2p` streams of versions 2 and 3.
//!
//! All numbers are little-endian. A stream is a header, then for every level from L to M its geometry and then its colours, so that
//! what ends after a level is a valid coarser stream. Version 3 codes colours as transform coefficients and needs no model file;
//! version 2 codes learned features (latents), which only the model that they were coded with can decode.
//!
//! # Header
//! With `n = M − L + 1` levels and the arrays at `a` = 84 in version 2, 72 in version 3, it takes a + 4 + 12·n bytes:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | 8 bytes | magic: `89 42 32 50 0d 0a 1a 0a` |
//! | 8 | u16, u16 | version: major 2 or 3, minor 0. Another major is another format; a greater minor is read like 0 |
//! | 12 | u32 | critical flags: a reader must refuse what it does not know. None is defined |
//! | 16 | u32 | optional flags: what a reader does not know it ignores. None is defined |
//! | 20 | u8, u8, u8, u8 | bit depth N, base level L, top level M, zero. 1 ≤ N ≤ 21, L ≤ M. Version 2: M < N, n ≤ 3. Version 3: M ≤ N, n ≤ 21 |
//! | 24 | u64 | points: occupied voxels of level N, at least those of level M |
//! | 32 | f64 × 4 | placement: origin x, y, z and voxel size, as in [`Placement`](crate::Placement) |
//! | 64 | 16 bytes | version 2 only: model id |
//! | a − 4, or a − 8 in version 3 | u32 | geometry slice size S, 1 to 16,384 voxels |
//! | a − 4 | u32 | version 3 only: colour slice size C, 1 to 65,536 voxels |
//! | a | u32 × n | voxels of level L, …, M: at most 8ᴸ, then from once to eight times those of the level before |
//! | a + 4·n | (u32, u32) × n | bytes of level L's geometry section and of its colour section, …, of level M's |
//! | a + 12·n | u32 | CRC-32C of all bytes before |
//!
//! After the header follow geometry L, colours L, geometry L + 1, …, colours M, of exactly the lengths that the header tells. Each is
//! a sequence of chunks. Nothing follows the last section.
//!
//! # Version 3
//! A chunk, its numbers without a type in LEB128 (below 2³², in as few bytes as they take):
//!
//! | type | field |
//! |---|---|
//! | u8 | type: 1 geometry, 5 geometry trunk, 6 colour trunk, 7 colours, 8 colour filter. From 128 on: ancillary, anywhere in a section, to be skipped. Any other: refuse |
//! | u8 | level |
//! | | slice |
//! | | count |
//! | | length of the payload |
//! | u32 | CRC-32C of the fields before and the payload |
//! | | payload |
//!
//! Level 0 is one voxel and has no geometry. If L > 0, the geometry section of level L starts with the geometry trunk, slice 0: its level J,
//! 1 ≤ J ≤ L, says that it holds the levels 1 to J, its count is the voxels of level J. For each of these levels in turn the payload has the number of
//! its voxels (LEB128; from once to eight times those of the level before), the length of its code (LEB128), and the code. A level is in the trunk only
//! if the one before it has at most S voxels. Then follow the chunks of the levels J + 1 to L, and in any other level's section those of this
//! level alone. Level ℓ has a chunk for every S voxels of level ℓ − 1 (the last one for what is left), in order, slices
//! numbered from 0; it tells which children these parents have, and its count is the number of those children: from once to eight
//! times the number of parents. A code, in the trunk or in a chunk, is that of a slice in [`crate::geometry::codec`].
//!
//! The colour section of level L starts with the colour trunk, slice 0: its level K, 0 ≤ K ≤ L, says that it holds the colours of the levels 0
//! to K, its count is the voxels of level K, at most 65,536. Then follow the chunks of the levels K + 1 to L, and in any other level's section those of this level alone.
//! Level ℓ has a chunk for every C voxels of level ℓ − 1 (the last one for what is left), slices numbered from 0; its count is that of these
//! parents. The payload of a section's first chunk is preceded by u64: XXH3-64 of the colours of the section's level as decoded, before the
//! filter, red, green, blue of one voxel after the other, a byte each. At the end of the section may stand the colour filter of its level, slice 0, whose count is the
//! level's voxels. The payloads are those of [`crate::colour`].
//!
//! # Version 2
//! A chunk:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | u8 | type: 1 geometry, 2 features, 3 colour filter, 4 colour residual. From 128 on: ancillary, anywhere in a section, to be skipped. Any other: refuse |
//! | 1 | u8 | level |
//! | 2 | u16 | slice |
//! | 4 | u32 | voxels of the slice |
//! | 8 | u32 | length of the payload |
//! | 12 | u32 | CRC-32C of bytes 0 to 11 and the payload |
//! | 16 | | payload |
//!
//! The geometry section of level L holds the levels 1 to L in turn, that of any other level this level alone, each cut into slices as in version 3.
//!
//! The colour section of a level has a chunk of features for every S of its voxels (the last one for what is left), slices numbered from 0.
//! The payload is that of [`crate::latents::entropy`]; that of slice 0 is preceded by the level's latent hash, u64:
//! XXH3-64 of the level's latents as 16-bit numbers, voxel by voxel. A level whose role has no latents in the model has none of these chunks.
//! Then may follow colour filters, at most one for each set of heads: slice 0 for the best, then slice 1 for quick ones, whose count is
//! the level's voxels and whose payload is that of [`crate::latents::ColourFilter`]. Then may follow the colour residual of the level: a chunk for every S of its
//! voxels (the last one for what is left), slices numbered from 0, with the payload of [`crate::latents::ColourResidual`].

mod chunk;
pub(crate) mod feed;
mod header;
mod reader;
mod stream;
mod transform;
mod writer;

pub use header::{Format, Header, MAGIC, MAX_COLOUR_SLICE, MAX_SLICE_VOXELS, Section, version};
pub use reader::{Reader, put_varint};
pub use stream::{Geometry, Level, Slice, Stream};
pub use transform::{ColourLevel, Colours, MAX_TRUNK_VOXELS, Trunk};
pub use writer::Writer;

use crate::error::{Error, Stage};

/// Something at byte `offset` that breaks the format.
fn malformed(
    offset: impl std::fmt::Display,
    field: impl ToString,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(Stage::Bitstream, format!("byte {offset}"), field, value, expected)
}

#[cfg(test)]
mod tests;
