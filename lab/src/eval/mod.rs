//! Rate and distortion: what a method costs, and how far its pictures are from the truth.
//!
//! [`protocol`] says what is drawn and compared, [`metrics`] how. Clouds without Gaussians of their own are drawn as
//! squares, as one round Gaussian a point ([`points`]) and as surfels ([`surfels`]). A [`Bench`] holds one object's
//! truth and judges files of every kind against it.

pub mod bench;
pub mod item;
pub mod metrics;
pub mod nearest;
pub mod picture;
pub mod points;
pub mod protocol;
pub mod reframe;
pub mod report;
pub mod sequence;
pub mod sheet;
pub mod surfels;

pub use bench::{Bench, Entry};
