//! Scenes of blocks: index, parts, damage, cutting, and what a camera sees.

mod common;

use std::borrow::Cow;
use std::sync::atomic::{AtomicU64, Ordering};

use b2p::cloud::ColouredVoxels;
use b2p::container::Header;
use b2p::container::scene::{BlockEntry, parse_index, write_index};
use b2p::geometry::morton;
use b2p::scene::ViewOptions;
use b2p::{
    Background, Camera, Decoder, Error, FileSource, Gaussians, Image, Limits, Renderer, SceneDecoder, SceneDecoding,
    SceneEncoder, SceneReader, SequenceReader, Source, Wanted,
};
use common::{Ball, cloud_of};
use rayon::prelude::*;

const MOST: usize = 1500;

fn encoder() -> SceneEncoder {
    SceneEncoder::new().with_levels(3..=5).with_block_voxels(MOST)
}

fn ball() -> ColouredVoxels {
    Ball::new(6, 24.0).cloud()
}

fn scene_bytes() -> Vec<u8> {
    encoder().encode(&ball()).expect("a ball can be coded")
}

fn reader(bytes: &[u8]) -> SceneReader<&[u8]> {
    SceneReader::new(bytes, &Limits::default()).expect("a scene")
}

type Points = (Vec<u64>, Vec<[u8; 3]>);

fn points(scene: &SceneReader<impl Source>, level: Option<u8>, wanted: &Wanted) -> Result<(Points, usize), Error> {
    let decoded = SceneDecoder::new(Decoder::new().with_level(level)).voxels(scene, wanted)?;
    let (voxels, colours) = decoded.content;
    Ok(((voxels.keys().to_vec(), colours), decoded.lost.len()))
}

/// A source that counts the bytes that are read.
struct Counted<'a>(&'a [u8], AtomicU64);

impl Source for &Counted<'_> {
    fn length(&self) -> u64 {
        self.0.length()
    }

    fn read(&self, offset: u64, count: usize) -> Result<Cow<'_, [u8]>, Error> {
        self.1.fetch_add(count as u64, Ordering::Relaxed);
        self.0.read(offset, count)
    }
}

#[test]
fn blocks_have_all_voxels_once_and_decode_as_streams_of_their_own() {
    let (bytes, cloud) = (scene_bytes(), ball());
    let scene = reader(&bytes);
    assert!(scene.blocks().len() >= 8);
    scene.check_end().expect("nothing follows");
    for level in 3..=5 {
        let ((keys, colours), lost) = points(&scene, Some(level), &Wanted::All).expect("a scene");
        let mut expected: Vec<u64> = cloud.voxels.keys().iter().map(|key| key >> (3 * (6 - level))).collect();
        expected.dedup();
        assert_eq!((keys, lost), (expected, 0));
        let mut alone = Vec::new();
        for (block, entry) in scene.blocks().iter().enumerate() {
            let stream = scene.block(block).expect("a block");
            let decoder = Decoder::new().with_level(level - entry.cube.level);
            let decoding = decoder.whole(&stream).expect("a stream");
            alone.extend_from_slice(decoding.points().expect("a level").colours);
        }
        assert_eq!(alone, colours);
    }
    assert!(scene.blocks().iter().all(|block| block.points as usize <= MOST));
}

#[test]
fn a_scene_does_not_depend_on_the_number_of_threads() {
    let bytes = scene_bytes();
    let whole = SceneDecoder::default().gaussians(&reader(&bytes), &Wanted::All);
    let whole = whole.expect("Gaussians").content;
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        pool.install(|| {
            assert!(scene_bytes() == bytes);
            let again = SceneDecoder::default().gaussians(&reader(&bytes), &Wanted::All);
            assert!(again.expect("Gaussians").content == whole);
        });
    }
}

