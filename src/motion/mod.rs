//! Prediction of a frame from the frame before it (`docs/format.md`, clauses 17.5 to 17.10).
//!
//! A frame is cut into *blocks*, the nodes of one coarse level. Each has a motion vector, and for every level one mode
//! for its occupancies and one for its colours; its eight *parts* have their own for all levels but the first of them.
//! All that a level is predicted from is the previous frame as it was decoded, so that encoder and decoder never differ:
//! the same level of it, or the moved frame that one finer level makes. A *warped* frame moves the previous frame by a
//! smooth field before anything else, and its blocks have modes alone.
//!
//! - [`Previous`] is the previous frame, searched by position.
//! - [`Head`] and [`Blocks`] are what a frame says of its blocks.
//! - [`Lattice`] is the field of a warped frame, and [`Warped`] what the previous frame becomes by it.
//! - [`Inter`] makes of both what the coders of occupancies and colours take.

mod bricks;
mod guides;
mod lattice;
mod models;
pub(crate) mod moved;
mod payload;
mod previous;
mod warp;

pub use bricks::Bricks as Places;
pub use guides::{ColourGuide, GeometryGuide, Inter};
#[cfg(feature = "encoder")]
pub use lattice::Corners;
pub use lattice::Lattice;
pub use models::{Groups, predicted};
pub(crate) use payload::level_of;
pub use payload::{Blocks, Head, Modes};
pub use previous::{Coloured, Previous, PreviousLevel};
pub use warp::Warped;
#[cfg(feature = "encoder")]
pub use warp::{Scattered, offset};

pub use crate::geometry::codec::guide::{Mode, own};
