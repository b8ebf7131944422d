//! The arithmetic kernels of `b2p`, and the one place that maps files into memory.
//!
//! Every `unsafe` block of the project lives here, each with its reason. Nothing here knows of streams, levels or Gaussians.
