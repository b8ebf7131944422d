//! What decoding and drawing reserve at most, counted by the allocator: no stream can make it more.

mod common;

use std::path::Path;
use std::sync::Mutex;

use b2p::Decoder;
use b2p::cloud::ColouredVoxels;
use b2p::container::{Format, Header};
use b2p::encoder::transform::{self, GeometryTarget, Outline, QualityTarget};
use b2p::encoder::{Options, Residual, encode};
use b2p::gaussians::Heads;
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Gaussians, Harmonics};
use b2p::geometry::morton;
use b2p::latents::LatentDecoder;
use b2p::latents::network::{Model, Shape, untrained};
use b2p::layers::Precision;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Channel, Effect, EffectMode, Effects, Ids, Image, Renderer, render};
use b2p::{Error, Limits};
use common::{Ball, cloud_of, steps};
use peak_alloc::PeakAlloc;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// One measurement at a time.
static QUIET: Mutex<()> = Mutex::new(());

/// What `run` gives, and how many bytes more than before it held at its peak.
fn peak<T>(run: impl FnOnce() -> T) -> (T, u64) {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let value = run();
    (value, (MEMORY.peak_usage().saturating_sub(before)) as u64)
}

fn models() -> Vec<(&'static str, Model)> {
    let wide = Shape {
        channels: 32,
        latents: 8,
        learning: true,
        ..Shape::tiny()
    };
    let load = |bytes: &[u8]| Model::from_bytes(bytes).expect("a model loads");
    vec![
        ("tiny", load(&untrained(&Shape::tiny().with_quick_heads(), 0))),
        ("wide", load(&untrained(&wide, 0))),
        #[cfg(feature = "embedded-learned")]
        ("lite", load(b2p::embedded::model())),
    ]
}

/// Clouds of every kind: surfaces, solids, and the deepest chains of lone voxels.
fn clouds() -> Vec<(&'static str, ColouredVoxels)> {
    let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
    vec![
        ("surface", Ball::new(7, 50.0).cloud()),
        ("solid", cloud_of(5, (0..1 << 15).collect())),
        ("lone voxels", cloud_of(21, (0..2000).map(far).collect())),
        ("one voxel", cloud_of(10, vec![12345])),
    ]
}

#[test]
fn decoding_holds_no_more_than_the_bound_that_its_header_gives() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    for (name, model) in models() {
        let decoder = LatentDecoder::new(&model).with_limits(Limits::unlimited());
        let with = |heads: &Heads| decoder.clone().with_heads(*heads).unwrap();
        let decoders: Vec<_> = model.shape().heads().iter().map(with).collect();
        for (kind, cloud) in clouds() {
            let options = Options {
                residual: Residual::Fine(steps(4)),
                ..Options::default()
            };
            let bytes = encode(&cloud, &model, &options, &Log::default()).unwrap().bytes;
            let header = Header::parse(&bytes, &Limits::unlimited()).unwrap();
            let levels = decoder.levels(&bytes).unwrap();
            for (decoder, level) in decoders.iter().flat_map(|d| levels.iter().map(move |l| (d, *l))) {
                let most = decoder.memory(&header, level).unwrap();
                let decode = || decoder.decode(&bytes, Some(level), &Log::default());
                // Threads start, and weights are put in order, the first time.
                decode().unwrap();
                let (gaussians, held) = peak(decode);
                let count = gaussians.unwrap().len();
                println!("{name}, {kind}, level {level}, {count} Gaussians: {held} of {most} bytes");
                assert!(held <= most + Limits::OVERHEAD, "{name}, {kind}, level {level}: {held}");
            }
        }
    }
}

/// Streams of version 3 of one cloud: lossy and lossless, of few slices and of many. Each is encoded when it is taken.
fn transformed(cloud: &ColouredVoxels) -> impl Iterator<Item = Vec<u8>> {
    let top = cloud.voxels.depth();
    [
        (top.saturating_sub(3)..=top, 30_000, QualityTarget::Step(4.0)),
        (top.saturating_sub(1)..=top, 500, QualityTarget::Lossless),
        (1..=top - 1, 16_384, QualityTarget::Step(20.0)),
    ]
    .into_iter()
    .map(move |(levels, slice, fineness)| {
        let options = transform::Options {
            levels: Some(levels),
            fineness,
            colour_slice: slice,
            ..transform::Options::default()
        };
        let encoded = transform::encode(cloud, &options, &Log::default());
        encoded.unwrap().bytes
    })
}

