//! The laboratory of `b2p`: what is needed to make data, train, and judge, and never to decode.
#![forbid(unsafe_code)]

pub mod capture;
pub mod cli;
pub mod dataset;
pub mod error;
pub mod eval;
pub mod mesh;
pub mod motion;
pub mod occupancy;
pub mod procedural;
pub mod random;
pub mod raster;
pub mod sample;
pub mod scatter;
pub mod surface;
pub mod tradeoff;
pub mod triplanar;

pub use error::{LabError, Result};
