use super::*;
use crate::geometry::{KernelMap, Voxels};
use proptest::prelude::*;

/// A cloud, its octree down to level `top`, and the maps of all levels.
struct Case {
    voxels: Voxels,
    colours: Vec<[u8; 3]>,
    octree: Octree,
    maps: Vec<SiblingMap>,
}

impl Case {
    fn new(depth: u8, top: u8, keys: Vec<u64>, colour: impl Fn([u32; 3]) -> [u8; 3]) -> Case {
        let voxels = Voxels::new(depth, keys);
        let colours = (0..voxels.len()).map(|i| colour(voxels.coordinate(i))).collect();
        let octree = Octree::new(voxels.clone()).unwrap().truncated(top);
        let maps = (0..=top).map(|level| octree.sibling_map(level)).collect();
        Case {
            voxels,
            colours,
            octree,
            maps,
        }
    }

    /// A paraboloid with a colour pattern.
    fn bowl(depth: u8, top: u8) -> Case {
        let side = 1u32 << depth;
        let keys = (0..side * side).map(|i| {
            let [x, y] = [i % side, i / side];
            crate::geometry::morton::encode([x, y, (x * x + y * y) / (2 * side)])
        });
        Case::new(depth, top, keys.collect(), |[x, y, z]| {
            [
                (x * 5 % 256) as u8,
                ((x / 3 + y / 5) * 40 % 256) as u8,
                (z * 9 % 256) as u8,
            ]
        })
    }

    fn truth(&self, trunk: u8, steps: Steps) -> Truth {
        let top = self.octree.depth();
        Truth::new(
            &self.voxels,
            &self.colours,
            &self.octree,
            trunk,
            top,
            steps.is_lossless(),
        )
    }

    /// The payloads of the trunk and of every level below, and the colours of the last level.
    fn encode(&self, isa: Isa, trunk: u8, slice: usize, steps: Steps) -> (Vec<Vec<Vec<u8>>>, LevelColours) {
        let (truth, options) = (self.truth(trunk, steps), Options::new(steps));
        let (bytes, mut colours) = encode_trunk(
            isa,
            &self.octree,
            &self.maps[..=usize::from(trunk)],
            self.octree.depth(),
            &truth,
            options,
            &[],
        );
        let mut payloads = vec![vec![bytes]];
        for level in trunk + 1..=self.octree.depth() {
            let (above, map) = (self.octree.sibling_map(level - 1), &self.maps[usize::from(level)]);
            let (slices, next) = encode_level(
                isa,
                &self.octree,
                level,
                &above,
                map,
                &colours,
                &truth,
                slice,
                options,
                None,
            );
            payloads.push(slices);
            colours = next;
        }
        (payloads, colours)
    }

    fn decode(&self, isa: Isa, trunk: u8, slice: usize, payloads: &[Vec<Vec<u8>>]) -> Result<LevelColours> {
        let first = Slice {
            voxels: 0,
            bytes: &payloads[0][0],
            offset: 0,
        };
        let mut colours = decode_trunk(isa, &self.octree, &self.maps[..=usize::from(trunk)], &first)?;
        for (level, payloads) in (trunk + 1..=self.octree.depth()).zip(&payloads[1..]) {
            let (above, map) = (self.octree.sibling_map(level - 1), &self.maps[usize::from(level)]);
            let slices: Vec<_> = payloads
                .iter()
                .map(|bytes| Slice {
                    voxels: 0,
                    bytes,
                    offset: 0,
                })
                .collect();
            colours = decode_level(
                isa,
                &self.octree,
                level,
                &above,
                map,
                &colours,
                &slices,
                slice,
                None,
                &Cancel::default(),
            )?;
        }
        Ok(colours)
    }
}

