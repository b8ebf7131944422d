//! Gaussian splats.
