//! How much an input may ask for.

use crate::error::{Error, Result};

/// The deepest octree level: what a Morton key of 64 bits addresses.
pub const MAX_DEPTH: u8 = 21;

/// Bounds that are checked before memory is reserved. Finite by default: 2²⁶ points, 21 levels, 2²⁶ pixels, 2²⁸ pairs,
/// 2²⁰ frames, 2 GiB.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Voxels of any one level, and points of any one cloud.
    pub max_points: u64,
    /// Octree levels.
    pub max_depth: u8,
    /// Pixels of one picture. A pixel takes 16 bytes of `max_bytes`.
    pub max_pixels: u64,
    /// Pairs of a Gaussian and a tile of 32×32 pixels that it touches, in one picture: the work of drawing it.
    pub max_pairs: u64,
    /// Frames of one sequence.
    pub max_frames: u64,
    /// Bytes that one input may make the library reserve, estimated from its counts.
    pub max_bytes: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Limits {
            max_points: 1 << 26,
            max_depth: 21,
            max_pixels: 1 << 26,
            max_pairs: 1 << 28,
            max_frames: 1 << 20,
            max_bytes: 2 << 30,
        }
    }
}

impl Limits {
    /// What the library takes beyond `max_bytes`, however small the input: threads and their scratch.
    pub const OVERHEAD: u64 = 4 << 20;

    /// For boards with 512 MB of memory: 2²⁰ points, pictures of 2²² pixels and 2²⁴ pairs, 2¹⁶ frames,
    /// 192 MiB.
    pub fn embedded() -> Self {
        Limits {
            max_points: 1 << 20,
            max_depth: 21,
            max_pixels: 1 << 22,
            max_pairs: 1 << 24,
            max_frames: 1 << 16,
            max_bytes: 192 << 20,
        }
    }

    /// No bounds but those of the format: for input that is trusted.
    pub fn unlimited() -> Self {
        Limits {
            max_points: u64::MAX,
            max_depth: u8::MAX,
            max_pixels: u64::MAX,
            max_pairs: u64::MAX,
            max_frames: u64::MAX,
            max_bytes: u64::MAX,
        }
    }

    /// The same limits with other [`Limits::max_points`].
    pub fn with_max_points(mut self, points: u64) -> Self {
        self.max_points = points;
        self
    }

    /// The same limits with other [`Limits::max_depth`].
    pub fn with_max_depth(mut self, depth: u8) -> Self {
        self.max_depth = depth;
        self
    }

    /// The same limits with other [`Limits::max_pixels`].
    pub fn with_max_pixels(mut self, pixels: u64) -> Self {
        self.max_pixels = pixels;
        self
    }

    /// The same limits with other [`Limits::max_pairs`].
    pub fn with_max_pairs(mut self, pairs: u64) -> Self {
        self.max_pairs = pairs;
        self
    }

    /// The same limits with other [`Limits::max_frames`].
    pub fn with_max_frames(mut self, frames: u64) -> Self {
        self.max_frames = frames;
        self
    }

    /// The same limits with other [`Limits::max_bytes`].
    pub fn with_max_bytes(mut self, bytes: u64) -> Self {
        self.max_bytes = bytes;
        self
    }

    /// Holds `count` points against the limit.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_points(&self, what: &'static str, count: u64) -> Result<()> {
        check(what, count, self.max_points, "max_points")
    }

    /// Holds `depth` levels against the limit.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_depth(&self, what: &'static str, depth: u8) -> Result<()> {
        check(what, depth.into(), self.max_depth.into(), "max_depth")
    }

    /// Holds `count` pixels against the limit.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_pixels(&self, what: &'static str, count: u64) -> Result<()> {
        check(what, count, self.max_pixels, "max_pixels")
    }

    /// Holds `count` pairs of Gaussians and tiles against the limit.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_pairs(&self, what: &'static str, count: u64) -> Result<()> {
        check(what, count, self.max_pairs, "max_pairs")
    }

    /// Holds `count` frames against the limit.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_frames(&self, what: &'static str, count: u64) -> Result<()> {
        check(what, count, self.max_frames, "max_frames")
    }

    /// Holds `bytes` against the limit, which is never more than the machine can address.
    ///
    /// # Errors
    /// [`Error::LimitExceeded`], naming `what`, if they are more.
    #[doc(hidden)]
    pub fn check_bytes(&self, what: &'static str, bytes: u64) -> Result<()> {
        let addressable = isize::MAX as u64;
        check(what, bytes, self.max_bytes.min(addressable), "max_bytes")
    }
}

fn check(what: &'static str, needed: u64, limit: u64, option: &'static str) -> Result<()> {
    if needed <= limit {
        return Ok(());
    }
    Err(Error::LimitExceeded {
        what,
        needed,
        limit,
        option,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_of_small_devices_are_below_the_usual_ones() {
        let all = |limits: Limits| {
            let Limits {
                max_points,
                max_pixels,
                max_pairs,
                max_frames,
                max_bytes,
                ..
            } = limits;
            [max_points, max_pixels, max_pairs, max_frames, max_bytes]
        };
        let (small, usual) = (all(Limits::embedded()), all(Limits::default()));
        assert!(
            small.iter().zip(&usual).all(|(small, usual)| small < usual),
            "{small:?} {usual:?}"
        );
    }

    #[test]
    fn the_largest_picture_of_each_preset_fits_its_memory_twice_over() {
        for limits in [Limits::default(), Limits::embedded()] {
            let pixel = size_of::<[f32; 4]>() as u64;
            assert!(2 * limits.max_pixels * pixel <= limits.max_bytes, "{limits:?}");
        }
    }
}