#[test]
fn a_scene_that_arrives_in_pieces_has_all_levels_once_it_is_all_there() {
    let bytes = scene_bytes();
    let whole = SceneDecoder::default();
    for (piece, level) in [(1, Some(4)), (1000, None), (usize::MAX, None)] {
        let mut arriving = SceneDecoding::new(Decoder::new().with_level(level));
        let mut reached = Vec::new();
        for piece in bytes.chunks(piece.min(bytes.len())) {
            assert!(reached.is_empty() && !arriving.is_drawable());
            assert!(arriving.gaussians().is_err());
            arriving.push(piece).expect("the limits allow it");
            while let Some(level) = arriving.advance().expect("a scene") {
                let decoder = SceneDecoder::new(Decoder::new().with_level(level));
                let expected = decoder.gaussians(&reader(&bytes), &Wanted::All).expect("a scene");
                assert!(arriving.gaussians().expect("Gaussians") == expected.content);
                let expected = decoder.voxels(&reader(&bytes), &Wanted::All).expect("a scene");
                assert_eq!(arriving.voxels().expect("voxels"), expected.content);
                assert!(arriving.is_drawable());
                reached.push(level);
            }
        }
        assert_eq!(reached, (3..=level.unwrap_or(5)).collect::<Vec<_>>());
        assert!(arriving.is_complete());
        arriving.push(b"what follows is dropped").expect("no memory is needed");
        arriving.finish().expect("all is there");
    }
    assert_eq!(whole.levels(&reader(&bytes)).expect("levels"), [3, 4, 5]);
}

#[test]
fn a_scene_that_does_not_arrive_whole_is_an_error_and_so_is_one_above_the_limits() {
    let bytes = scene_bytes();
    for end in [0, 15, 100, bytes.len() - 1] {
        let mut arriving = SceneDecoding::new(Decoder::new());
        arriving.push(&bytes[..end]).expect("the limits allow it");
        assert_eq!(arriving.advance().expect("so far nothing is wrong"), None);
        assert!(matches!(arriving.finish(), Err(Error::Truncated { .. })), "{end} bytes");
        arriving.push(&bytes[end..]).expect("the limits allow it");
        assert_eq!(arriving.advance().expect("now it is whole"), Some(3));
    }
    let limits = Limits::default().with_max_bytes(bytes.len() as u64 - 1);
    let mut limited = SceneDecoding::new(Decoder::new().with_limits(limits));
    assert!(matches!(limited.push(&bytes), Err(Error::LimitExceeded { .. })));
    let mut none = SceneDecoding::new(Decoder::new().with_level(9));
    none.push(&bytes).expect("the limits allow it");
    assert!(matches!(none.advance(), Err(Error::Usage(_))), "there is no level 9");
}

#[test]
fn a_scene_takes_the_part_of_the_cube_that_its_voxels_take() {
    let bytes = scene_bytes();
    let extent = SceneDecoder::default().extent(&reader(&bytes)).expect("a scene");
    let [low, high] = extent.corners();
    // A ball of 24 voxels in a cube of 64, in voxels of level 3.
    assert!(low.iter().all(|x| (-1.0..=-0.75).contains(x)), "{low:?}");
    assert!(high.iter().all(|x| (0.75..=1.0).contains(x)), "{high:?}");
}

#[test]
fn a_file_that_becomes_shorter_after_its_index_was_read_loses_the_blocks_behind_its_end_alone() {
    let bytes = scene_bytes();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("scene.b2p");
    std::fs::write(&path, &bytes).expect("written");
    let source = FileSource::open(&path).expect("a file");
    let scene = SceneReader::new(source, &Limits::default()).expect("a scene");
    let kept = scene.blocks().len() / 2;
    let file = std::fs::File::options().write(true).open(&path).expect("a file");
    file.set_len(scene.blocks()[kept].offset + 1).expect("it is cut");
    let decoded = SceneDecoder::default().voxels(&scene, &Wanted::All).expect("a part");
    let whole = SceneDecoder::default().voxels(&reader(&bytes), &Wanted::Blocks((0..kept).collect()));
    assert_eq!(decoded.content, whole.expect("a part").content);
    assert_eq!(decoded.lost.len(), scene.blocks().len() - kept);
    for error in &decoded.lost {
        let Error::Block { block, source } = error else {
            panic!("{error}")
        };
        assert!(*block >= kept && matches!(**source, Error::Truncated { .. }), "{error}");
    }
}

