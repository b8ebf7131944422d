//! The header is what cbindgen makes of the source.

use std::path::Path;

/// With `B2P_WRITE_HEADER` set, the header is written instead.
#[test]
fn the_header_is_the_source_s() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_file(here.join("cbindgen.toml")).expect("a configuration");
    let sources = ["boundary", "model", "decoding", "parts", "points", "picture"];
    let mut builder = cbindgen::Builder::new().with_config(config);
    for source in sources {
        builder = builder.with_src(here.join(format!("src/{source}.rs")));
    }
    let mut made = Vec::new();
    builder.generate().expect("bindings").write(&mut made);
    let path = here.join("include/b2p.h");
    if std::env::var_os("B2P_WRITE_HEADER").is_some() {
        std::fs::write(&path, &made).expect("written");
    }
    let made = String::from_utf8(made).expect("text");
    let there = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(
        there == made,
        "the header is not the source's: run B2P_WRITE_HEADER=1 cargo test -p b2p-capi --test header"
    );
}
