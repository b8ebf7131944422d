//! The streams of the suite: what is unusual about them is in their names.

use b2p::Placement;
use b2p::container::{Format, Header, Writer};
use b2p::encoder::{Options, Residual, encode};
use b2p::geometry::{KernelMap, Octree, Voxels, codec, morton};
use b2p::latents::entropy::{Condition, encode_level, encode_passes, latent_hash};
use b2p::latents::network::Model;
use b2p::latents::{COLOUR_INPUTS, ColourFilter, ColourResidual, ResidualSteps, Steps};
use b2p::log::Log;

use crate::common::{Ball, cloud_of, steps};
use crate::models::model;
use crate::seal;

/// A stream of the suite.
pub struct Case {
    pub name: String,
    pub model: &'static str,
    pub bytes: Vec<u8>,
    /// Whether no float had a part in it, so that every machine makes the same bytes.
    pub anywhere: bool,
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
}

/// What latents are made up.
#[derive(Clone, Copy)]
enum Latents {
    Zero,
    Small,
    /// Every length of escape, on both sides.
    Escapes,
    /// The ends of the range that latents of this model may have, and those of 16 bits.
    Extremes,
}

impl Latents {
    fn next(self, random: &mut Random) -> i16 {
        match self {
            Latents::Zero => 0,
            Latents::Small => random.below(7) as i16 - 3,
            Latents::Escapes => {
                let sign = 1 - 2 * random.below(2) as i32;
                let magnitude = 1i32 << random.below(16);
                (sign * (magnitude + random.below(3) as i32)).clamp(-32_768, 32_767) as i16
            }
            Latents::Extremes => [i16::MIN, i16::MAX, 31, -31, 2047, -2047, 0][random.below(7) as usize],
        }
    }
}

/// A stream of these voxels, level `bits` of them, with made-up latents at the levels `base` to `top`.
fn stream(model: &Model, bits: u8, keys: &[u64], levels: (u8, u8), slice: u32, latents: Latents) -> Vec<u8> {
    coloured(model, bits, keys, levels, slice, latents, Corrections::default())
}

/// What all levels of a stream say of their colours.
#[derive(Default, Clone, Copy)]
struct Corrections {
    /// Filters for both sets of heads, of this exponent and weights up to as much.
    filter: Option<(u8, i8)>,
    /// As finely as this, what is up to so much in each channel.
    residual: Option<(ResidualSteps, f32)>,
}

/// The same, and all its levels correct colours.
fn coloured(
    model: &Model,
    bits: u8,
    keys: &[u64],
    (base, top): (u8, u8),
    slice: u32,
    latents: Latents,
    corrections: Corrections,
) -> Vec<u8> {
    let cloud = Voxels::new(bits, keys.to_vec());
    let octree = Octree::new(cloud.clone()).expect("voxels");
    let mut random = Random(keys.len() as u64);
    let mut writer = Writer::new(Header {
        optional_flags: 0,
        bits,
        base,
        top,
        points: cloud.len() as u64,
        placement: Placement {
            origin: [-1.5, 1e6, 0.0],
            voxel_size: 0.25,
        },
        format: Format::Learned { model: model.id() },
        slice_voxels: slice,
        voxels: (base..=top).map(|n| octree.level(n).len() as u32).collect(),
        sections: Vec::new(),
    })
    .expect("a header that the format allows");
    let mut map = KernelMap::root();
    let mut below: Option<Vec<i16>> = None;
    for level in 0..=top {
        if level > 0 {
            let slices = codec::encode_level(model.isa(), &octree, &map, level, slice as usize);
            writer.geometry(level, &slices).expect("geometry");
            map = octree.child_map(level - 1, &map);
        }
        let Some(role) = level.checked_sub(base).map(usize::from) else {
            continue;
        };
        let context = below
            .as_ref()
            .map(|g| model.upsample(role, g, octree.occupancy(level - 1)));
        let correct = |writer: &mut Writer, random: &mut Random| {
            for set in 0..2 {
                let Some((exponent, most)) = corrections.filter else {
                    break;
                };
                let mut weights = [[0; COLOUR_INPUTS]; 3];
                for weight in weights.as_flattened_mut() {
                    let whole = 2 * most as u64 + 1;
                    *weight = (random.below(whole) as i64 - i64::from(most)) as i8;
                }
                let payload = ColourFilter { exponent, weights }.to_bytes();
                writer.filter(level, set, &payload).expect("a filter");
            }
            if let Some((own, most)) = corrections.residual {
                let keys = octree.level(level).keys();
                let mut draw = || most * (random.below(1 << 20) as f32 / (1 << 19) as f32 - 1.0);
                let missing: Vec<_> = keys.iter().map(|_| [draw(), draw(), draw()]).collect();
                let residual = ColourResidual::of(&missing, keys, slice as usize, own);
                let written = writer.residual(level, &residual.to_payloads(keys));
                written.expect("a residual");
            }
        };
        if !model.has_latents(role) {
            below = Some(model.reconstruct(role, &[], context.as_deref(), &map));
            correct(&mut writer, &mut random);
            continue;
        }
        let parameters = context.as_ref().map(|c| model.entropy_parameters(role, c, &map));
        let count = octree.level(level).len() * model.shape().latents;
        let latents: Vec<i16> = (0..count).map(|_| latents.next(&mut random)).collect();
        let (tables, slice) = (model.tables(), slice as usize);
        let slices = if model.has_passes(role) {
            let voxels = octree.level(level);
            let octants = voxels.octants();
            let predict = model.passes(role, &octants, &map, parameters.as_ref());
            encode_passes(tables, voxels.keys(), &predict, &latents, slice)
        } else {
            let condition = match &parameters {
                Some((mu, sigma)) => Condition::Gauss { mu, sigma },
                None => Condition::Prior,
            };
            encode_level(tables, condition, &latents, slice)
        };
        writer
            .features(level, latent_hash(&latents), &slices)
            .expect("features");
        correct(&mut writer, &mut random);
        below = Some(model.reconstruct(role, &latents, context.as_deref(), &map));
    }
    writer.finish().expect("a stream that the format allows")
}

