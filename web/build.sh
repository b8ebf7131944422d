#!/usr/bin/env bash
# Builds the C interface for WebAssembly with SIMD: web/b2p.wasm, and web/b2p-threads.wasm with threads, for pages that are
# isolated from other origins. Needs rustup, which adds the targets; without the second one it says what it skips.
#
# They are those of packages, unless B2P_PROFILE names a profile that takes less time to build.
#
#     web/build.sh && cargo run --release -- serve FOLDER
set -euo pipefail
cd "$(dirname "$0")/.."
profile=${B2P_PROFILE:-dist}
features="-C target-feature=+simd128,+bulk-memory"

target() { # TARGET
    rustup target list --installed | grep -qx "$1" || rustup target add "$1"
}

build() { # TARGET MODULE
    cargo build --locked --profile "$profile" -p b2p-capi --features page --target "$1"
    cp "${CARGO_TARGET_DIR:-target}/$1/$profile/b2p_c.wasm" "web/$2"
    printf 'web/%s: %s bytes, %s compressed\n' "$2" "$(stat -c %s "web/$2")" "$(gzip -9 -c "web/$2" | wc -c)"
}

target wasm32-wasip1
CARGO_TARGET_WASM32_WASIP1_RUSTFLAGS=$features build wasm32-wasip1 b2p.wasm

target wasm32-wasip1-threads || {
    rm -f web/b2p-threads.wasm
    echo "skipped: web/b2p-threads.wasm; the target wasm32-wasip1-threads cannot be had"
    exit 0
}
# `_initialize` sets up the first thread. The memory is that of web/src/threads.js.
start=$(rustc --print sysroot)/lib/rustlib/wasm32-wasip1-threads/lib/self-contained/crt1-reactor.o
memory="-C link-arg=--initial-memory=1073741824 -C link-arg=--max-memory=4294967296"
export CARGO_TARGET_WASM32_WASIP1_THREADS_RUSTFLAGS="$features -C link-arg=$start -C link-arg=--export=_initialize $memory"
build wasm32-wasip1-threads b2p-threads.wasm