/// Decodes a level all at once and in parts, and holds what each takes to its bound, which may be so many `tenths` of
/// that at most, but for what small streams need anyway.
fn check_level(of: &str, decoder: &Decoder, header: &Header, level: u8, bytes: &[u8], tenths: u64) {
    let whole = decoder.clone().with_level(level);
    let in_parts = whole.clone().with_gaussians_in_parts();
    let bounds = [&whole, &in_parts].map(|decoder| decoder.memory(header, level).unwrap());
    let (gaussians, held) = peak(|| whole.decode(bytes));
    let count = gaussians.unwrap().len();
    let (done, held_in_parts) = peak(|| whole.decode_in_parts(bytes, |_| Ok(())));
    done.unwrap();
    for (held, most) in [held, held_in_parts].into_iter().zip(bounds) {
        println!("{of}, level {level}, {count} Gaussians: {held} of {most} bytes");
        assert!(held <= most + Limits::OVERHEAD, "{of}, level {level}: {held} of {most}");
        assert!(
            10 * most <= tenths * held + 10 * Limits::OVERHEAD,
            "{of}, level {level}: {held} of {most}"
        );
    }
}

#[test]
fn decoding_version_3_holds_no_more_than_the_bound_that_its_header_gives() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let decoder = Decoder::new().with_limits(Limits::unlimited());
    let mut clouds = clouds();
    // Surfels fit windows to all of these.
    let lattice = (0..40 * 40 * 40).map(|i| [i % 40, i / 40 % 40, i / 1600].map(|v| 3 * v));
    clouds.push(("lattice", cloud_of(7, lattice.map(morton::encode).collect())));
    for (kind, cloud) in clouds {
        for bytes in transformed(&cloud) {
            let header = Header::parse(&bytes, &Limits::unlimited()).unwrap();
            // Threads start the first time.
            decoder.clone().with_level(header.base).decode(&bytes).unwrap();
            for level in header.base..=header.top {
                check_level(kind, &decoder, &header, level, &bytes, 20);
            }
            let limits = Limits::default().with_max_bytes(decoder.memory(&header, header.top).unwrap() - 1);
            let strict = Decoder::new().with_limits(limits);
            let (refused, held) = peak(|| strict.decode(&bytes));
            assert!(matches!(refused, Err(Error::LimitExceeded { .. })));
            assert!(held < 1 << 12, "{held} bytes to refuse");
        }
    }
}

/// With each network of the heads that ship, in each precision that every machine has.
#[test]
fn drawing_version_3_with_learned_heads_holds_no_more_than_the_bound_that_its_header_gives() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let heads = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/heads.safetensors");
    let heads = HeadsModel::open(&heads).expect("the heads that ship load");
    let sets: Vec<_> = heads.sets().collect();
    assert_eq!(sets.len(), 4, "{sets:?}");
    let mut clouds = clouds();
    // The network's output is computed in parts of 16,384 voxels: this cloud has several.
    clouds.push(("large surface", Ball::new(8, 60.0).cloud()));
    // The network is evaluated on spans of at most 98,304 rows with the lower limit, and all at once with the other.
    clouds.push(("several spans", Ball::new(8, 100.0).cloud()));
    clouds.push(("one span", Ball::new(8, 100.0).cloud()));
    for (kind, cloud) in clouds {
        let (max_bytes, finest_alone) = match kind {
            "one span" => (2 << 30, true),
            kind => (192 << 20, kind == "several spans"),
        };
        let bytes = transformed(&cloud).next().unwrap();
        let header = Header::parse(&bytes, &Limits::unlimited()).unwrap();
        for (set, gaussians) in sets.iter().copied() {
            for precision in [Precision::Int16, Precision::F16] {
                let decoder = Decoder::new().with_limits(Limits::default().with_max_bytes(max_bytes));
                let decoder = decoder.with_heads_model(heads.clone()).with_heads(set.into());
                let decoder = decoder.with_precision(precision).with_per_voxel(gaussians);
                let of = format!("{kind}, {set}.{gaussians} in {precision}");
                // Weights are put in order the first time.
                let coarsest = header.base.max(1);
                decoder.clone().with_level(coarsest).decode(&bytes).unwrap();
                let first = if finest_alone { header.top } else { coarsest };
                for level in first..=header.top {
                    check_level(&of, &decoder, &header, level, &bytes, 13);
                }
            }
        }
    }
}

