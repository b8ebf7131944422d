//! What a stream holds.

use b2p::container::{Level, Section, Stream, axes};
use b2p::{Error, Result, colour};
use pyo3::prelude::*;
use serde_json::{Value, json};

use crate::scene::{self, Input};
use crate::source::Source;
use crate::values::{self, PyLimits};
use crate::work::Work;

/// Describes a stream, as `b2p info --json` does, without decoding it.
///
/// Parameters
/// ----------
/// stream : path or bytes
///     It may be cut or damaged behind its header.
/// limits : Limits, optional
///
/// Returns
/// -------
/// dict
///     version, bits, points; levels, each a dict of level, voxels, geometry_bytes, colour_bytes, luma_step, lossless,
///     prefix_bytes (where a stream that ends with it is cut) and whole; total_bytes, model, up, metres_per_unit, crs,
///     origin, voxel_size, complete_to_level, top_level, and damage, which says what is wrong. Of a scene of blocks,
///     levels are the first and the last, voxels those of each, and blocks a dict each of level, at (coordinates of
///     its cube), points, voxels, offset and bytes.
#[pyfunction]
#[pyo3(signature = (stream, *, limits=None))]
pub fn info<'py>(py: Python<'py>, stream: &Bound<'py, PyAny>, limits: Option<PyLimits>) -> PyResult<Bound<'py, PyAny>> {
    let source = Source::of(stream)?;
    let limits = values::limits(limits);
    let text = Work::default().run(py, move |_, _| {
        let source = match Input::of(source, &limits)? {
            Input::Scene(scene) => return Ok(scene::description(&scene).to_string()),
            Input::Stream(source) => source,
        };
        let bytes = source.load(&limits)?;
        let stream = Stream::parse(&bytes, &limits)?;
        Ok(description(&stream, &bytes)?.to_string())
    })?;
    py.import("json")?.call_method1("loads", (text,))
}

fn description(stream: &Stream<'_>, bytes: &[u8]) -> Result<Value> {
    let header = stream.header();
    let axes = axes(bytes)?;
    let sections = header.voxels.iter().zip(&header.sections);
    let level = |(i, (level, (voxels, section))): (usize, (u8, (&u32, &Section)))| {
        let found: Option<&Level<'_>> = stream.levels().get(i);
        let steps = found.and_then(steps);
        Ok(json!({
            "level": level,
            "voxels": voxels,
            "geometry_bytes": section.geometry,
            "colour_bytes": section.colours,
            "luma_step": steps.map(|steps| steps.luma_step()),
            "lossless": steps.map(|steps| steps.is_lossless()),
            "prefix_bytes": header.prefix_bytes(level)?,
            "whole": found.is_some(),
        }))
    };
    let levels = (header.base..).zip(sections).enumerate().map(level);
    let levels = levels.collect::<Result<Vec<_>>>()?;
    let ends_at_a_level = |level: &u8| header.prefix_bytes(*level).is_ok_and(|end| end == bytes.len() as u64);
    let is_cut = stream.deepest().as_ref().is_some_and(ends_at_a_level);
    let damage = stream.damage().filter(|_| !is_cut);
    Ok(json!({
        "version": header.format.version(),
        "bits": header.bits,
        "points": header.points,
        "levels": levels,
        "total_bytes": bytes.len(),
        "model": header.model(),
        "up": axes.up.map(|up| up.to_string()),
        "metres_per_unit": axes.metres_per_unit,
        "crs": axes.crs,
        "origin": header.placement.origin,
        "voxel_size": header.placement.voxel_size,
        "complete_to_level": stream.deepest(),
        "top_level": header.top,
        "damage": damage.map(Error::to_string),
    }))
}

/// The quantisation steps of a level of version 3.
fn steps(level: &Level<'_>) -> Option<colour::Steps> {
    let colours = level.colours.as_ref()?;
    let trunk = colours.trunk.map(|trunk| trunk.slice);
    let last = colours.levels.last().and_then(|level| level.slices.first());
    let &[luma, chroma, ..] = last.or(trunk.as_ref())?.bytes else {
        return None;
    };
    let steps = colour::Steps { luma, chroma };
    steps.is_valid().then_some(steps)
}
