//! Gaussians as they should be.

use std::time::Instant;

use super::Subject;
use crate::bitstream::Header;
use crate::decoder::Decoder;
use crate::error::Result;
use crate::gaussians::{Gaussians, activate};
use crate::log::Log;
use crate::network::Model;

/// The Gaussians of a level, generated in double precision; and how many milliseconds that took.
///
/// # Errors
/// Those of [`Decoder::exact`] and [`Model::generate_in_double`].
pub fn in_double(subject: &Subject<'_>, model: &Model, level: u8) -> Result<(Gaussians, f64)> {
    let header = Header::parse(subject.stream, subject.limits)?;
    let decoder = Decoder::new(model).with_limits(subject.limits.clone());
    let exact = decoder.exact(subject.stream, level, &mut Log::default())?;
    let role = usize::from(level.saturating_sub(header.base));
    let map = exact.octree.kernel_map(level);
    let start = Instant::now();
    let raw = model.generate_in_double(role, &exact.features, &map)?;
    let took = start.elapsed().as_secs_f64() * 1e3;
    let children = model.shape().head(role).map_or(1, |head| head.children);
    let (voxels, frame) = (exact.octree.level(level), decoder.frame(subject.stream)?);
    Ok((activate(&raw, voxels, children, model.shape(), frame), took))
}
