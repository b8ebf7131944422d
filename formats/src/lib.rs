//! File formats of point clouds and Gaussian splats: what `b2p` reads and writes beside its own streams.
//!
//! - [`detect`]: what a file is, by its content.
//! - [`clouds`]: point clouds (PLY, LAS, PCD, …) to and from [`b2p::cloud::PointCloud`].
//! - [`splats`]: Gaussians (PLY, SPZ, SOG, …) to and from [`b2p::gaussians::Gaussians`].
#![forbid(unsafe_code)]

pub mod clouds;
pub mod detect;
pub mod splats;
