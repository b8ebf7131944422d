//! b2p for C. The header is `include/b2p.h`; a test holds it to this source.
//!
//! Objects are handed out as pointers and taken back by their `_free` function. Every function catches panics, so that none crosses
//! the boundary, and reports them as [`Status::Internal`].

mod boundary;
mod decoding;
mod model;
mod parts;
mod picture;
#[cfg(feature = "page")]
mod player;
mod points;
#[cfg(feature = "page")]
mod splats;
#[cfg(target_family = "wasm")]
pub mod wasm;

pub use boundary::Status;
pub use decoding::{Arrays, Cancel, Decoding, Gaussians};
pub use model::{Limits, Model};
pub use parts::Part;
pub use picture::Camera;
#[cfg(feature = "page")]
pub use player::{PlayedFrame, Player, SequenceInfo};
pub use points::{PointArrays, Points};
#[cfg(feature = "page")]
pub use splats::Content;
