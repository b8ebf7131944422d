//! Point clouds as arrays.

use std::sync::Arc;

use b2p::cloud::{Note, RawColours, RawPoints, ReadOptions, Stored};
use b2p::container::axes;
use b2p::{Axes, ColourRange, ColouredVoxels, Limits};
use numpy::{PyArray2, PyArrayDescrMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyIterator, PyTuple};

use crate::arrays::{as_array, check, check_count, flat, matrix, rows, view};
use crate::errors;
use crate::values::{self, PyLimits};

/// Coloured points. ``xyz, rgb = cloud`` takes it apart.
///
/// Parameters
/// ----------
/// xyz : array_like of numbers, [n, 3]
///     Coordinates in the world. Points with a coordinate that is not finite are left out, with a warning.
/// rgb : array_like of uint8 or of floats from 0 to 1, [n, 3], optional
///     sRGB colours. Without any, points are shaded by their height, with a warning.
/// up : {"x", "-x", "y", "-y", "z", "-z"}, optional
///     The axis that points up.
/// unit : str or float, optional
///     Length of a unit: "m", "cm", "mm", "km", "in", "ft", "us-ft", or a number of metres.
/// crs : str, optional
///     The coordinate system, such as WKT or "EPSG:32633".
/// limits : Limits, optional
#[pyclass(frozen, module = "b2p", name = "PointCloud")]
pub struct PyPointCloud {
    pub cloud: Arc<b2p::PointCloud>,
    /// The voxels that the points are the centres of, if they were decoded.
    pub grid: Option<Arc<ColouredVoxels>>,
    notes: Vec<String>,
}

impl PyPointCloud {
    /// A cloud that was read. What was mended or guessed becomes warnings.
    pub fn read(py: Python<'_>, cloud: b2p::PointCloud, notes: &[Note]) -> PyResult<Self> {
        let notes: Vec<_> = notes.iter().map(ToString::to_string).collect();
        for note in &notes {
            errors::warn(py, note)?;
        }
        Ok(PyPointCloud {
            cloud: Arc::new(cloud),
            grid: None,
            notes,
        })
    }

    /// The cloud of arrays.
    pub fn of(
        xyz: &Bound<'_, PyAny>,
        rgb: Option<&Bound<'_, PyAny>>,
        up: Option<&str>,
        unit: Option<&Bound<'_, PyAny>>,
        crs: Option<String>,
        limits: Option<PyLimits>,
    ) -> PyResult<Self> {
        let py = xyz.py();
        let limits = values::limits(limits);
        let (raw, options) = raw(xyz, rgb, &limits)?;
        let options = ReadOptions {
            up: values::up(py, up)?,
            metres_per_unit: values::unit(unit)?,
            ..options
        };
        let (mut cloud, notes) = raw.finish(&options).map_err(|e| errors::exception(py, &e))?;
        cloud.axes.crs = crs.unwrap_or_default();
        Self::read(py, cloud, &notes)
    }

    /// The voxels of a stream that starts with these bytes.
    pub fn decoded(grid: ColouredVoxels, stream: &[u8]) -> Self {
        Self::of_grid(grid, axes(stream).unwrap_or_default())
    }

    /// Decoded voxels, whose coordinates are to be understood by these axes.
    pub fn of_grid(grid: ColouredVoxels, axes: Axes) -> Self {
        let mut cloud = grid.to_world();
        cloud.axes = axes;
        PyPointCloud {
            cloud: Arc::new(cloud),
            grid: Some(Arc::new(grid)),
            notes: Vec::new(),
        }
    }
}

#[pymethods]
impl PyPointCloud {
    #[new]
    #[pyo3(signature = (xyz, rgb=None, *, up=None, unit=None, crs=None, limits=None))]
    fn new(
        xyz: &Bound<'_, PyAny>,
        rgb: Option<&Bound<'_, PyAny>>,
        up: Option<&str>,
        unit: Option<&Bound<'_, PyAny>>,
        crs: Option<String>,
        limits: Option<PyLimits>,
    ) -> PyResult<Self> {
        Self::of(xyz, rgb, up, unit, crs, limits)
    }

