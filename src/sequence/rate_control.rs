//! The best sequence of at most so many bits: one quality for all frames, found by trials on a few.

use std::sync::atomic::{AtomicU32, Ordering};

use super::{SequenceEncoder, SequenceReader};
use crate::cloud::ColouredVoxels;
use crate::encoder::transform::QualityTarget;
use crate::error::{Error, Result};
use crate::limits::Limits;

/// Bits that a sequence may have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rate {
    /// For each point of its frames.
    BitsPerPoint(f64),
    /// For each frame.
    BitsPerFrame(f64),
}

/// Frames that are tried: the first ones.
const TRIAL: u64 = 4;
/// The coarsest step that a level is tried with, in eighths of an octave above half of a 255th: 64 255ths; 45 for the
/// cloud's own level, whose geometry takes most (`docs/sequences.md`, "Measured").
const COARSEST: [i32; 2] = [56, 52];
/// Steps that are tried until all frames fit.
const CORRECTIONS: usize = 8;

impl SequenceEncoder {
    /// Codes `count` frames as well as possible with at most so many bits, the whole sequence counted. All frames have
    /// one quality. It is found on the first frames, and corrected if all frames together take more. `cloud` and `done`
    /// are as in [`SequenceEncoder::encode`].
    ///
    /// # Errors
    /// [`Error::Usage`] if the bits are not a finite number above 0, [`Error::TooFewBits`] if the smallest sequence has
    /// more, and those of [`SequenceEncoder::encode`].
    pub fn encode_to_rate(
        &self,
        count: u64,
        cloud: impl Fn(u64) -> Result<ColouredVoxels> + Sync,
        done: impl Fn(u64) + Sync,
        rate: Rate,
    ) -> Result<Vec<u8>> {
        let (Rate::BitsPerPoint(bits) | Rate::BitsPerFrame(bits)) = rate;
        if !(bits.is_finite() && bits > 0.0) {
            return Err(Error::Usage(format!(
                "a sequence cannot have {bits} bits for each point or frame"
            )));
        }
        let points = Points((0..count).map(|_| AtomicU32::new(0)).collect());
        let cloud = |frame: u64| -> Result<ColouredVoxels> {
            let cloud = cloud(frame)?;
            points.0[frame as usize].store(cloud.voxels.len() as u32, Ordering::Relaxed);
            Ok(cloud)
        };
        let depth = cloud(0)?.voxels.depth();
        let levels = self.options.levels.clone().unwrap_or(depth.saturating_sub(3)..=depth);
        let mut least = f64::INFINITY;
        for top in levels.clone().rev() {
            let encoder = |at: i32| {
                let encoder = self.clone().with_levels(*levels.start().min(&top)..=top);
                encoder.with_quality(QualityTarget::Step(0.5 * 2f32.powf(at as f32 / 8.0)))
            };
            let coarsest = COARSEST[usize::from(top == depth && top > *levels.start())];
            let mut fits = |at: i32| -> Result<bool> {
                let used = encoder(at).trial(count, &cloud, &points, rate)?;
                least = least.min(used);
                Ok(used <= bits)
            };
            if !fits(coarsest)? {
                continue;
            }
            let (mut finest, mut too_fine) = (coarsest, -1);
            while finest - too_fine > 1 {
                let middle = (finest + too_fine) / 2;
                match fits(middle)? {
                    true => finest = middle,
                    false => too_fine = middle,
                }
            }
            for at in (finest..=coarsest).take(CORRECTIONS) {
                let bytes = encoder(at).encode(count, cloud, &done)?;
                let used = used(count, bytes.len(), &cloud, &points, rate)?;
                least = least.min(used);
                if used <= bits {
                    return Ok(bytes);
                }
            }
        }
        Err(Error::TooFewBits { asked: bits, least })
    }

    /// The bits that a sequence of `count` frames takes, by its first frames.
    fn trial(
        &self,
        count: u64,
        cloud: &(impl Fn(u64) -> Result<ColouredVoxels> + Sync),
        points: &Points,
        rate: Rate,
    ) -> Result<f64> {
        let frames = count.min(TRIAL).min(self.group.into());
        let bytes = self.encode(frames, cloud, |_| {})?;
        let sequence = SequenceReader::new(&bytes[..], &Limits::unlimited())?;
        let tried = used(frames, bytes.len(), cloud, points, rate)?;
        let group = sequence.group(0)?;
        let whole = group.frame_bytes(0) as f64;
        let rest: u64 = (1..group.len()).map(|at| group.frame_bytes(at)).sum();
        if group.len() < 2 {
            return Ok(tried);
        }
        // A group has one whole frame, whatever its length.
        let each = rest as f64 / (group.len() - 1) as f64;
        let length = count.min(self.group.into()) as f64;
        let mean = (whole + each * (length - 1.0)) / length;
        let overhead = bytes.len() as f64 - whole - rest as f64;
        Ok(tried * (mean + overhead / frames as f64) * frames as f64 / bytes.len() as f64)
    }
}

/// How many points each frame's cloud has, 0 where it was not read: a frame of the cloud's own level states its voxels.
struct Points(Vec<AtomicU32>);

impl Points {
    /// The points of the first `frames` frames.
    fn of(&self, frames: u64, cloud: &impl Fn(u64) -> Result<ColouredVoxels>) -> Result<u64> {
        let points = |frame: u64| match self.0[frame as usize].load(Ordering::Relaxed) {
            0 => cloud(frame).map(|cloud| cloud.voxels.len() as u64),
            points => Ok(points.into()),
        };
        (0..frames).map(points).sum()
    }
}

/// The bits that a sequence of `frames` frames in `bytes` bytes takes for each point or frame.
fn used(
    frames: u64,
    bytes: usize,
    cloud: &impl Fn(u64) -> Result<ColouredVoxels>,
    points: &Points,
    rate: Rate,
) -> Result<f64> {
    let bits = bytes as f64 * 8.0;
    match rate {
        Rate::BitsPerFrame(_) => Ok(bits / frames as f64),
        Rate::BitsPerPoint(_) => Ok(bits / points.of(frames, cloud)?.max(1) as f64),
    }
}
