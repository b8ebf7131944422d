//! Decoded points: voxels with their colours.

use std::ffi::c_char;

use crate::boundary::{Fault, Status, borrowed, changed, give, guard, take};
use crate::decoding::Decoding;

/// The voxels of a level with their colours.
pub struct Points {
    coordinates: Vec<[u32; 3]>,
    colours: Vec<[u8; 3]>,
    level: u8,
    origin: [f64; 3],
    voxel_size: f64,
}

/// Where the numbers of points lie, until these are freed. A voxel with coordinates `c` covers `origin + c * voxel_size` to
/// `origin + (c + 1) * voxel_size` in the world, along each axis; its point is the middle.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct PointArrays {
    /// How many points.
    pub count: usize,
    /// Coordinates x, y, z of voxels, below 2^level: 3 * count numbers.
    pub coordinate: *const u32,
    /// Red, green, blue, display-referred: 3 * count bytes.
    pub colour: *const u8,
    /// The level of the octree.
    pub level: u8,
    /// The world coordinates of the cube's lowest corner.
    pub origin: [f64; 3],
    /// The edge of a voxel of this level in the world.
    pub voxel_size: f64,
}

/// The points of the deepest level decoded so far, in Morton order. Fails with UNSUPPORTED for streams of version 2, whose colours
/// are those of Gaussians, with USAGE, and for a scene as b2p_decoding_advance does.
///
/// # Safety
/// `decoding` is a decoding; `points` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_decoding_points(
    decoding: *const Decoding,
    points: *mut *mut Points,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `decoding`.
        let decoding = unsafe { borrowed(decoding, "decoding") }?;
        if !decoding.has_level() {
            return Err(Fault::usage("no level has been decoded yet"));
        }
        let Some((voxels, colours, frame)) = decoding.points()? else {
            return Err(b2p::Error::Unsupported {
                what: "decoding points",
                detail: "the stream has version 2, which has no colours of voxels".into(),
            }
            .into());
        };
        let coarser = frame.bits - voxels.depth();
        let made = Points {
            coordinates: (0..voxels.len()).map(|i| voxels.coordinate(i)).collect(),
            colours,
            level: voxels.depth(),
            origin: frame.placement.origin,
            voxel_size: frame.placement.voxel_size * f64::from(1u32 << coarser),
        };
        // SAFETY: the caller vouches for `points`.
        unsafe { give(points, "points", made) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Where the numbers of the points lie. Fails with USAGE.
///
/// # Safety
/// `points` are points; `arrays` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_points_arrays(
    points: *const Points,
    arrays: *mut PointArrays,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `points` and `arrays`.
        let (points, arrays) = unsafe { (borrowed(points, "points")?, changed(arrays, "arrays")?) };
        *arrays = PointArrays {
            count: points.coordinates.len(),
            coordinate: points.coordinates.as_ptr().cast(),
            colour: points.colours.as_ptr().cast(),
            level: points.level,
            origin: points.origin,
            voxel_size: points.voxel_size,
        };
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Frees points, and with them what b2p_points_arrays told.
///
/// # Safety
/// `points` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_points_free(points: *mut Points) {
    // SAFETY: the caller vouches for `points`.
    unsafe { take(points) }
}
