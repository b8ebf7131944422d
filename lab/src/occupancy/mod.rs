//! Trains the network that predicts octree occupancy ([`b2p::geometry::codec::network`]).
//!
//! The examples are the octrees of sampled meshes, each shown several ways: as it stands, turned, rough or as one side
//! alone; and of shapes that are no surfaces at all, so that the network has seen points, lines and solids. The loss is
//! the length of the code in bits, without the learning that the codec itself does.

mod clouds;
mod network;
mod samples;

pub use clouds::{shapes, views};
pub use network::Network;
pub use samples::Samples;
