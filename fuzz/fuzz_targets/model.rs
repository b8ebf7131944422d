//! Any bytes as a model: an error, or a model whose identity depends on nothing but the bytes.
#![no_main]

use b2p::network::Model;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(model) = Model::from_bytes(bytes) {
        let again = Model::from_bytes(bytes).expect("what loaded once loads again");
        assert_eq!(model.id(), again.id());
    }
});
