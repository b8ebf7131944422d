//! Streams, Gaussians and point clouds in files, or one stream that arrives on standard input.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use b2p::sequence::play::clock::Clock;
use b2p::{Cancel, Decoder, Decoding, Error, Extent, Gaussians, HeadSet, Header, Limits, Log, Stage, container};

use super::blocks::OpenScene;
use super::source::{Arrived, Choices, Scene, Source, Tell, Wish};
use crate::args::{DetailArg, ModelArg};
use crate::cloud::UpArg;
use crate::load::Loaded;
use crate::pipe::{self, Piece};
use crate::{Failure, Result, cloud, kinds, load, manners, scene};

/// How long is waited for bytes of a pipe before other wishes are looked at.
const PATIENCE: Duration = Duration::from_millis(100);
/// Bytes of a stream that tell its version.
const STREAM_START: usize = 10;

/// How files are read and decoded.
#[derive(Debug, Clone)]
pub struct Loading {
    pub model: ModelArg,
    pub per_voxel: Option<usize>,
    pub up: Option<UpArg>,
    pub limits: Limits,
}

impl Loading {
    /// Level and heads are those of a wish.
    pub fn detail(&self) -> DetailArg {
        DetailArg {
            level: None,
            heads: None,
            per_voxel: self.per_voxel,
        }
    }
}

/// Decodes files on a thread of its own, each level as soon as it can be drawn.
pub struct Files {
    orders: Sender<Order>,
    /// The file at hand, and what stops its decoding.
    current: Option<(PathBuf, Cancel)>,
}

struct Order {
    wanted: Wish,
    cancel: Cancel,
}

impl Files {
    /// Starts the thread.
    pub fn start(loading: Loading, tell: Arc<Tell>) -> Result<Files> {
        let (orders, received) = channel();
        let worker = Worker {
            loading,
            orders: received,
            tell,
        };
        let started = std::thread::Builder::new().spawn(move || worker.run());
        started.map_err(|e| Failure(format!("cannot start a thread to decode: {e}")))?;
        Ok(Files { orders, current: None })
    }
}

impl Files {
    /// Stops what is being decoded: nothing of it is wanted any more.
    pub fn stop(&mut self) {
        if let Some((_, cancel)) = self.current.take() {
            cancel.cancel();
        }
    }
}

impl Source for Files {
    fn want(&mut self, wanted: Wish) {
        let cancel = match &self.current {
            Some((path, cancel)) if *path == wanted.path => cancel.clone(),
            other => {
                if let Some((_, cancel)) = other {
                    cancel.cancel();
                }
                Cancel::default()
            }
        };
        self.current = Some((wanted.path.clone(), cancel.clone()));
        // If the thread has ended, so will the program.
        let _ = self.orders.send(Order { wanted, cancel });
    }

    fn play(&mut self, _: &Clock) {}
}

struct Worker {
    loading: Loading,
    orders: Receiver<Order>,
    tell: Arc<Tell>,
}

/// A file that was opened.
enum Opened {
    Fixed(Box<Scene>),
    Stream(Box<OpenStream>),
    Scene(Box<OpenScene>),
}

impl Worker {
    fn run(self) {
        let mut open: Option<(PathBuf, Opened)> = None;
        let mut next = self.orders.recv().ok();
        while let Some(order) = next.take() {
            let number = order.wanted.number;
            match self.serve(&mut open, &order) {
                Ok(newer) => next = newer,
                Err(Failure(message)) => {
                    open = None;
                    (self.tell)(number, Arrived::Failed(message));
                }
            }
            if next.is_none() {
                next = self.orders.recv().ok();
            }
        }
    }

    /// The last of the orders that wait.
    fn newer(&self) -> Option<Order> {
        self.orders.try_iter().last()
    }

    /// Makes what is wanted; gives the order that came meanwhile, if one did.
    fn serve(&self, open: &mut Option<(PathBuf, Opened)>, order: &Order) -> Result<Option<Order>> {
        let wanted = &order.wanted;
        let fresh = open.as_ref().is_none_or(|(path, _)| *path != wanted.path);
        if fresh {
            *open = None;
            let opened = open_file(&wanted.path, &self.loading, &order.cancel)?;
            *open = Some((wanted.path.clone(), opened));
        }
        let Some((_, opened)) = open else { return Ok(None) };
        match opened {
            Opened::Fixed(scene) => {
                (self.tell)(wanted.number, Arrived::Choices(Choices::default()));
                (self.tell)(wanted.number, Arrived::Scene(scene.clone()));
                (self.tell)(wanted.number, Arrived::Done);
                Ok(None)
            }
            Opened::Stream(stream) => self.decode(stream, wanted, fresh),
            Opened::Scene(scene) => self.decode_scene(scene, wanted, fresh).map(|()| None),
        }
    }

