//! Peak throughput of tiles: loops of their products alone.

use std::arch::asm;

use super::tiles::{LINE, TILE, configure, release};
use crate::simd::amx::Amx;
use crate::sparse::peak::some_words;
use crate::sparse::rows::{PANEL, Words};

/// As many tiles of bytes between −32 and 31: the digits of numbers are no larger.
fn some_digits<const N: usize>() -> [Words; N] {
    let digits = |word: u32| {
        let of = |byte: u8| ((byte << 2) as i8 >> 2) as u8;
        u32::from_le_bytes(word.to_le_bytes().map(of))
    };
    // Their lower bytes are as good as any.
    some_words().map(|words: Words| Words(words.0.map(|word| digits(word ^ word << 8))))
}

/// A function that multiplies tiles of `$words` `4 · rounds` times, and gives the number of products of `$bytes` bytes.
macro_rules! batch {
    ($name:ident, $multiply:literal, $bytes:literal, $words:expr) => {
        pub(crate) fn $name(_: Amx, rounds: usize) -> usize {
            let words: [Words; 4 * TILE] = $words;
            configure();
            // SAFETY: tiles are configured, and four of them read; the registers that are written are named.
            unsafe {
                asm!(
                    "tileloadd tmm4, [{words} + {line}]",
                    "tileloadd tmm5, [{words} + {line} + 1024]",
                    "tileloadd tmm6, [{words} + {line} + 2048]",
                    "tileloadd tmm7, [{words} + {line} + 3072]",
                    "2:",
                    concat!($multiply, " tmm0, tmm4, tmm6"),
                    concat!($multiply, " tmm1, tmm5, tmm6"),
                    concat!($multiply, " tmm2, tmm4, tmm7"),
                    concat!($multiply, " tmm3, tmm5, tmm7"),
                    "dec {rounds}",
                    "jnz 2b",
                    rounds = inout(reg) rounds.max(1) => _,
                    words = in(reg) words.as_ptr(),
                    line = in(reg) LINE,
                    out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                    out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                    options(nostack, readonly),
                );
            }
            release();
            rounds.max(1) * 4 * TILE * PANEL * LINE / $bytes
        }
    };
}
batch!(bytes, "tdpbssd", 1, some_digits());
#[cfg(feature = "close")]
batch!(bf16, "tdpbf16ps", 2, some_words());
