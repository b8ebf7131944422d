use super::*;
use crate::geometry::{Voxels, morton};
use proptest::prelude::*;

/// The slices of every level from level 1 on.
fn encode(octree: &Octree, slice: usize) -> Vec<Vec<(u32, Vec<u8>)>> {
    let mut map = KernelMap::root();
    let mut levels = Vec::new();
    for level in 1..=octree.depth() {
        levels.push(encode_level(Isa::detect(), octree, &map, level, slice));
        map = octree.child_map(level - 1, &map);
    }
    levels
}

fn decode(levels: &[Vec<(u32, Vec<u8>)>], slice: usize) -> Result<Octree> {
    let mut octree = Octree::root();
    for encoded in levels {
        let map = octree.kernel_map(octree.depth());
        decode_level(
            Isa::detect(),
            &mut octree,
            &map,
            &borrowed(encoded),
            slice,
            &Cancel::default(),
        )?;
    }
    Ok(octree)
}

#[test]
fn a_thrown_switch_stops_before_the_first_slice_and_between_slices() {
    let octree = bowl(6);
    let levels = encode(&octree, 100);
    let encoded = &levels[5];
    assert!(encoded.len() > 2, "several slices");
    let map = octree.kernel_map(5);
    let cancel = Cancel::default();
    let decode = || decode_masks(Isa::detect(), 6, &map, &borrowed(encoded), 100, None, &cancel);
    assert_eq!(decode().unwrap(), octree.occupancy(5));
    cancel.cancel();
    assert!(matches!(decode(), Err(Error::Cancelled)));
}

/// A slice that starts at byte `offset` of a stream.
fn slice_at(offset: usize, voxels: u32, bytes: &[u8]) -> Slice<'_> {
    Slice { voxels, bytes, offset }
}

fn borrowed(encoded: &[(u32, Vec<u8>)]) -> Vec<Slice<'_>> {
    let mut slices = Vec::new();
    for (voxels, bytes) in encoded {
        slices.push(slice_at(0, *voxels, bytes));
    }
    slices
}

fn check(voxels: Voxels, slice: usize) {
    let octree = Octree::new(voxels).unwrap();
    assert_eq!(decode(&encode(&octree, slice), slice).unwrap(), octree);
}

/// A paraboloid of width 2^`depth`: a surface with all slopes.
fn bowl(depth: u8) -> Octree {
    let side = 1u32 << depth;
    let column = |i: u32| {
        let [x, y] = [i % side, i / side];
        morton::encode([x, y, (x * x + y * y) / (4 * side)])
    };
    Octree::new(Voxels::new(depth, (0..side * side).map(column).collect())).unwrap()
}

/// A paraboloid of depth 6, the kernel map of level 5, and all of level 6 in one slice.
fn level_of_a_bowl() -> (Octree, KernelMap, u32, Vec<u8>) {
    let octree = bowl(6);
    let map = octree.kernel_map(5);
    let (voxels, bytes) = encode_level(Isa::detect(), &octree, &map, 6, usize::MAX).remove(0);
    (octree, map, voxels, bytes)
}

proptest! {
    #[test]
    fn any_cloud_round_trips(
        depth in 1u8..=7, keys in prop::collection::vec(any::<u64>(), 1..500), slice in 1usize..100
    ) {
        let keys = keys.iter().map(|k| k & ((1 << (3 * depth)) - 1)).collect();
        check(Voxels::new(depth, keys), slice);
    }

    #[test]
    fn points_in_the_deepest_octree_round_trip(keys in prop::collection::vec(0u64..1 << 63, 1..20)) {
        check(Voxels::new(21, keys), 16);
    }

    #[test]
    fn any_bytes_decode_to_the_declared_count_or_an_error(
        bytes in prop::collection::vec(any::<u8>(), 0..200), voxels in 0u32..600
    ) {
        let octree = bowl(4).truncated(3);
        let map = octree.kernel_map(3);
        let mut grown = octree.clone();
        match decode_level(Isa::detect(), &mut grown, &map, &[slice_at(0, voxels, &bytes)], usize::MAX, &Cancel::default()) {
            Ok(()) => prop_assert_eq!(grown.level(4).len(), voxels as usize),
            Err(_) => prop_assert_eq!(grown, octree),
        }
    }
}

#[test]
fn one_point_round_trips_at_every_depth() {
    for depth in 1..=21 {
        check(Voxels::new(depth, vec![(1 << (3 * depth)) - 1]), 1);
        check(Voxels::new(depth, vec![0]), 16_384);
    }
}

#[test]
fn opposite_corners_round_trip() {
    check(Voxels::new(21, vec![0, (1 << 63) - 1]), 16_384);
}

#[test]
fn full_cubes_lines_and_checkerboards_round_trip() {
    check(Voxels::new(5, (0..1 << 15).collect()), 1000);
    let diagonal = (0..1 << 10).map(|i| morton::encode([i, i, 1023 - i]));
    check(Voxels::new(10, diagonal.collect()), 100);
    let board = (0..1u64 << 12).filter(|&k| morton::decode(k).iter().sum::<u32>() % 2 == 0);
    check(Voxels::new(4, board.collect()), 100);
}

