//! Bits-to-Photon on a plain CPU.
//!
//! A coloured point cloud is coded as a scalable stream: an octree, then latent features per octree level. The stream decodes
//! straight to 3D Gaussians, and those to pictures, without a GPU.
//!
//! ```text
//! bytes → bitstream → geometry → entropy → network → gaussians → projection → tiles → pixels
//!         ╰─────────────── exact: bit-equal everywhere ───────────────╯╰─ close: bounded error ─╯
//! ```
//!
//! A stage imports only from the stages to its left, the `b2p-kernels` crate, and the commons ([`error`], [`limits`], [`cancel`], [`placement`]).
//!
//! Stream to picture:
//!
//! ```
//! # #[cfg(feature = "cli")]
//! # fn main() -> b2p::Result<()> {
//! use b2p::{Limits, decoder::Decoder, log::Log, network::Model, pixels, projection::Camera};
//!
//! let model = Model::from_bytes(b2p::embedded::MODEL)?;
//! let gaussians = Decoder::new(&model).decode(b2p::embedded::SAMPLE, None, &mut Log::default())?;
//! let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 160, 120)?;
//! let (image, stats) = pixels::render(&gaussians, &camera, pixels::Background::WHITE, &Limits::default())?;
//! assert_eq!((image.width, image.height), (160, 120));
//! assert!(stats.visible > 0);
//! # Ok(())
//! # }
//! # #[cfg(not(feature = "cli"))]
//! # fn main() {}
//! ```
#![forbid(unsafe_code)]

pub mod bitstream;
pub mod cancel;
#[cfg(feature = "ply")]
pub mod cloud;
mod coding;
pub mod colour;
pub mod decoder;
#[cfg(feature = "cli")]
pub mod embedded;
#[cfg(feature = "encoder")]
pub mod encoder;
pub mod entropy;
pub mod error;
pub mod gaussians;
pub mod geometry;
pub mod limits;
pub mod log;
pub mod network;
pub mod output;
#[cfg(feature = "render")]
pub mod pixels;
pub mod placement;
#[cfg(feature = "render")]
pub mod projection;
#[cfg(feature = "render")]
pub mod tiles;
#[cfg(feature = "tradeoff")]
pub mod tradeoff;

pub use b2p_kernels::{Isa, UnknownIsa, ceiling};
pub use cancel::Cancel;
pub use error::{Error, Result};
pub use limits::Limits;
pub use placement::Placement;
