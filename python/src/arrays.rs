//! NumPy arrays in and out.

use std::sync::Arc;

use b2p::Limits;
use numpy::{
    Element, PyArray1, PyArray2, PyArrayDescrMethods, PyArrayMethods, PyReadonlyArray1, PyUntypedArray,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::errors;

/// What NumPy makes an array of, be it an array, a list or a tensor of another library.
pub fn as_array<'py>(value: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyUntypedArray>> {
    let array = value.py().import("numpy")?.call_method1("asarray", (value,))?;
    Ok(array.cast_into()?)
}

/// Fails unless an array has this shape, in which `None` stands for any number, and holds numbers.
pub fn check(name: &str, array: &Bound<'_, PyUntypedArray>, shape: &[Option<usize>]) -> PyResult<()> {
    let py = array.py();
    let fits = |(found, wanted): (&usize, &Option<usize>)| wanted.is_none_or(|wanted| wanted == *found);
    if array.ndim() != shape.len() || !array.shape().iter().zip(shape).all(fits) {
        let wanted: Vec<_> = shape.iter().map(|n| n.map_or("n".into(), |n| n.to_string())).collect();
        let (found, wanted) = (array.shape(), wanted.join(", "));
        return Err(errors::usage(
            py,
            format!("{name} has the shape {found:?}, expected [{wanted}]"),
        ));
    }
    if !b"fiu".contains(&array.dtype().kind()) {
        let found = array.dtype().str()?;
        return Err(errors::usage(
            py,
            format!("{name} has the dtype {found}, expected numbers"),
        ));
    }
    Ok(())
}

/// Fails if an array has more rows than points are allowed: before it is copied, for it may be a repeated view.
pub fn check_count(name: &'static str, array: &Bound<'_, PyUntypedArray>, limits: &Limits) -> PyResult<()> {
    let count = array.shape().first().copied().unwrap_or(0) as u64;
    let checked = limits.check_points(name, count);
    checked.map_err(|error| errors::exception(array.py(), &error))
}

/// The elements of an array, row by row.
pub fn flat<T: Element + Copy>(array: &Bound<'_, PyUntypedArray>) -> PyResult<Vec<T>> {
    let py = array.py();
    let numpy = py.import("numpy")?;
    let dense = numpy.call_method1("ascontiguousarray", (array, T::get_dtype(py)))?;
    let dense: PyReadonlyArray1<'_, T> = dense.call_method1("reshape", (-1,))?.extract()?;
    Ok(dense.as_slice()?.to_vec())
}

/// The rows of an array of `[n, N]` numbers.
pub fn rows<T: Element + Copy, const N: usize>(
    name: &'static str,
    value: &Bound<'_, PyAny>,
    limits: &Limits,
) -> PyResult<Vec<[T; N]>> {
    let array = as_array(value)?;
    check(name, &array, &[None, Some(N)])?;
    check_count(name, &array, limits)?;
    Ok(flat::<T>(&array)?.as_chunks().0.to_vec())
}

/// An array of `[n, N]` elements, which takes over the memory of `rows`.
pub fn matrix<T: Element, const N: usize>(py: Python<'_>, rows: Vec<[T; N]>) -> PyResult<Bound<'_, PyArray2<T>>> {
    let count = rows.len();
    PyArray1::from_vec(py, rows.into_flattened()).reshape([count, N])
}

/// Memory that NumPy looks into: the array made of it holds this object, and this object what owns the memory. Nothing
/// changes that memory: owners are shared and have no interior mutability, and the array is read-only.
#[pyclass(frozen, module = "b2p._b2p")]
pub struct View {
    _owner: Arc<dyn std::any::Any + Send + Sync>,
    address: usize,
    code: &'static str,
    shape: Vec<usize>,
}

#[pymethods]
impl View {
    #[getter]
    fn __array_interface__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let interface = PyDict::new(py);
        interface.set_item("version", 3)?;
        interface.set_item("data", (self.address, true))?;
        interface.set_item("typestr", self.code)?;
        interface.set_item("shape", PyTuple::new(py, &self.shape)?)?;
        Ok(interface)
    }
}

/// Elements of arrays that look into Rust's memory.
pub trait Viewed: Copy + Send + Sync + 'static {
    /// The type in NumPy's code.
    const CODE: &'static str;
}

impl Viewed for f32 {
    const CODE: &'static str = if cfg!(target_endian = "little") { "<f4" } else { ">f4" };
}

impl Viewed for f64 {
    const CODE: &'static str = if cfg!(target_endian = "little") { "<f8" } else { ">f8" };
}

impl Viewed for u8 {
    const CODE: &'static str = "|u1";
}

/// A read-only array of what `field` finds in `owner`, without a copy.
pub fn view<'py, O, T: Viewed>(
    py: Python<'py>,
    owner: &Arc<O>,
    shape: Vec<usize>,
    field: impl FnOnce(&O) -> &[T],
) -> PyResult<Bound<'py, PyAny>>
where
    O: Send + Sync + 'static,
{
    let elements = field(owner);
    debug_assert_eq!(shape.iter().product::<usize>(), elements.len());
    let view = View {
        address: elements.as_ptr() as usize,
        code: T::CODE,
        shape,
        _owner: owner.clone(),
    };
    py.import("numpy")?.call_method1("asarray", (Bound::new(py, view)?,))
}
