//! Sequences of frames (`docs/format.md`, clause 17).
//!
//! A sequence is one file: a header for all frames, an index by time, and groups of frames. A group decodes without any
//! other, so sequences are cut and joined at the borders of groups without coding anything again. Frames are scalable
//! as streams of one frame are. The first frame of a group is *whole*, coded by itself; the others may be *predicted*
//! from the frame before.
//!
//! - [`SequenceReader`] reads header and index, and finds frames by number or time.
//! - [`SequenceDecoder`] decodes frames.
//! - `SequenceEncoder` codes clouds on one grid.
//! - [`play`] has the clock of a player, and chooses frames and levels by it.
//! - [`cut`](SequenceReader::cut) and [`join`] edit sequences by groups.

mod assembly;
mod decoder;
#[cfg(feature = "encoder")]
mod encoder;
#[doc(hidden)]
pub mod play;
#[cfg(feature = "encoder")]
mod rate_control;
mod reader;

pub use assembly::join;
pub use decoder::{DecodedFrame, Frames, GaussianFrames, SequenceDecoder};
#[cfg(feature = "encoder")]
pub use encoder::{KeptGroups, SequenceEncoder};
#[cfg(feature = "encoder")]
pub use rate_control::Rate;
pub use reader::{FramePart, Group, SequenceReader};