/// Puts a chunk that readers skip before every chunk of the stream.
fn with_notes(bytes: &[u8]) -> Vec<u8> {
    let note = [200, 9, 1, 0, 5, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0, b'n', b'o', b't', b'e'];
    let (levels, header) = seal::header_end(bytes).expect("a header");
    let mut ends = Vec::new();
    let mut at = header + 4;
    for i in 0..2 * levels {
        let length = seal::FIXED + 4 * levels + 4 * i;
        let length: [u8; 4] = bytes[length..length + 4].try_into().expect("four bytes");
        at += u32::from_le_bytes(length) as usize;
        ends.push(at);
    }
    let starts = seal::chunks(bytes);
    let mut out = bytes[..header + 4].to_vec();
    let mut grown = vec![0u32; ends.len()];
    for (i, &start) in starts.iter().enumerate() {
        let section = ends.iter().position(|end| start < *end).expect("a section");
        grown[section] += note.len() as u32;
        out.extend(note);
        out.extend(&bytes[start..starts.get(i + 1).copied().unwrap_or(bytes.len())]);
    }
    for (i, grown) in grown.into_iter().enumerate() {
        let at = seal::FIXED + 4 * levels + 4 * i;
        let length: [u8; 4] = out[at..at + 4].try_into().expect("four bytes");
        let length = u32::from_le_bytes(length) + grown;
        out[at..at + 4].copy_from_slice(&length.to_le_bytes());
    }
    seal::seal(&mut out);
    out
}

/// Steps of luma and chromas, fine and coarse, and the boundary.
fn precision(fine: [u8; 2], coarse: [u8; 2], boundary: u8) -> ResidualSteps {
    let [fine, coarse] = [fine, coarse].map(|[luma, chroma]| Steps { luma, chroma });
    ResidualSteps { fine, coarse, boundary }
}

fn cube(side: u32) -> Vec<u64> {
    (0..side.pow(3))
        .map(|i| morton::encode([i % side, i / side % side, i / side / side]))
        .collect()
}

fn scattered(bits: u8, count: u64) -> Vec<u64> {
    let mut random = Random(count);
    (0..count).map(|_| random.below(1 << (3 * bits))).collect()
}

fn sphere() -> Vec<u64> {
    Ball::new(4, 5.5).cloud().voxels.keys().to_vec()
}