#[test]
fn a_check_of_a_damaged_block_finds_the_chunk_and_counts_from_the_start_of_the_scene() {
    let bytes = scene_bytes();
    let scene = reader(&bytes);
    let (number, entry) = (1, &scene.blocks()[1]);
    let stream = &bytes[entry.offset as usize..][..entry.bytes as usize];
    let whole = Decoder::new().check(stream);
    assert!(whole.chunks.len() >= 4, "{whole:?}");
    for chunk in whole.chunks {
        let mut damaged = bytes.clone();
        damaged[entry.offset as usize + chunk.end - 1] ^= 1;
        let checks = reader(&damaged).check(&Decoder::new());
        for (block, found) in checks.blocks.iter().enumerate() {
            let found = found.as_ref().expect("it can be read");
            assert_eq!(found.is_valid(), block != number);
        }
        let found = checks.blocks[number].as_ref().expect("it can be read");
        let first: Vec<_> = found
            .faults
            .iter()
            .take(2)
            .map(|fault| (fault.error.clause(), fault.offset))
            .collect();
        let place = entry.offset + chunk.start as u64;
        assert_eq!(
            first,
            [(Some("18.2.4"), Some(entry.offset)), (Some("3.1.1"), Some(place))]
        );
        assert_eq!(found.faults[1].level, Some(chunk.section));
        assert_eq!(found.faults[1].error.offset(), Some(place));
        let start = found.chunks.first().map(|chunk| chunk.start as u64);
        assert!(start >= Some(entry.offset), "{found:?}");
    }
}

#[test]
fn a_box_has_the_voxels_whose_centres_lie_in_it_and_their_gaussians() {
    let bytes = scene_bytes();
    let scene = reader(&bytes);
    let (low, high) = ([8.2, 12.0, 30.0], [30.0, 40.6, 61.0]);
    let wanted = Wanted::Box(low, high);
    let ((keys, _), _) = points(&scene, Some(5), &wanted).expect("a part");
    let ((all, _), _) = points(&scene, Some(5), &Wanted::All).expect("a scene");
    // Voxels of level 5 are two wide, and the grid starts at −½.
    let is_in = |key: &u64| {
        let centre = morton::decode(*key).map(|x| f64::from(2 * x + 1) - 0.5);
        (0..3).all(|axis| (low[axis]..=high[axis]).contains(&centre[axis]))
    };
    let expected: Vec<u64> = all.iter().copied().filter(is_in).collect();
    assert_eq!(keys, expected);
    assert!(!keys.is_empty() && keys.len() < all.len());
    let decoder = SceneDecoder::default();
    let part = decoder.gaussians(&scene, &wanted).expect("a part").content;
    let whole = decoder.gaussians(&scene, &Wanted::All).expect("a scene").content;
    let rows = |gaussians: &Gaussians| -> Vec<_> {
        (0..gaussians.len())
            .map(|i| {
                let numbers = [gaussians.position[i], gaussians.scale[i], gaussians.colour[i]];
                (
                    numbers.map(|row| row.map(f32::to_bits)),
                    gaussians.rotation[i].map(f32::to_bits),
                )
            })
            .collect()
    };
    // One surfel of each voxel of the last level but one.
    let chosen = all
        .iter()
        .zip(rows(&whole))
        .filter(|(key, _)| is_in(key))
        .map(|(_, row)| row);
    assert!(rows(&part) == chosen.collect::<Vec<_>>());
}

#[test]
fn a_part_is_decoded_from_the_bytes_of_its_blocks_alone() {
    let bytes = scene_bytes();
    let source = Counted(&bytes, AtomicU64::new(0));
    let scene = SceneReader::new(&source, &Limits::default()).expect("a scene");
    let low_corner = Wanted::Box([0.0; 3], [20.0, 20.0, 31.0]);
    let blocks = SceneDecoder::default().blocks(&scene, &low_corner).expect("blocks");
    assert!(blocks.len() < scene.blocks().len() / 2);
    let own: u64 = blocks.iter().map(|block| u64::from(scene.blocks()[*block].bytes)).sum();
    source.1.store(0, Ordering::Relaxed);
    points(&scene, None, &low_corner).expect("a part");
    assert_eq!(source.1.load(Ordering::Relaxed), own);
}

