//! Makes the checksums of a changed stream right again, so that what lies behind them is put to the test.
#![allow(dead_code)] // each test file uses its part

/// Bytes of the header of version 2 before its arrays, and of a chunk before its payload.
pub const FIXED: usize = 84;
pub const CHUNK: usize = 16;

/// Where the parts of a chunk are.
#[derive(Clone, Copy)]
pub struct Place {
    pub start: usize,
    /// Its length, a u32 in version 2, LEB128 in version 3.
    length: usize,
    sum: usize,
    pub payload: usize,
    pub end: usize,
}

/// Whether it calls itself a stream of version 3.
fn is_short(bytes: &[u8]) -> bool {
    bytes.get(8) == Some(&3)
}

/// Bytes of the header before its arrays.
pub fn fixed(bytes: &[u8]) -> usize {
    if is_short(bytes) { 72 } else { FIXED }
}

/// How many levels the header speaks of, and where its checksum stands.
pub fn header_end(bytes: &[u8]) -> Option<(usize, usize)> {
    let levels = bytes.get(22)?.checked_sub(*bytes.get(21)?)?;
    let levels = usize::from(levels) + 1;
    let most = if is_short(bytes) { 21 } else { 3 };
    let end = fixed(bytes) + 12 * levels;
    (levels <= most && bytes.len() >= end + 4).then_some((levels, end))
}

/// Where the chunks start, as far as their lengths lead.
pub fn chunks(bytes: &[u8]) -> Vec<usize> {
    places(bytes).iter().map(|place| place.start).collect()
}

/// Where the parts of all chunks are, as far as their lengths lead.
pub fn places(bytes: &[u8]) -> Vec<Place> {
    let mut places = Vec::new();
    let Some((_, end)) = header_end(bytes) else {
        return places;
    };
    let mut at = end + 4;
    while let Some(place) = place(bytes, at) {
        places.push(place);
        at = place.end;
    }
    places
}

/// The chunk that starts at `start`, if it lies within the stream.
fn place(bytes: &[u8], start: usize) -> Option<Place> {
    let (length, sum, count) = if is_short(bytes) {
        let count = varint(bytes, start + 2)?.1;
        let length = varint(bytes, count)?.1;
        let (value, sum) = varint(bytes, length)?;
        (length, sum, value)
    } else {
        let length = bytes.get(start + 8..start + 12)?;
        let value = u32::from_le_bytes([length[0], length[1], length[2], length[3]]);
        (start + 8, start + 12, value)
    };
    let payload = sum + 4;
    let end = payload.checked_add(count as usize)?;
    (end <= bytes.len()).then_some(Place {
        start,
        length,
        sum,
        payload,
        end,
    })
}

/// A number in LEB128, and where it ends.
fn varint(bytes: &[u8], at: usize) -> Option<(u32, usize)> {
    let mut number = 0u64;
    for (i, byte) in bytes.get(at..)?.iter().take(5).enumerate() {
        number |= u64::from(byte & 0x7f) << (7 * i);
        if *byte < 0x80 {
            return Some((u32::try_from(number).ok()?, at + i + 1));
        }
    }
    None
}

/// The stream with another payload in one chunk: every length and every checksum fit.
pub fn with_payload(bytes: &[u8], place: Place, payload: &[u8]) -> Vec<u8> {
    let mut stream = bytes[..place.length].to_vec();
    let mut length = payload.len() as u32;
    if is_short(bytes) {
        while length >= 0x80 {
            stream.push(length as u8 | 0x80);
            length >>= 7;
        }
        stream.push(length as u8);
    } else {
        stream.extend(length.to_le_bytes());
    }
    stream.extend([0; 4]);
    stream.extend(payload);
    let now = stream.len() - place.start;
    stream.extend(&bytes[place.end..]);
    if let Some(section) = section_of(bytes, place.start) {
        let of = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        let length = u32::from_le_bytes(of(section)) as usize + now;
        let length = length.saturating_sub(place.end - place.start) as u32;
        stream[section..section + 4].copy_from_slice(&length.to_le_bytes());
    }
    seal(&mut stream);
    stream
}

/// Where the header tells the length of the section that holds the byte `at`.
fn section_of(bytes: &[u8], at: usize) -> Option<usize> {
    let (levels, end) = header_end(bytes)?;
    let mut section_end = end + 4;
    (0..2 * levels)
        .map(|i| fixed(bytes) + 4 * levels + 4 * i)
        .find(|&section| {
            let length = &bytes[section..section + 4];
            let length = u32::from_le_bytes([length[0], length[1], length[2], length[3]]);
            section_end = section_end.saturating_add(length as usize);
            at < section_end
        })
}

/// Puts the right checksums into the header and into every chunk that can be found.
pub fn seal(bytes: &mut [u8]) {
    if let Some((_, end)) = header_end(bytes) {
        let sum = crc32c::crc32c(&bytes[..end]);
        bytes[end..end + 4].copy_from_slice(&sum.to_le_bytes());
    }
    for place in places(bytes) {
        let sum = crc32c::crc32c(&bytes[place.start..place.sum]);
        let sum = crc32c::crc32c_append(sum, &bytes[place.payload..place.end]);
        bytes[place.sum..place.payload].copy_from_slice(&sum.to_le_bytes());
    }
}
