//! Gaussians as arrays.

use std::sync::Arc;

use b2p::gaussians::{Frame, Harmonics};
use b2p::{Limits, Placement, Up};
use numpy::{PyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::arrays::{as_array, check, check_count, flat, matrix, rows, view};
use crate::errors;
use crate::values::{self, PyLimits};

/// 3D Gaussians, one array for each parameter.
///
/// The arrays that attributes give are read-only float32 views of memory that belongs to the library: nothing is
/// copied, and a view keeps that memory alive. Their coordinates are those of the cube frame, in which the voxel cube
/// is ``[-1, 1]``³: ``world = origin + (position + 1) * unit``.
///
/// Parameters
/// ----------
/// positions : array_like, [n, 3]
///     Centres, in the coordinates that `coordinates` names.
/// scales : array_like, [n, 3]
///     Standard deviations along the Gaussian's own axes, in the same unit; not logarithms.
/// rotations : array_like, [n, 4]
///     Unit quaternions w, x, y, z from the Gaussian's axes to the world's.
/// opacities : array_like, [n]
///     Opacities at the centre, 0 to 1; not logits.
/// colours : array_like, [n, 3]
///     Red, green and blue, display-referred (sRGB), 0 to 1; of view-dependent colour the part of degree 0.
/// harmonics : array_like, [n, k, 3], optional
///     Coefficients of view-dependent colour, k = 3, 8 or 15 for degree 1 to 3, by ascending degree and order.
/// coordinates : {"world", "cube"}
///     What positions, scales and blur refer to. Of the world, the cube is fitted to the centres unless it is given.
/// bits, origin, voxel_size : optional
///     The cube: 2**bits voxels of this size a side, from this corner. All of them or none.
/// blur : float
///     Variance that is added to every Gaussian when it is drawn, in squared units of the coordinates.
/// compensated : bool
///     Whether the Gaussians were made for rendering with opacity compensation (anti-aliasing).
/// up : {"x", "-x", "y", "-y", "z", "-z"}, optional
///     The axis that points up, for cameras on an orbit.
/// level : int, optional
///     The octree level that they were decoded from.
/// limits : Limits, optional
#[pyclass(frozen, module = "b2p", name = "Gaussians")]
pub struct PyGaussians {
    pub inner: Arc<b2p::Gaussians>,
    pub up: Option<Up>,
    pub level: Option<u8>,
}

/// The arguments that make the same Gaussians again, in the cube frame.
const STATE: [&str; 13] = [
    "positions",
    "scales",
    "rotations",
    "opacities",
    "colours",
    "harmonics",
    "bits",
    "origin",
    "voxel_size",
    "blur",
    "compensated",
    "up",
    "level",
];

impl PyGaussians {
    /// Gaussians of which nothing more is known.
    pub fn bare(gaussians: b2p::Gaussians) -> Self {
        PyGaussians {
            inner: Arc::new(gaussians),
            up: None,
            level: None,
        }
    }
}

#[pymethods]
impl PyGaussians {
    #[new]
    #[pyo3(signature = (positions, scales, rotations, opacities, colours, harmonics=None, *, coordinates="world",
        bits=None, origin=None, voxel_size=None, blur=0.0, compensated=false, up=None, level=None, limits=None))]
    fn new(
        py: Python<'_>,
        positions: &Bound<'_, PyAny>,
        scales: &Bound<'_, PyAny>,
        rotations: &Bound<'_, PyAny>,
        opacities: &Bound<'_, PyAny>,
        colours: &Bound<'_, PyAny>,
        harmonics: Option<&Bound<'_, PyAny>>,
        coordinates: &str,
        bits: Option<u8>,
        origin: Option<[f64; 3]>,
        voxel_size: Option<f64>,
        blur: f64,
        compensated: bool,
        up: Option<&str>,
        level: Option<u8>,
        limits: Option<PyLimits>,
    ) -> PyResult<Self> {
        let limits = values::limits(limits);
        let given = frame(py, bits, origin, voxel_size)?;
        let mut gaussians = b2p::Gaussians {
            rotation: rows("rotations", rotations, &limits)?,
            opacity: column("opacities", opacities, &limits)?,
            colour: rows("colours", colours, &limits)?,
            harmonics: coefficients(harmonics, &limits)?,
            compensated,
            ..b2p::Gaussians::default()
        };
        gaussians.frame = given.unwrap_or_default();
        match coordinates {
            "cube" => {
                gaussians.position = rows("positions", positions, &limits)?;
                gaussians.scale = rows("scales", scales, &limits)?;
                gaussians.blur = blur as f32;
            }
            "world" => {
                let positions = rows("positions", positions, &limits)?;
                let scales = rows("scales", scales, &limits)?;
                place(&mut gaussians, given, &positions, &scales, blur);
            }
            other => {
                let what = format!("coordinates are {other:?}, expected \"world\" or \"cube\"");
                return Err(errors::usage(py, what));
            }
        }
        let checked = gaussians.check_lengths();
        checked.map_err(|error| errors::exception(py, &error))?;
        if !gaussians.frame.is_valid() {
            let what = format!("the cube of the Gaussians is not valid: {:?}", gaussians.frame);
            return Err(errors::usage(py, what));
        }
        Ok(PyGaussians {
            inner: Arc::new(gaussians),
            up: values::up(py, up)?,
            level,
        })
    }

    /// Centres in the cube frame: float32 [n, 3], read-only, not copied.
    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.inner, vec![self.inner.len(), 3], |g| {
            g.position.as_flattened()
        })
    }

    /// Standard deviations along the Gaussian's own axes, in cube-frame units: float32 [n, 3], read-only, not copied.
    #[getter]
    fn scales<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.inner, vec![self.inner.len(), 3], |g| g.scale.as_flattened())
    }

    /// Unit quaternions w, x, y, z: float32 [n, 4], read-only, not copied.
    #[getter]
    fn rotations<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.inner, vec![self.inner.len(), 4], |g| {
            g.rotation.as_flattened()
        })
    }

    /// Opacities, 0 to 1: float32 [n], read-only, not copied.
    #[getter]
    fn opacities<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.inner, vec![self.inner.len()], |g| &g.opacity)
    }

    /// Red, green and blue, display-referred (sRGB), 0 to 1: float32 [n, 3], read-only, not copied.
    #[getter]
    fn colours<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        view(py, &self.inner, vec![self.inner.len(), 3], |g| g.colour.as_flattened())
    }

    /// Coefficients of view-dependent colour: float32 [n, k, 3], read-only, not copied; None if there are none.
    #[getter]
    fn harmonics<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        let count = self.inner.harmonics.count;
        if count == 0 {
            return Ok(None);
        }
        let shape = vec![self.inner.len(), count, 3];
        view(py, &self.inner, shape, |g| g.harmonics.coefficients.as_flattened()).map(Some)
    }

    /// Centres in the world, in the unit of the cloud: float64 [n, 3], computed at each access.
    #[getter]
    fn world_positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let frame = self.inner.frame;
        let world = |position: &[f32; 3]| frame.placement.from_cube(frame.bits, *position);
        matrix(py, self.inner.position.iter().map(world).collect())
    }

    /// Standard deviations in the unit of the cloud: float64 [n, 3], computed at each access.
    #[getter]
    fn world_scales<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let unit = self.inner.frame.unit();
        let world = |scale: &[f32; 3]| scale.map(|s| f64::from(s) * unit);
        matrix(py, self.inner.scale.iter().map(world).collect())
    }

    /// The corner of the cube with the lowest coordinates, in the world.
    #[getter]
    fn origin(&self) -> (f64, f64, f64) {
        self.inner.frame.placement.origin.into()
    }

    /// One unit of the cube frame, half a side of the cube, in units of the world.
    #[getter]
    fn unit(&self) -> f64 {
        self.inner.frame.unit()
    }

    /// Bit depth of the cube: it has 2**bits voxels a side.
    #[getter]
    fn bits(&self) -> u8 {
        self.inner.frame.bits
    }

    /// Edge of the cube's finest voxels, in units of the world.
    #[getter]
    fn voxel_size(&self) -> f64 {
        self.inner.frame.placement.voxel_size
    }

    /// Variance that is added to every Gaussian when it is drawn, in squared cube-frame units.
    #[getter]
    fn blur(&self) -> f32 {
        self.inner.blur
    }

    /// Whether the Gaussians were made for rendering with opacity compensation (anti-aliasing).
    #[getter]
    fn compensated(&self) -> bool {
        self.inner.compensated
    }

    /// The axis that points up, such as "z"; None if it is not known.
    #[getter]
    fn up(&self) -> Option<String> {
        self.up.map(|up| up.to_string())
    }

    /// The octree level that they were decoded from; None of others.
    #[getter]
    fn level(&self) -> Option<u8> {
        self.level
    }

    fn __len__(&self) -> usize {
        self.inner.len()
    }

    fn __repr__(&self) -> String {
        let level = self.level.map_or(String::new(), |level| format!(", level {level}"));
        format!("<b2p.Gaussians: {} at {} bits{level}>", self.inner.len(), self.bits())
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let fields = PyDict::new(slf.py());
        fields.set_item("coordinates", "cube")?;
        fields.set_item("limits", PyLimits(Limits::unlimited()))?;
        values::reduced(slf.as_any(), &STATE, fields)
    }
}