/// All streams of the suite, by model.
pub fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    let corner = |bits: u8| (1u64 << (3 * bits)) - 1;
    for name in [
        "tiny", "other", "nearest", "wide", "plain", "base", "bare", "learning", "lite",
    ] {
        let model = model(name);
        let mut add = |what: String, anywhere: bool, make: &dyn Fn(&Model) -> Vec<u8>| {
            cases.push(Case {
                name: format!("{name}-{what}"),
                model: name,
                bytes: make(&model),
                anywhere,
            });
        };
        use Latents::{Escapes, Extremes, Small, Zero};
        let sphere = sphere();
        if name == "tiny" {
            for base in 0..4u8 {
                for top in base..4.min(base + 3) {
                    add(format!("levels-{base}-{top}"), true, &|m| {
                        stream(m, 4, &sphere, (base, top), 16_384, Small)
                    });
                }
            }
            for slice in [1, 2, 7, 63, 64] {
                add(format!("slices-of-{slice}"), true, &|m| {
                    let keys = if slice < 3 { cube(3) } else { sphere.clone() };
                    stream(m, 4, &keys, (1, 3), slice, Small)
                });
            }
            for bits in [1u8, 2, 3, 10, 21] {
                for (place, key) in [("first", 0), ("last", corner(bits))] {
                    let levels = (bits.saturating_sub(3), bits - 1);
                    add(format!("one-voxel-{place}-of-{bits}-bits"), true, &|m| {
                        stream(m, bits, &[key], levels, 16_384, Small)
                    });
                }
            }
            for side in [2u32, 5, 8] {
                add(format!("cube-of-{side}"), true, &|m| {
                    stream(m, 4, &cube(side), (1, 3), 100, Small)
                });
            }
            let ends = [0, 77, corner(21) - 1, corner(21)];
            add("far-corners".into(), true, &|m| {
                stream(m, 21, &ends, (18, 20), 2, Small)
            });
            add("deepest-level-alone".into(), true, &|m| {
                stream(m, 21, &ends, (20, 20), 2, Small)
            });
            add("lone-voxels".into(), true, &|m| {
                stream(m, 21, &scattered(21, 20), (18, 20), 16, Small)
            });
            let checkerboard: Vec<u64> = (0..512u64).filter(|k| k.count_ones() % 2 == 0).collect();
            add("checkerboard".into(), true, &|m| {
                stream(m, 3, &checkerboard, (0, 2), 16_384, Small)
            });
            let plane: Vec<u64> = (0..256).map(|i| morton::encode([i % 16, i / 16, 7])).collect();
            add("plane".into(), true, &|m| stream(m, 4, &plane, (1, 3), 20, Small));
            let line: Vec<u64> = (0..64).map(|i| morton::encode([i, 63 - i, 0])).collect();
            add("diagonal".into(), true, &|m| stream(m, 6, &line, (3, 5), 9, Small));
            add("notes-between-chunks".into(), true, &|m| {
                with_notes(&stream(m, 4, &sphere, (1, 3), 40, Small))
            });
            add("cut-cloud".into(), true, &|m| {
                stream(m, 8, &scattered(8, 60), (2, 3), 30, Small)
            });
        }
        if name == "learning" {
            let ends = [0, 77, corner(21) - 1, corner(21)];
            add("far-corners".into(), true, &|m| {
                stream(m, 21, &ends, (18, 20), 4, Small)
            });
            add("slices-of-7".into(), true, &|m| {
                stream(m, 4, &cube(7), (1, 3), 7, Small)
            });
            add("a-voxel-in-two".into(), true, &|m| {
                let lone = cube(12).into_iter().filter(|key| key & 7 == 0);
                let lone: Vec<u64> = lone.map(|key| key << 3).collect();
                stream(m, 5, &lone, (2, 4), 100, Small)
            });
        }
        add("nothing-to-say".into(), true, &|m| {
            stream(m, 4, &sphere, (1, 3), 25, Zero)
        });
        add("small".into(), true, &|m| stream(m, 4, &sphere, (1, 3), 16_384, Small));
        add("escapes".into(), true, &|m| stream(m, 4, &cube(6), (1, 3), 50, Escapes));
        add("extremes".into(), true, &|m| {
            stream(m, 4, &cube(5), (1, 3), 50, Extremes)
        });
        let sphere_saying = |m: &Model, filter, residual| {
            let corrections = Corrections { filter, residual };
            coloured(m, 4, &sphere, (1, 3), 30, Small, corrections)
        };
        let scatter_saying = |m: &Model, filter, residual| {
            let corrections = Corrections { filter, residual };
            coloured(m, 5, &scattered(5, 90), (2, 4), 30, Small, corrections)
        };
        add("filtered".into(), true, &|m| sphere_saying(m, Some((6, 20)), None));
        add("filtered-to-the-ends".into(), true, &|m| {
            scatter_saying(m, Some((0, 127)), None)
        });
        for (bands, fine, coarse, boundary) in [
            ("", [20, 9], [12, 7], 3),
            ("-coarse", [0, 0], [12, 7], 3),
            ("-fine", [20, 9], [0, 0], 3),
            ("-luma", [20, 0], [12, 0], 6),
            ("-chroma", [0, 9], [0, 7], 6),
            ("-luma-below-chroma", [20, 0], [0, 7], 4),
            ("-all-coarse", [0, 0], [12, 7], 0),
            ("-first-alone", [0, 0], [1, 1], 63),
        ] {
            add(format!("residual{bands}"), true, &|m| {
                let precision = precision(fine, coarse, boundary);
                sphere_saying(m, Some((6, 20)), Some((precision, 0.3)))
            });
        }
        add("residual-to-the-ends".into(), true, &|m| {
            let precision = precision([1, 2], [2, 1], 6);
            scatter_saying(m, None, Some((precision, 100.0)))
        });
        let encoded = |cloud, m: &Model, residual: Residual| {
            let options = Options {
                slice_voxels: 60,
                residual,
                bit_price: 0.0,
                ..Options::default()
            };
            encode(&cloud, m, &options, &Log::default())
                .expect("the model encodes")
                .bytes
        };
        add("encoded-sphere".into(), false, &|m| {
            encoded(Ball::new(5, 7.5).cloud(), m, Residual::Coarse)
        });
        add("encoded-sphere-with-residual".into(), false, &|m| {
            encoded(Ball::new(5, 7.5).cloud(), m, Residual::Fine(steps(8)))
        });
        add("encoded-scatter".into(), false, &|m| {
            encoded(cloud_of(7, scattered(7, 60)), m, Residual::Coarse)
        });
    }
    cases
}
