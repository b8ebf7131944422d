use b2p::Limits;
use b2p::gaussians::Gaussians;

use super::*;
use crate::splats::tests::{read_back, sample, written};
use crate::splats::{Options, turn};

/// A document in JSON with changes.
fn changed(gaussians: &Gaussians, change: impl Fn(&mut Value)) -> Vec<u8> {
    let mut root: Value = serde_json::from_slice(&written(gaussians, Format::Gltf)).unwrap();
    change(&mut root);
    root.to_string().into_bytes()
}

fn refusal(change: impl Fn(&mut Value)) -> String {
    let bytes = changed(&sample(3, 3), change);
    super::super::read(&bytes, Format::Gltf, &Options::default(), &Limits::default())
        .unwrap_err()
        .to_string()
}

fn places(g: &Gaussians) -> Vec<[f64; 3]> {
    g.position
        .iter()
        .map(|&p| g.frame.placement.from_cube(g.frame.bits, p))
        .collect()
}

#[test]
fn a_glb_file_has_aligned_chunks_and_its_length() {
    for count in [0, 1, 2, 7] {
        let bytes = written(&sample(count, 3), Format::Glb);
        let word = |at: usize| u32::from_le_bytes(std::array::from_fn(|k| bytes[at + k])) as usize;
        assert_eq!(word(8), bytes.len());
        assert_eq!(word(12) % 4, 0);
        assert_eq!(20 + word(12) + 8 + word(20 + word(12)), bytes.len());
        let root: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
        assert_eq!(root["buffers"][0]["byteLength"], word(20 + word(12)));
    }
}

#[test]
fn the_transforms_of_nodes_are_applied() {
    let before = sample(4, 3);
    let plain = read_back(&written(&before, Format::Gltf), Format::Gltf, [0.0; 3]).gaussians;
    // Two units along x after a quarter turn about y, doubled; in an outer node that lifts by 5.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let nested = |inner: Value| {
        changed(&before, |root| {
            root["asset"]["extras"] = Value::Null;
            root["nodes"] = json!([{ "children": [1], "translation": [0, 5, 0] }, inner]);
            root["nodes"][1]["mesh"] = 0.into();
        })
    };
    let parts = nested(json!({ "translation": [2, 0, 0], "rotation": [0, half, 0, half], "scale": [2, 2, 2] }));
    let matrix = nested(json!({ "matrix": [0, 0, -2, 0, 0, 2, 0, 0, 2, 0, 0, 0, 2, 0, 0, 1] }));
    for file in [parts, matrix] {
        let moved = read_back(&file, Format::Gltf, [0.0; 3]).gaussians;
        for (i, (a, b)) in places(&plain).iter().zip(places(&moved)).enumerate() {
            let expected = [2.0 * a[2] + 2.0, 2.0 * a[1] + 5.0, -2.0 * a[0]];
            assert!((0..3).all(|k| (expected[k] - b[k]).abs() < 1e-3), "{a:?} {b:?}");
            let ratio =
                moved.frame.unit() * f64::from(moved.scale[i][0]) / plain.frame.unit() / f64::from(plain.scale[i][0]);
            assert!((ratio - 2.0).abs() < 1e-4, "{ratio}");
            let turn = turn::Turn::new([half, 0.0, half, 0.0]);
            let rotated = turn.rotation(plain.rotation[i].map(f64::from));
            let dot: f64 = (0..4).map(|k| rotated[k] * f64::from(moved.rotation[i][k])).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-5, "{dot}");
        }
    }
}

#[test]
fn normalised_integers_are_read() {
    let before = sample(2, 0);
    let file = changed(&before, |root| {
        // Opacities as two bytes of the colours: those of the first two channels of Gaussian 0.
        let opacity = root["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:OPACITY"]
            .as_u64()
            .unwrap();
        root["accessors"][opacity as usize] = json!({
            "bufferView": 1, "componentType": UNSIGNED_BYTE, "normalized": true, "count": 2, "type": "SCALAR",
        });
        root["bufferViews"][1]["byteStride"] = 4.into();
    });
    let after = read_back(&file, Format::Gltf, [0.0; 3]).gaussians;
    for (opacity, colour) in after.opacity.iter().zip(&before.colour) {
        assert!((f64::from(*opacity) - linear(colour[0].into())).abs() < 0.003);
    }
}

#[test]
fn documents_that_lie_are_errors() {
    assert!(refusal(|root| root["meshes"] = Value::Null).contains("none in the scene"));
    assert!(refusal(|root| root["nodes"][0]["children"] = json!([0])).contains("a cycle"));
    assert!(refusal(|root| root["nodes"][0]["children"] = json!([7])).contains("expected below 1"));
    assert!(refusal(|root| root["nodes"][0]["scale"] = json!([1, 2, 1])).contains("scale 1 × 2 × 1"));
    assert!(refusal(|root| root["nodes"][0]["scale"] = json!([1, -1, 1])).contains("one scale above 0"));
    assert!(refusal(|root| root["nodes"][0]["rotation"] = json!([0, 0, 0, 0])).contains("a quaternion"));
    assert!(refusal(|root| root["nodes"][0]["matrix"] = json!([1, 0])).contains("16 numbers"));
    let mirror = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]);
    assert!(refusal(|root| root["nodes"][0]["matrix"] = mirror.clone()).contains("mirrors"));
    assert!(refusal(|root| root["accessors"][3]["count"] = 4.into()).contains("count is 4, expected 3"));
    assert!(refusal(|root| (0..9).for_each(|i| root["accessors"][i]["count"] = 4.into())).contains("extent"));
    assert!(refusal(|root| (0..9).for_each(|i| root["accessors"][i]["count"] = u64::MAX.into())).contains("limit"));
    assert!(refusal(|root| root["accessors"][3]["type"] = "VEC2".into()).contains("type"));
    assert!(refusal(|root| root["accessors"][3]["componentType"] = 5125.into()).contains("componentType"));
    assert!(refusal(|root| root["accessors"][3]["byteOffset"] = u64::MAX.into()).contains("extent"));
    assert!(refusal(|root| root["bufferViews"][3]["byteStride"] = 1.into()).contains("extent"));
    assert!(refusal(|root| root["bufferViews"][3]["byteOffset"] = u64::MAX.into()).contains("extent"));
    assert!(refusal(|root| root["bufferViews"][3]["buffer"] = 1.into()).contains("below 1"));
    assert!(refusal(|root| root["buffers"][0]["uri"] = "x.bin".into()).contains("another file"));
    assert!(refusal(|root| root["buffers"][0]["uri"] = "data:x;base64,!".into()).contains("base64"));
    let spz = json!({ "KHR_gaussian_splatting_compression_spz_2": {} });
    let compressed = refusal(|root| {
        root["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = spz.clone();
    });
    assert!(compressed.contains("compression_spz_2"), "{compressed}");
}