    /// Coordinates in the world: float64 [n, 3], read-only, not copied.
    #[getter]
    fn xyz<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.cloud, vec![self.__len__(), 3], |c| c.positions.as_flattened())
    }

    /// sRGB colours: uint8 [n, 3], read-only, not copied.
    #[getter]
    fn rgb<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.cloud, vec![self.__len__(), 3], |c| c.colours.as_flattened())
    }

    /// Of decoded points, the voxels: uint32 [n, 3], in Morton order. The centre of voxel v is
    /// ``origin + (v + 0.5) * voxel_size``. None of other clouds.
    #[getter]
    fn voxels<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<u32>>>> {
        let Some(grid) = &self.grid else { return Ok(None) };
        let voxels = (0..grid.voxels.len()).map(|i| grid.voxels.coordinate(i));
        matrix(py, voxels.collect()).map(Some)
    }

    /// Bit depth of the voxel grid that the points lie on, if that is known.
    #[getter]
    fn bits(&self) -> Option<u8> {
        self.cloud.hints.bits
    }

    /// The corner of that grid with the lowest coordinates, in the world.
    #[getter]
    fn origin(&self) -> Option<(f64, f64, f64)> {
        self.cloud.hints.placement.map(|placement| placement.origin.into())
    }

    /// Edge of its voxels, in units of the world.
    #[getter]
    fn voxel_size(&self) -> Option<f64> {
        self.cloud.hints.placement.map(|placement| placement.voxel_size)
    }

    /// The axis that points up, such as "z"; None if it is not known.
    #[getter]
    fn up(&self) -> Option<String> {
        self.cloud.axes.up.map(|up| up.to_string())
    }

    /// Length of a unit in metres; None if it is not known.
    #[getter]
    fn metres_per_unit(&self) -> Option<f64> {
        self.cloud.axes.metres_per_unit
    }

    /// The coordinate system; empty if it is not known.
    #[getter]
    fn crs(&self) -> &str {
        &self.cloud.axes.crs
    }

    /// What was mended, guessed or left out when the points were read, a sentence each.
    #[getter]
    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }

    fn __len__(&self) -> usize {
        self.cloud.positions.len()
    }

    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyIterator>> {
        PyTuple::new(py, [self.xyz(py)?, self.rgb(py)?])?.try_iter()
    }

    fn __repr__(&self) -> String {
        format!("<b2p.PointCloud: {} points>", self.__len__())
    }
}

/// Points of arrays, and how they are to be read.
fn raw(xyz: &Bound<'_, PyAny>, rgb: Option<&Bound<'_, PyAny>>, limits: &Limits) -> PyResult<(RawPoints, ReadOptions)> {
    let raw = RawPoints {
        positions: rows("xyz", xyz, limits)?,
        colours: match rgb {
            Some(rgb) => colours(rgb, limits)?,
            None => RawColours::None,
        },
        ..RawPoints::default()
    };
    let options = ReadOptions {
        // Floats are never taken for another range, however large they are.
        colour_range: matches!(raw.colours, RawColours::Rgb(..)).then_some(ColourRange::Unit),
        ..ReadOptions::default()
    };
    Ok((raw, options))
}

fn colours(rgb: &Bound<'_, PyAny>, limits: &Limits) -> PyResult<RawColours> {
    let array = as_array(rgb)?;
    check("rgb", &array, &[None, Some(3)])?;
    check_count("rgb", &array, limits)?;
    let (kind, size) = (array.dtype().kind(), array.dtype().itemsize());
    if kind == b'u' && size == 1 {
        return Ok(RawColours::Bytes(flat::<u8>(&array)?.as_chunks().0.to_vec()));
    }
    if kind == b'f' {
        let values = flat::<f32>(&array)?.as_chunks().0.to_vec();
        return Ok(RawColours::Rgb(values, Stored::Float));
    }
    let found = array.dtype().str()?;
    let what = format!("rgb has the dtype {found}, expected uint8, or floats from 0 to 1");
    Err(errors::usage(rgb.py(), what))
}
