#!/usr/bin/env bash
# Builds the WebAssembly module and tests it: in Node, and as a page in a headless Chromium, which it installs on Debian as
# root. Says what it skips where Node, the target or Chromium cannot be had.
set -euo pipefail
cd "$(dirname "$0")/.."

install() { # COMMAND PACKAGE
    command -v "$1" > /dev/null && return
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "$2"; } > /dev/null 2>&1
}

install node nodejs || { echo "skipped: Node cannot be had" && exit 0; }
web/build.sh || { echo "skipped: the target wasm32-wasip1 cannot be had" && exit 0; }
# The kernels, but for tests that end in a panic, which ends a module.
CARGO_TARGET_WASM32_WASIP1_RUSTFLAGS="-C target-feature=+simd128,+bulk-memory" \
    CARGO_TARGET_WASM32_WASIP1_RUNNER="node --no-warnings $PWD/tests/wasi.mjs" \
    cargo test --locked --target wasm32-wasip1 -p b2p-kernels --lib -- \
    --skip map:: --skip a_vector_is_not_loaded_from_fewer_values
install chromium chromium || echo "skipped: the page; Chromium cannot be had"
node --test web/tests/
