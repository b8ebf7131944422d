//! The two entropy-coded formats inside a stream.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use b2p::Cancel;
use b2p::bitstream::Slice;
use b2p::entropy::{Condition, RawRows, Tables, decode_slice, encode_slice, quantise};
use b2p::geometry::{KernelMap, Octree, Voxels, codec};

use crate::Source;

/// Any bytes as voxels: encode → decode is equal. Any bytes as the code of the next level: an error, or occupancies that have the
/// very same code.
pub fn octree(bytes: &[u8]) {
    let mut source = Source(bytes);
    let depth = 1 + source.byte() % 5;
    let slice = 1 + usize::from(source.byte()) % 40;
    let count = usize::from(source.byte()) % 64 + 1;
    let keys = (0..count).map(|_| u64::from(source.u16()) % (1 << (3 * depth)));
    let voxels = Voxels::new(depth, keys.collect());
    let octree = Octree::new(voxels).expect("at least one voxel");
    let mut decoded = Octree::root();
    let mut map = KernelMap::root();
    for level in 1..=depth {
        let encoded = codec::encode_level(&octree, &map, level, slice);
        let slices: Vec<_> = encoded.iter().map(|(n, code)| whole(*n, code)).collect();
        codec::decode_level(&mut decoded, &map, &slices, slice, &Cancel::default())
            .expect("what was encoded decodes");
        map = octree.child_map(level - 1, &map);
    }
    assert_eq!(decoded, octree);

    let parents = octree.level(depth).len();
    let voxels = parents + usize::from(source.byte()) % (7 * parents + 1);
    let code = source.rest();
    let slice = whole(voxels as u32, code);
    let Ok(masks) = codec::decode_slice(depth + 1, &map, 0..parents, &slice) else {
        return;
    };
    assert_eq!(
        masks.iter().map(|m| m.count_ones() as usize).sum::<usize>(),
        voxels
    );
    let mut grown = octree.clone();
    grown
        .grow(masks)
        .expect("one occupancy for every parent, none empty");
    let again = codec::encode_level(&grown, &map, depth + 1, usize::MAX);
    assert_eq!(again[0].1, code, "another code for the same octree");
}

/// A slice that is all there is of its stream.
fn whole(voxels: u32, bytes: &[u8]) -> Slice<'_> {
    Slice {
        voxels,
        bytes,
        offset: 0,
    }
}

/// Tables made of the seed: steep and flat rows, short and long, from anywhere.
fn tables(seed: u8) -> Rc<Tables> {
    thread_local! {
        static MADE: RefCell<BTreeMap<u8, Rc<Tables>>> = const { RefCell::new(BTreeMap::new()) };
    }
    MADE.with_borrow_mut(|made| {
        made.entry(seed)
            .or_insert_with(|| Rc::new(make(seed)))
            .clone()
    })
}

fn make(seed: u8) -> Tables {
    let mut state = u64::from(seed) + 1;
    let mut random = move |n: u64| {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        (state >> 33) % n
    };
    let mut rows = |count: usize| {
        let (mut entries, mut offsets, mut low) = (Vec::new(), vec![0u32], Vec::new());
        for _ in 0..count {
            let length = 2 + random(if seed.is_multiple_of(2) { 6 } else { 60 }) as usize;
            let mut left = 65_536 - length as u64;
            for _ in 1..length {
                let some = random(left + 1) >> random(8);
                entries.push(some as u16);
                left -= some;
            }
            entries.push(left as u16);
            offsets.push(entries.len() as u32);
            let from = [0, -(length as i64) / 2, -32_768, 32_767 - length as i64 + 2];
            low.push(from[random(4) as usize] as i16);
        }
        (entries, offsets, low)
    };
    let (gauss, prior) = (rows(1024), rows(1 + usize::from(seed) % 5));
    Tables::new(raw("gauss", &gauss), raw("prior", &prior)).expect("tables made to be sound")
}

fn raw<'a>(name: &'a str, rows: &'a (Vec<u16>, Vec<u32>, Vec<i16>)) -> RawRows<'a> {
    RawRows {
        name,
        entries: &rows.0,
        offsets: &rows.1,
        low: &rows.2,
    }
}

/// Any table and symbols: encode → decode is equal. Any bytes as code: an error, or symbols that have the very same code. Any real
/// latents: rounded down or up, whatever a bit costs.
pub fn entropy(bytes: &[u8]) {
    let mut source = Source(bytes);
    let tables = tables(source.byte());
    let voxels = usize::from(source.byte()) % 16;
    let prior = source.byte().is_multiple_of(2);
    let count = voxels * tables.channels();
    let (mut mu, mut sigma, mut latents) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..count {
        latents.push(source.u16() as i16);
        if !prior {
            mu.push(source.u16() as i16);
            sigma.push(source.byte() % 64);
        }
    }
    let condition = match prior {
        true => Condition::Prior,
        false => Condition::Gauss {
            mu: &mu,
            sigma: &sigma,
        },
    };
    let at = "here";
    let code = encode_slice(&tables, condition, &latents);
    let decoded = decode_slice(&tables, condition, &code, voxels, &at);
    assert_eq!(decoded.expect("what was encoded decodes"), latents);
    let code = source.rest();
    if let Ok(latents) = decode_slice(&tables, condition, code, voxels, &at) {
        let again = encode_slice(&tables, condition, &latents);
        assert_eq!(again, code, "another code for the same latents");
    }

    const LIMIT: i16 = 500;
    let price = f32::from(code.first().copied().unwrap_or(0)) / 64.0;
    let real: Vec<f32> = latents.iter().map(|&y| f32::from(y) / 7.0).collect();
    let rounded = quantise(&tables, condition, &real, LIMIT, price);
    for (q, y) in rounded.iter().zip(real) {
        let bound = f32::from(LIMIT);
        let away = (f32::from(*q) - y.clamp(-bound, bound)).abs();
        assert!(q.abs() <= LIMIT && away <= 1.0, "{y} became {q}");
    }
}
