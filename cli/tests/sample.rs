//! The sample and the model that ship: what every user decodes first.

#[path = "../../tests/common/mod.rs"]
mod common;

use b2p::embedded::{self, SAMPLE};
use b2p::encoder::{Options, encode};
use b2p::gaussians::Gaussians;
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, render};
use b2p::{Isa, Limits};
use common::Ball;

fn model() -> Model {
    Model::from_bytes(embedded::model()).expect("the model inside the program loads")
}

fn decoded(model: &Model, level: u8) -> Gaussians {
    LatentDecoder::new(model)
        .decode(SAMPLE, Some(level), &Log::default())
        .expect("the sample inside the program decodes")
}

/// Every number of the Gaussians, as bits.
fn bits(g: &Gaussians) -> Vec<u32> {
    let numbers = g.position.as_flattened().iter();
    let numbers = numbers.chain(g.scale.as_flattened());
    let numbers = numbers.chain(g.rotation.as_flattened()).chain(&g.opacity);
    let numbers = numbers.chain(g.colour.as_flattened());
    numbers.map(|x| x.to_bits()).collect()
}

#[test]
fn the_higher_lambda_the_shorter_the_stream() {
    let (model, cloud) = (model(), Ball::new(7, 45.0).cloud());
    let length = |bit_price| {
        let options = Options {
            bit_price,
            ..Options::default()
        };
        let encoded = encode(&cloud, &model, &options, &Log::default());
        encoded.expect("the model encodes").bytes.len()
    };
    let lengths = [0.0, Options::default().bit_price, 4.0].map(length);
    assert!(lengths.is_sorted_by(|a, b| a > b), "{lengths:?}");
}

#[test]
fn the_sample_decodes_to_the_same_bits_with_every_instruction_set() {
    assert_eq!(model().precision(), Precision::Int16);
    let level = LatentDecoder::new(&model()).levels(SAMPLE).unwrap()[0];
    let best = bits(&decoded(&model(), level));
    for isa in Isa::available() {
        println!("ran on {isa}");
        let same = bits(&decoded(&model().with_isa(isa), level)) == best;
        assert!(same, "{isa} gives other Gaussians");
    }
}

#[test]
fn gaussians_generated_in_integers_draw_the_pictures_of_those_generated_in_floats() {
    let floats = model().with_precision(Precision::F16).unwrap();
    for level in LatentDecoder::new(&floats).levels(SAMPLE).unwrap() {
        let camera = Camera::orbit(30.0, 10.0, 3.0, 45.0, 512, 512).unwrap();
        let [a, b] = [&model(), &floats].map(|model| {
            let g = decoded(model, level);
            let (image, _) = render(&g, &camera, Background::WHITE, &Limits::default()).unwrap();
            image
        });
        let errors = a.pixels.as_flattened().iter().zip(b.pixels.as_flattened());
        let squares: f64 = errors.map(|(a, b)| f64::from(a - b).powi(2)).sum();
        // A quarter of the numbers is alpha, which is 1 in both.
        let mse = squares / (a.pixels.len() * 3) as f64;
        let psnr = -10.0 * mse.log10();
        println!("level {level}: {psnr:.1} dB");
        assert!(psnr > 55.0, "level {level}: {psnr:.1} dB");
    }
}

#[test]
fn all_heads_draw_the_scene_and_give_the_same_bits_with_every_instruction_set() {
    use b2p::{Decoder, HeadSet, HeadsModel};

    let heads = HeadsModel::from_bytes(b2p::embedded::HEADS).unwrap();
    for set in [HeadSet::Best, HeadSet::Quick, HeadSet::Surfels] {
        let draw = |isa| {
            let decoder = Decoder::new().with_heads_model(heads.clone());
            let decoder = decoder.with_heads(set).with_isa(isa);
            decoder.with_level(7).decode(b2p::embedded::SCENE).unwrap()
        };
        let gaussians = draw(b2p::Isa::detect());
        gaussians.check_lengths().unwrap();
        assert!(gaussians.len() > 10_000, "{set:?}");
        for isa in b2p::Isa::available() {
            assert!(draw(isa) == gaussians, "{set:?} on {isa}");
        }
    }
}
