use std::collections::BTreeMap;

use b2p_kernels::f16;
use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::error::Error;
use crate::geometry::{Voxels, morton};
use crate::layers::{Dtype, File};

mod files;
mod reference;

/// Uniform numbers in −1..1.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// Extents and weights of one network.
#[derive(Clone)]
struct Made {
    set: Set,
    channels: usize,
    blocks: [usize; 2],
    tensors: BTreeMap<String, (Vec<usize>, Vec<f16>)>,
}

impl Made {
    fn new(set: Set, channels: usize, blocks: [usize; 2], seed: u64) -> Made {
        let mut made = Made {
            set,
            channels,
            blocks,
            tensors: BTreeMap::new(),
        };
        let mut random = Random(seed);
        let mut layer = |name: String, volume: usize, cin: usize, cout: usize| {
            // Activations stay about as large as they are, on surfaces.
            let gain = match name.as_str() {
                "up" => 2.0,
                "out" => 0.3,
                _ => 0.7,
            };
            let size = gain * (6.0 / (9 * cin) as f32).sqrt();
            let mut numbers = |count: usize, size: f32| {
                let number = || f16::from_f32(size * random.next());
                std::iter::repeat_with(number).take(count).collect::<Vec<_>>()
            };
            let weights = numbers(volume * cin * cout, size);
            let bias = numbers(cout, 0.2);
            let tensors = &mut made.tensors;
            tensors.insert(format!("{name}.weight"), (vec![volume, cin, cout], weights));
            if volume == 27 {
                tensors.insert(format!("{name}.bias"), (vec![cout], bias));
            }
        };
        for (side, cin, blocks) in [("parent", 12, blocks[0]), ("child", 7, blocks[1])] {
            layer(format!("{side}.in"), 27, cin, channels);
            for (i, part) in (0..blocks).flat_map(|i| [(i, "a"), (i, "b")]) {
                layer(format!("{side}.{i}.{part}"), 27, channels, channels);
            }
        }
        layer("up".into(), 8, channels, channels);
        layer("out".into(), 27, channels, RAW * set.1);
        made
    }

    fn json(&self) -> serde_json::Value {
        let [parent_blocks, child_blocks] = self.blocks;
        let layers = self.tensors.keys().filter_map(|name| name.strip_suffix(".bias"));
        let ranges: BTreeMap<_, _> = layers.map(|layer| (layer, 20.0)).collect();
        json!({
            "channels": self.channels, "gaussians": self.set.1, "ranges": ranges,
            "parent_blocks": parent_blocks, "child_blocks": child_blocks,
        })
    }
}

fn description(networks: &[Made]) -> serde_json::Value {
    let name = |made: &Made| format!("{}.{}", made.set.0, made.set.1);
    let sets: BTreeMap<_, _> = networks.iter().map(|n| (name(n), n.json())).collect();
    json!({"version": 1, "blur": 0.15, "sets": sets})
}

fn file(networks: &[Made], description: &serde_json::Value) -> Vec<u8> {
    let metadata = [("b2p-heads".to_owned(), description.to_string())];
    let mut file = File::new(metadata.into());
    for made in networks {
        for (name, (shape, values)) in &made.tensors {
            let name = format!("{}.{}.{name}", made.set.0, made.set.1);
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            file.add(&name, Dtype::F16, shape, &bytes);
        }
    }
    file.write()
}

fn model(networks: &[Made]) -> HeadsModel {
    HeadsModel::from_bytes(&file(networks, &description(networks))).unwrap()
}

/// A cloud with colours at a level and the one above it.
struct Cloud {
    octree: Octree,
    maps: [SiblingMap; 2],
    colours: [Vec<[u8; 3]>; 2],
    step: f32,
}

impl Cloud {
    fn new(keys: Vec<u64>, depth: u8, seed: u64) -> Cloud {
        let octree = Octree::new(Voxels::new(depth, keys)).unwrap();
        let mut random = Random(seed);
        let colours = [depth, depth - 1].map(|level| {
            let mut channel = |_| (128.0 + 60.0 * random.next()) as u8;
            let count = octree.level(level).len();
            (0..count).map(|_| [0; 3].map(&mut channel)).collect()
        });
        Cloud {
            maps: [octree.sibling_map(depth), octree.sibling_map(depth - 1)],
            octree,
            colours,
            step: 1.0 + 20.0 * random.next().abs(),
        }
    }

