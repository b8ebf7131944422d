//! Lossless WebP of pictures whose channels have nothing to do with each other: no transform, or each pixel less its
//! left neighbour, whichever is smaller; runs of equal pixels; one set of Huffman codes.
//!
//! The encoder of `image-webp` always subtracts green from red and blue, which adds the noise of one number to two
//! others.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Signature of a lossless stream.
const SIGNATURE: u64 = 0x2f;
/// Most bits of a code, and of the code of the codes' lengths.
const LONGEST: u8 = 15;
const LONGEST_OF_LENGTHS: u8 = 7;
/// Longest run.
const MOST: usize = 4096;
/// Values of green, and prefixes of the lengths of runs.
const GREENS: usize = 256 + 24;
/// The order in which the lengths of the code of lengths are written.
const ORDER: [usize; 19] = [17, 18, 0, 1, 2, 3, 4, 5, 16, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
/// The largest exponent of 2 of a tile's side.
const TILE: u32 = 9;
/// Predictor: the pixel to the left.
const LEFT: u8 = 1;
/// The prefix of the distance to the left pixel.
const DISTANCE: u8 = 1;

/// A picture of `width` × `height` pixels, both 1 to 16,384.
pub(super) fn encode(pixels: &[[u8; 4]], width: u32, height: u32) -> Vec<u8> {
    let frames = [false, true].map(|predicted| frame(pixels, width, height, predicted));
    let [plain, predicted] = frames;
    let frame = if predicted.len() < plain.len() {
        predicted
    } else {
        plain
    };
    let padded = frame.len().next_multiple_of(2);
    let mut bytes = b"RIFF".to_vec();
    bytes.extend((padded as u32 + 12).to_le_bytes());
    bytes.extend(b"WEBPVP8L");
    bytes.extend((frame.len() as u32).to_le_bytes());
    bytes.extend(&frame);
    bytes.resize(20 + padded, 0);
    bytes
}

fn frame(pixels: &[[u8; 4]], width: u32, height: u32, predicted: bool) -> Vec<u8> {
    let mut to = Bits::default();
    to.put(SIGNATURE, 8);
    to.put(u64::from(width) - 1, 14);
    to.put(u64::from(height) - 1, 14);
    // Alpha is used; version 0.
    to.put(1, 1);
    to.put(0, 3);
    let differences;
    let mut pixels = pixels;
    if predicted {
        // A transform; of this kind; with tiles of this size, all of which have one predictor.
        to.put(1, 1);
        to.put(0, 2);
        to.put(u64::from(TILE) - 2, 3);
        to.put(0, 1);
        to.put_single(LEFT);
        (0..4).for_each(|_| to.put_single(0));
        differences = less_left(pixels, width as usize);
        pixels = &differences;
    }
    // No more transforms, no colour cache, one set of codes.
    to.put(0, 3);
    let tokens = tokens(pixels);
    let mut counts = [vec![0; GREENS], vec![0; 256], vec![0; 256], vec![0; 256]];
    for &(pixel, run) in &tokens {
        for (counts, value) in counts.iter_mut().zip(in_order(pixel)) {
            counts[usize::from(value)] += 1;
        }
        if run > 0 {
            counts[0][256 + prefix(run).0] += 1;
        }
    }
    let codes = counts.map(|counts| to.put_code(&counts));
    to.put_single(DISTANCE);
    for (pixel, run) in tokens {
        for (code, value) in codes.iter().zip(in_order(pixel)) {
            to.put_symbol(code, value.into());
        }
        if run > 0 {
            let (prefix, extra, bits) = prefix(run);
            to.put_symbol(&codes[0], 256 + prefix);
            to.put(extra, bits);
        }
    }
    to.finish()
}

/// Channels in the order of the format: green, red, blue, alpha.
fn in_order([r, g, b, a]: [u8; 4]) -> [u8; 4] {
    [g, r, b, a]
}

/// Pixels less their left neighbours; the first of a row less the one above, the very first less black.
fn less_left(pixels: &[[u8; 4]], width: usize) -> Vec<[u8; 4]> {
    let difference = |i: usize| {
        let before = match i {
            0 => [0, 0, 0, 255],
            _ if i.is_multiple_of(width) => pixels[i - width],
            _ => pixels[i - 1],
        };
        std::array::from_fn(|k| pixels[i][k].wrapping_sub(before[k]))
    };
    (0..pixels.len()).map(difference).collect()
}

/// Pixels, each with how often it is repeated.
fn tokens(pixels: &[[u8; 4]]) -> Vec<([u8; 4], usize)> {
    let mut tokens: Vec<([u8; 4], usize)> = Vec::new();
    for &pixel in pixels {
        match tokens.last_mut() {
            Some((last, run)) if *last == pixel && *run < MOST => *run += 1,
            _ => tokens.push((pixel, 0)),
        }
    }
    tokens
}

/// Prefix, extra bits and their number of a length, which is 1 or more.
fn prefix(length: usize) -> (usize, u64, u32) {
    let value = length - 1;
    if value < 4 {
        return (value, 0, 0);
    }
    let high = value.ilog2();
    let extra = high - 1;
    let second = value >> extra & 1;
    (2 * high as usize + second, (value & ((1 << extra) - 1)) as u64, extra)
}

/// Of each symbol its code, with the first bit lowest, and the number of its bits.
type Code = Vec<(u64, u32)>;

#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    pending: u64,
    count: u32,
}