#[test]
fn every_flipped_bit_is_noticed_and_leaves_the_other_blocks() {
    let small = SceneEncoder::new().with_levels(2..=3).with_block_voxels(150);
    let bytes = small.encode(&Ball::new(4, 6.0).cloud()).expect("a ball can be coded");
    let scene = reader(&bytes);
    let start = scene.blocks()[0].offset;
    let ((whole, colours), _) = points(&scene, None, &Wanted::All).expect("a scene");
    (0..8 * bytes.len()).into_par_iter().for_each(|bit| {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let Ok(found) = SceneReader::new(&damaged[..], &Limits::default()) else {
            return assert!((bit as u64) / 8 < start, "bit {bit}");
        };
        let ((keys, found_colours), lost) = points(&found, None, &Wanted::All).expect("other blocks");
        assert_eq!(lost, 1, "bit {bit}");
        let of = |key: &u64| whole.iter().position(|k| k == key);
        for (key, colour) in keys.iter().zip(found_colours) {
            assert_eq!(of(key).map(|i| colours[i]), Some(colour), "bit {bit}");
        }
        let hurt = found.blocks().iter().find(|block| {
            let end = block.offset + u64::from(block.bytes);
            (block.offset..end).contains(&(bit as u64 / 8))
        });
        let hurt = hurt.expect("the bit lies in a block").voxels[1] as usize;
        assert_eq!(keys.len() + hurt, whole.len(), "bit {bit}");
    });
}

#[test]
fn every_cut_gives_whole_blocks_and_typed_errors() {
    let small = SceneEncoder::new().with_levels(2..=3).with_block_voxels(150);
    let bytes = small.encode(&Ball::new(4, 6.0).cloud()).expect("a ball can be coded");
    (0..bytes.len()).into_par_iter().for_each(|length| {
        let Ok(scene) = SceneReader::new(&bytes[..length], &Limits::default()) else {
            return;
        };
        assert!(scene.check_end().is_err());
        let missing = scene
            .blocks()
            .iter()
            .filter(|block| block.offset + u64::from(block.bytes) > length as u64);
        let missing = missing.count();
        match points(&scene, None, &Wanted::All) {
            Ok((_, lost)) => assert_eq!(lost, missing, "{length} bytes"),
            Err(Error::Block { .. }) => assert_eq!(missing, scene.blocks().len(), "{length} bytes"),
            Err(error) => panic!("{length} bytes: {error}"),
        }
    });
}

#[test]
fn a_scene_that_is_cut_after_a_level_decodes_to_that_level() {
    let bytes = scene_bytes();
    let scene = reader(&bytes);
    for level in 3..=5 {
        let cut = scene.cut(level).expect("a level");
        let cut = reader(&cut);
        cut.check_end().expect("nothing follows");
        assert_eq!(cut.header().top, level);
        let expected = points(&scene, Some(level), &Wanted::All).expect("a scene").0;
        assert!(points(&cut, None, &Wanted::All).expect("a scene").0 == expected);
        let checks = cut.check(&Decoder::new());
        assert!(
            checks.end.is_none()
                && checks
                    .blocks
                    .iter()
                    .all(|block| block.as_ref().is_ok_and(|b| b.is_valid()))
        );
    }
    assert!(matches!(scene.cut(6), Err(Error::Usage(_))));
}

#[test]
fn decoders_of_frames_and_sequences_refuse_a_scene_by_name() {
    let bytes = scene_bytes();
    let refused = [
        Decoder::new().decode(&bytes).map(drop),
        SequenceReader::new(&bytes[..], &Limits::default()).map(drop),
    ];
    for refused in refused {
        let error = refused.expect_err("a scene is no stream");
        assert_eq!(error.clause(), Some("2.2.1"));
        assert!(error.to_string().contains("scene of blocks"), "{error}");
    }
    let stream = reader(&bytes).block(0).expect("a block").into_owned();
    let error = SceneReader::new(&stream[..], &Limits::default()).expect_err("a block is no scene");
    assert!(error.to_string().contains("a single frame"), "{error}");
}

