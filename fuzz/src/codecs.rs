//! The two entropy-coded formats inside a stream.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::ops::Range;
use std::rc::Rc;
use std::sync::LazyLock;

use b2p::container::Slice;
use b2p::geometry::{KernelMap, Octree, Voxels, codec, morton};
use b2p::latents::entropy::{
    Condition, RawRows, Rounding, SlicePart, Tables, UNPREDICTED, decode_coefficients, decode_level, decode_passes,
    decode_slice, encode_coefficients, encode_level, encode_passes, encode_slice, quantise, quantise_passes,
};
use b2p::{Cancel, Isa};

use crate::Source;

/// Any bytes as voxels: encode → decode is equal, and parents and neighbours are those that a search finds. Any bytes as occupancies:
/// an error, or the octree that its finest voxels have. Any bytes as the code of the next level: an error, or occupancies that have
/// the very same code.
pub fn octree(bytes: &[u8]) {
    let mut source = Source(bytes);
    let depth = 1 + source.byte() % 5;
    let slice = 1 + usize::from(source.byte()) % 40;
    let count = source.count(8, 64);
    let keys = (0..count).map(|_| u64::from(source.u16()) % (1 << (3 * depth)));
    let voxels = Voxels::new(depth, keys.collect());
    let octree = match Octree::new(voxels) {
        Ok(octree) => octree,
        Err(error) => {
            assert!(count == 0, "{error}");
            return;
        }
    };
    let mut decoded = Octree::root();
    let mut map = KernelMap::root();
    for level in 1..=depth {
        let encoded = codec::encode_level(Isa::detect(), &octree, &map, level, slice);
        let slices: Vec<_> = encoded.iter().map(|(n, code)| whole(*n, code)).collect();
        codec::decode_level(Isa::detect(), &mut decoded, &map, &slices, slice, &Cancel::default())
            .expect("what was encoded decodes");
        assert_eq!(decoded, octree.truncated(level));
        let fewer = &slices[1..];
        let refused = codec::decode_level(Isa::detect(), &mut decoded, &map, fewer, slice, &Cancel::default());
        assert!(refused.is_err(), "a slice is missing");
        assert_eq!(decoded, octree.truncated(level));
        map = octree.child_map(level - 1, &map);
        check_family(octree.level(level - 1), octree.level(level));
        assert_eq!(map, searched(octree.level(level)));
    }
    assert_eq!(decoded, octree);
    occupancies(source.0);

    let parents = octree.level(depth).len();
    let voxels = parents + usize::from(source.byte()) % (7 * parents + 1);
    let code = source.rest();
    let slice = whole(voxels as u32, code);
    let Ok(masks) = codec::decode_slice(Isa::detect(), depth + 1, &map, 0..parents, &slice) else {
        return;
    };
    assert_eq!(masks.iter().map(|m| m.count_ones() as usize).sum::<usize>(), voxels);
    let mut grown = octree.clone();
    grown.grow(masks).expect("one occupancy for every parent, none empty");
    let again = codec::encode_level(Isa::detect(), &grown, &map, depth + 1, usize::MAX);
    assert_eq!(again[0].1, code, "another code for the same octree");
}

/// Every voxel is a child of its parent, and every parent has one.
fn check_family(parents: &Voxels, children: &Voxels) {
    assert_eq!(children.parents(), *parents);
    let indices = children.parent_indices();
    assert_eq!(indices.len(), children.len());
    for ((&parent, key), octant) in indices.iter().zip(children.keys()).zip(children.octants()) {
        let parent = parents.keys()[parent as usize];
        assert_eq!(*key, parent << 3 | u64::from(octant));
    }
}