/// With as many voxels as a person of 900,000 points has at the finest level but one.
#[test]
fn the_limits_of_boards_allow_a_person_with_any_heads() {
    let heads = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/heads.safetensors");
    let heads = HeadsModel::open(&heads).expect("the heads that ship load");
    let voxels = vec![14_362, 59_046, 236_729];
    let section = b2p::container::Section {
        geometry: 4000,
        colours: 4000,
    };
    let header = Header {
        optional_flags: 0,
        bits: 10,
        base: 7,
        top: 9,
        points: 914_831,
        placement: b2p::Placement::VOXEL_GRID,
        format: Format::Transform { colour_slice: 8192 },
        slice_voxels: 16_384,
        sections: vec![section; voxels.len()],
        voxels,
    };
    let decoder = Decoder::new().with_limits(Limits::embedded());
    let learned = decoder.clone().with_heads_model(heads);
    let [best, quick] = [Heads::Best, Heads::Quick].map(|heads| learned.clone().with_heads(heads.into()));
    for (name, decoder) in [("best", best), ("quick", quick), ("surfels", decoder)] {
        let most = decoder.memory(&header, 9).unwrap();
        println!("{name}: {most} bytes");
        let decoded = decoder.decode(&header.write());
        assert!(matches!(decoded, Err(Error::Truncated { .. })), "{name}: {decoded:?}");
    }
}

#[test]
fn encoding_holds_no_more_than_is_said_of_so_many_voxels() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let heads = HeadsModel::from_bytes(include_bytes!("../models/heads.safetensors")).unwrap();
    let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
    let lone = cloud_of(21, (0..10_000).map(far).collect());
    // With levels, and bits per point that they can be coded to.
    let clouds = [
        (Ball::new(7, 50.0).cloud(), None, Some(0.2)),
        (Ball::new(9, 90.0).cloud(), None, Some(0.2)),
        (Ball::new(8, 70.0).cloud(), Some(5..=8), Some(0.4)),
        (lone, None, None),
    ];
    for (cloud, levels, rate) in clouds {
        let voxels = cloud.voxels.len();
        for (with_heads, rounds, outline) in [
            (false, 0, Outline::Surface),
            (true, 0, Outline::Surface),
            (true, 1, Outline::Cloud),
        ] {
            let options = transform::Options {
                heads: with_heads.then(|| heads.clone()),
                rounds,
                outline,
                tries: 2,
                geometry: GeometryTarget::Visual,
                levels: levels.clone(),
                ..transform::Options::default()
            };
            let (encoded, most) = peak(|| transform::encode(&cloud, &options, &Log::default()));
            let bound = transform::encode_memory(&cloud.voxels, &options, false);
            println!("{voxels} voxels: {most} of {bound}");
            assert!(encoded.is_ok() && most <= bound, "{voxels} voxels: {most} of {bound}");
            // Nobody draws lone voxels with learned heads.
            let Some(rate) = rate else { break };
            // Each try holds the same again, and takes long.
            if rounds > 0 {
                continue;
            }
            let (encoded, most) = peak(|| transform::encode_to_rate(&cloud, &options, rate, &Log::default()));
            let bound = transform::encode_memory(&cloud.voxels, &options, true);
            println!("{voxels} voxels to a rate: {most} of {bound}");
            assert!(
                encoded.is_ok() && most <= bound,
                "{voxels} voxels to a rate: {most} of {bound}"
            );
        }
    }
}

#[test]
fn a_decode_gives_back_all_that_it_reserved_whether_it_succeeds_or_fails() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let (_, model) = models().remove(0);
    let options = Options::default();
    let bytes = encode(&Ball::new(7, 50.0).cloud(), &model, &options, &Log::default())
        .unwrap()
        .bytes;
    let (mut cut, mut damaged) = (bytes.clone(), bytes.clone());
    cut.truncate(bytes.len() * 9 / 10);
    damaged[bytes.len() * 9 / 10] ^= 1;
    for (kind, bytes, sound) in [("whole", bytes, true), ("cut", cut, false), ("damaged", damaged, false)] {
        let decode = || {
            let decoded = LatentDecoder::new(&model).decode(&bytes, None, &Log::default());
            assert_eq!(decoded.is_ok(), sound, "{kind}");
        };
        // What is prepared at the first use stays, and so does an odd block of the threads' queues.
        decode();
        let ((), most) = peak(decode);
        let kept = || {
            let before = MEMORY.current_usage();
            (0..20).for_each(|_| decode());
            MEMORY.current_usage().saturating_sub(before) as u64
        };
        // What is lost is lost each time.
        let kept = kept().min(kept());
        assert!(kept < most / 100, "{kind}: {kept} of {most} bytes are kept");
    }
}

