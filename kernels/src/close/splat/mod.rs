//! Splats: Gaussians onto the picture ([`project`]), and into the pixels of one tile ([`Tile`]).
//!
//! Each kernel is one body over the vectors of any instruction set. Between sets the last bits differ, because only
//! some multiply and add in one rounding; in each of them the result is a function of the input alone.

mod block;
mod camera;
mod ellipse;
mod extent;
mod layout;
mod pixels;
mod project;
mod tile;

#[cfg(test)]
mod tests;

pub use block::{Loop, Scene, Share, TILE};
pub use camera::View;
pub use ellipse::{ALPHA_CEILING, Bounds, Crossing, Ellipse, FINISHED, MAX_SCALE, MIN_COMPENSATION, WAITING};
pub use project::{Cloud, Tally, project};
pub use tile::Tile;
