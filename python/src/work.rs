//! Long work: on threads of its own, while the calling thread, without Python's lock, waits for it and for signals.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::Result as Caught;
use std::time::Duration;

use b2p::{Cancel, Error, Log};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::errors;

/// How often signals are looked for.
const TICK: Duration = Duration::from_millis(20);
/// How long work may go on once it has been cancelled, before the caller no longer waits for it. Work that has no
/// such switch, as drawing, ends by itself, and nobody gets what comes of it.
const GRACE: Duration = Duration::from_secs(2);

/// The threads of calls that do not ask for a number. While it is held no Python runs, so that nobody waits for it who
/// has Python's lock.
static SHARED: Mutex<Shared> = Mutex::new(Shared {
    pool: None,
    threads: None,
});

struct Shared {
    pool: Option<Arc<ThreadPool>>,
    threads: Option<usize>,
}

/// Sets how many threads work.
///
/// `count` holds for all later calls that have no `threads` of their own. `None`: one for each processor. Work in
/// progress keeps its threads.
#[pyfunction]
#[pyo3(signature = (count=None))]
pub fn set_threads(py: Python<'_>, count: Option<usize>) -> PyResult<()> {
    let pool = new_pool(count).map_err(|error| errors::exception(py, &error))?;
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    *shared = Shared {
        pool: Some(pool),
        threads: count,
    };
    Ok(())
}

/// Forgets threads that did not come along into a forked process.
#[pyfunction]
pub fn after_fork() {
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(pool) = shared.pool.take() {
        // To drop it would be to wake its threads, and what they wait on may be locked for ever.
        std::mem::forget(pool);
    }
}

fn new_pool(threads: Option<usize>) -> b2p::Result<Arc<ThreadPool>> {
    if threads == Some(0) {
        let what = "the number of threads is 0, expected at least 1";
        return Err(Error::Usage(what.into()));
    }
    let builder = ThreadPoolBuilder::new().num_threads(threads.unwrap_or(0));
    let pool = builder.thread_name(|i| format!("b2p-{i}")).build();
    pool.map(Arc::new)
        .map_err(|e| Error::Usage(format!("cannot start threads: {e}")))
}

fn pool(threads: Option<usize>) -> b2p::Result<Arc<ThreadPool>> {
    if threads.is_some() {
        return new_pool(threads);
    }
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(pool) = &shared.pool {
        return Ok(pool.clone());
    }
    let pool = new_pool(shared.threads)?;
    shared.pool = Some(pool.clone());
    Ok(pool)
}

/// What a worker tells the thread that waits for it.
enum Event<T> {
    Step(String),
    Done(Caught<b2p::Result<T>>),
}

type Events<T> = Receiver<Event<T>>;

/// How a call works.
#[derive(Default)]
pub struct Work {
    /// Number of threads; `None` for those of all calls.
    pub threads: Option<usize>,
    /// Called with the name of each step.
    pub progress: Option<Py<PyAny>>,
    /// What stops it.
    pub cancel: Cancel,
}

impl Work {
    /// Work with so many threads.
    pub fn on(threads: Option<usize>) -> Self {
        Work {
            threads,
            ..Work::default()
        }
    }

    /// Runs `work`, which is to stop when the switch is thrown, and waits for it. A signal whose handler raises, such
    /// as Ctrl-C, throws the switch, and its exception comes back; so does one of the progress callback.
    ///
    /// # Errors
    /// These exceptions, and that for the error of `work`.
    pub fn run<T: Send + 'static>(
        self,
        py: Python<'_>,
        work: impl FnOnce(&Cancel, &Log) -> b2p::Result<T> + Send + 'static,
    ) -> PyResult<T> {
        let pool = pool(self.threads).map_err(|error| errors::exception(py, &error))?;
        let (sender, receiver) = channel();
        let log = self.log(&sender).with_cancel(self.cancel.clone());
        let switch = self.cancel.clone();
        pool.spawn(move || {
            let done = catch_unwind(AssertUnwindSafe(|| work(&switch, &log)));
            // Nobody may be waiting any longer.
            let _ = sender.send(Event::Done(done));
        });
        let (waited, receiver) = self.wait(py, receiver);
        if waited.is_err() {
            self.cancel.cancel();
            py.detach(move || settle(&receiver));
        }
        waited?.map_err(|error| errors::exception(py, &error))
    }

    fn log<T: Send + 'static>(&self, sender: &Sender<Event<T>>) -> Log {
        if self.progress.is_none() {
            return Log::new();
        }
        let sender = sender.clone();
        Log::with_listener(move |step| {
            let _ = sender.send(Event::Step(step.to_owned()));
        })
    }

    fn wait<T: Send + 'static>(&self, py: Python<'_>, mut events: Events<T>) -> (PyResult<b2p::Result<T>>, Events<T>) {
        loop {
            let next;
            (next, events) = py.detach(move || (events.recv_timeout(TICK), events));
            let heard = match next {
                Ok(Event::Done(Ok(done))) => return (Ok(done), events),
                Ok(Event::Done(Err(panic))) => return (Err(errors::defect(&*panic)), events),
                Ok(Event::Step(name)) => self.tell(py, name),
                Err(RecvTimeoutError::Timeout) => Ok(()),
                Err(RecvTimeoutError::Disconnected) => {
                    let what = "a defect in b2p: its thread has ended";
                    return (Err(PyRuntimeError::new_err(what)), events);
                }
            };
            if let Err(raised) = heard.and_then(|()| py.check_signals()) {
                return (Err(raised), events);
            }
        }
    }

    fn tell(&self, py: Python<'_>, step: String) -> PyResult<()> {
        match &self.progress {
            Some(progress) => progress.call1(py, (step,)).map(drop),
            None => Ok(()),
        }
    }
}

/// Waits until cancelled work has ended, but not for ever.
fn settle<T>(events: &Events<T>) {
    while let Ok(Event::Step(_)) = events.recv_timeout(GRACE) {}
}
