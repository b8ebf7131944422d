//! Links the program.

use std::env::var;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let optimised = var("PROFILE").as_deref() == Ok("release");
    // Rust's own linker, the default for this target alone, keeps functions of the same code once.
    if optimised && var("TARGET").as_deref() == Ok("x86_64-unknown-linux-gnu") {
        println!("cargo::rustc-link-arg-bins=-Wl,--icf=all");
    }
}