fn some_steps() -> impl Strategy<Value = Steps> {
    prop_oneof![
        Just(Steps::LOSSLESS),
        (0u8..=87, 0u8..=87).prop_map(|(luma, chroma)| Steps { luma, chroma }),
        (0u8..=87).prop_map(|luma| Steps {
            luma,
            chroma: Steps::ABSENT
        }),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn encoding_and_decoding_agree_on_every_instruction_set(
        keys in prop::collection::vec(0u64..1 << 12, 1..400), noise: u32, slice in 1usize..60, trunk in 0u8..=4, steps in some_steps()
    ) {
        let case = Case::new(4, 4, keys, |xyz| {
            let hash = xyz.iter().fold(noise, |h, x| (h ^ x).wrapping_mul(0x9E37_79B1));
            hash.to_le_bytes()[..3].try_into().unwrap()
        });
        let (payloads, colours) = case.encode(Isa::detect(), trunk, slice, steps);
        for isa in Isa::available() {
            prop_assert_eq!(&case.encode(isa, trunk, slice, steps).0, &payloads);
            prop_assert_eq!(&case.decode(isa, trunk, slice, &payloads).unwrap(), &colours);
        }
        if steps.is_lossless() {
            prop_assert_eq!(colours.rgb(), case.colours);
        }
    }

    #[test]
    fn damaged_payloads_never_panic(
        place in 0usize..10_000, with: u8, cut in 0usize..10_000
    ) {
        let case = Case::bowl(5, 5);
        let steps = Steps { luma: 32, chroma: 40 };
        let (mut payloads, _) = case.encode(Isa::detect(), 3, 100, steps);
        let level = place % payloads.len();
        let slice = place % payloads[level].len();
        let bytes = &mut payloads[level][slice];
        let (place, cut) = (place % bytes.len(), cut % (bytes.len() + 1));
        bytes[place] = with;
        let _ = case.decode(Isa::detect(), 3, 100, &payloads);
        payloads[level][slice].truncate(cut);
        let _ = case.decode(Isa::detect(), 3, 100, &payloads);
    }
}

#[test]
fn the_error_grows_with_the_step() {
    let case = Case::bowl(7, 6);
    let truth = case.truth(3, Steps { luma: 0, chroma: 0 });
    let mut last = 0.0;
    for index in [0, 16, 32, 48] {
        let steps = Steps {
            luma: index,
            chroma: index,
        };
        let (payloads, colours) = case.encode(Isa::detect(), 3, 1 << 14, steps);
        let pairs = colours.values().iter().zip(truth.level(6));
        let sum: f64 = pairs.map(|(a, b)| f64::from(a[0] - b[0]).powi(2)).sum();
        let error = (sum / colours.values().len() as f64).sqrt() / 64.0;
        assert!(
            error > last && error < 0.8 * f64::from(steps.luma_step()),
            "{index}: {error}"
        );
        assert!(payloads.iter().flatten().map(Vec::len).sum::<usize>() > 0);
        last = error;
    }
}

#[test]
fn coarser_steps_need_fewer_bytes() {
    let case = Case::bowl(7, 6);
    let bytes = |index| {
        let steps = Steps {
            luma: index,
            chroma: index,
        };
        case.encode(Isa::detect(), 3, 1 << 14, steps)
            .0
            .iter()
            .flatten()
            .map(Vec::len)
            .sum::<usize>()
    };
    let sizes = [0, 16, 32, 48, 64].map(bytes);
    assert!(sizes.is_sorted_by(|a, b| a > b), "{sizes:?}");
}

#[test]
fn absent_chroma_keeps_the_value_of_the_root() {
    let case = Case::bowl(5, 5);
    let steps = Steps {
        luma: 24,
        chroma: Steps::ABSENT,
    };
    let (_, colours) = case.encode(Isa::detect(), 4, 1 << 14, steps);
    let root = colours.values()[0][1..].to_vec();
    assert!(colours.values().iter().all(|ycc| ycc[1..] == root[..]));
}

#[test]
fn a_wrong_number_of_slices_is_an_error() {
    let case = Case::bowl(5, 5);
    let (mut payloads, _) = case.encode(Isa::detect(), 3, 100, Steps { luma: 32, chroma: 32 });
    payloads[1].pop();
    let error = case.decode(Isa::detect(), 3, 100, &payloads).unwrap_err();
    assert!(error.to_string().contains("number of colour slices"), "{error}");
}

#[test]
fn invalid_steps_are_an_error() {
    let case = Case::bowl(5, 5);
    let (payloads, _) = case.encode(Isa::detect(), 3, 100, Steps { luma: 32, chroma: 32 });
    for (level, steps) in [(0, [88, 0]), (1, [255, 255]), (1, [0, 255])] {
        let mut payloads = payloads.clone();
        payloads[level][0][..2].copy_from_slice(&steps);
        let error = case.decode(Isa::detect(), 3, 100, &payloads).unwrap_err();
        assert!(error.to_string().contains("steps"), "{error}");
    }
}

/// A coarsely coded level of a paraboloid, its map, and its original colours.
fn noisy() -> (LevelColours, SiblingMap, Vec<Ycc>) {
    let case = Case::bowl(7, 6);
    let steps = Steps { luma: 44, chroma: 52 };
    let (_, colours) = case.encode(Isa::detect(), 3, 1 << 14, steps);
    (colours, case.maps[6].clone(), case.truth(3, steps).level(6).to_vec())
}

fn squared_error(values: &[[u8; 3]], truth: &[Ycc]) -> f64 {
    let truth = truth.iter().map(|ycc| space::display(*ycc, space::FRACTION));
    let squares = values
        .iter()
        .zip(truth)
        .flat_map(|(a, b)| [0, 1, 2].map(|k| f64::from(a[k].abs_diff(b[k])).powi(2)));
    squares.sum()
}

#[test]
fn a_fitted_filter_reduces_the_error_and_its_payload_round_trips() {
    let (colours, map, truth) = noisy();
    let filter = Filter::fit(Isa::detect(), &colours, &map, &truth).expect("noise to remove");
    let before = squared_error(&colours.rgb(), &truth);
    let filtered = filter.rgb(Isa::detect(), &colours, &map, colours.steps());
    assert!(squared_error(&filtered, &truth) < 0.95 * before);
    let bytes = filter.to_bytes();
    assert_eq!(Filter::parse(&bytes, 0).unwrap(), filter);
    for wrong in [&bytes[..bytes.len() - 1], &[], &[0], &[3]] {
        assert!(Filter::parse(wrong, 7).unwrap_err().to_string().contains("byte 7"));
    }
    for isa in Isa::available() {
        assert_eq!(filter.rgb(isa, &colours, &map, colours.steps()), filtered, "{isa}");
    }
}

#[test]
fn one_pass_matches_its_definition() {
    let (colours, map, _) = noisy();
    let weights = [[10i8, -3, 40, 7, 127], [-128, 0, 1, 2, 3], [0; 5]];
    let bytes: Vec<u8> = [1]
        .into_iter()
        .chain(weights.iter().flatten().map(|w| *w as u8))
        .collect();
    let filtered = Filter::parse(&bytes, 0)
        .unwrap()
        .rgb(Isa::detect(), &colours, &map, colours.steps());
    let units = colours.steps().units().map(i64::from);
    for (voxel, own) in colours.values().iter().enumerate() {
        let mut expected = *own;
        for t in 0..3 {
            let (mut terms, mut counts) = ([0i64; 5], 0);
            for (k, &neighbour) in map.row(voxel).iter().enumerate() {
                let axes = [k % 3, k / 3 % 3, k / 9].iter().filter(|x| **x != 1).count();
                if neighbour == KernelMap::ABSENT || axes == 0 {
                    continue;
                }
                let count = [20, 12, 7][axes - 1];
                counts += count;
                let d = i64::from(colours.values()[neighbour as usize][t]) - i64::from(own[t]);
                let response = |tenths: i64| {
                    let r = ((1 << 24) / (units[t] * tenths / 10).max(1)).min(1 << 16);
                    let x = ((d.abs() * r) >> 12).min(4096);
                    count * ((d * (4096 - ((x * x) >> 12))) >> 12)
                };
                terms[axes - 1] += response(7);
                terms[if axes == 1 { 3 } else { 4 }] += response(28);
            }
            let sum: i64 = (0..5)
                .map(|j| i64::from(weights[t][j]) * ((terms[j] * (65536 / counts.max(1))) >> 14))
                .sum();
            expected[t] = space::clamp((i64::from(own[t]) + ((sum + 32) >> 6)) as i32, space::FRACTION);
        }
        assert_eq!(
            filtered[voxel],
            space::display(expected, space::FRACTION),
            "voxel {voxel}"
        );
    }
}

#[test]
fn a_root_with_invalid_chroma_is_an_error() {
    let case = Case::bowl(5, 5);
    let steps = Steps { luma: 32, chroma: 32 };
    let (mut payloads, _) = case.encode(Isa::detect(), 3, 100, steps);
    for chroma in [i16::MIN, -256, 256, i16::MAX] {
        payloads[0][0][4..6].copy_from_slice(&chroma.to_le_bytes());
        let error = case.decode(Isa::detect(), 3, 100, &payloads).unwrap_err();
        assert!(error.to_string().contains("chroma of the root"), "{error}");
    }
}
