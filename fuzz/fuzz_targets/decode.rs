//! Any bytes as a stream, under small limits and with a small model: an error, or as many finite Gaussians as the header tells.
#![no_main]

use std::sync::LazyLock;

use b2p::Limits;
use b2p::decoder::Decoder;
use b2p::log::Log;
use b2p::network::{Model, Shape, untrained};
use libfuzzer_sys::fuzz_target;

static MODEL: LazyLock<Model> = LazyLock::new(|| {
    Model::from_bytes(&untrained(&Shape::tiny(), 0)).expect("an untrained model loads")
});

fuzz_target!(|bytes: &[u8]| {
    let limits = Limits {
        max_points: 1 << 12,
        max_bytes: 64 << 20,
        ..Limits::default()
    };
    let decoder = Decoder::new(&MODEL).with_limits(limits);
    if let Ok(gaussians) = decoder.decode(bytes, None, &mut Log::default()) {
        assert!(gaussians.len() <= 8 << 12);
        assert!(gaussians.position.iter().flatten().all(|v| v.is_finite()));
    }
});