/// The 3³ kernel map by looking every neighbour up.
fn searched(voxels: &Voxels) -> KernelMap {
    let size = 1i64 << voxels.depth();
    let mut rows = Vec::new();
    for i in 0..voxels.len() {
        let [x, y, z] = voxels.coordinate(i).map(i64::from);
        for k in 0..27 {
            let at = [x + k % 3 - 1, y + k / 3 % 3 - 1, z + k / 9 - 1];
            let inside = at.iter().all(|v| (0..size).contains(v));
            let key = || morton::encode(at.map(|v| v as u32));
            let found = inside.then(|| voxels.keys().binary_search(&key()).ok());
            rows.push(found.flatten().map_or(KernelMap::ABSENT, |i| i as u32));
        }
    }
    KernelMap::new(27, rows)
}

/// Bytes as the occupancies of one level after the other: refused if they are too few, one is zero, or there is no such level.
fn occupancies(mut bytes: &[u8]) {
    let mut octree = Octree::root();
    while !bytes.is_empty() {
        let parents = octree.level(octree.depth()).len();
        let (masks, rest) = bytes.split_at(parents.min(bytes.len()));
        let possible = masks.len() == parents && !masks.contains(&0) && octree.depth() < morton::MAX_DEPTH;
        let before = octree.clone();
        if octree.grow(masks.to_vec()).is_err() {
            assert!(!possible, "occupancies were refused");
            assert_eq!(octree, before);
            break;
        }
        assert!(possible, "no occupancies of a level");
        bytes = rest;
    }
    let again = Octree::new(octree.level(octree.depth()).clone());
    assert_eq!(again.expect("it has voxels"), octree);
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
    MADE.with_borrow_mut(|made| made.entry(seed).or_insert_with(|| Rc::new(make(seed))).clone())
}

fn make(seed: u8) -> Tables {
    let mut state = u64::from(seed) + 1;
    let mut random = move |n: u64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
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

/// Entries, offsets, low, as in [`RawRows`].
type RawTable = (Vec<u16>, Vec<u32>, Vec<i16>);

fn raw<'a>(name: &'a str, rows: &'a RawTable) -> RawRows<'a> {
    RawRows {
        name,
        entries: &rows.0,
        offsets: &rows.1,
        low: &rows.2,
    }
}

/// Any table and symbols: encode → decode is equal, in slices and in passes too. Any bytes as code: an error, or symbols that have the
/// very same code. Any real latents: rounded down or up, whatever a bit costs. Any numbers as a table: an error, or a sound one.
pub fn entropy(bytes: &[u8]) {
    let mut source = Source(bytes);
    let seed = source.byte();
    if seed >= 224 {
        return any_table(source, seed);
    }
    let tables = tables(seed);
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
        false => Condition::Gauss { mu: &mu, sigma: &sigma },
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
    as_coefficients(&latents, code);
    let slice = 1 + code.len() % 6;
    in_slices(&tables, condition, &latents, slice);
    // Far and near, of any octants.
    let mut key = 0;
    let keys: Vec<u64> = (0..voxels)
        .map(|v| {
            key += 1 + u64::from(code.get(v).copied().unwrap_or(0) % 16);
            key
        })
        .collect();
    in_passes(&tables, &keys, &latents, slice, code);
    let learning = Tables::clone(&tables).with_learning(true);
    in_passes(&learning, &keys, &latents, slice, code);

    const LIMIT: i16 = 500;
    let price = f32::from(code.first().copied().unwrap_or(0)) / 64.0;
    let real: Vec<f32> = latents.iter().map(|&y| f32::from(y) / 7.0).collect();
    let prices = vec![price; tables.channels()];
    let rounding = Rounding {
        limit: LIMIT,
        prices: &prices,
    };
    for q in quantise(&tables, condition, &real, rounding) {
        assert!(q.abs() <= LIMIT, "{q} is beyond the limit");
    }
}

/// Numbers as coefficients of colours, in two parts of any channels: encode → decode is equal, but for the one number that is brought within. Any bytes:
/// an error, or coefficients that have the very same code.
fn as_coefficients(values: &[i16], code: &[u8]) {
    let which = usize::from(code.first().copied().unwrap_or(0));
    let channels = [0..3, 0..1, 1..3, 0..0];
    let present = [&channels[which % 4], &channels[which / 4 % 4]];
    let parts = |triples: &[[i16; 3]]| encode_coefficients(&two(present, triples.split_at(triples.len() / 2)));
    let decode = |code: &[u8], count: usize| {
        let mut triples = vec![[0; 3]; count];
        let mut parts = two(present, triples.split_at_mut(count / 2));
        decode_coefficients(code, &mut parts, &"here").map(|()| triples)
    };
    let mut triples: Vec<[i16; 3]> = (values.chunks_exact(3))
        .map(|three| [0, 1, 2].map(|k| three[k].max(-i16::MAX)))
        .collect();
    let half = triples.len() / 2;
    for (i, triple) in triples.iter_mut().enumerate() {
        let present = present[usize::from(i >= half)];
        (0..3).filter(|k| !present.contains(k)).for_each(|k| triple[k] = 0);
    }
    let decoded = decode(&parts(&triples), triples.len());
    assert_eq!(decoded.expect("what was encoded decodes"), triples);
    for count in [0, 1, 40, code.len()] {
        if let Ok(triples) = decode(code, count) {
            assert_eq!(parts(&triples), code, "another code for the same coefficients");
        }
    }
}

/// Two parts of triples, of which these channels are present.
fn two<T>(present: [&Range<usize>; 2], (first, second): (T, T)) -> [SlicePart<T>; 2] {
    let part = |present: &Range<usize>, triples| SlicePart {
        present: present.clone(),
        triples,
    };
    [part(present[0], first), part(present[1], second)]
}

fn slices(codes: &[Vec<u8>]) -> Vec<Slice<'_>> {
    codes.iter().map(|code| whole(0, code)).collect()
}

