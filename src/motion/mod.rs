//! Prediction of a frame from the frame before it (`docs/format.md`, clauses 17.5 to 17.9).
//!
//! A frame is cut into *blocks*, the nodes of one coarse level. Each has a motion vector, and for every level one mode
//! for its occupancies and one for its colours; its eight *parts* have their own for all levels but the first of them.
//! All that a level is predicted from is the previous frame as it was decoded, so that encoder and decoder never differ:
//! the same level of it, or the moved frame that one finer level makes.
//!
//! - [`Previous`] is the previous frame, searched by position.
//! - [`Head`] and [`Blocks`] are what a frame says of its blocks.
//! - [`Inter`] makes of both what the coders of occupancies and colours take.

mod bricks;
mod guides;
mod models;
pub(crate) mod moved;
mod payload;
mod previous;

pub use bricks::Bricks as Places;
pub use guides::{ColourGuide, GeometryGuide, Inter};
pub use models::{Groups, predicted};
pub(crate) use payload::level_of;
pub use payload::{Blocks, Head, Modes};
pub use previous::{Coloured, Previous, PreviousLevel};

pub use crate::geometry::codec::guide::{Mode, own};
