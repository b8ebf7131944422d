use b2p::gaussians::Gaussians;

use super::*;
use crate::splats::tests::{read_back, sample, written};
use crate::splats::{Format, Options};

/// The archive with another `meta.json`.
fn with_meta(bytes: &[u8], change: impl Fn(&mut Value)) -> Vec<u8> {
    let mut archive = Archive::open(bytes, &Limits::default()).unwrap();
    let mut meta: Value = serde_json::from_slice(&archive.need("meta.json").unwrap()).unwrap();
    change(&mut meta);
    let mut out = Vec::new();
    let mut writer = ArchiveWriter::new(&mut out);
    writer
        .start("meta.json", 0)
        .unwrap()
        .write_all(meta.to_string().as_bytes())
        .unwrap();
    for name in [
        "means_l",
        "means_u",
        "quats",
        "scales",
        "sh0",
        "shN_centroids",
        "shN_labels",
    ] {
        let name = format!("{name}.webp");
        if let Some(file) = archive.get(&name).unwrap() {
            writer.start(&name, 0).unwrap().write_all(&file).unwrap();
        }
    }
    writer.finish().unwrap();
    out
}

fn refusal(bytes: &[u8]) -> String {
    crate::splats::read(bytes, Format::Sog, &Options::default(), &Limits::default())
        .unwrap_err()
        .to_string()
}

#[test]
fn colours_under_an_opacity_of_nothing_survive() {
    let mut before = sample(5, 0);
    before.opacity.fill(0.0);
    let after = read_back(&written(&before, Format::Sog), Format::Sog, [0.0; 3]).gaussians;
    let sum = |g: &Gaussians| g.colour.as_flattened().iter().sum::<f32>();
    assert!((sum(&before) - sum(&after)).abs() < 1e-3);
}

#[test]
fn meta_data_that_lie_are_errors() {
    let bytes = written(&sample(5, 3), Format::Sog);
    let changed = |change: &dyn Fn(&mut Value)| refusal(&with_meta(&bytes, change));
    assert!(changed(&|meta| meta["version"] = 3.into()).contains("expected version 2"));
    assert!(changed(&|meta| meta["version"] = Value::Null).contains("version 1"));
    assert!(changed(&|meta| meta["count"] = (-1).into()).contains("count is -1"));
    assert!(changed(&|meta| meta["count"] = 17.into()).contains("expected 17 pixels"));
    assert!(changed(&|meta| meta["count"] = 5_000_000_000u64.into()).contains("limit"));
    assert!(changed(&|meta| meta["shN"]["bands"] = 4.into()).contains("shN.bands"));
    assert!(changed(&|meta| meta["shN"]["bands"] = 2.into()).contains("expected 512×1"));
    assert!(changed(&|meta| meta["shN"]["count"] = 65.into()).contains("expected 192×2"));
    assert!(changed(&|meta| meta["scales"]["codebook"][0] = "x".into()).contains("codebook of scales"));
    assert!(changed(&|meta| meta["sh0"]["codebook"] = Value::Null).contains("codebook of sh0 is absent"));
    assert!(changed(&|meta| meta["means"]["mins"] = 1.into()).contains("means.mins"));
    assert!(changed(&|meta| meta["quats"]["files"][0] = "../x".into()).contains("file ../x is absent"));
    assert!(changed(&|meta| meta["quats"]["files"] = Value::Null).contains("files of quats is 0"));
}

#[test]
fn pictures_have_a_pixel_for_each_gaussian() {
    for count in [0, 1, 15, 16, 17, 1000, 1_000_000] {
        let (width, height) = size_of_pictures(count).unwrap();
        assert!((width * height) as usize >= count);
        assert!(width % 4 == 0 && height % 4 == 0);
    }
    assert_eq!(size_of_pictures(16).unwrap(), (4, 4));
    assert!(size_of_pictures(1 << 29).is_err());
}
