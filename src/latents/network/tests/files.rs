//! Model files that are not what they should be.

use std::collections::HashMap;

use b2p_kernels::f16;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use super::super::generate::Generator;
use super::super::{Model, Shape, untrained};
use crate::error::{Error, Result};
use crate::gaussians::Heads;
use crate::layers::Precision;

/// A model file that can be altered.
struct File {
    json: String,
    tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)>,
}

impl File {
    fn tiny() -> Self {
        File::of(&Shape::tiny())
    }

    /// With quick heads as well.
    fn both() -> Self {
        File::of(&Shape::tiny().with_quick_heads())
    }

    fn of(shape: &Shape) -> Self {
        let bytes = untrained(shape, 1);
        let (_, metadata) = SafeTensors::read_metadata(&bytes).unwrap();
        let json = metadata.metadata().as_ref().unwrap()["b2p"].clone();
        let view = SafeTensors::deserialize(&bytes).unwrap();
        let tensors = view
            .iter()
            .map(|(name, t)| (name.to_owned(), t.dtype(), t.shape().to_vec(), t.data().to_vec()))
            .collect();
        File { json, tensors }
    }

    fn without(mut self, prefix: &str) -> Self {
        self.tensors.retain(|(name, ..)| !name.starts_with(prefix));
        self
    }

    fn with(mut self, name: &str, dtype: Dtype, extents: &[usize], bytes: &[u8]) -> Self {
        self.tensors.retain(|(other, ..)| other != name);
        self.tensors
            .push((name.to_owned(), dtype, extents.to_vec(), bytes.to_vec()));
        self
    }

    /// Overwrites an entry.
    fn poke(mut self, name: &str, at: usize, entry: &[u8]) -> Self {
        let (.., bytes) = self.tensors.iter_mut().find(|(other, ..)| other == name).unwrap();
        bytes[at * entry.len()..][..entry.len()].copy_from_slice(entry);
        self
    }

    fn bytes(&self) -> Vec<u8> {
        let views = self
            .tensors
            .iter()
            .map(|(name, dtype, extents, bytes)| (name, TensorView::new(*dtype, extents.clone(), bytes).unwrap()));
        safetensors::serialize(views, Some(HashMap::from([("b2p".to_owned(), self.json.clone())]))).unwrap()
    }

    fn load(&self) -> Result<Model> {
        Model::from_bytes(&self.bytes())
    }
}

