//! Letters of eight by eight pixels.

use font8x8::legacy::{BASIC_LEGACY, LATIN_LEGACY};

/// A character is so many pixels wide and high before it is enlarged.
pub const CHARACTER: u32 = 8;

/// Eight rows of eight pixels, the lowest bit leftmost; an empty one for what the font has not.
pub fn glyph(character: char) -> [u8; 8] {
    let code = character as usize;
    match code {
        0..0x80 => BASIC_LEGACY[code],
        0xa0..0x100 => LATIN_LEGACY[code - 0xa0],
        _ => [0; 8],
    }
}
