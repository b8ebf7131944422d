//! Streams that arrive in pieces on standard input.

use std::io::Read;
use std::path::Path;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::sync::{Mutex, PoisonError};

use b2p::error::Stage;
use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::{Axes, Decoding, Error, Limits};

use super::args::{DetailArg, ModelArg};
use super::{Failure, Result, cloud, convert, kinds, load, manners};

/// The input that is standard input, and the output that is standard output.
pub const PIPE: &str = "-";

/// Bytes that are asked for at once, and how many such pieces wait before the sender has to.
const PIECE: usize = 1 << 16;
const WAITING: usize = 16;

/// Bytes of a stream that hold its header and its axes.
const HEAD: usize = 1 << 18;
/// Bytes that tell what comes, and of which version.
const STREAM_START: usize = 10;

/// Bytes of standard input that were looked at before anything took them.
static SEEN: Mutex<Vec<u8>> = Mutex::new(Vec::new());

/// Standard input from its start, also after [`peek`].
pub fn stdin() -> impl Read {
    let seen = std::mem::take(&mut *SEEN.lock().unwrap_or_else(PoisonError::into_inner));
    std::io::Cursor::new(seen).chain(std::io::stdin())
}

/// The first bytes of standard input, which stay there to be read; fewer if it ends before. Waits for them.
///
/// # Errors
/// What the system says when they are read.
pub fn peek(count: usize) -> std::io::Result<Vec<u8>> {
    let mut seen = SEEN.lock().unwrap_or_else(PoisonError::into_inner);
    let missing = count.saturating_sub(seen.len());
    std::io::stdin().take(missing as u64).read_to_end(&mut seen)?;
    Ok(seen.clone())
}

/// The first bytes of a file, at most `count`, or of standard input, which stay to be read. None of what is no file, and
/// is read once.
///
/// # Errors
/// What the system says when they are read.
pub fn start_of(path: &Path, count: usize) -> std::io::Result<Vec<u8>> {
    if manners::is_pipe(path) {
        return peek(count);
    }
    let mut start = Vec::new();
    if std::fs::metadata(path)?.is_file() {
        std::fs::File::open(path)?.take(count as u64).read_to_end(&mut start)?;
    }
    Ok(start)
}

/// What was read at once, and what stops reading.
pub type Piece = std::io::Result<Vec<u8>>;

/// Gaussians, or a level that they are to be made of.
pub enum Shown<'a> {
    Gaussians(&'a Gaussians),
    Level(&'a Decoding<'a>),
}

impl Shown<'_> {
    /// Calls `show` with all Gaussians, which come from `path`.
    pub fn all_at_once(self, path: &Path, show: impl FnOnce(&Gaussians) -> Result<()>) -> Result<()> {
        match self {
            Shown::Gaussians(gaussians) => show(gaussians),
            Shown::Level(level) => show(&level.gaussians().map_err(Failure::in_file(path))?),
        }
    }
}

/// What is done with Gaussians, of a cloud of whose coordinates so much is known.
pub type Show<'a> = dyn FnMut(Shown<'_>, &Axes, &Log) -> Result<()> + 'a;

/// Shows the Gaussians of a file, or of standard input: then also those of coarser levels, if `early` and nothing finer
/// has come meanwhile; and if the stream is cut and no level was named, what its finest whole level has. Memory is
/// counted for Gaussians `in_parts` or all at once.
pub fn each(
    path: &Path,
    detail: &DetailArg,
    model_arg: &ModelArg,
    limits: &Limits,
    (early, in_parts): (bool, bool),
    log: &Log,
    show: &mut Show,
) -> Result<()> {
    let decoder = |start: &[u8]| {
        let decoder = load::decoder(start, detail, model_arg, limits)?.with_log(log);
        Ok::<_, Failure>(match in_parts {
            true => decoder.with_gaussians_in_parts(),
            false => decoder,
        })
    };
    if path != Path::new(PIPE) {
        let bytes = load::bytes(path, limits)?;
        if let Some(loaded) = load::other(path, &bytes, detail, limits, log)? {
            return show(Shown::Gaussians(&loaded.gaussians), &loaded.axes, log);
        }
        kinds::check_stream(path, &bytes)?;
        let bytes = load::whole_levels(path, bytes, detail, limits)?;
        let decoder = decoder(&bytes)?;
        load::reserve_for(path, &bytes, &decoder, detail.level, limits)?;
        let level = decoder.whole(&bytes).map_err(Failure::in_file(path))?;
        return show(Shown::Level(&level), &cloud::axes(&bytes), log);
    }
    let pieces = pieces()?;
    let mut start = Vec::new();
    while start.len() < STREAM_START {
        match pieces.recv() {
            Ok(piece) => start.extend(piece.map_err(broken)?),
            Err(_) => break,
        }
    }
    if convert::may_be(&start) || cloud::is_cloud(&start) {
        let bytes = rest(start, pieces, limits)?;
        if let Some(loaded) = load::other(path, &bytes, detail, limits, log)? {
            return show(Shown::Gaussians(&loaded.gaussians), &loaded.axes, log);
        }
        kinds::check_stream(path, &bytes)?;
        let what = "neither a stream, nor Gaussians or points that are known by their contents";
        return Err(Failure(format!("standard input: {what}")));
    }
    kinds::check_stream(path, &start)?;
    let decoder = decoder(&start)?;
    let arriving = Arriving { start, pieces };
    arriving.show(decoder.start(), detail.level.is_none(), early, &mut |level, axes| {
        show(Shown::Level(level), axes, log)
    })
}