/// Places Gaussians of the world in the cube that is given, or that is fitted to them.
fn place(gaussians: &mut b2p::Gaussians, given: Option<Frame>, positions: &[[f64; 3]], scales: &[[f64; 3]], blur: f64) {
    let frame = given.unwrap_or_else(|| Frame::fitted(positions.iter().copied()));
    let unit = frame.unit();
    let in_cube = |world: &[f64; 3]| frame.placement.to_cube(frame.bits, *world);
    gaussians.position = positions.iter().map(in_cube).collect();
    gaussians.scale = scales.iter().map(|scale| scale.map(|s| (s / unit) as f32)).collect();
    gaussians.blur = (blur / (unit * unit)) as f32;
    gaussians.frame = frame;
}

/// The cube that is given, if any is.
fn frame(
    py: Python<'_>,
    bits: Option<u8>,
    origin: Option<[f64; 3]>,
    voxel_size: Option<f64>,
) -> PyResult<Option<Frame>> {
    let frame = match (bits, origin, voxel_size) {
        (None, None, None) => return Ok(None),
        (Some(bits), Some(origin), Some(voxel_size)) => Frame {
            bits,
            placement: Placement { origin, voxel_size },
        },
        _ => {
            return Err(errors::usage(
                py,
                "bits, origin and voxel_size name a cube together or not at all",
            ));
        }
    };
    match frame.is_valid() {
        true => Ok(Some(frame)),
        false => Err(errors::usage(
            py,
            format!("the cube of the Gaussians is not valid: {frame:?}"),
        )),
    }
}

/// The numbers of an array of `[n]`, or of `[n, 1]`.
fn column(name: &'static str, value: &Bound<'_, PyAny>, limits: &Limits) -> PyResult<Vec<f32>> {
    let array = as_array(value)?;
    match array.ndim() {
        2 => check(name, &array, &[None, Some(1)])?,
        _ => check(name, &array, &[None])?,
    }
    check_count(name, &array, limits)?;
    flat(&array)
}

fn coefficients(value: Option<&Bound<'_, PyAny>>, limits: &Limits) -> PyResult<Harmonics> {
    let Some(value) = value else {
        return Ok(Harmonics::default());
    };
    let array = as_array(value)?;
    check("harmonics", &array, &[None, None, Some(3)])?;
    check_count("harmonics", &array, limits)?;
    Ok(Harmonics {
        count: array.shape()[1],
        coefficients: flat::<f32>(&array)?.as_chunks().0.to_vec(),
    })
}