#[test]
fn lies_of_the_index_are_refused() {
    let bytes = scene_bytes();
    let header = Header::parse_scene(&bytes, &Limits::default()).expect("a header");
    let blocks = parse_index(&bytes, &header, &Limits::default()).expect("an index");
    let start = blocks[0].offset as usize;
    let clause = |change: &dyn Fn(&mut Vec<BlockEntry>)| {
        let mut blocks = blocks.clone();
        change(&mut blocks);
        let mut changed = match write_index(&header, &blocks) {
            Ok(index) => index,
            Err(error) => return error.clause(),
        };
        changed.extend(&bytes[start..]);
        let scene = SceneReader::new(&changed[..], &Limits::default()).expect("an index");
        scene.block(0).err().and_then(|error| error.clause())
    };
    assert_eq!(clause(&|_| {}), None);
    assert_eq!(clause(&|blocks| blocks[0].hash ^= 1), Some("18.2.4"));
    assert_eq!(clause(&|blocks| blocks[0].bytes -= 1), Some("18.2.4"));
    assert_eq!(clause(&|blocks| blocks[0].points += 1), Some("18.3.1"));
    assert_eq!(clause(&|blocks| blocks[0].voxels[1] += 1), Some("18.3.1"));
    assert_eq!(clause(&|blocks| blocks[0].points = 1), Some("18.2.3"));
    assert_eq!(clause(&|blocks| blocks[0].cube.level = 4), Some("18.2.2"));
    // The header states the sums.
    let mut other = header.clone();
    other.points += 1;
    let mut changed = other.write_scene();
    changed.extend(&bytes[header.bytes()..]);
    let error = SceneReader::new(&changed[..], &Limits::default()).expect_err("another sum");
    assert_eq!(error.clause(), Some("18.1.2"));
    let longer = [&bytes[..], &[0]].concat();
    assert_eq!(
        reader(&longer).check_end().err().and_then(|e| e.clause()),
        Some("18.1.1")
    );
}

#[test]
fn limits_on_points_hold_for_blocks_and_limits_on_memory_for_what_is_decoded() {
    let bytes = scene_bytes();
    let limits = Limits::default().with_max_points(MOST as u64);
    let scene = SceneReader::new(&bytes[..], &limits).expect("no block is larger");
    assert!(scene.header().points > limits.max_points);
    let limits = Limits::default().with_max_points(100);
    let refused = SceneReader::new(&bytes[..], &limits);
    assert!(matches!(
        refused,
        Err(Error::LimitExceeded {
            option: "max_points",
            ..
        })
    ));
    let decoder = |bytes| SceneDecoder::new(Decoder::new().with_limits(Limits::default().with_max_bytes(bytes)));
    let least = (0..40).find(|i| decoder(1 << i).gaussians(&scene, &Wanted::Blocks(vec![0])).is_ok());
    let bound = 1 << least.expect("some memory is enough");
    let refused = decoder(bound).gaussians(&scene, &Wanted::All);
    let refused = refused.map(drop).err().map(|e| e.to_string()).unwrap_or_default();
    assert!(bound > 1 << 18 || refused.contains("memory"), "{refused}");
}

#[test]
fn a_scene_keeps_to_the_bits_asked_for() {
    let cloud = ball();
    for most in [2.0, 6.0] {
        let encoder = SceneEncoder::new().with_block_voxels(MOST);
        let (bytes, _, level) = encoder.encode_to_rate(&cloud, most).expect("a scene");
        assert!(bytes.len() as f64 * 8.0 <= most * cloud.voxels.len() as f64);
        assert_eq!(reader(&bytes).header().top, level);
    }
    let refused = encoder().encode_to_rate(&cloud, 0.01);
    assert!(matches!(refused, Err(Error::TooFewBits { .. })));
}

#[test]
fn voxels_that_are_not_in_order_are_refused() {
    let cloud = cloud_of(4, (0..500).collect());
    let voxels = cloud.voxels.keys().iter().rev().map(|key| Ok((*key, [0; 3])));
    let grid = b2p::scene::Grid::of(&cloud);
    let refused = encoder()
        .with_levels(2..=3)
        .encode_voxels(grid, voxels, &mut |_, _| Ok(()));
    assert!(matches!(refused, Err(Error::Usage(_))));
}