#[test]
fn an_error_names_the_tensor_at_fault() {
    let nan = f32::NAN.to_le_bytes();
    let cases = [
        ("pem.2.mu.bias", File::tiny().without("pem.2.mu.bias")),
        ("fr.0.lin1.weight", File::tiny().without("fr.0.")),
        ("g_scale", File::tiny().without("g_scale")),
        ("fc.3.conv_in.weight", File::tiny().without("fc.3.")),
        ("cdf.gauss", File::tiny().without("cdf.")),
        (
            "up.1.weight",
            File::tiny().with("up.1.weight", Dtype::F16, &[8, 8, 8], &[0; 1024]),
        ),
        (
            "up.1.weight",
            File::tiny().with("up.1.weight", Dtype::I16, &[8, 8, 4], &[0; 512]),
        ),
        ("up.1.weight", File::tiny().with("up.1.weight", Dtype::I16, &[0], &[])),
        ("up.1.shift", File::tiny().poke("up.1.shift", 3, &[31])),
        (
            "fr.1.lin2.weight",
            File::tiny().poke("fr.1.lin2.weight", 5, &512i16.to_le_bytes()),
        ),
        (
            "fr.1.lin2.weight",
            File::tiny().poke("fr.1.lin2.weight", 5, &i16::MIN.to_le_bytes()),
        ),
        (
            "fr.1.lin2.weight",
            File::tiny().poke("fr.1.lin2.bias", 5, &i32::MAX.to_le_bytes()),
        ),
        (
            "fr.1.lin2.weight",
            File::tiny().poke("fr.1.lin2.bias", 5, &i32::MIN.to_le_bytes()),
        ),
        ("pem.1.conv_in.gain", File::tiny().poke("pem.1.conv_in.gain", 0, &nan)),
        (
            "pem.1.conv_in.bias",
            File::tiny().poke("pem.1.conv_in.bias", 7, &f32::INFINITY.to_le_bytes()),
        ),
        (
            "gg.1.conv_out.gain",
            File::tiny().poke("gg.1.conv_out.gain", 1, &1e9f32.to_le_bytes()),
        ),
        (
            "gg.2.layer4.weight",
            File::tiny().poke("gg.2.layer4.weight", 9, &f16::INFINITY.to_le_bytes()),
        ),
        ("fs.0.lin2.bias", File::tiny().poke("fs.0.lin2.bias", 0, &nan)),
        ("g_scale", File::tiny().poke("g_scale", 0, &0f32.to_le_bytes())),
        ("c_scale", File::tiny().poke("c_scale", 2, &(-1f32).to_le_bytes())),
        ("cdf.gauss", File::tiny().poke("cdf.gauss", 0, &u16::MAX.to_le_bytes())),
        ("gg.quick.1.conv_in.weight", File::both().without("gg.quick.1.conv_in.")),
        ("gg.2.conv_in.weight", File::both().without("gg.2.")),
        (
            "gg.quick.2.after.0.c1.weight",
            File::both().poke("gg.quick.2.after.0.c1.weight", 3, &f16::NAN.to_le_bytes()),
        ),
        (
            "gg.quick.1.scale",
            File::both().with("gg.quick.1.scale", Dtype::F32, &[1], &[0; 4]),
        ),
        (
            "cdf.prior",
            File::tiny().with("cdf.prior.offset", Dtype::U32, &[1], &[0; 4]),
        ),
    ];
    for (name, file) in cases {
        let error = file.load().err().unwrap_or_else(|| panic!("{name} should not load"));
        assert!(matches!(error, Error::Malformed { .. }), "{name}: {error}");
        assert!(error.to_string().contains(name), "{name}: {error}");
    }
}

#[test]
fn weights_that_could_overflow_a_sum_are_refused_though_each_is_small() {
    // 27 taps of 128 channels at the largest weight reach 2^31.7.
    let shape = Shape {
        channels: 128,
        ..Shape::tiny()
    };
    let bytes = untrained(&shape, 1);
    assert!(Model::from_bytes(&bytes).is_ok());
    let view = SafeTensors::deserialize(&bytes).unwrap();
    let tensors = view
        .iter()
        .map(|(name, t)| {
            let mut data = t.data().to_vec();
            if name == "pem.1.conv_in.weight" {
                data = 511i16.to_le_bytes().repeat(data.len() / 2);
            }
            (name.to_owned(), t.dtype(), t.shape().to_vec(), data)
        })
        .collect();
    let error = File {
        json: shape.to_json(),
        tensors,
    }
    .load()
    .err()
    .unwrap()
    .to_string();
    assert!(error.contains("pem.1.conv_in") && error.contains("2^31"), "{error}");
}

#[test]
fn a_model_for_another_number_of_latents_than_its_tables_is_refused() {
    let mut file = File::tiny();
    file.json = Shape {
        latents: 5,
        ..Shape::tiny()
    }
    .to_json();
    let error = file.load().err().unwrap().to_string();
    assert!(error.contains("cdf.prior"), "{error}");
}

#[test]
fn a_model_whose_layers_read_latents_that_its_description_has_not_is_refused() {
    let shape = Shape {
        latent_roles: 2,
        near_channels: [8, 0],
        ..Shape::tiny()
    };
    let mut file = File::tiny();
    file.json = shape.to_json();
    let error = file.load().err().unwrap().to_string();
    assert!(error.contains("fr.2.lin1"), "{error}");
    assert!(Model::from_bytes(&untrained(&shape, 1)).is_ok());
}

