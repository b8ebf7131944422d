//! Coloured point clouds as small streams, decoded to 3D Gaussians and pictures on a CPU.
//!
//! Three lines from bytes to a picture:
//!
//! ```
//! # #[cfg(all(feature = "embedded", feature = "render"))]
//! # fn main() -> b2p::Result<()> {
//! # let bytes = b2p::embedded::SCENE;
//! use b2p::{Camera, Decoder, Renderer};
//!
//! let gaussians = Decoder::new().decode(bytes)?;
//! let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 640, 480)?;
//! let png = Renderer::new().render(&gaussians, &camera)?.to_png()?;
//! # assert!(png.len() > 1000);
//! # Ok(())
//! # }
//! # #[cfg(not(all(feature = "embedded", feature = "render")))]
//! # fn main() {}
//! ```
//!
//! | to | use |
//! |---|---|
//! | decode a stream, whole or as it arrives | [`Decoder`], [`Decoding`] |
//! | read and decode sequences of frames | [`SequenceReader`], [`SequenceDecoder`], `SequenceEncoder` |
//! | read and decode scenes of blocks, in part | [`SceneReader`], [`SceneDecoder`], `SceneEncoder` |
//! | draw with learned heads | [`HeadsModel`], [`HeadSet`] |
//! | read and write Gaussians | [`Gaussians`] |
//! | draw | `Renderer`, `Camera`, `Image` |
//! | read, voxelise and encode a cloud | `PointCloud`, `voxelise`, `Encoder` |
//! | bound what untrusted input may ask for | [`Limits`] |
//! | stop, or observe | [`Cancel`], [`Log`] |
//!
//! Options are set by `with_…` methods. Decoders, models and logs are cheap to clone. Bad input gives an [`Error`];
//! nothing panics.
//!
//! # Streams
//!
//! A stream is scalable: a lossless octree and its colours, level by level. A stream cut after a level is a valid
//! coarser stream. Version 3 codes colours as transform coefficients and needs no model file; how it is drawn, as
//! surfels in closed form or with learned heads, is the decoder's choice. Version 2, *Bits-to-Photon*, codes latents,
//! from which the [`Model`] that coded them generates Gaussians.
//!
//! ```text
//! bytes → container → per level: geometry → colour → gaussians → renderer → picture
//!         ╰────── bit-exact on every machine ─────╯ ╰── bounded error ──╯
//! ```
//!
//! Each stage is a folder of `src/` and imports only earlier stages; `docs/architecture.md` describes them, and
//! `docs/format.md` the format. Modules are public for the program, the tests and the tools of this repository. They
//! are not documented here, and change without notice: what this page lists is the interface.
//!
//! # Features
//!
//! Without any, the library is the bare decoder: streams and models in, Gaussians in memory out. `ply` adds PLY files,
//! `render` pictures, `encoder` (default) all of it, and `embedded` the models and samples that the program contains.
#![forbid(unsafe_code)]
#![cfg_attr(not(test), warn(clippy::print_stderr, clippy::print_stdout))]

#[doc(hidden)]
pub mod axes;
#[doc(hidden)]
pub mod cancel;
#[cfg(feature = "ply")]
#[doc(hidden)]
pub mod cloud;
mod coding;
#[doc(hidden)]
pub mod colour;
#[doc(hidden)]
pub mod container;
#[doc(hidden)]
pub mod decoder;
#[cfg(feature = "embedded")]
pub mod embedded;
#[cfg(feature = "encoder")]
#[doc(hidden)]
pub mod encoder;
#[doc(hidden)]
pub mod error;
#[doc(hidden)]
pub mod gaussians;
#[doc(hidden)]
pub mod geometry;
#[doc(hidden)]
pub mod input;
#[doc(hidden)]
pub mod latents;
#[doc(hidden)]
pub mod layers;
#[doc(hidden)]
pub mod limits;
#[doc(hidden)]
pub mod log;
mod memory;
#[cfg(feature = "encoder")]
#[doc(hidden)]
pub mod metrics;
#[doc(hidden)]
pub mod motion;
#[doc(hidden)]
pub mod output;
#[doc(hidden)]
pub mod placement;
#[cfg(feature = "render")]
#[doc(hidden)]
pub mod renderer;
#[doc(hidden)]
pub mod scene;
#[doc(hidden)]
pub mod sequence;
#[cfg(test)]
mod testing;

pub use axes::{Axes, Up};
#[doc(hidden)]
pub use b2p_kernels::peak as peak_throughput;
pub use b2p_kernels::{Isa, UnknownIsa};
pub use cancel::Cancel;
#[cfg(feature = "ply")]
pub use cloud::{
    ColourRange, ColouredVoxels, Coordinates, GridReport, Hints, Note, PointCloud, RawColours, RawPoints, ReadOptions,
    Stored, voxelise, voxelise_closed,
};
pub use container::{Format, Header};
pub use decoder::{Decoder, Decoding, Points};
#[cfg(feature = "encoder")]
pub use encoder::{
    Encoded, Encoder, Rate, transform::GeometryTarget, transform::Motion, transform::Outline, transform::QualityTarget,
    transform::Tune,
};
pub use error::{Error, Result, Stage};
pub use gaussians::learned::HeadsModel;
pub use gaussians::{Frame, Gaussians, Harmonics, HeadSet};
pub use geometry::Voxels;
pub use latents::network::Model;
pub use layers::Precision;
pub use limits::Limits;
pub use log::{Log, Step};
pub use placement::Placement;
#[cfg(feature = "render")]
pub use renderer::camera::{Camera, Extent, Projection};
#[cfg(feature = "render")]
pub use renderer::projection::Dropped;
#[cfg(feature = "render")]
pub use renderer::{
    Background, Channel, Effect, EffectMode, EffectSet, Effects, Explanation, Ids, Image, Quality, Renderer, Stats,
    Times,
};
#[cfg(feature = "encoder")]
pub use scene::SceneEncoder;
pub use scene::{DecodedScene, FileSource, SceneDecoder, SceneDecoding, SceneReader, Source, Wanted};
pub use sequence::{DecodedFrame, SequenceDecoder, SequenceReader};
#[cfg(feature = "encoder")]
pub use sequence::{KeptGroups, SequenceEncoder};