/// A level in slices: each has the code that it has alone, and together they decode; one less does not.
fn in_slices(tables: &Tables, condition: Condition, latents: &[i16], slice: usize) {
    let voxels = latents.len() / tables.channels();
    let codes = encode_level(tables, condition, latents, slice);
    if voxels <= slice && voxels > 0 {
        assert_eq!(codes, [encode_slice(tables, condition, latents)]);
    }
    let decode = |slices: &[Slice]| {
        let cancel = Cancel::default();
        decode_level(tables, condition, slices, voxels, slice, 1, &cancel)
    };
    let slices = slices(&codes);
    assert_eq!(decode(&slices).expect("what was encoded decodes"), latents);
    if let [_, fewer @ ..] = &slices[..] {
        assert!(decode(fewer).is_err(), "a slice is missing");
    }
}

/// A level in passes, each voxel predicted from the one before it if that is of a lower octant: encode → decode is equal, and what
/// any bytes decode to has the very same code.
fn in_passes(tables: &Tables, keys: &[u64], latents: &[i16], slice: usize, code: &[u8]) {
    let k = tables.channels();
    let predict = |slice: Range<usize>, voxels: &[u32], known: &[i16]| {
        let (mut mu, mut sigma) = (Vec::new(), Vec::new());
        for v in voxels.iter().map(|&v| v as usize) {
            let lower = v > slice.start && keys[v - 1] & 7 < keys[v] & 7;
            for channel in 0..k {
                let before = || known[(v - 1 - slice.start) * k + channel];
                mu.push(if lower { before().wrapping_mul(7) } else { 0 });
                sigma.push(if lower { (keys[v] & 7) as u8 * 8 } else { UNPREDICTED });
            }
        }
        (mu, sigma)
    };
    let decode = |slices: &[Slice], slice: usize| {
        let cancel = Cancel::default();
        decode_passes(tables, keys, &predict, slices, slice, 1, &cancel)
    };
    let codes = encode_passes(tables, keys, &predict, latents, slice);
    let decoded = decode(&slices(&codes), slice);
    assert_eq!(decoded.expect("what was encoded decodes"), latents);
    // Whole already: at no price they stay; at one they may not, and have a code all the same.
    let real: Vec<f32> = latents.iter().map(|&y| f32::from(y)).collect();
    for price in [0.0, 0.3] {
        let prices = vec![price; k];
        let rounding = Rounding {
            limit: i16::MAX,
            prices: &prices,
        };
        let rounded = quantise_passes(tables, keys, &predict, &real, rounding, slice);
        let within = |y: &i16| (*y).max(-i16::MAX);
        assert!(price > 0.0 || rounded.iter().copied().eq(latents.iter().map(within)));
        let codes = encode_passes(tables, keys, &predict, &rounded, slice);
        let decoded = decode(&slices(&codes), slice);
        assert_eq!(decoded.expect("what was rounded decodes"), rounded);
    }
    if let Ok(latents) = decode(&[whole(0, code)], keys.len().max(1)) {
        let again = encode_passes(tables, keys, &predict, &latents, keys.len());
        assert_eq!(again, [code], "another code for the same latents");
    }
}

