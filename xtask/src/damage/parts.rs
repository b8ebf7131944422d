//! A stream taken apart, so that one thing in it can be made wrong and all checksums right again.

/// A stream as its parts.
#[derive(Clone)]
pub struct Parts {
    /// The header before its arrays.
    pub fixed: Vec<u8>,
    pub voxels: Vec<u32>,
    /// Geometry and colour section of each level.
    pub sections: Vec<[Vec<Chunk>; 2]>,
    /// What the header adds to the lengths of the sections.
    pub longer: Vec<[i64; 2]>,
    /// What is wrong with the header's checksum.
    pub sum: u32,
    /// Bytes after the last section.
    pub tail: Vec<u8>,
    /// Where the stream ends, if not at its end.
    pub end: Option<usize>,
}

/// A chunk, or any bytes in place of one.
#[derive(Clone)]
pub struct Chunk {
    pub kind: u8,
    pub level: u8,
    /// As they are written.
    pub slice: Vec<u8>,
    pub count: Vec<u8>,
    /// If it is not that of the payload.
    pub length: Option<Vec<u8>>,
    pub payload: Vec<u8>,
    /// What is wrong with its checksum.
    pub sum: u32,
    /// These bytes instead of a chunk.
    pub raw: Option<Vec<u8>>,
}

/// A varint.
pub fn varint(mut number: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while number >= 0x80 {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
    bytes
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// A header whose checksum is wrong by `sum`, and its chunks. The one of no payload gets that of the index, and says that
/// it has so many units.
pub fn framed(header: &[u8], sum: u32, chunks: &[Chunk], index: &[u8], units: i64) -> Vec<u8> {
    let sum = crc32c::crc32c(header) ^ sum;
    let mut bytes = [header, &sum.to_le_bytes()].concat();
    for chunk in chunks {
        let mut chunk = chunk.clone();
        if chunk.payload.is_empty() {
            chunk.payload = index.to_vec();
            chunk.count = varint(units as u64);
        }
        chunk.write(true, &mut bytes);
    }
    bytes
}

impl Parts {
    /// Takes a valid stream apart.
    pub fn of(bytes: &[u8]) -> Self {
        let short = bytes[8] == 3;
        let fixed = if short { 72 } else { 84 };
        let levels = usize::from(bytes[22] - bytes[21]) + 1;
        let mut at = fixed + 12 * levels + 4;
        let mut sections = Vec::new();
        for level in 0..levels {
            sections.push([0, 1].map(|part| {
                let length = u32_at(bytes, fixed + 4 * levels + 8 * level + 4 * part) as usize;
                let section = &bytes[at..at + length];
                at += length;
                Chunk::all(section, short)
            }));
        }
        Parts {
            fixed: bytes[..fixed].to_vec(),
            voxels: (0..levels).map(|i| u32_at(bytes, fixed + 4 * i)).collect(),
            sections,
            longer: vec![[0; 2]; levels],
            sum: 0,
            tail: Vec::new(),
            end: None,
        }
    }

    /// The stream.
    pub fn bytes(&self) -> Vec<u8> {
        let short = self.fixed[8] != 2;
        let mut header = self.fixed.clone();
        header.extend(self.voxels.iter().flat_map(|count| count.to_le_bytes()));
        let mut body = Vec::new();
        for (parts, longer) in self.sections.iter().zip(&self.longer) {
            for (chunks, longer) in parts.iter().zip(longer) {
                let start = body.len();
                chunks.iter().for_each(|chunk| chunk.write(short, &mut body));
                let length = (body.len() - start) as i64 + longer;
                header.extend((length as u32).to_le_bytes());
            }
        }
        header.extend((crc32c::crc32c(&header) ^ self.sum).to_le_bytes());
        let mut bytes = [header, body, self.tail.clone()].concat();
        bytes.truncate(self.end.unwrap_or(usize::MAX));
        bytes
    }

    /// Replaces bytes of the header.
    pub fn put(&mut self, at: usize, bytes: &[u8]) {
        self.fixed[at..at + bytes.len()].copy_from_slice(bytes);
    }

    /// The geometry chunks of the level with this index.
    pub fn geometry(&mut self, level: usize) -> &mut Vec<Chunk> {
        &mut self.sections[level][0]
    }

    /// The colour chunks of the level with this index.
    pub fn colours(&mut self, level: usize) -> &mut Vec<Chunk> {
        &mut self.sections[level][1]
    }
}

impl Chunk {
    /// A chunk of version 3.
    pub fn new(kind: u8, level: u8, slice: u64, count: u64, payload: &[u8]) -> Self {
        Chunk {
            kind,
            level,
            slice: varint(slice),
            count: varint(count),
            length: None,
            payload: payload.to_vec(),
            sum: 0,
            raw: None,
        }
    }

    /// These bytes in place of a chunk.
    pub fn raw(bytes: &[u8]) -> Self {
        let raw = Some(bytes.to_vec());
        Chunk {
            raw,
            ..Chunk::new(0, 0, 0, 0, &[])
        }
    }

    /// The count of a chunk of version 3, changed by this much.
    pub fn count_by(&mut self, change: i64) {
        let bits = self.count.iter().rev();
        let count = bits.fold(0, |number, byte| number << 7 | u64::from(byte & 0x7f));
        self.count = varint(count.wrapping_add_signed(change));
    }

    fn all(section: &[u8], short: bool) -> Vec<Chunk> {
        let mut chunks = Vec::new();
        let mut at = 0;
        while at < section.len() {
            let mut take = |count: usize| {
                at += count;
                section[at - count..at].to_vec()
            };
            let [kind, level] = [take(1)[0], take(1)[0]];
            let mut number = |width| match short {
                false => take(width),
                true => {
                    let mut bytes = take(1);
                    while bytes[bytes.len() - 1] >= 0x80 {
                        bytes.extend(take(1));
                    }
                    bytes
                }
            };
            let [slice, count, length] = [number(2), number(4), number(4)];
            let shift = if short { 7 } else { 8 };
            let bits = length.iter().rev();
            let length = bits.fold(0, |n, byte| {
                n << shift | usize::from(byte & if short { 0x7f } else { 0xff })
            });
            take(4);
            chunks.push(Chunk {
                kind,
                level,
                slice,
                count,
                length: None,
                payload: take(length),
                sum: 0,
                raw: None,
            });
        }
        chunks
    }

    /// Appends the chunk, in the form of version 3 if `short`.
    pub fn write(&self, short: bool, out: &mut Vec<u8>) {
        if let Some(raw) = &self.raw {
            return out.extend(raw);
        }
        let start = out.len();
        out.extend([self.kind, self.level]);
        out.extend(&self.slice);
        out.extend(&self.count);
        let own = || match short {
            true => varint(self.payload.len() as u64),
            false => (self.payload.len() as u32).to_le_bytes().to_vec(),
        };
        out.extend(self.length.clone().unwrap_or_else(own));
        let sum = crc32c::crc32c_append(crc32c::crc32c(&out[start..]), &self.payload);
        out.extend((sum ^ self.sum).to_le_bytes());
        out.extend(&self.payload);
    }
}