    /// Decodes as much of a scene as is wanted, and its coarsest level before if the file is `fresh`.
    fn decode_scene(&self, scene: &mut OpenScene, wanted: &Wish, fresh: bool) -> Result<()> {
        let choices = scene.choices();
        check_level(wanted, &choices)?;
        (self.tell)(wanted.number, Arrived::Choices(choices));
        let first = if fresh { scene.first(wanted) } else { None };
        if let Some(first) = first {
            (self.tell)(wanted.number, Arrived::Scene(Box::new(first)));
        }
        (self.tell)(wanted.number, Arrived::Scene(Box::new(scene.wanted(wanted)?)));
        (self.tell)(wanted.number, Arrived::Done);
        Ok(())
    }

    /// Decodes a stream to the level that is wanted. Coarser levels are shown if the file is `fresh`.
    fn decode(&self, stream: &mut OpenStream, wanted: &Wish, fresh: bool) -> Result<Option<Order>> {
        stream.prepare(wanted)?;
        let mut told = None;
        let mut known = false;
        loop {
            if let Some(newer) = self.newer() {
                return Ok(Some(newer));
            }
            if let (false, Some(choices)) = (known, stream.choices()) {
                check_level(wanted, &choices)?;
                (self.tell)(wanted.number, Arrived::Choices(choices));
                known = true;
            }
            let level = stream.decoding.level();
            let is_goal = level.is_some() && level == wanted.level;
            if (fresh || is_goal) && level != told && stream.decoding.is_drawable() {
                told = level;
                (self.tell)(wanted.number, Arrived::Scene(Box::new(stream.scene()?)));
            }
            if is_goal || !stream.advance()? {
                break;
            }
        }
        if stream.decoding.level() != told {
            (self.tell)(wanted.number, Arrived::Scene(Box::new(stream.scene()?)));
        }
        (self.tell)(wanted.number, Arrived::Done);
        Ok(None)
    }
}

/// Whether the level that is wanted can be drawn.
fn check_level(wanted: &Wish, choices: &Choices) -> Result<()> {
    match wanted.level {
        Some(level) if !choices.levels.contains(&level) => {
            let (path, levels) = (wanted.path.display(), &choices.levels);
            Err(Failure(format!(
                "{path}: level {level} cannot be drawn, but {levels:?} can"
            )))
        }
        _ => Ok(()),
    }
}

/// Reads a file, and decodes nothing of a stream yet.
fn open_file(path: &Path, loading: &Loading, cancel: &Cancel) -> Result<Opened> {
    let (log, limits) = (Log::new(), &loading.limits);
    if scene::is_scene(path) {
        return OpenScene::open(path, loading, cancel).map(|scene| Opened::Scene(Box::new(scene)));
    }
    if manners::is_pipe(path) {
        return open_pipe(loading, cancel).map(|stream| Opened::Stream(Box::new(stream)));
    }
    let bytes = load::bytes(path, limits)?;
    if let Some(Loaded { gaussians, axes }) = load::other(path, &bytes, &loading.detail(), limits, &log)? {
        return Ok(Opened::Fixed(Box::new(Scene {
            extent: Extent::of_gaussians(&gaussians),
            gaussians: Arc::new(gaussians),
            up: cloud::up_of(loading.up, &axes),
            made: None,
            is_part: false,
            steps: log.steps(),
            frame: None,
        })));
    }
    kinds::check_stream(path, &bytes)?;
    let bytes = load::whole_levels(path, bytes, &loading.detail(), limits)?;
    let stream = OpenStream::new(path, bytes, None, loading, cancel)?;
    load::reserve_for(path, &stream.bytes, &stream.decoder, None, limits)?;
    Ok(Opened::Stream(Box::new(stream)))
}

/// Begins to read the stream on standard input.
fn open_pipe(loading: &Loading, cancel: &Cancel) -> Result<OpenStream> {
    let path = Path::new(pipe::PIPE);
    let pieces = pipe::pieces()?;
    let mut start = Vec::new();
    while start.len() < STREAM_START {
        match pieces.recv() {
            Ok(piece) => start.extend(piece.map_err(pipe::broken)?),
            Err(_) => break,
        }
    }
    kinds::check_stream(path, &start)?;
    OpenStream::new(path, start, Some(pieces), loading, cancel)
}

/// A stream as far as it is there, and as far as it is decoded.
struct OpenStream {
    path: PathBuf,
    bytes: Vec<u8>,
    /// What is still to come.
    pieces: Option<Receiver<Piece>>,
    decoder: Decoder,
    decoding: Decoding<'static>,
    log: Log,
    /// Steps that were taken for an earlier wish.
    old_steps: usize,
    heads: Option<HeadSet>,
    up: Option<UpArg>,
    /// Of the first level that was drawn.
    extent: Option<Extent>,
    limits: Limits,
}

