//! Streams that are decoded as their bytes arrive.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use b2p::container::axes;
use b2p::{Cancel, Decoding, Error, Gaussians, Limits, Result, SceneDecoding, SceneReader, Up};
use pyo3::prelude::*;

use crate::cloud::PyPointCloud;
use crate::errors;
use crate::gaussians::PyGaussians;
use crate::scene::START;
use crate::source::{self, Drawing, no_points};
use crate::values::{self, PyLimits};
use crate::work::Work;

/// Bytes of a stream that hold its header and its axes.
const AXES: usize = 1 << 18;

/// A stream that is decoded level by level as its bytes arrive. `b2p.open` is the usual way to use it.
///
/// Bytes are pushed in pieces of any size; `advance` decodes a level as soon as it is whole, and `gaussians` and
/// `points` give what the level reached holds. Of a scene of blocks all levels are whole when its last byte has come;
/// they are decoded when they are asked for. After an error what was reached before stays usable, and nothing more is
/// decoded. The parameters are those of `b2p.decode`.
#[pyclass(frozen, module = "b2p", name = "Stream")]
pub struct PyStream {
    state: Arc<Mutex<State>>,
    threads: Option<usize>,
    cancel: Cancel,
}

struct State {
    drawing: Drawing,
    limits: Limits,
    cancel: Cancel,
    /// The first bytes, which hold what is said of axes.
    start: Vec<u8>,
    /// Once it is known that a stream of one frame comes.
    decoding: Option<Decoding<'static>>,
    /// Once it is known that a scene of blocks comes.
    scene: Option<SceneDecoding>,
}

impl State {
    fn push(&mut self, bytes: &[u8]) -> Result<()> {
        // All that has come, as long as the version is not known.
        let before = self.start.len();
        self.start
            .extend(&bytes[..bytes.len().min(AXES.saturating_sub(before))]);
        let is_known = self.decoding.is_some() || self.scene.is_some();
        if !is_known && self.start.len() < START {
            return Ok(());
        }
        if !is_known {
            self.open(before)?;
        }
        if let Some(scene) = &mut self.scene {
            scene.push(bytes)?;
        }
        if let Some(decoding) = &mut self.decoding {
            decoding.push(bytes);
        }
        Ok(())
    }

    /// Begins to decode, with so many of the first bytes.
    fn open(&mut self, count: usize) -> Result<()> {
        let decoder = self.drawing.decoder(&self.start, &self.limits)?;
        let decoder = decoder.with_cancel(self.cancel.clone());
        if SceneReader::is_scene(&self.start) {
            let mut scene = SceneDecoding::new(decoder);
            scene.push(&self.start[..count])?;
            self.scene = Some(scene);
            return Ok(());
        }
        let mut decoding = decoder.start();
        decoding.push(&self.start[..count]);
        self.decoding = Some(decoding);
        Ok(())
    }

    /// The decoding, also of a stream that ends before its version is known.
    fn decoding(&mut self) -> Result<&mut Decoding<'static>> {
        if self.decoding.is_none() {
            self.open(self.start.len())?;
        }
        self.decoding.as_mut().ok_or_else(nothing)
    }

    fn reached(&self) -> Result<&Decoding<'static>> {
        self.decoding.as_ref().ok_or_else(nothing)
    }

    fn advance(&mut self) -> Result<Option<u8>> {
        match (&mut self.scene, &mut self.decoding) {
            (Some(scene), _) => scene.advance(),
            (None, Some(decoding)) => decoding.advance(),
            (None, None) => Ok(None),
        }
    }

    fn finish(&mut self) -> Result<()> {
        match &mut self.scene {
            Some(scene) => scene.finish(),
            None => self.decoding()?.finish(),
        }
    }

    fn gaussians(&self) -> Result<(Gaussians, Option<u8>, Option<Up>)> {
        if let Some(scene) = &self.scene {
            return Ok((scene.gaussians()?, scene.level(), scene.axes()?.up));
        }
        let decoding = self.reached()?;
        Ok((decoding.gaussians()?, decoding.level(), self.up()))
    }

    fn points(&self) -> Result<PyPointCloud> {
        if let Some(scene) = &self.scene {
            return Ok(PyPointCloud::of_grid(scene.points()?, scene.axes()?));
        }
        let decoding = self.reached()?;
        if decoding.level().is_none() {
            return Err(nothing());
        }
        let points = decoding.points().map(|points| points.to_voxels());
        Ok(PyPointCloud::decoded(points.ok_or_else(no_points)?, &self.start))
    }

    fn level(&self) -> Option<u8> {
        match &self.scene {
            Some(scene) => scene.level(),
            None => self.decoding.as_ref()?.level(),
        }
    }

    fn up(&self) -> Option<Up> {
        axes(&self.start).ok().and_then(|axes| axes.up)
    }

    fn is_complete(&self) -> bool {
        if let Some(scene) = &self.scene {
            return scene.is_complete();
        }
        let Some(decoding) = &self.decoding else { return false };
        let top = || decoding.header().map(|header| header.top);
        let last = self.drawing.level().or_else(top);
        last.is_some() && decoding.level() == last
    }
}