impl Bits {
    /// Appends at most 32 bits.
    fn put(&mut self, bits: u64, count: u32) {
        self.pending |= bits << self.count;
        self.count += count;
        while self.count >= 8 {
            self.bytes.push(self.pending as u8);
            self.pending >>= 8;
            self.count -= 8;
        }
    }

    fn finish(mut self) -> Vec<u8> {
        self.put(0, 7);
        self.bytes
    }

    fn put_symbol(&mut self, code: &Code, symbol: usize) {
        let (bits, count) = code[symbol];
        self.put(bits, count);
    }

    /// The code of a single symbol, which takes no bits.
    fn put_single(&mut self, symbol: u8) {
        // A simple code, of one symbol, of 8 bits.
        self.put(0b101, 3);
        self.put(symbol.into(), 8);
    }

    /// The code of symbols that occur so often, the first of which is below 256 if only one does.
    fn put_code(&mut self, counts: &[u64]) -> Code {
        let used: Vec<usize> = (0..counts.len()).filter(|&symbol| counts[symbol] > 0).collect();
        if let &[] | &[_] = &used[..] {
            self.put_single(used.first().map_or(0, |&symbol| symbol as u8));
            return vec![(0, 0); counts.len()];
        }
        let lengths = lengths(counts, LONGEST);
        let mut of_lengths = [0; 19];
        lengths.iter().for_each(|&length| of_lengths[usize::from(length)] += 1);
        let single = of_lengths.iter().filter(|&&count| count > 0).count() == 1;
        let own = match single {
            // A code of one length takes no bits.
            true => of_lengths.iter().map(|&count| u8::from(count > 0)).collect(),
            false => self::lengths(&of_lengths, LONGEST_OF_LENGTHS),
        };
        self.put(0, 1);
        self.put(19 - 4, 4);
        ORDER.iter().for_each(|&length| self.put(own[length].into(), 3));
        // The lengths of all symbols follow.
        self.put(0, 1);
        if !single {
            let code = code(&own);
            lengths.iter().for_each(|&length| self.put_symbol(&code, length.into()));
        }
        code(&lengths)
    }
}

/// The canonical code of these lengths.
fn code(lengths: &[u8]) -> Code {
    let mut code = vec![(0, 0); lengths.len()];
    let mut next = 0u32;
    for length in 1..=u32::from(LONGEST) {
        for (symbol, _) in lengths.iter().enumerate().filter(|(_, own)| u32::from(**own) == length) {
            code[symbol] = (u64::from(next.reverse_bits() >> (32 - length)), length);
            next += 1;
        }
        next <<= 1;
    }
    code
}