/// Numbers as a table, some of them put right: an error, or a table under which symbols of each of its rows come back.
fn any_table(mut source: Source, how: u8) {
    let rows = usize::from(source.byte() % 4);
    let (mut entries, mut offsets, mut low) = (Vec::new(), vec![0u32], Vec::new());
    for _ in 0..rows {
        let length = usize::from(source.byte() % 8);
        let mut row: Vec<u16> = (0..length).map(|_| source.u16()).collect();
        // One in four is left as it comes, as the last entry of the others makes up for what the sum lacks.
        if !how.is_multiple_of(4)
            && let Some((last, others)) = row.split_last_mut()
        {
            others.iter_mut().for_each(|entry| *entry >>= 3);
            let sum: u32 = others.iter().map(|&entry| u32::from(entry) + 1).sum();
            *last = (65_535 - sum) as u16;
        }
        entries.extend(row);
        offsets.push(entries.len() as u32);
        low.push(source.u16() as i16);
    }
    match how / 4 % 8 {
        0 => offsets[rows / 2] = source.u16().into(),
        1 => _ = low.pop(),
        2 => _ = offsets.pop(),
        _ => (),
    }
    let sound = is_sound(&entries, &offsets, &low);
    let table = (entries, offsets, low);
    let refused = Tables::new(raw("gauss", &table), raw("prior", &FLAT));
    assert!(refused.is_err(), "1024 rows are needed");
    let tables = match Tables::new(raw("gauss", &FLAT), raw("prior", &table)) {
        Ok(tables) => tables,
        Err(error) => return assert!(!sound, "{error}"),
    };
    assert!(sound, "a table that is none");
    let voxels = source.0.len() / (2 * rows);
    let latents: Vec<i16> = (0..voxels * rows).map(|_| source.u16() as i16).collect();
    let code = encode_slice(&tables, Condition::Prior, &latents);
    let decoded = decode_slice(&tables, Condition::Prior, &code, voxels, &"here");
    assert_eq!(decoded.expect("what was encoded decodes"), latents);
}

/// Whether these are rows end to end, each of probabilities for values of 16 bits and an escape.
fn is_sound(entries: &[u16], offsets: &[u32], low: &[i16]) -> bool {
    let mut end = 0;
    let mut rows = 0;
    for (ends, &low) in offsets.windows(2).zip(low) {
        let Some(row) = entries.get(end..ends[1] as usize) else {
            return false;
        };
        let sum: u64 = row.iter().map(|&entry| u64::from(entry) + 1).sum();
        let last = i64::from(low) + row.len() as i64 - 2;
        if ends[0] as usize != end || row.len() < 2 || sum != 65_536 || last > 32_767 {
            return false;
        }
        (end, rows) = (ends[1] as usize, rows + 1);
    }
    rows > 0 && rows == low.len() && rows + 1 == offsets.len() && end == entries.len()
}

/// The least table that conditions with means and scales can have: two entries a row.
static FLAT: LazyLock<RawTable> = LazyLock::new(|| {
    let rows = 1024;
    let offsets = (0..=rows).map(|row| 2 * row).collect();
    (vec![32_767; 2 * rows as usize], offsets, vec![0; rows as usize])
});
