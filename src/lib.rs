//! Coloured point clouds as small streams, decoded to 3D Gaussians and pictures on a CPU.
//!
//! A stream is scalable: an octree and its colours, level by level, so that what ends after a level is a coarser stream. Version 3 codes
//! colours as transform coefficients and needs no model file; what draws it, discs in closed form or learned heads, is the decoder's choice.
//! Version 2, *Bits-to-Photon*, codes learned features, from which the model that coded them generates Gaussians.
//!
//! ```text
//! bytes → bitstream → geometry → colour ────────────→ gaussians → projection → tiles → pixels    (version 3)
//! bytes → bitstream → geometry → entropy → network → gaussians → projection → tiles → pixels    (version 2)
//!         ╰─────────── exact: bit-equal everywhere ───────────╯╰──── close: bounded error ────╯
//! ```
//!
//! A stage imports only from the stages to its left, the `b2p-kernels` crate, and the commons ([`error`], [`limits`], [`cancel`], [`placement`]).
//!
//! Cloud to stream to picture:
//!
//! ```
//! # #[cfg(feature = "encoder")]
//! # fn main() -> b2p::Result<()> {
//! use b2p::cloud::{PointCloud, voxelise};
//! use b2p::encoder::transform;
//! use b2p::{Limits, decoder::StreamDecoder, log::Log, renderer, renderer::camera::Camera};
//!
//! let place = |i: u32| [i % 40, i / 40, 20].map(f64::from);
//! let cloud = PointCloud {
//!     positions: (0..1600).map(place).collect(),
//!     colours: (0..1600).map(|i| [200, (i % 40 * 6) as u8, 40]).collect(),
//!     ..PointCloud::default()
//! };
//! let mut log = Log::default();
//! let options = transform::Options::default();
//! let stream = transform::encode(&voxelise(&cloud, Some(6))?, &options, &mut log)?.bytes;
//!
//! let gaussians = StreamDecoder::new().decode(&stream, None, &mut log)?;
//! let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 160, 120)?;
//! let (image, stats) = renderer::render(&gaussians, &camera, renderer::Background::WHITE, &Limits::default())?;
//! assert_eq!((image.width, image.height), (160, 120));
//! assert!(stats.visible > 0);
//! # Ok(())
//! # }
//! # #[cfg(not(feature = "encoder"))]
//! # fn main() {}
//! ```
#![forbid(unsafe_code)]

pub mod axes;
pub mod cancel;
#[cfg(feature = "ply")]
pub mod cloud;
mod coding;
pub mod colour;
pub mod container;
pub mod decoder;
#[cfg(feature = "embedded")]
pub mod embedded;
#[cfg(feature = "encoder")]
pub mod encoder;
pub mod error;
pub mod gaussians;
pub mod geometry;
pub mod latents;
pub mod layers;
pub mod limits;
pub mod log;
mod memory;
#[cfg(feature = "encoder")]
pub mod metrics;
pub mod output;
pub mod placement;
#[cfg(feature = "render")]
pub mod renderer;
#[cfg(test)]
mod testing;

pub use axes::{Axes, Up};
pub use b2p_kernels::{Isa, UnknownIsa, ceiling};
pub use cancel::Cancel;
pub use error::{Error, Result};
pub use limits::Limits;
pub use placement::Placement;