/// Lengths of a Huffman code for two symbols or more that occur. Counts are flattened until none is above `longest`.
fn lengths(counts: &[u64], longest: u8) -> Vec<u8> {
    let mut counts = counts.to_vec();
    loop {
        let lengths = huffman(&counts);
        if lengths.iter().all(|&length| length <= longest) {
            return lengths;
        }
        let occurring = counts.iter_mut().filter(|count| **count > 0);
        occurring.for_each(|count| *count = *count / 2 + 1);
    }
}

fn huffman(counts: &[u64]) -> Vec<u8> {
    let leaves = (0..counts.len()).filter(|&symbol| counts[symbol] > 0);
    let mut heap: BinaryHeap<_> = leaves.map(|symbol| Reverse((counts[symbol], symbol))).collect();
    let mut pairs = Vec::new();
    while let (Some(Reverse((a, first))), Some(Reverse((b, second)))) = (heap.pop(), heap.pop()) {
        heap.push(Reverse((a + b, counts.len() + pairs.len())));
        pairs.push([first, second]);
        if heap.len() == 1 {
            break;
        }
    }
    let mut depths = vec![0; counts.len() + pairs.len()];
    for (i, pair) in pairs.iter().enumerate().rev() {
        pair.iter()
            .for_each(|&child| depths[child] = depths[counts.len() + i] + 1);
    }
    depths.truncate(counts.len());
    depths
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use image_webp::WebPDecoder;

    use super::*;

    fn decoded(bytes: &[u8]) -> Vec<[u8; 4]> {
        let mut decoder = WebPDecoder::new(Cursor::new(bytes)).unwrap();
        let mut raw = vec![0; decoder.output_buffer_size().unwrap()];
        decoder.read_image(&mut raw).unwrap();
        raw.as_chunks().0.to_vec()
    }

    fn noise(i: u32) -> u32 {
        (i.wrapping_mul(0x9e37_79b9) ^ i >> 7).wrapping_mul(0x85eb_ca6b) >> 8
    }

    #[test]
    fn pictures_of_any_kind_come_back() {
        type Pixel = fn(u32) -> [u8; 4];
        let kinds: [Pixel; 6] = [
            |_| [7, 8, 9, 255],
            |i| noise(i).to_le_bytes(),
            |i| [i as u8, (i / 3) as u8, 0, 255],
            |i| [0, noise(i / 9000) as u8, 0, 255],
            |i| [(noise(i) as u8).leading_zeros() as u8; 4],
            |i| [noise(i).trailing_zeros() as u8, (i % 2) as u8, 200, 252],
        ];
        for pixel in kinds {
            for (width, height) in [(1, 1), (1, 5), (5, 1), (4, 4), (700, 4), (64, 1030)] {
                let pixels: Vec<_> = (0..width * height).map(pixel).collect();
                let bytes = encode(&pixels, width, height);
                assert_eq!(decoded(&bytes), pixels, "{width}×{height}");
            }
        }
    }

    #[test]
    fn codes_have_lengths_that_the_format_can_hold() {
        let fibonacci = (0..40).scan((1u64, 1u64), |pair, _| {
            *pair = (pair.1, pair.0 + pair.1);
            Some(pair.0)
        });
        let counts: Vec<u64> = fibonacci.collect();
        for longest in [7, 15] {
            let lengths = lengths(&counts, longest);
            let whole: f64 = lengths.iter().map(|&length| 0.5f64.powi(length.into())).sum();
            assert!(lengths.iter().all(|&length| length <= longest) && whole == 1.0);
        }
    }

    #[test]
    fn channels_without_relation_take_their_own_entropy_alone() {
        let pixels: Vec<[u8; 4]> = (0..1 << 16)
            .map(|i| {
                [
                    (noise(i) & 15) as u8,
                    (noise(i) >> 4 & 15) as u8,
                    (noise(i) >> 8 & 15) as u8,
                    255,
                ]
            })
            .collect();
        let size = encode(&pixels, 256, 256).len();
        // 12 bits a pixel, and the codes.
        assert!(size < (12 << 13) + 600, "{size}");
    }
}
