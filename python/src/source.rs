//! Streams and files in, and what decodes them.

use std::ops::Deref;
use std::path::PathBuf;
use std::sync::OnceLock;

use b2p::container::version;
use b2p::{Decoder, Error, HeadSet, HeadsModel, Limits, Model, Result, input};
use pyo3::prelude::*;
use pyo3::pybacked::PyBackedBytes;
use pyo3::types::{PyByteArray, PyBytes, PyString};

use crate::{errors, values};

/// Where bytes are.
pub enum Source {
    Memory(PyBackedBytes),
    File(PathBuf),
}

/// Bytes that are here.
pub enum Loaded {
    Memory(PyBackedBytes),
    File(Vec<u8>),
}

impl Deref for Loaded {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Loaded::Memory(bytes) => bytes,
            Loaded::File(bytes) => bytes,
        }
    }
}

impl Source {
    /// The source that a path (`str`, `os.PathLike`) or bytes (`bytes`, `bytearray`, whatever has a buffer) stand for.
    pub fn of(value: &Bound<'_, PyAny>) -> PyResult<Self> {
        let is_bytes = value.is_instance_of::<PyBytes>() || value.is_instance_of::<PyByteArray>();
        if !is_bytes && (value.is_instance_of::<PyString>() || value.hasattr("__fspath__")?) {
            return Ok(Source::File(value.extract()?));
        }
        bytes(value).map(Source::Memory)
    }

    /// Reads it, but no more than the limits allow.
    pub fn load(self, limits: &Limits) -> Result<Loaded> {
        match self {
            Source::Memory(bytes) => Ok(Loaded::Memory(bytes)),
            Source::File(path) => input::read_file(&path, limits).map(Loaded::File),
        }
    }
}

/// The bytes of whatever has a buffer; those of `bytes` are not copied.
pub fn bytes(value: &Bound<'_, PyAny>) -> PyResult<PyBackedBytes> {
    if let Ok(bytes) = value.extract::<PyBackedBytes>() {
        return Ok(bytes);
    }
    let py = value.py();
    let view = py.import("builtins")?.call_method1("memoryview", (value,));
    let view = view.map_err(|_| {
        let found = value
            .get_type()
            .name()
            .map_or("an object".into(), |name| name.to_string());
        errors::usage(py, format!("expected a path or bytes, not {found}"))
    })?;
    Ok(view.call_method0("tobytes")?.extract::<PyBackedBytes>()?)
}

/// What makes Gaussians of a stream.
#[derive(Clone, Default, PartialEq)]
pub struct Drawing {
    heads: Option<HeadSet>,
    model: Option<PathBuf>,
    per_voxel: Option<usize>,
    level: Option<u8>,
}

impl Drawing {
    /// `heads`: a name, or the path of a model; `model`: such a path.
    pub fn new(
        py: Python<'_>,
        heads: Option<&str>,
        model: Option<PathBuf>,
        per_voxel: Option<usize>,
        level: Option<u8>,
    ) -> PyResult<Self> {
        let is_path = |name: &&str| name.contains(['/', '.', '\\']);
        let (heads, path) = match heads.filter(is_path) {
            Some(path) if model.is_some() => {
                let what = format!("heads is {path:?}, but model names a file, too");
                return Err(errors::usage(py, what));
            }
            Some(path) => (None, Some(path.into())),
            None => (values::heads(py, heads)?, None),
        };
        Ok(Drawing {
            heads,
            model: model.or(path),
            per_voxel,
            level,
        })
    }

    /// Whether nothing was asked for.
    pub fn is_default(&self) -> bool {
        *self == Drawing::default()
    }

    /// The level that is asked for.
    pub fn level(&self) -> Option<u8> {
        self.level
    }

    /// Surfels, which draw every level and need no model: for points.
    pub fn for_points(level: Option<u8>) -> Self {
        Drawing {
            heads: Some(HeadSet::Surfels),
            level,
            ..Drawing::default()
        }
    }

    /// What decodes the stream that starts with these bytes. A model is loaded only if it takes one.
    pub fn decoder(&self, start: &[u8], limits: &Limits) -> Result<Decoder> {
        let mut decoder = Decoder::new().with_limits(limits.clone()).with_level(self.level);
        if let Some(heads) = self.heads {
            decoder = decoder.with_heads(heads);
        }
        if let Some(count) = self.per_voxel {
            decoder = decoder.with_per_voxel(count);
        }
        if version(start) == Some(2) {
            let model = match &self.model {
                Some(path) => Model::open(path)?,
                None => once(&MODEL, || Model::from_bytes(b2p::embedded::model()))?,
            };
            return Ok(decoder.with_model(model));
        }
        if self.heads == Some(HeadSet::Surfels) {
            return Ok(decoder);
        }
        let heads = match &self.model {
            Some(path) => HeadsModel::open(path)?,
            None => embedded_heads()?,
        };
        Ok(decoder.with_heads_model(heads))
    }
}

static MODEL: OnceLock<Model> = OnceLock::new();
static HEADS: OnceLock<HeadsModel> = OnceLock::new();

/// The heads inside the library.
pub fn embedded_heads() -> Result<HeadsModel> {
    once(&HEADS, || HeadsModel::from_bytes(b2p::embedded::HEADS))
}

/// What is made at the first call.
fn once<T: Clone>(cell: &OnceLock<T>, make: impl FnOnce() -> Result<T>) -> Result<T> {
    if let Some(made) = cell.get() {
        return Ok(made.clone());
    }
    let made = make()?;
    Ok(cell.get_or_init(|| made).clone())
}

/// The error of asking a stream of version 2 for points.
pub fn no_points() -> Error {
    Error::Unsupported {
        what: "decoding points of a stream of version 2",
        detail: "it holds no colours of voxels, but Gaussians".into(),
    }
}
