//! The container: `.b2p` streams, version 2.
//!
//! All numbers are little-endian. A stream is a header, then for every level from L to M its geometry and then its features, so that
//! what ends after a level is a valid coarser stream.
//!
//! # Header
//! With `n = M − L + 1` levels, 88 + 12·n bytes:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | 8 bytes | magic: `89 42 32 50 0d 0a 1a 0a` |
//! | 8 | u16, u16 | version: major 2, minor 0. Another major is another format; a greater minor is read like 0 |
//! | 12 | u32 | critical flags: a reader must refuse what it does not know. None is defined |
//! | 16 | u32 | optional flags: what a reader does not know it ignores. None is defined |
//! | 20 | u8, u8, u8, u8 | bit depth N, base level L, top level M, zero. 1 ≤ N ≤ 21, L ≤ M < N, M − L ≤ 2 |
//! | 24 | u64 | points: occupied voxels of level N, at least those of level M |
//! | 32 | f64 × 4 | placement: origin x, y, z and voxel size, as in [`Placement`](crate::Placement) |
//! | 64 | 16 bytes | model id |
//! | 80 | u32 | slice size S, 1 to 16,384 voxels |
//! | 84 | u32 × n | voxels of level L, …, M: at most 8ᴸ, then from once to eight times those of the level before |
//! | 84 + 4·n | (u32, u32) × n | bytes of level L's geometry section and of its feature section, …, of level M's |
//! | 84 + 12·n | u32 | CRC-32C of all bytes before |
//!
//! # Sections
//! After the header follow geometry L, features L, geometry L + 1, …, features M, of exactly the lengths that the header tells. Each is
//! a sequence of chunks:
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
//! The geometry section of level L holds the levels 1 to L in turn, that of any other level this level alone. Level 0 is one voxel
//! and has no chunk. Level ℓ has a chunk for every S voxels of level ℓ − 1 (the last one for what is left), in order, slices
//! numbered from 0; it tells which children these parents have, and its count is the number of those children: from once to eight
//! times the number of parents. The payload is that of [`crate::geometry`].
//!
//! The feature section of a level has a chunk for every S of its voxels (the last one for what is left), slices numbered from 0.
//! The payload is that of [`crate::entropy`]; that of slice 0 is preceded by the level's latent hash, u64:
//! XXH3-64 of the level's latents as 16-bit numbers, voxel by voxel. A level whose role has no latents in the model has none of these chunks.
//! Then may follow colour filters, at most one for each set of heads: slice 0 for the best, then slice 1 for quick ones, whose count is
//! the level's voxels and whose payload is that of [`crate::gaussians::ColourFilter`]. Then may follow the colour residual of the level: a chunk for every S of its
//! voxels (the last one for what is left), slices numbered from 0, with the payload of [`crate::gaussians::ColourResidual`].
//!
//! Nothing follows the last section.

mod chunk;
mod header;
mod reader;
mod stream;
mod writer;

pub use header::{Header, MAGIC, MAX_SLICE_VOXELS, Section, VERSION};
pub use reader::Reader;
pub use stream::{Geometry, Level, Slice, Stream};
pub use writer::Writer;

use crate::error::{Error, Stage};

/// Something at byte `offset` that breaks the format.
fn malformed(
    offset: impl std::fmt::Display,
    field: impl ToString,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(
        Stage::Bitstream,
        format!("byte {offset}"),
        field,
        value,
        expected,
    )
}

#[cfg(test)]
mod tests;