#[test]
fn a_surface_needs_less_than_half_of_its_occupancy_bytes() {
    let octree = bowl(8);
    let (_, bytes) = encode_level(Isa::detect(), &octree, &octree.kernel_map(7), 8, usize::MAX).remove(0);
    let (bits, parents) = (8 * bytes.len(), octree.level(7).len());
    assert!(bits < 4 * parents, "{bits} bits for {parents} parents");
}

#[test]
fn a_full_cube_needs_few_bits() {
    let octree = Octree::new(Voxels::new(6, (0..1 << 18).collect())).unwrap();
    let (_, bytes) = encode_level(Isa::detect(), &octree, &octree.kernel_map(5), 6, usize::MAX).remove(0);
    assert!(8 * bytes.len() < octree.level(5).len() / 4, "{}", bytes.len());
}

#[test]
fn slices_decode_independently() {
    let octree = bowl(7);
    let map = octree.kernel_map(6);
    let slices = encode_level(Isa::detect(), &octree, &map, 7, 1000);
    assert!(slices.len() > 2);
    for (i, (voxels, bytes)) in slices.iter().enumerate().rev() {
        let parents = i * 1000..map.len().min((i + 1) * 1000);
        let masks = decode_slice(Isa::detect(), 7, &map, parents.clone(), &slice_at(0, *voxels, bytes)).unwrap();
        assert_eq!(masks, octree.occupancy(6)[parents]);
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let octree = bowl(7);
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| encode(&octree, 500))
    };
    assert_eq!(with_threads(1), with_threads(2));
}

#[test]
fn every_instruction_set_gives_the_same_bytes_and_voxels() {
    let (octree, map, voxels, bytes) = level_of_a_bowl();
    for isa in Isa::available() {
        let (found, own) = encode_level(isa, &octree, &map, 6, usize::MAX).remove(0);
        assert_eq!((found, &own), (voxels, &bytes), "{isa}");
        let masks = decode_slice(isa, 6, &map, 0..map.len(), &slice_at(0, voxels, &bytes));
        assert_eq!(masks.unwrap(), octree.occupancy(5), "{isa}");
    }
}

#[test]
fn every_truncation_is_detected() {
    let (_, map, voxels, bytes) = level_of_a_bowl();
    for end in 0..bytes.len() {
        let result = decode_slice(
            Isa::detect(),
            6,
            &map,
            0..map.len(),
            &slice_at(0, voxels, &bytes[..end]),
        );
        assert!(matches!(result, Err(Error::Truncated { .. })), "{end}");
    }
}

#[test]
fn surplus_bytes_are_refused() {
    let (_, map, voxels, mut bytes) = level_of_a_bowl();
    bytes.push(0);
    let result = decode_slice(Isa::detect(), 6, &map, 0..map.len(), &slice_at(0, voxels, &bytes));
    assert!(matches!(result, Err(Error::Malformed { .. })));
}

#[test]
fn a_wrong_count_is_refused() {
    let (_, map, voxels, bytes) = level_of_a_bowl();
    for wrong in [0, 1, voxels - 1, voxels + 1, u32::MAX] {
        let result = decode_slice(Isa::detect(), 6, &map, 0..map.len(), &slice_at(0, wrong, &bytes));
        assert!(matches!(result, Err(Error::Malformed { .. })), "{wrong}");
    }
}

#[test]
fn every_flipped_bit_is_detected() {
    let octree = bowl(5);
    let map = octree.kernel_map(4);
    let (voxels, bytes) = encode_level(Isa::detect(), &octree, &map, 5, usize::MAX).remove(0);
    for bit in 0..8 * bytes.len() {
        let mut bytes = bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let result = decode_slice(Isa::detect(), 5, &map, 0..map.len(), &slice_at(0, voxels, &bytes));
        assert!(result.is_err(), "bit {bit}");
    }
}

#[test]
fn a_missing_slice_is_refused() {
    let octree = bowl(5);
    let map = octree.kernel_map(4);
    let slices = encode_level(Isa::detect(), &octree, &map, 5, 50);
    let mut decoded = octree.truncated(4);
    let result = decode_level(
        Isa::detect(),
        &mut decoded,
        &map,
        &borrowed(&slices[1..]),
        50,
        &Cancel::default(),
    );
    assert!(matches!(result, Err(Error::Malformed { .. })));
}

#[test]
fn errors_state_the_byte_offset() {
    let (_, map, voxels, bytes) = level_of_a_bowl();
    let fault = |voxels: u32, bytes: &[u8]| {
        let slice = slice_at(1000, voxels, bytes);
        decode_slice(Isa::detect(), 6, &map, 0..map.len(), &slice).unwrap_err()
    };
    let cut = fault(voxels, &bytes[..bytes.len() - 1]);
    let end = 1000 + bytes.len() as u64;
    assert!(
        matches!(cut, Error::Truncated { offset, .. } if offset == end - 1),
        "{cut}"
    );
    let longer = fault(voxels, &[&bytes[..], &[0]].concat()).to_string();
    assert!(longer.contains(&format!("byte {end}:")), "{longer}");
    let last = bytes.len() - 1;
    let mut changed = bytes.clone();
    changed[last] ^= 1;
    let changed = fault(voxels, &changed).to_string();
    assert!(changed.contains(&format!("byte {}:", end - 4)), "{changed}");
    let fewer = fault(voxels - 1, &bytes).to_string();
    assert!(fewer.contains("byte 1000, level 6"), "{fewer}");
}
