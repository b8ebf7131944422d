//! What players have in common: the clock of a sequence, and which frame is decoded next, at which level, so that the
//! clock is kept.

pub mod clock;
pub mod player;
pub mod schedule;