#[test]
fn a_stream_over_the_memory_limit_is_refused_almost_for_nothing() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let (_, model) = models().remove(0);
    let cloud = Ball::new(7, 50.0).cloud();
    let options = Options::default();
    let bytes = encode(&cloud, &model, &options, &Log::default()).unwrap().bytes;
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    let needed = LatentDecoder::new(&model).memory(&header, 6).unwrap();
    let limits = |max_bytes| Limits::default().with_max_bytes(max_bytes);
    let decode = |max_bytes| {
        let decoder = LatentDecoder::new(&model).with_limits(limits(max_bytes));
        decoder.decode(&bytes, None, &Log::default())
    };
    assert!(decode(needed).is_ok());
    let (refused, held) = peak(|| decode(needed - 1));
    assert!(matches!(refused, Err(Error::LimitExceeded { needed: n, .. }) if n == needed));
    assert!(held < 1 << 12, "{held} bytes to refuse");
}

/// A header that promises the most that the limits allow, and nothing behind it.
#[test]
fn a_bomb_of_a_hundred_bytes_reserves_nothing() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let (_, model) = models().remove(0);
    let header = |format| Header {
        optional_flags: 0,
        bits: 21,
        base: 18,
        top: 20,
        points: 1 << 26,
        placement: b2p::Placement::VOXEL_GRID,
        format,
        slice_voxels: 1,
        voxels: vec![1 << 26; 3],
        sections: vec![
            b2p::container::Section {
                geometry: u32::MAX,
                colours: u32::MAX
            };
            3
        ],
    };
    // Threads start the first time.
    rayon::current_num_threads();
    let learned = Format::Learned { model: model.id() };
    let transform = Format::Transform { colour_slice: 1 };
    for format in [learned, transform] {
        let mut bytes = header(format).write();
        bytes.extend([0; 1000]);
        for limits in [Limits::default(), Limits::unlimited()] {
            let decode = || match format {
                Format::Learned { .. } => {
                    let decoder = LatentDecoder::new(&model).with_limits(limits.clone());
                    decoder.decode(&bytes, None, &Log::default())
                }
                Format::Transform { .. } => {
                    let decoder = Decoder::new().with_limits(limits.clone());
                    decoder.decode(&bytes)
                }
            };
            // The least of three: the harness may start another test's thread meanwhile, which counts too.
            let runs = [(); 3].map(|()| peak(decode));
            for (refused, _) in &runs {
                let expected = matches!(refused, Err(Error::LimitExceeded { .. } | Error::Truncated { .. }));
                assert!(expected, "{refused:?}");
            }
            let held = runs.iter().map(|(_, held)| *held).min().unwrap();
            assert!(held < 1 << 12, "{held} bytes");
        }
    }
}

fn splats(count: usize, scale: f32) -> Gaussians {
    let at = |i: usize| {
        let turn = i as f32 * 2.399;
        let height = (i as f32 + 0.5) / count as f32 * 2.0 - 1.0;
        [turn.cos() * 0.8, height * 0.8, turn.sin() * 0.8]
    };
    Gaussians {
        position: (0..count).map(at).collect(),
        scale: vec![[scale; 3]; count],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity: vec![0.9; count],
        colour: vec![[0.5; 3]; count],
        ..Gaussians::default()
    }
}

#[test]
fn drawing_stays_within_the_memory_limit() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let camera = Camera::orbit(10.0, 10.0, 3.0, 45.0, 640, 480).unwrap();
    for (count, scale) in [(1, 0.01), (20_000, 0.005), (20_000, 0.5)] {
        let gaussians = splats(count, scale);
        let draw = |max_bytes: u64| {
            let limits = Limits::default().with_max_bytes(max_bytes);
            render(&gaussians, &camera, Background::WHITE, &limits)
        };
        let Err(Error::LimitExceeded { needed, .. }) = draw(1 << 16) else {
            panic!("64 kB are too few for a picture of 5 MB");
        };
        for max_bytes in [needed, 2 * needed, 1 << 30] {
            let (picture, held) = peak(|| draw(max_bytes));
            match picture {
                Ok(_) => assert!(held <= max_bytes + Limits::OVERHEAD, "{held} of {max_bytes}"),
                // The fullest tile is known only when all Gaussians have been looked at.
                Err(Error::LimitExceeded { .. }) => assert!(held <= max_bytes + Limits::OVERHEAD),
                Err(error) => panic!("{error}"),
            }
            println!("{count} Gaussians of {scale}: {held} of {max_bytes} bytes");
        }
    }
}

