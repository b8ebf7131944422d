#!/usr/bin/env bash
# Runs tests where undefined behaviour, accesses out of bounds and data races are errors.
#
#     tests/sanitizers.sh [miri|address|thread …]    all by default
#
# miri     The kernels' unit tests in Miri, an interpreter that checks every access: the plain kernels, and those of
#          AVX2 as far as Miri knows its instructions.
# address  The tests of the kernels, and the library's units, hostile input, conformance and scenes, with AddressSanitizer.
# thread   The same with ThreadSanitizer, which needs a standard library that is built with it.
#
# It needs a nightly toolchain, and installs the components that are missing (miri, rust-src).
set -euo pipefail
cd "$(dirname "$0")/.."

target=x86_64-unknown-linux-gnu
[ $# -gt 0 ] || set -- miri address thread

component() { rustup component list --toolchain nightly --installed | grep -q "^$1" || rustup component add --toolchain nightly "$1"; }

# Runs the suite, built with a sanitizer: $1 its name, $2 further options of the build.
suite() {
    export RUSTFLAGS="-Zsanitizer=$1" RUSTDOCFLAGS="-Zsanitizer=$1" CARGO_TARGET_DIR=target/sanitizers/$1
    # shellcheck disable=SC2086
    cargo +nightly test --locked --target $target $2 -p b2p-kernels
    # shellcheck disable=SC2086
    cargo +nightly test --locked --target $target $2 -p b2p --lib --test hostile --test conformance --test scenes
}

for kind; do
    echo "== $kind"
    case $kind in
        miri)
            component miri
            # Files are read, and instruction sets asked for, outside of what Miri isolates.
            export MIRIFLAGS=-Zmiri-disable-isolation CARGO_TARGET_DIR=target/sanitizers/miri
            cargo +nightly miri test --locked -p b2p-kernels --lib
            RUSTFLAGS="-C target-feature=+avx2,+fma,+f16c" cargo +nightly miri test --locked -p b2p-kernels --lib
            ;;
        address) (suite address "") ;;
        thread)
            component rust-src
            (suite thread -Zbuild-std)
            ;;
        *)
            echo "miri, address or thread, not $kind" >&2
            exit 2
            ;;
    esac
done
