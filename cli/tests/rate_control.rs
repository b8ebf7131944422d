//! Streams of at most so many bits.

#[path = "../../tests/common/mod.rs"]
mod common;

use b2p::Error;
use b2p::cloud::ColouredVoxels;
use b2p::encoder::{Encoded, Options, Residual, encode, encode_to_rate};
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::log::Log;
use common::{Ball, cloud_of, tiny_model};

/// The model inside the program: others that tests have do not give λ.
fn model() -> Model {
    Model::from_bytes(b2p::embedded::model()).expect("the model inside the program loads")
}

fn encode_to(bits: f64, cloud: &ColouredVoxels, model: &Model, options: &Options) -> Result<(Encoded, Options), Error> {
    encode_to_rate(cloud, model, options, bits, &Log::default())
}

fn bits_of(encoded: &Encoded, cloud: &ColouredVoxels) -> f64 {
    encoded.bytes.len() as f64 * 8.0 / cloud.voxels.len() as f64
}

/// How far along the path from few bits to many: whether there is a residual, and a fine one; less, λ, and the step.
fn place(chosen: &Options) -> (u8, f32, i16) {
    match chosen.residual {
        Residual::None => (0, -chosen.bit_price, 0),
        Residual::Coarse => (1, -chosen.bit_price, 0),
        Residual::Fine(steps) => (2, -chosen.bit_price, -i16::from(steps.luma)),
    }
}

#[test]
fn streams_take_no_more_than_was_asked_for_and_nearly_all_of_it_and_more_room_is_never_to_the_worse() {
    let (model, cloud) = (model(), Ball::new(6, 25.0).cloud());
    let coded = |options: &Options| {
        let coded = encode(&cloud, &model, options, &Log::default());
        coded.unwrap()
    };
    let usual = bits_of(&coded(&Options::default()), &cloud);
    let mut last: Option<Options> = None;
    for asked in [0.93, 0.97, 1.0, 1.3, 2.0, 3.0] {
        let asked = asked * usual;
        let (encoded, chosen) = encode_to(asked, &cloud, &model, &Options::default()).unwrap();
        let bits = bits_of(&encoded, &cloud);
        assert!(bits <= asked, "{bits} of {asked}: {chosen:?}");
        assert!(bits >= 0.85 * asked, "{bits} of {asked}: {chosen:?}");
        assert!(
            encoded.bytes == coded(&chosen).bytes,
            "as with the options that it says"
        );
        if let Some(last) = last {
            let (before, now) = (place(&last), place(&chosen));
            assert!(now >= before, "{before:?} then {now:?}");
        }
        let decoded = LatentDecoder::new(&model).decode(&encoded.bytes, None, &Log::default());
        assert!(!decoded.unwrap().is_empty());
        last = Some(chosen);
    }
    assert!(last.is_some_and(|last| place(&last).0 == 2));
}

#[test]
fn fewer_bits_than_can_be_are_refused_and_the_least_that_is_named_can_be_had() {
    let (model, cloud) = (model(), Ball::new(6, 20.0).cloud());
    let usual = Options::default();
    let error = encode_to(0.001, &cloud, &model, &usual).unwrap_err();
    let Error::TooFewBits { asked, least } = error else {
        panic!("{error}");
    };
    assert_eq!(asked, 0.001);
    let (encoded, chosen) = encode_to(least, &cloud, &model, &usual).unwrap();
    assert_eq!(bits_of(&encoded, &cloud), least);
    assert!(chosen.bit_price >= 1.0);
    let said = |least: f64| Error::TooFewBits { asked, least }.to_string();
    assert!(said(0.12341).ends_with(" 0.1235"), "rounded up: {}", said(0.12341));
}

#[test]
fn with_more_room_than_can_be_used_the_finest_comes_out() {
    let model = Model::from_bytes(&tiny_model(0)).unwrap();
    let one_bit = cloud_of(1, vec![0, 7]);
    for cloud in [Ball::new(5, 10.0).cloud(), one_bit] {
        let (encoded, chosen) = encode_to(1e6, &cloud, &model, &Options::default()).unwrap();
        assert_eq!(place(&chosen), (2, -1.0, -1));
        let finest = encode(&cloud, &model, &chosen, &Log::default());
        assert!(encoded.bytes == finest.unwrap().bytes);
    }
}

#[test]
fn what_else_was_chosen_stays_chosen() {
    let (model, cloud) = (model(), Ball::new(6, 20.0).cloud());
    let options = Options {
        levels: Some(3..=4),
        filter: false,
        slice_voxels: 200,
        bit_price: 0.0,
        residual: Residual::Coarse,
        every_level: true,
    };
    let mut fine = 0;
    for asked in [2.0, 6.0] {
        let (encoded, chosen) = encode_to(asked, &cloud, &model, &options).unwrap();
        assert!(bits_of(&encoded, &cloud) <= asked);
        let others = Options {
            bit_price: 0.0,
            residual: Residual::Coarse,
            ..chosen.clone()
        };
        assert_eq!(format!("{others:?}"), format!("{options:?}"));
        assert_ne!(chosen.residual, Residual::Coarse, "that goes with filters");
        let again = encode(&cloud, &model, &chosen, &Log::default());
        assert!(encoded.bytes == again.unwrap().bytes);
        fine += usize::from(matches!(chosen.residual, Residual::Fine(_)));
    }
    assert!(fine > 0);
}

#[test]
fn the_same_is_chosen_with_any_number_of_threads() {
    let (model, cloud) = (model(), Ball::new(6, 25.0).cloud());
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let code = || encode_to(4.0, &cloud, &model, &Options::default());
        pool.build().unwrap().install(code).unwrap().0.bytes
    };
    assert!(run(1) == run(3));
}

#[test]
fn bits_that_are_no_number_above_0_are_refused() {
    let (model, cloud) = (model(), Ball::new(4, 4.5).cloud());
    for asked in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = encode_to(asked, &cloud, &model, &Options::default()).unwrap_err();
        assert!(matches!(error, Error::Usage(_)), "{asked}: {error}");
    }
}

#[test]
fn each_try_is_reported_as_it_begins_and_there_are_at_most_seven() {
    let (model, cloud) = (model(), Ball::new(5, 10.0).cloud());
    let (sender, heard) = std::sync::mpsc::channel();
    let log = Log::with_listener(move |step| sender.send(step.to_owned()).unwrap());
    encode_to_rate(&cloud, &model, &Options::default(), 8.0, &log).unwrap();
    let heard: Vec<String> = heard.try_iter().collect();
    let tries: Vec<_> = heard.iter().filter(|step| step.starts_with("try ")).collect();
    assert!((1..=7).contains(&tries.len()), "{heard:?}");
    for (i, step) in (1..).zip(tries) {
        assert!(step.starts_with(&format!("try {i} of 7: λ scale ")), "{step}");
    }
}
