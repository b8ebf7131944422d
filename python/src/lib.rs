//! b2p for Python: the module `b2p._b2p`, whose contents `b2p/__init__.py` exports.
//!
//! - [`work`]: every call that takes long runs on threads of its own, while the caller waits for signals.
//! - [`errors`]: errors of the library become the exceptions of `b2p/_errors.py`.
//! - [`arrays`]: NumPy arrays in, by a copy; out as views of Rust's memory, or with that memory given away.
//! - The other modules have one class or function each, with its documentation for Python.
#![forbid(unsafe_code)]

mod arrays;
mod camera;
mod cloud;
mod decode;
mod encode;
mod errors;
mod files;
mod gaussians;
mod info;
mod render;
mod scene;
mod source;
mod stream;
mod values;
mod work;

use pyo3::prelude::*;
use pyo3::types::PyDict;

#[pymodule]
fn _b2p(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<arrays::View>()?;
    module.add_class::<camera::PyCamera>()?;
    module.add_class::<cloud::PyPointCloud>()?;
    module.add_class::<gaussians::PyGaussians>()?;
    module.add_class::<stream::PyStream>()?;
    module.add_class::<values::PyLimits>()?;
    module.add_function(wrap_pyfunction!(decode::decode, module)?)?;
    module.add_function(wrap_pyfunction!(decode::decode_points, module)?)?;
    module.add_function(wrap_pyfunction!(encode::encode, module)?)?;
    module.add_function(wrap_pyfunction!(files::read, module)?)?;
    module.add_function(wrap_pyfunction!(files::write, module)?)?;
    module.add_function(wrap_pyfunction!(info::info, module)?)?;
    module.add_function(wrap_pyfunction!(render::render, module)?)?;
    module.add_function(wrap_pyfunction!(work::set_threads, module)?)?;
    forget_threads_in_forks(module.py())
}

/// Threads do not come along into a forked process: it starts its own.
fn forget_threads_in_forks(py: Python<'_>) -> PyResult<()> {
    let os = py.import("os")?;
    if os.hasattr("register_at_fork")? {
        let forget = wrap_pyfunction!(work::after_fork, py)?;
        let hooks = PyDict::new(py);
        hooks.set_item("after_in_child", forget)?;
        os.call_method("register_at_fork", (), Some(&hooks))?;
    }
    Ok(())
}
