#!/usr/bin/env bash
# Runs tests where undefined behaviour, accesses out of bounds and data races are errors.
#
#     tests/sanitizers.sh [miri|address|thread …]    all by default
#
# miri     Few units of the kernels in Miri, an interpreter that checks every access: conversions and pairs of weights, in
#          plain code. It is too slow for the others, and knows no large pages and no mapped files.
# address  The tests of the kernels, and the library's units, hostile input, conformance and scenes, with AddressSanitizer.
# thread   The tests of the kernels and the library's units with ThreadSanitizer, and a standard library built with it.
#
# It needs a nightly toolchain, and installs the components that are missing (miri, rust-src).
set -euo pipefail
cd "$(dirname "$0")/.."

target=x86_64-unknown-linux-gnu
[ $# -gt 0 ] || set -- miri address thread

component() { rustup component list --toolchain nightly --installed | grep -q "^$1" || rustup component add --toolchain nightly "$1"; }

# Runs tests that are built with a sanitizer: its name, then options of the build and tests of the library.
suite() {
    export RUSTFLAGS="-Zsanitizer=$1" CARGO_TARGET_DIR=target/sanitizers/$1
    cargo +nightly test --locked --target $target "${@:2:1}" -p b2p-kernels --lib --tests
    cargo +nightly test --locked --target $target "${@:2:1}" -p b2p --lib "${@:3}"
}

for kind; do
    echo "== $kind"
    case $kind in
        miri)
            component miri
            # Files are read outside of what Miri isolates.
            export MIRIFLAGS=-Zmiri-disable-isolation CARGO_TARGET_DIR=target/sanitizers/miri
            cargo +nightly miri test --locked -p b2p-kernels --lib -- convert pairing map::
            ;;
        address) (suite address --no-fail-fast --test hostile --test conformance --test scenes) ;;
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
