//! The tiles themselves.

use std::arch::asm;

/// Bytes of a tile row.
pub(crate) const LINE: usize = 64;
/// [`Words`](crate::sparse::rows::Words) of a tile, and rows of a group.
pub(super) const TILE: usize = 16;
/// Lays out eight tiles of 16 rows by 64 bytes.
pub(super) fn configure() {
    let mut layout = [0u8; 64];
    layout[0] = 1;
    for tile in 0..8 {
        layout[16 + 2 * tile] = LINE as u8;
        layout[48 + tile] = TILE as u8;
    }
    // SAFETY: reads the 64 bytes of a valid layout. Compilers never use tile registers of their own accord.
    unsafe { asm!("ldtilecfg [{}]", in(reg) &layout, options(nostack, preserves_flags, readonly)) };
}

/// Gives the tiles back, which spares the system from saving them.
pub(super) fn release() {
    // SAFETY: no tile is in use any more.
    unsafe { asm!("tilerelease", options(nostack, preserves_flags, nomem)) };
}
