//! Makes the checksums of a changed stream right again, so that what lies behind them is put to the test.

/// Bytes of the header before its arrays, and of a chunk before its payload.
pub const FIXED: usize = 84;
pub const CHUNK: usize = 16;

/// How many levels the header speaks of, and where its checksum stands.
pub fn header_end(bytes: &[u8]) -> Option<(usize, usize)> {
    let levels = bytes.get(22)?.checked_sub(*bytes.get(21)?)?;
    let levels = usize::from(levels) + 1;
    let end = FIXED + 12 * levels;
    (levels <= 3 && bytes.len() >= end + 4).then_some((levels, end))
}

/// Where the chunks start, as far as their lengths lead.
pub fn chunks(bytes: &[u8]) -> Vec<usize> {
    let mut starts = Vec::new();
    let Some((_, end)) = header_end(bytes) else {
        return starts;
    };
    let mut at = end + 4;
    while let Some(next) = chunk_end(bytes, at) {
        starts.push(at);
        at = next;
    }
    starts
}

/// Where the chunk that starts at `at` ends, if it lies within the stream.
fn chunk_end(bytes: &[u8], at: usize) -> Option<usize> {
    let length = bytes.get(at + 8..at + 12)?;
    let length = u32::from_le_bytes([length[0], length[1], length[2], length[3]]);
    let end = (at + CHUNK).checked_add(length as usize)?;
    (end <= bytes.len()).then_some(end)
}

/// Puts the right checksums into the header and into every chunk that can be found.
pub fn seal(bytes: &mut [u8]) {
    if let Some((_, end)) = header_end(bytes) {
        let sum = crc32c::crc32c(&bytes[..end]);
        bytes[end..end + 4].copy_from_slice(&sum.to_le_bytes());
    }
    for at in chunks(bytes) {
        let end = chunk_end(bytes, at).expect("chunks that were found have an end");
        let sum = crc32c::crc32c(&bytes[at..at + 12]);
        let sum = crc32c::crc32c_append(sum, &bytes[at + CHUNK..end]);
        bytes[at + 12..at + CHUNK].copy_from_slice(&sum.to_le_bytes());
    }
}
