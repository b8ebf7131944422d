//! The laboratory of `b2p`: what is needed to make data, train, and judge, and never to decode.
#![forbid(unsafe_code)]

pub mod mesh;
pub mod procedural;