#[test]
fn a_file_without_the_encoder_decodes_and_says_that_it_cannot_encode() {
    let model = File::tiny().without("fc.").without("fs.").load().unwrap();
    assert!(!model.can_encode());
    let error = model.squeeze(0, &[], None).unwrap_err();
    assert!(
        matches!(error, Error::Unsupported { .. }) && error.to_string().contains("encoding"),
        "{error}"
    );
    assert_eq!(model.id(), File::tiny().load().unwrap().id());
}

#[test]
fn a_role_without_a_generator_is_an_error_that_names_those_that_have_one() {
    let model = File::tiny().load().unwrap();
    let map = crate::geometry::KernelMap::root();
    let error = model.generate(0, &[0; 8], &map).unwrap_err();
    assert!(
        matches!(error, Error::Unsupported { .. }) && error.to_string().contains("1 and 2"),
        "{error}"
    );
}

#[test]
fn quick_heads_that_a_model_has_not_are_an_error_that_says_so() {
    let (one, both) = (File::tiny().load().unwrap(), File::both().load().unwrap());
    let map = crate::geometry::KernelMap::root();
    let error = one.generate_with(Heads::Quick, 1, &[0; 8], &map);
    let error = error.unwrap_err();
    assert!(
        matches!(error, Error::Unsupported { .. }) && error.to_string().contains("no quick heads"),
        "{error}"
    );
    let best = one.generate(1, &[9; 8], &map).unwrap();
    assert_eq!(both.generate(1, &[9; 8], &map).unwrap(), best);
    let quick = both.generate_with(Heads::Quick, 1, &[9; 8], &map).unwrap();
    assert!(quick.len() == best.len() && quick != best);
    assert_eq!(both.shape().heads(), Heads::ALL);
}

#[test]
fn heads_that_cannot_run_in_integers_make_the_whole_model_run_in_floats() {
    let model = File::both().without("gg.quick.2.scale").load().unwrap();
    assert_eq!(model.precision(), Precision::F16);
    let error = model.with_precision(Precision::Int16).err().unwrap();
    assert!(error.to_string().contains("gg.quick.2.scale"), "{error}");
}

#[test]
fn only_the_heads_that_are_used_are_got_ready() {
    let model = File::both().load().unwrap();
    let map = crate::geometry::KernelMap::root();
    let ready = || -> Vec<bool> { model.generators.iter().map(Generator::is_ready).collect() };
    assert_eq!(ready(), [false; 4]);
    model.generate_with(Heads::Quick, 2, &[9; 8], &map).unwrap();
    assert_eq!(ready(), [false, false, false, true]);
}

#[test]
fn the_id_changes_with_whatever_bears_on_the_decoded_bits_and_nothing_else() {
    let id = |file: File| file.load().unwrap().id();
    let plain = id(File::tiny());
    assert_eq!(plain, id(File::tiny()));
    let mut described = File::tiny();
    described.json = Shape {
        name: "another".into(),
        lambda: Some(9.0),
        scale_bias: 0.0,
        ..Shape::tiny()
    }
    .to_json();
    let alike = [
        File::tiny().poke("gg.1.conv_out.bias", 0, &0.5f32.to_le_bytes()),
        File::tiny().poke("fc.0.conv_in.bias", 0, &0.5f32.to_le_bytes()),
        described,
        File::both(),
        File::both().poke("gg.quick.1.conv_out.bias", 0, &0.5f32.to_le_bytes()),
    ];
    for file in alike {
        assert_eq!(plain, id(file));
    }
    let mut altered = File::tiny();
    altered.json = Shape {
        inception_relu: false,
        ..Shape::tiny()
    }
    .to_json();
    let different = [
        File::tiny().poke("pem.1.mu.weight", 3, &5i16.to_le_bytes()),
        File::tiny().poke("up.2.bias", 3, &5i32.to_le_bytes()),
        File::tiny().poke("near.2.lin1.weight", 3, &5i16.to_le_bytes()),
        File::tiny().poke("fr.0.lin1.shift", 0, &[3]),
        File::tiny().poke("pem.1.conv_in.gain", 0, &0.5f32.to_le_bytes()),
        altered,
    ];
    for file in different {
        assert_ne!(plain, id(file));
    }
}