fn nothing() -> Error {
    Error::Usage("no level has been decoded yet".into())
}

fn lock(state: &Mutex<State>) -> Result<MutexGuard<'_, State>> {
    match state.try_lock() {
        Ok(state) => Ok(state),
        Err(TryLockError::Poisoned(state)) => Ok(PoisonError::into_inner(state)),
        Err(TryLockError::WouldBlock) => Err(Error::Usage("the stream is in use by another thread".into())),
    }
}

#[pymethods]
impl PyStream {
    #[new]
    #[pyo3(signature = (*, level=None, heads=None, model=None, per_voxel=None, limits=None, threads=None))]
    fn new(
        py: Python<'_>,
        level: Option<u8>,
        heads: Option<&str>,
        model: Option<PathBuf>,
        per_voxel: Option<usize>,
        limits: Option<PyLimits>,
        threads: Option<usize>,
    ) -> PyResult<Self> {
        let cancel = Cancel::default();
        let state = State {
            drawing: Drawing::new(py, heads, model, per_voxel, level)?,
            limits: values::limits(limits),
            cancel: cancel.clone(),
            start: Vec::new(),
            decoding: None,
            scene: None,
        };
        Ok(PyStream {
            state: Arc::new(Mutex::new(state)),
            threads,
            cancel,
        })
    }

    /// Takes the next bytes of the stream. No more are kept than its header says are needed.
    fn push(&self, py: Python<'_>, data: &Bound<'_, PyAny>) -> PyResult<()> {
        let bytes = source::bytes(data)?;
        let pushed = lock(&self.state).and_then(|mut state| state.push(&bytes));
        pushed.map_err(|error| errors::exception(py, &error))
    }

    /// Decodes the next level if all of it has come, and returns its number, else None.
    fn advance(&self, py: Python<'_>) -> PyResult<Option<u8>> {
        self.run(py, State::advance)
    }

    /// Decodes what is left, knowing that no more bytes will come: a `TruncatedError` unless the stream is whole, or
    /// ends just where one of its levels ends.
    fn finish(&self, py: Python<'_>) -> PyResult<()> {
        self.run(py, State::finish)
    }

    /// The Gaussians of the level reached.
    fn gaussians(&self, py: Python<'_>) -> PyResult<PyGaussians> {
        let (gaussians, level, up) = self.run(py, |state| state.gaussians())?;
        Ok(PyGaussians {
            level,
            up,
            ..PyGaussians::bare(gaussians)
        })
    }

    /// The voxels of the level reached with their colours.
    fn points(&self, py: Python<'_>) -> PyResult<PyPointCloud> {
        self.run(py, |state| state.points())
    }

    /// The deepest level decoded so far; None before the first.
    #[getter]
    fn level(&self, py: Python<'_>) -> PyResult<Option<u8>> {
        self.ask(py, State::level)
    }

    /// Whether the level reached has Gaussians.
    #[getter]
    fn is_drawable(&self, py: Python<'_>) -> PyResult<bool> {
        self.ask(py, |state| match &state.scene {
            Some(scene) => scene.is_drawable(),
            None => state.decoding.as_ref().is_some_and(Decoding::is_drawable),
        })
    }

    /// Whether the last level has been decoded: that which was asked for, or the stream's finest.
    #[getter]
    fn is_complete(&self, py: Python<'_>) -> PyResult<bool> {
        self.ask(py, State::is_complete)
    }

    fn __repr__(&self) -> String {
        let level = lock(&self.state).ok().and_then(|state| state.level());
        match level {
            Some(level) => format!("<b2p.Stream: decoded to level {level}>"),
            None => "<b2p.Stream>".into(),
        }
    }
}

impl PyStream {
    /// Runs work on the state. What was interrupted is not gone on with.
    fn run<T: Send + 'static>(
        &self,
        py: Python<'_>,
        work: impl FnOnce(&mut State) -> Result<T> + Send + 'static,
    ) -> PyResult<T> {
        let state = self.state.clone();
        let run = Work {
            cancel: self.cancel.clone(),
            ..Work::on(self.threads)
        };
        // Whoever waits for the lock in a pool may hold up the one who has it: it is tried, and never waited for.
        run.run(py, move |_, _| work(&mut *lock(&state)?))
    }

    fn ask<T>(&self, py: Python<'_>, answer: impl FnOnce(&State) -> T) -> PyResult<T> {
        match lock(&self.state) {
            Ok(state) => Ok(answer(&state)),
            Err(error) => Err(errors::exception(py, &error)),
        }
    }
}
