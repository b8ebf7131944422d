//! Loops of tile products alone: see [`crate::ceiling`].

use std::arch::asm;

use super::{LINE, TILE, configure, release};
use crate::rows::PANEL;

/// A function that multiplies tiles `4 · rounds` times, and gives the number of products of `$bytes` bytes.
macro_rules! spin {
    ($name:ident, $multiply:literal, $bytes:literal) => {
        pub(crate) fn $name(isa: crate::Isa, rounds: usize) -> usize {
            assert!(isa.has_tiles());
            configure();
            // SAFETY: tiles are configured, and zero; the registers that are written are named.
            unsafe {
                asm!(
                    "2:",
                    concat!($multiply, " tmm0, tmm4, tmm6"),
                    concat!($multiply, " tmm1, tmm5, tmm6"),
                    concat!($multiply, " tmm2, tmm4, tmm7"),
                    concat!($multiply, " tmm3, tmm5, tmm7"),
                    "dec {rounds}",
                    "jnz 2b",
                    rounds = inout(reg) rounds.max(1) => _,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    options(nostack, nomem),
                );
            }
            release();
            rounds.max(1) * 4 * TILE * PANEL * LINE / $bytes
        }
    };
}
spin!(spin, "tdpbssd", 1);
spin!(spin_brain, "tdpbf16ps", 2);