#[test]
fn no_beginning_of_a_file_loads() {
    let bytes = untrained(&Shape::tiny(), 1);
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    for length in (0..header).step_by(13).chain((header..bytes.len()).step_by(997)) {
        assert!(
            matches!(Model::from_bytes(&bytes[..length]), Err(Error::Malformed { .. })),
            "{length} bytes"
        );
    }
}

#[test]
fn no_altered_byte_of_the_header_makes_loading_panic() {
    let bytes = untrained(&Shape::tiny(), 1);
    let header = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut refused = 0;
    for at in (0..header).step_by(7) {
        for value in [0, b'9', b'"', 0xff] {
            let mut altered = bytes.clone();
            altered[at] = value;
            refused += usize::from(Model::from_bytes(&altered).is_err());
        }
    }
    assert!(refused > header / 7, "most alterations are noticed");
}

#[test]
fn a_model_is_the_same_from_a_file_and_from_memory() {
    let bytes = untrained(&Shape::tiny(), 1);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    std::fs::write(&path, &bytes).unwrap();
    assert_eq!(
        Model::open(&path).unwrap().id(),
        Model::from_bytes(&bytes).unwrap().id()
    );
    let error = Model::open(&folder.path().join("none")).err().unwrap();
    assert!(matches!(error, Error::Io { .. }), "{error}");
    std::fs::write(&path, b"").unwrap();
    assert!(matches!(Model::open(&path), Err(Error::Malformed { .. })));
}

#[test]
fn lambda_is_given_by_the_model_and_changes_nothing_of_its_streams() {
    let plain = File::tiny();
    let id = Model::from_bytes(&plain.bytes()).unwrap().id();
    let saying = |price: &str| {
        let mut file = File::tiny();
        file.json = file.json.replacen('{', &format!("{{\"bit_price\": {price}, "), 1);
        Model::from_bytes(&file.bytes())
    };
    let k = Model::from_bytes(&plain.bytes()).unwrap().shape().latents;
    let of_roles = |model: &Model| [0, 1, 2].map(|role| model.bit_prices(role).to_vec());
    let of = |price: f32| [0, 1, 2].map(|_| vec![price; k]);
    assert_eq!(of_roles(&Model::from_bytes(&plain.bytes()).unwrap()), of(0.0));
    for (said, price) in [("0.25", 0.25), ("100", 100.0)] {
        let model = saying(said).unwrap();
        assert_eq!((model.id(), of_roles(&model)), (id, of(price)));
    }
    let each: [Vec<f32>; 3] = [0, 1, 2].map(|role| (0..k).map(|c| (role * k + c) as f32).collect());
    let model = saying(&format!("{each:?}")).unwrap();
    assert_eq!((model.id(), of_roles(&model)), (id, each.clone()));
    let two_roles = format!("{:?}", &each[..2]);
    let too_many = format!("{:?}", each.clone().map(|role| [role, vec![1.0]].concat()));
    let too_large = format!("{:?}", of(101.0));
    let said = ["-1", "101", "\"much\"", "null", "[]", &two_roles, &too_many, &too_large];
    for wrong in said {
        let error = saying(wrong).expect_err("it is wrong");
        let text = error.to_string();
        assert!(matches!(error, Error::Malformed { .. }), "{text}");
        assert!(text.contains("bit_price") && text.contains("0 to 100"), "{text}");
    }
}
