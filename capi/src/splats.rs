//! Files: what they are, and the Gaussians in those of other programs.

use std::ffi::c_char;

use b2p::{SceneReader, SequenceReader};
use b2p_formats::detect::{Group, Kind};
use b2p_formats::splats::{self, Format};

use crate::boundary::{Fault, Status, changed, give, guard, slice};
use crate::decoding::Gaussians;
use crate::model::Limits;

/// What a file holds that this library reads.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    /// A stream.
    Stream = 0,
    /// A scene of blocks.
    Scene = 1,
    /// A sequence of frames.
    Sequence = 2,
    /// Gaussians as other programs write them, or what may be that: PLY, SPZ, SOG, .splat, glTF, CSV and NumPy files.
    Splats = 3,
}

/// Tells what a file holds, one of [`Content`], by its first bytes: 4096, or all if there are less. Fails with UNSUPPORTED, whose text says what the file is, if
/// it is plainly nothing that this library reads. Fails with USAGE.
///
/// # Safety
/// `bytes` leads to `length` bytes; `content` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_content(
    bytes: *const u8,
    length: usize,
    content: *mut i32,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `bytes` and `content`.
        let (bytes, content) = unsafe { (slice(bytes, length, "bytes")?, changed(content, "content")?) };
        *content = content_of(bytes)? as i32;
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Reads a file of Gaussians, all of which is there: `bytes` are not needed afterwards. `limits` may be NULL. Coordinates keep the axes of
/// the file, those of glTF are turned to those of PLY. Fails with UNSUPPORTED, whose text says what the file is, if it holds no Gaussians;
/// with MALFORMED, TRUNCATED, LIMIT, USAGE.
///
/// # Safety
/// `bytes` leads to `length` bytes; `limits` is NULL or limits; `gaussians` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_gaussians_from_file(
    bytes: *const u8,
    length: usize,
    limits: *const Limits,
    gaussians: *mut *mut Gaussians,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `bytes` and `limits`.
        let (bytes, limits) = unsafe { (slice(bytes, length, "bytes")?, limits.as_ref()) };
        let limits = limits.map_or_else(b2p::Limits::default, |limits| (*limits).into());
        let format = format_of(bytes)?;
        let read = splats::read(bytes, format, &splats::Options::default(), &limits)?;
        // SAFETY: the caller vouches for `gaussians`.
        unsafe { give(gaussians, "gaussians", Gaussians(read.into_cloud())) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

fn content_of(start: &[u8]) -> Result<Content, Fault> {
    let kind = Kind::of(start);
    match (kind, kind.group()) {
        (Kind::Stream, _) if SequenceReader::is_sequence(start) => Ok(Content::Sequence),
        (Kind::Stream, _) if SceneReader::is_scene(start) => Ok(Content::Scene),
        (Kind::Stream, _) => Ok(Content::Stream),
        (Kind::Ksplat | Kind::SogMeta, _) => Err(refused(kind)),
        // What archives, glTF and rows of numbers hold shows further on.
        (Kind::Ply | Kind::Glb | Kind::Gltf | Kind::Json | Kind::Text | Kind::Zip | Kind::Npz, _)
        | (_, Group::Splats) => Ok(Content::Splats),
        _ => Err(refused(kind)),
    }
}

fn format_of(bytes: &[u8]) -> Result<Format, Fault> {
    let kind = Kind::of(bytes);
    match Format::of_bytes(bytes) {
        Some(Format::Ply) if kind != Kind::GaussianPly => Err(refused(kind)),
        Some(format) => Ok(format),
        None if kind == Kind::Splat => Ok(Format::Splat),
        None => Err(refused(kind)),
    }
}

/// What a file is that nothing is read from, and what to do with it.
fn refused(kind: Kind) -> Fault {
    let more = match kind.group() {
        Group::Splats => ", which is not read: convert it to PLY or SPZ",
        Group::Cloud => ", no stream and no Gaussians: `b2p encode` makes a stream of a point cloud",
        Group::Mesh => ", no stream and no Gaussians: sample it to a point cloud, which `b2p encode` makes a stream of",
        Group::Archive => ", no stream and no Gaussians: unpack it first",
        _ => ", no stream and no Gaussians",
    };
    Fault::unsupported(format!("this is {kind}{more}"))
}
