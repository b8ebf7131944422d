//! Learned heads of random weights, which the suites of version 3 are drawn with beside surfels.

use std::collections::BTreeMap;
use std::path::Path;

use b2p::gaussians::HeadSet;
use b2p::gaussians::learned::HeadsModel;
use b2p::{Decoder, Isa};

/// The file of digests that a suite has for each way of drawing it, and the decoder that draws it so.
pub fn drawn(suite: &Path, isa: Isa) -> [(&'static str, Decoder); 3] {
    let heads = HeadsModel::open(&suite.join("heads.safetensors")).expect("the heads of the suite load");
    let decoder = Decoder::new().with_isa(isa).with_heads_model(heads);
    [
        ("suite.txt", HeadSet::Surfels),
        ("best.txt", HeadSet::Best),
        ("quick.txt", HeadSet::Quick),
    ]
    .map(|(file, heads)| (file, decoder.clone().with_heads(heads)))
}

/// Channels, blocks of parents and of children, and Gaussians of a voxel.
type Shape = (usize, usize, usize, usize);

/// The file of the heads: all four networks, some without blocks.
#[allow(
    dead_code,
    reason = "who makes the suites uses it, and the test that does that again"
)]
pub fn file() -> Vec<u8> {
    let networks: [(&str, Shape); 4] = [
        ("best.1", (8, 1, 2, 1)),
        ("best.8", (6, 0, 1, 8)),
        ("quick.1", (4, 1, 0, 1)),
        ("quick.8", (3, 0, 0, 8)),
    ];
    let (mut tensors, mut sets, mut random) = (BTreeMap::new(), Vec::new(), Random(36));
    for (name, shape) in networks {
        sets.push(add(&mut tensors, &mut random, name, shape));
    }
    let described = format!(r#"{{"version":1,"blur":0.15,"sets":{{{}}}}}"#, sets.join(","));
    packed(&described, &tensors)
}

/// A safetensors file of f16 tensors (9.1.1 of the format).
fn packed(described: &str, tensors: &BTreeMap<String, (Vec<usize>, Vec<u16>)>) -> Vec<u8> {
    let escaped = described.replace('"', "\\\"");
    let mut header = format!(r#"{{"__metadata__":{{"b2p-heads":"{escaped}"}}"#);
    let mut bytes = Vec::new();
    for (name, (shape, values)) in tensors {
        let begin = bytes.len();
        bytes.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let end = bytes.len();
        header += &format!(r#","{name}":{{"dtype":"F16","shape":{shape:?},"data_offsets":[{begin},{end}]}}"#);
    }
    header += "}";
    while header.len() % 8 != 0 {
        header += " ";
    }
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &bytes].concat()
}

/// Adds the tensors of a network; its description.
fn add(
    tensors: &mut BTreeMap<String, (Vec<usize>, Vec<u16>)>,
    random: &mut Random,
    name: &str,
    (channels, parent_blocks, child_blocks, gaussians): Shape,
) -> String {
    let mut layers = vec![
        ("parent.in".to_owned(), 12, channels),
        ("child.in".to_owned(), 7, channels),
    ];
    for (side, blocks) in [("parent", parent_blocks), ("child", child_blocks)] {
        let inside = (0..blocks).flat_map(|i| ["a", "b"].map(|part| format!("{side}.{i}.{part}")));
        layers.extend(inside.map(|layer| (layer, channels, channels)));
    }
    // The second one is so small that its outputs reach the limit.
    let ranges = layers.iter().zip([6.0, 0.4, 5.0, 3.5, 2.75, 4.25, 3.0, 6.5]);
    let ranges: Vec<_> = ranges
        .map(|((layer, ..), range)| format!(r#""{layer}":{range:?}"#))
        .collect();
    layers.push(("out".to_owned(), channels, 14 * gaussians));
    for (layer, inputs, outputs) in layers {
        let mut bias = random.numbers(outputs, 12);
        if layer == "out" && gaussians == 8 {
            // Near the faintest opacity, so that some Gaussians are left out.
            bias.iter_mut()
                .skip(10)
                .step_by(28)
                .for_each(|value| *value = half(-7.5));
        }
        let weight = random.numbers(27 * inputs * outputs, 12);
        tensors.insert(format!("{name}.{layer}.weight"), (vec![27, inputs, outputs], weight));
        tensors.insert(format!("{name}.{layer}.bias"), (vec![outputs], bias));
    }
    let up = random.numbers(8 * channels * channels, 10);
    tensors.insert(format!("{name}.up.weight"), (vec![8, channels, channels], up));
    let ranges = ranges.join(",");
    format!(r#""{name}":{{"channels":{channels},"parent_blocks":{parent_blocks},"child_blocks":{child_blocks},"#)
        + &format!(r#""gaussians":{gaussians},"ranges":{{{ranges}}}}}"#)
}

struct Random(u64);

impl Random {
    /// Multiples of 2^−`shift`, up to 1,023 of them above and below 0.
    fn numbers(&mut self, count: usize, shift: i32) -> Vec<u16> {
        let mut number = || {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let steps = (self.0 >> 40) % 2047;
            half((steps as f32 - 1023.0) * 2f32.powi(-shift))
        };
        (0..count).map(|_| number()).collect()
    }
}

/// The bits as f16 of a number that is one, and 0 or not subnormal.
fn half(number: f32) -> u16 {
    if number == 0.0 {
        return 0;
    }
    let bits = number.to_bits();
    let exponent = (bits >> 23 & 255) - 112;
    (bits >> 16 & 0x8000 | exponent << 10 | bits >> 13 & 1023) as u16
}
