//! File formats of point clouds and Gaussian splats: what `b2p` reads and writes beside its own streams.
//!
//! - [`detect`]: what a file is, by its content.
//! - [`clouds`]: point clouds (PLY, LAS, PCD, …) to and from [`b2p::cloud::PointCloud`].
//! - [`sidecar`]: what stands in a file beside those, because their formats have no place for it.
//! - [`splats`]: Gaussians (PLY, SPZ, SOG, …) to and from [`b2p::gaussians::Gaussians`].
#![forbid(unsafe_code)]

pub mod clouds;
pub mod detect;
pub mod sidecar;
pub mod splats;
