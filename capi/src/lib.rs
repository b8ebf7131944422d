//! b2p for C. The header is `include/b2p.h`; a test holds it to this source.
//!
//! Objects are handed out as pointers and taken back by their `_free` function. Every function catches panics, so that none crosses
//! the border, and reports them as [`Status::Internal`].

mod border;
mod decoding;
mod model;
mod picture;
mod points;

pub use border::Status;
pub use decoding::{Arrays, Cancel, Decoding, Gaussians};
pub use model::{Limits, Model};
pub use picture::Camera;
pub use points::{PointArrays, Points};
