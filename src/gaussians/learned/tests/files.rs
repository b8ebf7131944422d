//! Files that are no models, or lie.

use super::*;

fn refused(networks: &[Made], description: &serde_json::Value) -> Error {
    match HeadsModel::from_bytes(&file(networks, description)) {
        Ok(_) => panic!("loaded: {description}"),
        Err(error) => error,
    }
}

fn small() -> [Made; 1] {
    [Made::new((Heads::Quick, 1), 2, [1, 1], 1)]
}

#[test]
fn a_description_out_of_range_is_refused_with_the_field() {
    let networks = small();
    let set = "/sets/quick.1";
    for (field, value, text) in [
        ("/blur", json!(-0.1), "blur"),
        ("/blur", json!(1e300), "blur"),
        ("/blur", json!("wide"), "b2p-heads"),
        (&format!("{set}/channels"), json!(0), "channels"),
        (&format!("{set}/channels"), json!(1u64 << 60), "channels"),
        (&format!("{set}/channels"), json!(-1), "b2p-heads"),
        (&format!("{set}/channels"), json!(3), "shape"),
        (&format!("{set}/parent_blocks"), json!(1u64 << 40), "parent_blocks"),
        (&format!("{set}/child_blocks"), json!(2), "range child.1."),
        (&format!("{set}/gaussians"), json!(8), "gaussians"),
        (&format!("{set}/ranges/parent.in"), json!(0), "range"),
        (&format!("{set}/ranges/parent.in"), json!(-2), "range"),
        (&format!("{set}/ranges/child.0.b"), json!(1e30), "range child.0.b"),
        (&format!("{set}/ranges"), json!({}), "missing"),
        ("/sets", json!({"worst.1": {}}), "b2p-heads"),
        ("/sets", json!([]), "b2p-heads"),
    ] {
        let mut description = description(&networks);
        *description.pointer_mut(field).unwrap() = value.clone();
        let error = refused(&networks, &description);
        assert!(matches!(error, Error::Malformed { .. }), "{field} {value}");
        assert!(error.to_string().contains(text), "{field} {value}: {error}");
    }
    let mut unknown = description(&networks);
    let set = unknown["sets"]["quick.1"].take();
    unknown["sets"] = json!({"quick.2": set});
    let error = refused(&networks, &unknown).to_string();
    assert!(error.contains("quick.2") && error.contains("quick.8"), "{error}");
}

#[test]
fn another_version_is_not_supported() {
    let networks = small();
    let mut description = description(&networks);
    description["version"] = json!(2);
    let error = refused(&networks, &description);
    assert!(matches!(error, Error::Unsupported { .. }), "{error}");
}

#[test]
fn a_file_without_a_description_is_refused() {
    let file = File::new(BTreeMap::new());
    let error = HeadsModel::from_bytes(&file.write());
    assert!(matches!(error, Err(Error::Malformed { .. })));
}

#[test]
fn every_tensor_is_needed_and_must_have_its_shape_and_finite_entries() {
    let networks = small();
    let description = description(&networks);
    let names: Vec<String> = networks[0].tensors.keys().cloned().collect();
    for name in names {
        let altered = |alter: &dyn Fn(&mut Made)| {
            let mut networks = networks.clone();
            alter(&mut networks[0]);
            let error = refused(&networks, &description);
            assert!(matches!(error, Error::Malformed { .. }));
            assert!(error.to_string().contains(&format!("quick.1.{name}")), "{error}");
        };
        altered(&|made| {
            made.tensors.remove(&name);
        });
        altered(&|made| {
            made.tensors.get_mut(&name).unwrap().0.push(1);
        });
        for bad in [f16::NAN, f16::INFINITY] {
            altered(&|made| made.tensors.get_mut(&name).unwrap().1[0] = bad);
        }
    }
}

#[test]
fn a_file_cut_anywhere_is_refused() {
    let networks = small();
    let bytes = file(&networks, &description(&networks));
    for end in (0..bytes.len()).step_by(97).chain([bytes.len() - 1]) {
        assert!(HeadsModel::from_bytes(&bytes[..end]).is_err(), "{end}");
    }
}

#[test]
fn the_largest_weights_and_ranges_draw_finite_gaussians_without_overflow() {
    let cloud = Cloud::surface(4);
    let mut networks = [Made::new((Heads::Best, 8), 32, [1, 1], 1)];
    for (_, values) in networks[0].tensors.values_mut() {
        for value in values {
            *value = if value.to_f32() < 0.3 { f16::MAX } else { f16::MIN };
        }
    }
    for range in [1e-6, 32_768.0] {
        let mut description = description(&networks);
        let ranges = description["sets"]["best.8"]["ranges"].as_object_mut().unwrap();
        ranges.values_mut().for_each(|value| *value = json!(range));
        let model = HeadsModel::from_bytes(&file(&networks, &description)).unwrap();
        for precision in [Precision::Int16, Precision::F16] {
            let expected = cloud.draw(&model, Isa::available()[0], precision, (Heads::Best, 8));
            let lengths = [&expected.position, &expected.scale, &expected.colour];
            assert!(
                lengths
                    .iter()
                    .all(|all| all.as_flattened().iter().all(|v| v.is_finite()))
            );
            assert!(expected.rotation.as_flattened().iter().all(|v| v.is_finite()));
            if precision == Precision::Int16 {
                for isa in Isa::available() {
                    assert!(cloud.draw(&model, isa, precision, (Heads::Best, 8)) == expected);
                }
            }
        }
    }
}