fn picture(gaussians: &Gaussians, camera: &Camera) -> Image {
    let mut renderer = Renderer::new().with_background(Background::WHITE);
    renderer.render(gaussians, camera).expect("a picture")
}

fn difference(a: &Image, b: &Image) -> f32 {
    let pixels = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    pixels.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn what_a_camera_sees_makes_the_picture_of_the_whole_scene() {
    // Two walls, one behind the other, and floors, on a grid of 8 bits.
    let wall = |x: u32| (0..200 * 200u32).map(move |i| [x, 20 + i % 200, 20 + i / 200]);
    let floor = (0..120 * 200u32).map(|i| [90 + i % 120, 15, 20 + i / 120]);
    let keys = wall(220)
        .chain(wall(60))
        .chain(wall(30))
        .chain(floor)
        .map(morton::encode);
    let cloud = cloud_of(8, keys.collect());
    let bytes = SceneEncoder::new()
        .with_levels(4..=7)
        .with_block_voxels(3000)
        .encode(&cloud);
    let bytes = bytes.expect("walls can be coded");
    let scene = reader(&bytes);
    let decoder = SceneDecoder::default();
    let whole = decoder.gaussians(&scene, &Wanted::All).expect("Gaussians").content;
    let mut fewest = usize::MAX;
    for (azimuth, elevation, distance) in [(90.0, 0.0, 3.0), (80.0, 20.0, 2.6), (0.0, 10.0, 2.0), (85.0, 0.0, 0.7)] {
        let camera = Camera::orbit(azimuth, elevation, distance, 40.0, 160, 120).expect("a camera");
        let all = picture(&whole, &camera);
        let seen = decoder
            .visible(&scene, &camera, ViewOptions::default())
            .expect("Gaussians");
        let off = difference(&picture(&seen.content, &camera), &all);
        assert!(off <= 1.0 / 255.0, "azimuth {azimuth}: {} of 255", off * 255.0);
        let open = decoder
            .visible(&scene, &camera, ViewOptions::default().with_occlusion_culling(false))
            .expect("Gaussians");
        assert!(seen.blocks <= open.blocks);
        assert!(difference(&picture(&open.content, &camera), &all) <= 1.0 / 255.0);
        fewest = fewest.min(seen.blocks * 100 / scene.blocks().len());
    }
    assert!(fewest < 60, "walls hide walls: {fewest} % of the blocks were decoded");
}

#[test]
fn what_is_far_away_is_drawn_from_coarser_levels() {
    let cloud = ball();
    let bytes = SceneEncoder::new()
        .with_levels(2..=6)
        .with_block_voxels(800)
        .encode(&cloud);
    let bytes = bytes.expect("a ball can be coded");
    let (scene, decoder) = (reader(&bytes), SceneDecoder::default());
    let camera = Camera::orbit(20.0, 10.0, 20.0, 40.0, 96, 96).expect("a camera");
    let full = decoder
        .visible(&scene, &camera, ViewOptions::default())
        .expect("Gaussians")
        .content;
    let options = ViewOptions::default().with_voxel_pixels(0.5);
    let coarse = decoder.visible(&scene, &camera, options).expect("Gaussians").content;
    assert!(coarse.len() * 3 < full.len(), "{} of {}", coarse.len(), full.len());
    // What they take is known before anything is decoded.
    let memory = |options| decoder.visible_memory(&scene, &camera, options).expect("a camera");
    let (all, some) = (memory(ViewOptions::default()), memory(options));
    let bytes = |gaussians: &Gaussians| (gaussians.len() * size_of::<[f32; 14]>()) as u64;
    assert!(
        all >= bytes(&full) && all <= 3 * bytes(&full),
        "{all} of {}",
        bytes(&full)
    );
    assert!(some >= bytes(&coarse) && some * 2 < all, "{some} of {all}");
    let (a, b) = (picture(&full, &camera), picture(&coarse, &camera));
    let squares = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    let mean = squares.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / (4 * a.pixels.len()) as f64;
    assert!(-10.0 * mean.log10() > 35.0, "{} dB", -10.0 * mean.log10());
}