/// All of standard input, of which this is the start.
fn rest(mut start: Vec<u8>, pieces: Receiver<Piece>, limits: &Limits) -> Result<Vec<u8>> {
    for piece in pieces {
        start.extend(piece.map_err(broken)?);
        let length = start.len() as u64;
        let checked = limits.check_bytes("size of the input, as far as it was read,", length);
        checked.map_err(Failure::in_file(Path::new(PIPE)))?;
    }
    Ok(start)
}

/// A stream that arrives by standard input.
struct Arriving {
    start: Vec<u8>,
    pieces: Receiver<Piece>,
}

impl Arriving {
    /// Shows the finest level once all has arrived, and if `early`, coarser ones when nothing waits. Of a stream that is
    /// cut that is the finest whole level if `any` will do.
    fn show(
        self,
        mut decoding: Decoding<'_>,
        any: bool,
        early: bool,
        show: &mut dyn FnMut(&Decoding<'_>, &Axes) -> Result<()>,
    ) -> Result<()> {
        let in_pipe = Failure::in_file(Path::new(PIPE));
        let (mut shown, mut piece) = (None, Some(self.start));
        let (mut length, mut head) = (0, Vec::new());
        while let Some(bytes) = piece {
            if head.len() < HEAD {
                head.extend(&bytes);
            }
            length += bytes.len() as u64;
            decoding.push(&bytes);
            while decoding.advance().map_err(&in_pipe)?.is_some() {}
            if let Some(header) = decoding.header()
                && length > header.stream_bytes()
            {
                // What follows the stream may have no end.
                break;
            }
            piece = match self.pieces.try_recv() {
                Err(TryRecvError::Empty) => {
                    if early && decoding.is_drawable() && shown != decoding.level() {
                        shown = decoding.level();
                        show(&decoding, &cloud::axes(&head))?;
                    }
                    self.pieces.recv().ok()
                }
                next => next.ok(),
            }
            .transpose()
            .map_err(broken)?;
        }
        match decoding.finish() {
            Err(
                error @ Error::Truncated {
                    stage: Stage::Bitstream,
                    ..
                },
            ) if any && decoding.is_drawable() => {
                let finest = decoding.level().unwrap_or_default();
                let what = format!("what follows is level {finest}, the finest that is complete");
                manners::warn(&format!("{PIPE}: {error}; {what}"));
            }
            done => done.map_err(&in_pipe)?,
        }
        match shown == decoding.level() {
            true => Ok(()),
            false => show(&decoding, &cloud::axes(&head)),
        }
    }
}

/// Standard input, read by a thread of its own so that it can be known whether something waits.
pub fn pieces() -> Result<Receiver<Piece>> {
    let (sender, receiver) = sync_channel(WAITING);
    let read = move || {
        let mut input = stdin();
        loop {
            let mut bytes = vec![0; PIECE];
            let piece = input.read(&mut bytes).map(|count| {
                bytes.truncate(count);
                bytes
            });
            let last = !piece.as_ref().is_ok_and(|bytes| !bytes.is_empty());
            // Nobody listens any more once decoding has ended.
            if sender.send(piece).is_err() || last {
                return;
            }
        }
    };
    let started = std::thread::Builder::new().spawn(read);
    started.map_err(|e| Failure(format!("cannot start a thread to read: {e}")))?;
    Ok(receiver)
}

/// What the system said when standard input was read.
pub fn broken(source: std::io::Error) -> Failure {
    Failure::from(Error::Io {
        path: PIPE.into(),
        source,
    })
}
