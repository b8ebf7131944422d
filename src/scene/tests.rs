use std::path::Path;

use proptest::prelude::*;

use super::decoder::{Blocks, Decoded};
use super::*;
use crate::cloud::ColouredVoxels;
use crate::decoder::{Decoder, Part};
use crate::gaussians::learned::HeadsModel;
use crate::gaussians::{Gaussians, HeadSet};
use crate::geometry::{Octree, Voxels, morton};
use crate::limits::Limits;
use crate::placement::Placement;

/// A wavy sheet, thick in places, with colours that vary along it.
fn sheet(bits: u8, waves: [u32; 2], thick: u32) -> ColouredVoxels {
    let side = 1u32 << bits;
    let height = |x: u32, y: u32| (x * waves[0] % (2 * side)).abs_diff(side) / 4 + (y * waves[1] % side) * y / side / 4;
    let columns = (0..side * side).map(|i| [i % side, i / side]);
    let voxel = |x: u32, y: u32, z: u32| {
        let colour = [x * 5 % 256, (y * 3 + z) % 256, (x ^ y) % 200].map(|c| c as u8);
        (morton::encode([x, y, z.min(side - 1)]), colour)
    };
    let mut voxels: Vec<_> = columns
        .flat_map(|[x, y]| {
            let z = height(x, y);
            (z..=z + 1 + u32::from(x % 37 < thick)).map(move |z| voxel(x, y, z))
        })
        .collect();
    voxels.sort_unstable_by_key(|voxel| voxel.0);
    voxels.dedup_by_key(|voxel| voxel.0);
    ColouredVoxels {
        voxels: Voxels::from_sorted(bits, voxels.iter().map(|voxel| voxel.0).collect()),
        colours: voxels.iter().map(|voxel| voxel.1).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

fn heads() -> HeadsModel {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/heads.safetensors");
    HeadsModel::open(&path).expect("the heads are there")
}

/// The Gaussians of all decoded blocks, drawn as one level without borders.
fn in_one_piece(decoder: &Decoder, scene: &SceneReader<&[u8]>, decoded: &Blocks, level: u8) -> Gaussians {
    let mut keys = Vec::new();
    let [mut colours, mut unfiltered] = [const { Vec::new() }; 2];
    for block in decoded.values().flatten() {
        keys.extend(&block.keys);
        colours.extend(&block.colours);
        unfiltered.extend(&block.unfiltered);
    }
    let octree = Octree::new(Voxels::from_sorted(level, keys)).expect("voxels");
    let (above, map) = octree.last_sibling_maps(level);
    let part = Part {
        octree: &octree,
        level,
        map: &map,
        above: above.as_ref(),
        colours: &colours,
        range: 0..map.len(),
        chosen: None,
        surfels: None,
        advice: decoded.values().flatten().next().expect("a block").advice,
    };
    let colours_above = || Decoder::colours_above(&octree, level, &unfiltered);
    decoder.draw(scene.header(), &part, colours_above).expect("Gaussians")
}

fn bits(gaussians: &Gaussians) -> Vec<u32> {
    let triples = gaussians
        .position
        .iter()
        .chain(&gaussians.scale)
        .chain(&gaussians.colour);
    let numbers = triples
        .flatten()
        .chain(gaussians.rotation.iter().flatten())
        .chain(&gaussians.opacity);
    numbers.map(|number| number.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]

    #[test]
    fn a_scene_is_drawn_block_by_block_as_it_is_in_one_piece(
        waves in prop::array::uniform2(1u32..5),
        thick in 0u32..20,
        most in 300usize..6000,
        set in prop::sample::select(vec![HeadSet::Surfels, HeadSet::Quick, HeadSet::Best]),
        level in 4u8..=6,
    ) {
        let encoder = SceneEncoder::new().with_levels(4..=6).with_block_voxels(most);
        let bytes = encoder.encode(&sheet(7, waves, thick)).expect("a scene");
        let scene = SceneReader::new(&bytes[..], &Limits::default()).expect("a scene");
        let decoder = Decoder::new().with_heads_model(heads()).with_heads(set).with_level(level);
        let scenes = SceneDecoder::new(decoder.clone());
        let found = scenes.gaussians(&scene, &Wanted::All).expect("Gaussians");
        prop_assert!(found.lost.is_empty());
        let blocks: Vec<usize> = (0..scene.blocks().len()).collect();
        prop_assert!(blocks.len() > 1);
        let mut decoded = Blocks::new();
        scenes.decode(&scene, &blocks, level, &mut decoded, &mut Vec::new()).expect("blocks");
        let expected = in_one_piece(&decoder, &scene, &decoded, level);
        prop_assert_eq!(found.content.blur, expected.blur);
        prop_assert!(bits(&found.content) == bits(&expected), "{} blocks, {set} heads", blocks.len());
        // And a part is that part, also of one block, for which others are decoded only where they are near.
        let part: Vec<usize> = blocks.iter().copied().filter(|block| block % 3 == 1).collect();
        let alone = scenes.gaussians(&scene, &Wanted::Blocks(part.clone())).expect("a part");
        let none = Gaussians { frame: alone.content.frame, blur: alone.content.blur, ..Gaussians::default() };
        let (mut of_whole, mut together) = (none.clone(), none);
        for block in blocks {
            let drawn = scenes.gaussians(&scene, &Wanted::Blocks(vec![block])).expect("a block").content;
            if part.contains(&block) {
                of_whole.append(drawn.clone());
            }
            together.append(drawn);
        }
        prop_assert!(bits(&together) == bits(&found.content));
        prop_assert!(bits(&alone.content) == bits(&of_whole));
    }
}

#[test]
fn of_the_blocks_around_one_only_those_with_voxels_near_its_border_are_decoded() {
    // Two cubes of 8 voxels in neighbouring octants, far from the border between them or on both sides of it.
    for (gap, expected) in [(0..8u32, vec![0]), (24..32, vec![0, 1])] {
        let corner = |octant: u32, at: u32| match octant {
            0 => at,
            _ => 63 - at,
        };
        let cells = (0..2).flat_map(|octant| {
            let gap = gap.clone();
            gap.flat_map(move |x| (0..64).map(move |i| [corner(octant, x), i % 8, i / 8]))
        });
        let voxels = Voxels::new(6, cells.map(morton::encode).collect());
        let cloud = ColouredVoxels {
            colours: vec![[9, 99, 200]; voxels.len()],
            voxels,
            placement: Placement::VOXEL_GRID,
        };
        let encoder = SceneEncoder::new().with_levels(3..=6).with_block_voxels(600);
        let bytes = encoder.encode(&cloud).expect("a cloud");
        let scene = SceneReader::new(&bytes[..], &Limits::default()).expect("a scene");
        assert_eq!(scene.blocks().len(), 2);
        let decoder = SceneDecoder::new(Decoder::new().with_heads(HeadSet::Surfels));
        let mut decoded = Decoded::default();
        for _ in 0..2 {
            let near = decoder.near(&scene, (6, &[0]), 0, &mut decoded).expect("a scene");
            assert_eq!(near, expected, "{gap:?}");
        }
        let whole = decoder.gaussians(&scene, &Wanted::All).expect("a scene").content;
        let one = decoder
            .gaussians(&scene, &Wanted::Blocks(vec![0]))
            .expect("a block")
            .content;
        assert_eq!(one.position, whole.position[..one.len()]);
        assert_eq!(one.scale, whole.scale[..one.len()]);
    }
}
