//! Errors of the library as Python exceptions, whose classes are in `b2p/_errors.py`.

use std::io::ErrorKind;

use b2p::Error;
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};

/// The module of the exceptions.
const MODULE: &str = "b2p._errors";

/// The exception for an error.
pub fn exception(py: Python<'_>, error: &Error) -> PyErr {
    let made = build(py, error);
    made.unwrap_or_else(|failed| failed)
}

/// A mistake of the caller.
pub fn usage(py: Python<'_>, text: impl Into<String>) -> PyErr {
    exception(py, &Error::Usage(text.into()))
}

/// Warns of something that was mended, guessed or left out. Fails if warnings are errors.
pub fn warn(py: Python<'_>, text: &str) -> PyResult<()> {
    let category = py.import(MODULE)?.getattr("InputWarning")?;
    py.import("warnings")?
        .call_method1("warn", (text, category, 1))
        .map(drop)
}

fn build(py: Python<'_>, error: &Error) -> PyResult<PyErr> {
    let fields = PyDict::new(py);
    let name = fill(error, &fields)?;
    let class = py.import(MODULE)?.getattr(name)?.cast_into::<PyType>()?;
    let value = class.call((error.to_string(),), Some(&fields))?;
    Ok(PyErr::from_value(value))
}

/// Sets the fields of an error, and names its class.
fn fill(error: &Error, fields: &Bound<'_, PyDict>) -> PyResult<&'static str> {
    Ok(match error {
        Error::Io { path, source } => {
            let path = path.display().to_string();
            fields.set_item("path", &path)?;
            fields.set_item("filename", path)?;
            fields.set_item("errno", source.raw_os_error())?;
            fields.set_item("strerror", source.to_string())?;
            match source.kind() {
                ErrorKind::NotFound => "NotFoundError",
                _ => "IoError",
            }
        }
        Error::LimitExceeded {
            what,
            needed,
            limit,
            option,
        } => {
            fields.set_item("what", what)?;
            fields.set_item("needed", needed)?;
            fields.set_item("limit", limit)?;
            fields.set_item("option", option)?;
            "LimitExceeded"
        }
        Error::OutOfMemory { what, bytes } => {
            fields.set_item("what", what)?;
            fields.set_item("bytes", bytes)?;
            "OutOfMemory"
        }
        Error::Unsupported { what, detail } => {
            fields.set_item("what", what)?;
            fields.set_item("detail", detail)?;
            "UnsupportedError"
        }
        Error::ModelMismatch { expected, found } => {
            fields.set_item("expected", expected)?;
            fields.set_item("found", found)?;
            "ModelError"
        }
        Error::ModelMissing { expected } => {
            fields.set_item("expected", expected)?;
            fields.set_item("found", None::<String>)?;
            "ModelError"
        }
        Error::TooFewBits { asked, least } => {
            fields.set_item("asked", asked)?;
            fields.set_item("least", least)?;
            "TooFewBits"
        }
        Error::Block { block, source } => {
            fields.set_item("block", block)?;
            return fill(source, fields);
        }
        Error::Cancelled => "Cancelled",
        Error::Usage(_) => "UsageError",
        other => return fill_format(other, fields),
    })
}

/// The same of errors in the input.
fn fill_format(error: &Error, fields: &Bound<'_, PyDict>) -> PyResult<&'static str> {
    Ok(match error {
        Error::Truncated {
            stage,
            offset,
            field,
            needed,
        } => {
            fields.set_item("stage", stage.to_string())?;
            fields.set_item("offset", offset)?;
            fields.set_item("field", field)?;
            fields.set_item("needed", needed)?;
            "TruncatedError"
        }
        Error::ChecksumMismatch {
            what,
            offset,
            expected,
            found,
            clause,
        } => {
            fields.set_item("clause", clause)?;
            fields.set_item("what", what)?;
            fields.set_item("offset", offset)?;
            fields.set_item("expected", expected)?;
            fields.set_item("found", found)?;
            "ChecksumError"
        }
        Error::DeterminismMismatch {
            what,
            level,
            expected,
            found,
        } => {
            fields.set_item("what", what)?;
            fields.set_item("level", level)?;
            fields.set_item("expected", expected)?;
            fields.set_item("found", found)?;
            "DeterminismError"
        }
        Error::Malformed {
            stage,
            at,
            field,
            value,
            expected,
            clause,
        } => {
            fields.set_item("clause", clause)?;
            fields.set_item("stage", stage.to_string())?;
            fields.set_item("at", at)?;
            fields.set_item("field", field)?;
            fields.set_item("found", value)?;
            fields.set_item("expected", expected)?;
            "MalformedError"
        }
        // A variant that is newer than this crate has its text.
        _ => "Error",
    })
}

/// The exception for a defect: a panic in the library.
pub fn defect(panic: &(dyn std::any::Any + Send)) -> PyErr {
    let told = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let told = told.or_else(|| panic.downcast_ref::<String>().cloned());
    PyRuntimeError::new_err(format!("a defect in b2p: {}", told.unwrap_or_default()))
}
