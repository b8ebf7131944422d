//! Rate and distortion: what a method costs, and how far its pictures are from the truth.
//!
//! [`protocol`] says what is drawn and compared, [`metrics`] how. Clouds without Gaussians of their own are drawn as squares and as
//! one round Gaussian a point ([`points`]).

pub mod item;
pub mod metrics;
pub mod nearest;
pub mod picture;
pub mod points;
pub mod protocol;
pub mod reframe;
pub mod report;
pub mod sheet;

use b2p::gaussians::{Frame, Gaussians};

use crate::error::Result;
use points::Points;
use protocol::{Judged, Truth};

/// Sides of squares that are tried, as multiples of the points' spacing.
const SIDES: [f64; 3] = [1.0, 1.3, 1.7];

/// How something was drawn, and what came of it.
#[derive(Debug, Clone)]
pub struct Drawn {
    /// In words.
    pub how: String,
    /// How many squares or Gaussians it took.
    pub primitives: usize,
    /// The pictures and their scores.
    pub judged: Judged,
}

/// Judges a cloud drawn as squares, of the best of three sizes by PSNR over whole pictures, and as global Gaussians.
///
/// # Errors
/// If it cannot be drawn.
pub fn judge_cloud(truth: &Truth, points: &Points, frame: Frame) -> Result<[Drawn; 2]> {
    let mut best: Option<(f64, Judged)> = None;
    for factor in SIDES {
        let judged = truth.judge(|camera| Ok(points.draw_squares(camera, factor)))?;
        let better = |(_, other): &(f64, Judged)| judged.mean.psnr > other.mean.psnr;
        if best.as_ref().is_none_or(better) {
            best = Some((factor, judged));
        }
    }
    let (factor, judged) = best.expect("the first size beats none");
    let squares = Drawn {
        how: format!("squares x{factor}"),
        primitives: points.positions.len(),
        judged,
    };
    let round = judge_gaussians(truth, points.to_gaussians(frame), "global Gaussian", frame)?;
    Ok([squares, round])
}

/// Judges Gaussians, after bringing them into the cube of `frame`, which the truth is in.
///
/// # Errors
/// If they cannot be drawn.
pub fn judge_gaussians(
    truth: &Truth,
    gaussians: Gaussians,
    how: &str,
    frame: Frame,
) -> Result<Drawn> {
    let gaussians = reframe::into_frame(gaussians, frame);
    Ok(Drawn {
        how: how.into(),
        primitives: gaussians.len(),
        judged: truth.judge_gaussians(&gaussians)?,
    })
}
