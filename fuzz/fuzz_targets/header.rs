//! Any bytes: an error, or a header that is written back as it was read.
#![no_main]

use b2p::Limits;
use b2p::bitstream::Header;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(header) = Header::parse(bytes, &Limits::default()) {
        let written = header.write();
        assert_eq!(
            written,
            bytes[..written.len()],
            "the header changed on its way"
        );
    }
});