    /// A bowl.
    fn surface(depth: u8) -> Cloud {
        let side = 1u32 << depth;
        let key = |i: u32| {
            let [x, y] = [i % side, i / side];
            morton::encode([x, y, (x * x + y * y) / (2 * side)])
        };
        Cloud::new((0..side * side).map(key).collect(), depth, 5)
    }

    fn input(&self) -> LevelInput<'_> {
        LevelInput {
            octree: &self.octree,
            level: self.octree.depth(),
            map: &self.maps[0],
            above: &self.maps[1],
            colours: &self.colours[0],
            colours_above: &self.colours[1],
            luma_step: self.step,
            without: None,
            range: None,
        }
    }

    fn draw(&self, model: &HeadsModel, isa: Isa, precision: Precision, set: Set) -> Gaussians {
        let frame = Frame::default();
        model.generate(isa, precision, set, self.input(), frame).unwrap()
    }
}

/// The largest differences of position and scale in voxels, rotation, opacity and colour.
fn differences(a: &Gaussians, b: &Gaussians, level: u8) -> [f32; 4] {
    assert_eq!(a.len(), b.len());
    let worst = |a: &[f32], b: &[f32]| {
        let pairs = a.iter().zip(b);
        pairs.fold(0.0f32, |worst, (a, b)| worst.max((a - b).abs()))
    };
    let voxel = 2.0 / (1u32 << level) as f32;
    let length = |of: fn(&Gaussians) -> &[[f32; 3]]| worst(of(a).as_flattened(), of(b).as_flattened()) / voxel;
    [
        length(|g| &g.position).max(length(|g| &g.scale)),
        worst(a.rotation.as_flattened(), b.rotation.as_flattened()),
        worst(&a.opacity, &b.opacity),
        worst(a.colour.as_flattened(), b.colour.as_flattened()),
    ]
}

fn all_sets() -> [Made; 4] {
    [
        Made::new((Heads::Best, 1), 32, [2, 2], 1),
        Made::new((Heads::Best, 8), 32, [1, 1], 2),
        Made::new((Heads::Quick, 1), 16, [1, 1], 3),
        // Neither whole panels of channels nor blocks on one side.
        Made::new((Heads::Quick, 8), 10, [0, 2], 4),
    ]
}

#[test]
fn every_precision_matches_the_definition_on_every_instruction_set() {
    let cloud = Cloud::surface(5);
    let networks = all_sets();
    let mut description = description(&networks);
    let expected = networks.each_ref().map(|made| {
        let (expected, ranges) = reference::gaussians(made, &cloud.input());
        let name = format!("{}.{}", made.set.0, made.set.1);
        description["sets"][name]["ranges"] = json!(ranges);
        expected
    });
    let model = HeadsModel::from_bytes(&file(&networks, &description)).unwrap();
    for (made, expected) in networks.iter().zip(&expected) {
        for isa in Isa::available() {
            for precision in [Precision::Int16, Precision::F16] {
                let drawn = cloud.draw(&model, isa, precision, made.set);
                let off = differences(&drawn, expected, 5);
                let limits = match precision {
                    Precision::Int16 => [0.1, 0.25, 0.05, 0.1],
                    _ => [0.02, 0.05, 0.01, 0.02],
                };
                let fine = off.iter().zip(limits).all(|(off, limit)| *off < limit);
                assert!(fine, "{:?} in {precision} with {isa}: {off:?}", made.set);
            }
        }
    }
}

