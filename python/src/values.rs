//! The values of arguments: limits, axes, names.

use b2p::{Axes, Error, HeadSet, Up};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::errors;

/// How much an input may ask for, checked before memory is reserved.
///
/// Parameters
/// ----------
/// max_points : int, default 2**26
///     Voxels of a level, points of a cloud, Gaussians.
/// max_depth : int, default 21
///     Octree levels.
/// max_pixels : int, default 2**26
///     Pixels of a picture.
/// max_pairs : int, default 2**28
///     Pairs of a Gaussian and a tile that it touches, in one picture.
/// max_bytes : int, default 2**31
///     Bytes of a file, and bytes that one input may make the library reserve.
#[pyclass(frozen, module = "b2p", name = "Limits", from_py_object)]
#[derive(Clone, Default)]
pub struct PyLimits(pub b2p::Limits);

#[pymethods]
impl PyLimits {
    #[new]
    #[pyo3(signature = (*, max_points=None, max_depth=None, max_pixels=None, max_pairs=None, max_bytes=None))]
    fn new(
        max_points: Option<u64>,
        max_depth: Option<u8>,
        max_pixels: Option<u64>,
        max_pairs: Option<u64>,
        max_bytes: Option<u64>,
    ) -> Self {
        let usual = b2p::Limits::default();
        let limits = usual.clone();
        PyLimits(
            limits
                .with_max_points(max_points.unwrap_or(usual.max_points))
                .with_max_depth(max_depth.unwrap_or(usual.max_depth))
                .with_max_pixels(max_pixels.unwrap_or(usual.max_pixels))
                .with_max_pairs(max_pairs.unwrap_or(usual.max_pairs))
                .with_max_bytes(max_bytes.unwrap_or(usual.max_bytes)),
        )
    }

    /// No bounds but those of the formats: for input that is trusted.
    #[staticmethod]
    fn unlimited() -> Self {
        PyLimits(b2p::Limits::unlimited())
    }

    /// For boards with 512 MB of memory.
    #[staticmethod]
    fn embedded() -> Self {
        PyLimits(b2p::Limits::embedded())
    }

    /// Voxels of a level, points of a cloud, Gaussians.
    #[getter]
    fn max_points(&self) -> u64 {
        self.0.max_points
    }

    /// Octree levels.
    #[getter]
    fn max_depth(&self) -> u8 {
        self.0.max_depth
    }

    /// Pixels of a picture.
    #[getter]
    fn max_pixels(&self) -> u64 {
        self.0.max_pixels
    }

    /// Pairs of a Gaussian and a tile in a picture.
    #[getter]
    fn max_pairs(&self) -> u64 {
        self.0.max_pairs
    }

    /// Bytes that one input may make the library reserve.
    #[getter]
    fn max_bytes(&self) -> u64 {
        self.0.max_bytes
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let names = ["max_points", "max_depth", "max_pixels", "max_pairs", "max_bytes"];
        reduced(slf.as_any(), &names, PyDict::new(slf.py()))
    }

    fn __repr__(&self) -> String {
        let b2p::Limits {
            max_points,
            max_depth,
            max_pixels,
            max_pairs,
            max_bytes,
            ..
        } = self.0;
        format!(
            "Limits(max_points={max_points}, max_depth={max_depth}, max_pixels={max_pixels}, max_pairs={max_pairs}, \
             max_bytes={max_bytes})"
        )
    }
}

/// What pickle makes an object of again: its class, called with the attributes of these names and with `fields`.
pub fn reduced<'py>(
    object: &Bound<'py, PyAny>,
    names: &[&str],
    fields: Bound<'py, PyDict>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
    let py = object.py();
    for name in names {
        fields.set_item(name, object.getattr(*name)?)?;
    }
    let partial = py.import("functools")?.getattr("partial")?;
    let build = partial.call((object.get_type(),), Some(&fields))?;
    Ok((build, PyTuple::empty(py)))
}

/// The limits that were given, or the usual ones.
pub fn limits(given: Option<PyLimits>) -> b2p::Limits {
    given.unwrap_or_default().0
}

/// An axis by its name; `auto` and nothing leave it open.
pub fn up(py: Python<'_>, name: Option<&str>) -> PyResult<Option<Up>> {
    match name {
        None | Some("auto") => Ok(None),
        Some(name) => name.parse().map(Some).map_err(|e: Error| errors::exception(py, &e)),
    }
}

/// Metres of a unit, by its name or as a number.
pub fn unit(given: Option<&Bound<'_, PyAny>>) -> PyResult<Option<f64>> {
    let Some(given) = given else { return Ok(None) };
    let name = match given.extract::<f64>() {
        Ok(metres) => format!("{metres:?}"),
        Err(_) => given.extract()?,
    };
    let metres = Axes::parse_unit(&name);
    metres.map(Some).map_err(|e| errors::exception(given.py(), &e))
}

/// Heads by their name.
pub fn heads(py: Python<'_>, name: Option<&str>) -> PyResult<Option<HeadSet>> {
    let parsed = name.map(str::parse).transpose();
    parsed.map_err(|e: Error| errors::exception(py, &e))
}