#[test]
fn gaussians_over_the_near_plane_are_refused_before_their_memory_is_taken() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let gaussians = splats(100_000, 0.9);
    let camera = Camera::orbit(10.0, 10.0, 0.5, 45.0, 32, 32).unwrap();
    let draw = |max_bytes| {
        let limits = Limits::default().with_max_bytes(max_bytes);
        render(&gaussians, &camera, Background::WHITE, &limits)
    };
    let (_, stats) = draw(1 << 30).unwrap();
    assert!(stats.crossing > 90_000, "{}", stats.crossing);
    // As much as they take without what is kept for those that cross.
    let Err(Error::LimitExceeded { needed, .. }) = draw(1 << 20) else {
        panic!("1 MB is too little for 100,000 Gaussians");
    };
    let (refused, held) = peak(|| draw(needed));
    assert!(matches!(refused, Err(Error::LimitExceeded { .. })));
    assert!(held <= needed + Limits::OVERHEAD, "{held} of {needed}");
}

#[test]
fn from_the_third_picture_on_drawing_takes_no_memory() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let mut gaussians = splats(20_000, 0.02);
    gaussians.harmonics = Harmonics {
        count: 3,
        coefficients: vec![[0.01; 3]; 3 * gaussians.len()],
    };
    let plain = Effects::default();
    let on = EffectMode::On;
    let antialias = plain.with(Effect::Antialias, on);
    let order = plain.with(Effect::Order, on);
    // One thread: of several, each takes what it needs when the fullest tile first comes to it.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1);
    let pool = pool.build().unwrap();
    // From a distance, and from among them, where some reach over the near plane.
    for (distance, crossing) in [(3.0, false), (0.8, true)] {
        let camera = Camera::orbit(10.0, 10.0, distance, 45.0, 200, 150).unwrap();
        for effects in [plain, antialias, order] {
            let mut renderer = Renderer::default();
            renderer.set_effects(effects);
            let (mut image, mut ids) = (Image::default(), Ids::default());
            let mut mixed = Vec::new();
            let mut draw = || {
                let limits = Limits::default();
                for channel in [Channel::Colour, Channel::Depth] {
                    let over = Background::WHITE;
                    let image = &mut image;
                    let stats = renderer.draw_into(&gaussians, &camera, channel, over, &limits, image);
                    assert_eq!(stats.unwrap().crossing > 0, crossing);
                }
                let stats = renderer.ids_into(&gaussians, &camera, &limits, &mut ids);
                assert!(stats.unwrap().touched > 0);
                let one = |_| [1.0];
                let mix = renderer.mix_into(&gaussians, &camera, one, &limits, &mut mixed);
                mix.unwrap();
            };
            pool.install(|| {
                draw();
                draw();
                let ((), held) = peak(&mut draw);
                assert_eq!(held, 0, "{effects:?} at {distance}");
            });
        }
    }
}

#[test]
fn a_picture_becomes_a_file_row_by_row() {
    let _quiet = QUIET.lock().unwrap_or_else(|e| e.into_inner());
    let (width, height) = (1500, 1500);
    let pixels = (0..width * height).map(|i: u32| [(i % 251) as f32 / 251.0, (i % 83) as f32 / 83.0, 0.5, 1.0]);
    let image = Image {
        width,
        height,
        pixels: pixels.collect(),
    };
    let distances = vec![1.0; image.pixels.len()];
    let path = Path::new("x");
    type Write<'a> = Box<dyn Fn(&mut dyn std::io::Write) -> b2p::Result<()> + 'a>;
    let formats: [(&str, Write); 5] = [
        ("png", Box::new(|to| image.write_png(to, path))),
        ("png16", Box::new(|to| image.write_png16(to, path))),
        ("ppm", Box::new(|to| image.write_ppm(to, path))),
        ("y4m", Box::new(|to| image.write_y4m_frame(to, path))),
        ("exr", Box::new(|to| image.write_exr(to, path, Some(&distances)))),
    ];
    for (name, write) in formats {
        let (written, bytes) = peak(|| write(&mut std::io::sink()));
        written.unwrap();
        assert!(
            bytes < 2 << 20,
            "{name}: {bytes} bytes for a picture of {}",
            16 * image.pixels.len()
        );
    }
}