impl OpenStream {
    fn new(
        path: &Path,
        bytes: Vec<u8>,
        pieces: Option<Receiver<Piece>>,
        loading: &Loading,
        cancel: &Cancel,
    ) -> Result<OpenStream> {
        let decoder = load::decoder(&bytes, &loading.detail(), &loading.model, &loading.limits)?;
        let decoder = decoder.with_cancel(cancel.clone());
        Ok(OpenStream {
            path: path.to_owned(),
            decoding: decoder.start(),
            decoder,
            bytes,
            pieces,
            log: Log::new(),
            old_steps: 0,
            heads: None,
            up: loading.up,
            extent: None,
            limits: loading.limits.clone(),
        }
        .restarted())
    }

    fn restarted(mut self) -> Self {
        self.restart();
        self
    }

    /// Decodes from the first level again.
    fn restart(&mut self) {
        self.log = Log::new();
        self.old_steps = 0;
        self.decoding = self.decoder.clone().with_log(&self.log).start();
        self.decoding.push(&self.bytes);
    }

    /// Makes ready for other heads or another level.
    fn prepare(&mut self, wanted: &Wish) -> Result<()> {
        let past = |level: u8| self.decoding.level().is_some_and(|reached| reached > level);
        match wanted.level.is_some_and(past) {
            true => self.restart(),
            false => self.old_steps = self.log.steps().len(),
        }
        self.heads = wanted.heads;
        if let Some(heads) = wanted.heads {
            let fail = Failure::in_file(&self.path);
            self.decoding.set_heads(heads).map_err(fail)?;
        }
        Ok(())
    }

    /// Decodes a level, or takes more bytes: `false` at the end.
    fn advance(&mut self) -> Result<bool> {
        let path = self.path.clone();
        let fail = Failure::in_file(&path);
        if self.decoding.advance().map_err(&fail)?.is_some() {
            return Ok(true);
        }
        let Some(pieces) = &self.pieces else {
            return self.end().map(|()| false);
        };
        match pieces.recv_timeout(PATIENCE) {
            Ok(piece) => {
                let piece = piece.map_err(pipe::broken)?;
                self.bytes.extend(&piece);
                let length = self.bytes.len() as u64;
                let what = "size of the input, as far as it was read,";
                self.limits.check_bytes(what, length).map_err(&fail)?;
                self.decoding.push(&piece);
                let whole = self.decoding.header().map(Header::stream_bytes);
                if whole.is_some_and(|whole| length > whole) {
                    // What follows the stream may have no end.
                    self.pieces = None;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => self.pieces = None,
        }
        Ok(true)
    }

    /// No more bytes will come. What is cut is shown as far as it is whole.
    fn end(&mut self) -> Result<()> {
        match self.decoding.finish() {
            Err(
                error @ Error::Truncated {
                    stage: Stage::Bitstream,
                    ..
                },
            ) if self.decoding.is_drawable() => {
                manners::warn(&format!("{}: {error}", self.path.display()));
                Ok(())
            }
            done => done.map_err(Failure::in_file(&self.path)),
        }
    }

    /// What there is to choose from, once the header is there.
    fn choices(&self) -> Option<Choices> {
        let header = self.decoding.header()?;
        let levels = self.decoder.levels(&self.bytes).unwrap_or_default();
        // A file that is cut has no finer ones.
        let deepest = container::Stream::parse(&self.bytes, &self.limits).ok();
        let deepest = deepest.and_then(|stream| stream.deepest());
        let deepest = deepest.filter(|_| self.pieces.is_none()).unwrap_or(header.top);
        let can = |heads: &HeadSet| match (self.decoder.model(), heads.learned()) {
            (None, _) => true,
            (Some(model), Some(learned)) => model.check_heads(learned).is_ok(),
            (Some(_), None) => false,
        };
        Some(Choices {
            levels: levels.into_iter().filter(|level| *level <= deepest).collect(),
            heads: HeadSet::ALL.into_iter().filter(can).collect(),
            timeline: None,
        })
    }

    /// The Gaussians of the level that was reached.
    fn scene(&mut self) -> Result<Scene> {
        let fail = Failure::in_file(&self.path);
        let gaussians: Gaussians = self.decoding.gaussians().map_err(fail)?;
        let extent = self.extent.get_or_insert_with(|| Extent::of_gaussians(&gaussians));
        let (level, header) = (self.decoding.level(), self.decoding.header());
        let heads = header.map(|header| self.heads.unwrap_or_else(|| self.decoder.heads_for(header)));
        Ok(Scene {
            extent: extent.clone(),
            gaussians: Arc::new(gaussians),
            up: cloud::up_of(self.up, &cloud::axes(&self.bytes)),
            made: level.zip(heads),
            is_part: false,
            steps: self.log.steps().split_off(self.old_steps),
            frame: None,
        })
    }
}

#[cfg(test)]
mod tests;
