//! Point clouds.
