//! Scenes: clouds of any size as blocks, each a stream of its own (`docs/format.md`, clause 18).
//!
//! A block is a cube of the octree. Header and index come first, so that a part of a scene is decoded from those bytes
//! that hold it. [`SceneReader`] finds them, in memory or in a file. [`SceneDecoder`] decodes them: Gaussians at the
//! border of a block depend on the voxels of the blocks around it, as if the scene was one piece. So those of a part
//! that is decoded by itself equal those of the whole, bit for bit.

mod arriving;
mod decoder;
mod edit;
#[cfg(feature = "encoder")]
mod encoder;
mod halo;
mod neighbours;
mod partition;
#[cfg(feature = "encoder")]
mod rate_control;
mod reader;
#[cfg(feature = "encoder")]
mod runs;
mod source;
#[cfg(all(test, feature = "encoder"))]
mod tests;
#[cfg(feature = "render")]
mod view;

pub use arriving::SceneDecoding;
pub use decoder::{DecodedScene, SceneDecoder, Wanted};
#[cfg(feature = "encoder")]
pub use encoder::{Grid, SceneEncoder, Sink, Voxel};
pub use partition::{BLOCK_VOXELS, Cutter, ONE_PIECE};
pub use reader::{Checks, SceneReader};
#[cfg(feature = "encoder")]
pub use runs::Runs;
pub use source::{FileSource, Source};
#[cfg(feature = "render")]
pub use view::ViewOptions;
