//! Where a viewer's Gaussians come from.

use std::path::PathBuf;
use std::sync::Arc;

use b2p::sequence::play::clock::{Clock, Timeline};
use b2p::{Camera, Extent, Gaussians, HeadSet, Step, Up};

/// What is to be shown.
#[derive(Debug, Clone, PartialEq)]
pub struct Wish {
    /// Tells what arrives for this from what arrives for an earlier wish.
    pub number: u64,
    pub path: PathBuf,
    /// Level of a stream to decode to; `None` for the finest, of a sequence the finest that there is time for.
    pub level: Option<u8>,
    /// Heads that draw a stream; `None` for the best, of a sequence those that there is time for.
    pub heads: Option<HeadSet>,
    /// What looks at a scene of blocks that does not fit into memory; `None` for the finest level of it that does.
    pub camera: Option<Camera>,
}

/// What there is to choose from in a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Choices {
    /// The levels that can be drawn, the coarsest first. Empty for files of Gaussians and points.
    pub levels: Vec<u8>,
    /// The heads that can draw them.
    pub heads: Vec<HeadSet>,
    /// When frames are shown, of a sequence.
    pub timeline: Option<Arc<Timeline>>,
}

/// Gaussians that are there to be drawn.
#[derive(Debug, Clone)]
pub struct Scene {
    pub gaussians: Arc<Gaussians>,
    /// The part of the cube that they take.
    pub extent: Extent,
    /// The axis that points up, if it is known.
    pub up: Option<Up>,
    /// Their level and the heads that made them, of a stream.
    pub made: Option<(u8, HeadSet)>,
    /// Whether a finer level of it fits into memory no more, so that [`Wish::camera`] says what is made of it.
    pub is_part: bool,
    /// What it took so far.
    pub steps: Vec<Step>,
    /// The frame that this is, of a sequence.
    pub frame: Option<Shown>,
}

/// A frame that is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// Its number, from 0.
    pub number: u64,
    /// Frames that were due before it and not shown, since the sequence was opened.
    pub dropped: u64,
}

/// What a source tells, with the number of the wish that it is for.
#[derive(Debug)]
pub enum Arrived {
    /// The file is open.
    Choices(Choices),
    /// Gaussians, the coarser before the finer.
    Scene(Box<Scene>),
    /// Frames of a sequence that cannot be shown. Others follow.
    Skipped(String),
    /// All that was wished for has arrived; of a sequence, the first frame.
    Done,
    /// Nothing more will arrive.
    Failed(String),
}

/// Makes Gaussians on threads of its own, and tells when they are there.
///
/// A viewer draws whatever scene arrived last with the camera that it has. A source of frames over time sends a scene
/// whenever the next one is due.
pub trait Source {
    /// Begins to make this. What was wished for before may never arrive.
    fn want(&mut self, wanted: Wish);

    /// Shows frames of a sequence by this clock from now on.
    fn play(&mut self, clock: &Clock);
}

/// Takes what a source tells, on any thread.
pub type Tell = dyn Fn(u64, Arrived) + Send + Sync;