#[test]
fn voxels_to_leave_out_get_no_gaussians_and_the_others_do_not_change() {
    let cloud = Cloud::surface(6);
    let model = model(&all_sets());
    let voxels = cloud.octree.level(6);
    let without: Vec<bool> = (0..voxels.len()).map(|i| i % 3 == 0 || i / 200 % 2 == 0).collect();
    for set in [(Heads::Best, 1), (Heads::Best, 8)] {
        let draw = |without| {
            let input = LevelInput {
                without,
                ..cloud.input()
            };
            let precision = Precision::Int16;
            model
                .generate(Isa::detect(), precision, set, input, Frame::default())
                .unwrap()
        };
        let kept: Vec<bool> = without.iter().map(|&out| !out).collect();
        let all = draw(None);
        let [with, rest] = [&kept, &without].map(|out| draw(Some(out)));
        assert_eq!(with.len() + rest.len(), all.len());
        let mut parts = [with.position.iter().peekable(), rest.position.iter().peekable()];
        for position in &all.position {
            let found = parts.iter_mut().any(|part| part.next_if_eq(&position).is_some());
            assert!(found);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn integers_are_bit_exact_on_every_instruction_set_and_number_of_threads(
        keys in prop::collection::vec(0u64..1 << 12, 1..400), seed in any::<u64>()
    ) {
        let cloud = Cloud::new(keys, 4, seed);
        let networks = [
            Made::new((Heads::Best, 8), 16, [1, 1], seed),
            Made::new((Heads::Quick, 1), 6, [1, 0], seed ^ 1),
        ];
        let model = model(&networks);
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        for made in &networks {
            let draw = |isa| cloud.draw(&model, isa, Precision::Int16, made.set);
            let expected = alone.install(|| draw(Isa::available()[0]));
            prop_assert!(expected.check_lengths().is_ok());
            for isa in Isa::available() {
                prop_assert!(draw(isa) == expected, "{:?} with {}", made.set, isa);
            }
        }
    }
}

#[test]
fn a_network_of_zeros_gives_spheres_of_the_decoded_colours_at_the_anchors() {
    let cloud = Cloud::surface(3);
    for k in [1, 8] {
        let mut made = Made::new((Heads::Best, k), 16, [1, 1], 9);
        for (_, values) in made.tensors.values_mut() {
            values.fill(f16::ZERO);
        }
        let drawn = cloud.draw(&model(&[made]), Isa::detect(), Precision::Int16, (Heads::Best, k));
        assert_eq!(drawn.len(), k * cloud.maps[0].len());
        let unit = 0.25 / if k == 8 { 2.0 } else { 1.0 };
        for i in 0..drawn.len() {
            let voxel = cloud.octree.level(3).coordinate(i / k);
            for (axis, &corner) in voxel.iter().enumerate() {
                let octant = if k == 8 {
                    (i >> axis & 1) as f32 * 0.5 + 0.25
                } else {
                    0.5
                };
                let anchor = (corner as f32 + octant) * 0.25 - 1.0;
                assert_eq!(drawn.position[i][axis], anchor);
                assert!((drawn.scale[i][axis] / unit - 0.55).abs() < 0.01);
                let decoded = f32::from(cloud.colours[0][i / k][axis]) / 255.0;
                assert_eq!(drawn.colour[i][axis], decoded);
            }
            assert_eq!(drawn.rotation[i], [1.0, 0.0, 0.0, 0.0]);
            let opacity = if k == 8 { 0.880_797 } else { 1.0 };
            assert!((drawn.opacity[i] - opacity).abs() < 1e-6);
        }
        let squared_half_unit = if k == 8 { 1.0 / 256.0 } else { 1.0 / 64.0 };
        assert!((drawn.blur / (0.15 * squared_half_unit) - 1.0).abs() < 1e-6);
    }
}

#[test]
fn faint_gaussians_are_omitted() {
    let cloud = Cloud::surface(4);
    let mut made = Made::new((Heads::Best, 8), 16, [1, 1], 9);
    for (name, (_, values)) in &mut made.tensors {
        values.fill(f16::ZERO);
        if name == "out.bias" {
            // Octant 3 is opaque, 5 is just seen, 6 is not; the others are far from it.
            for (octant, raw) in values.chunks_exact_mut(RAW).enumerate() {
                let opacity = [-20.0, -20.0, -20.0, 4.0, -20.0, -7.53, -7.55, -20.0][octant];
                raw[10] = f16::from_f32(opacity);
            }
        }
    }
    for precision in [Precision::Int16, Precision::F16] {
        let drawn = cloud.draw(&model(std::slice::from_ref(&made)), Isa::detect(), precision, made.set);
        assert_eq!(drawn.len(), 2 * cloud.maps[0].len());
        assert!(drawn.opacity.iter().all(|&o| o >= 1.0 / 255.0));
        for (i, position) in drawn.position.iter().enumerate() {
            let voxel = cloud.octree.level(4).coordinate(i / 2);
            let octant = if i % 2 == 0 { 3 } else { 5 };
            let place = [0, 1, 2].map(|a| (voxel[a] as f32 + (octant >> a & 1) as f32 * 0.5 + 0.25) / 8.0 - 1.0);
            assert_eq!(*position, place);
        }
    }
}

#[test]
fn the_division_into_parts_does_not_change_the_result() {
    // More voxels than one part has, of which each sees the same neighbours as its image in a smaller cloud.
    let cloud = Cloud::surface(8);
    assert!(cloud.maps[0].len() > 2 * activate::PART);
    let made = Made::new((Heads::Quick, 1), 4, [0, 0], 11);
    let model = model(std::slice::from_ref(&made));
    let drawn = cloud.draw(&model, Isa::detect(), Precision::F16, made.set);
    let (expected, _) = reference::gaussians(&made, &cloud.input());
    let off = differences(&drawn, &expected, 8);
    assert!(off.iter().all(|off| *off < 0.02), "{off:?}");
}

#[test]
fn the_size_of_spans_does_not_change_a_bit() {
    let cloud = Cloud::surface(6);
    for made in all_sets() {
        let model = model(std::slice::from_ref(&made));
        for precision in [Precision::Int16, Precision::F16] {
            let expected = cloud.draw(&model, Isa::detect(), precision, made.set);
            for (most, threads) in [(100, 3), (700, 1), (1500, 2), (3000, 2)] {
                let input = cloud.input();
                let generator = model.generator(Isa::detect(), precision, made.set, &input).unwrap();
                let drawing = Drawing::new(&input, made.set.1, model.blur, Frame::default(), true);
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let draw = || generator.generate(Isa::detect(), precision, most, &input, drawing, &mut |_| Ok(()));
                let drawn: crate::error::Result<Gaussians> = pool.install(draw);
                assert_eq!(drawn.unwrap(), expected, "{most} rows, {threads} threads, {precision}");
            }
        }
    }
}

#[test]
fn parts_that_are_taken_away_make_up_the_whole() {
    let cloud = Cloud::surface(8);
    let made = Made::new((Heads::Quick, 8), 4, [0, 0], 11);
    let model = model(std::slice::from_ref(&made));
    let expected = cloud.draw(&model, Isa::detect(), Precision::Int16, made.set);
    let (frame, mut whole, mut parts) = (Frame::default(), Gaussians::default(), 0);
    let mut taken = |part: &mut Gaussians| {
        parts += 1;
        whole.blur = part.blur;
        let empty = Gaussians {
            blur: part.blur,
            ..Gaussians::default()
        };
        whole.append(std::mem::replace(part, empty));
        Ok(())
    };
    let rest = model.generate_in_parts(
        Isa::detect(),
        Precision::Int16,
        made.set,
        cloud.input(),
        frame,
        (usize::MAX, false),
        &mut taken,
    );
    assert!(rest.unwrap().is_empty());
    assert!(parts > 3, "{parts} parts");
    assert_eq!(whole, expected);
}

#[test]
fn invalid_requests_are_refused_with_the_reason() {
    let model = model(&[Made::new((Heads::Best, 1), 4, [0, 0], 1)]);
    assert_eq!(model.sets().collect::<Vec<_>>(), [(Heads::Best, 1)]);
    let cloud = Cloud::surface(3);
    let draw = |set, level| {
        let input = LevelInput { level, ..cloud.input() };
        let (isa, frame) = (Isa::detect(), Frame::default());
        model.generate(isa, Precision::Int16, set, input, frame).unwrap_err()
    };
    let none_above = draw((Heads::Best, 1), 0);
    assert!(matches!(none_above, Error::Unsupported { .. }), "{none_above}");
    let no_such = draw((Heads::Quick, 8), 3);
    assert!(matches!(no_such, Error::Unsupported { .. }));
    assert!(no_such.to_string().contains("best.1, not quick.8"), "{no_such}");
}

#[test]
fn steps_are_clamped_to_their_range() {
    let mut cloud = Cloud::surface(3);
    let made = Made::new((Heads::Best, 1), 8, [1, 1], 1);
    let model = model(std::slice::from_ref(&made));
    let mut drawn = |step| {
        cloud.step = step;
        cloud.draw(&model, Isa::detect(), Precision::Int16, made.set)
    };
    let (lossless, coarsest) = (drawn(1.0), drawn(65_536.0));
    assert_ne!(lossless, coarsest);
    for step in [0.0, -3.0, f32::NAN, f32::NEG_INFINITY] {
        assert_eq!(drawn(step), lossless, "{step}");
    }
    for step in [1e9, f32::INFINITY] {
        assert_eq!(drawn(step), coarsest, "{step}");
    }
}
