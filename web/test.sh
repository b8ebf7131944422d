#!/usr/bin/env bash
# Builds the WebAssembly module and tests it: in Node, and as a page in a headless browser, which it installs on Debian as
# root. Says what it skips where Node, the target or the browser cannot be had.
#
#     web/test.sh [chromium|firefox]    chromium by default; firefox needs Node 20 or later
set -euo pipefail
cd "$(dirname "$0")/.."

browser=${1:-chromium}
case $browser in
    chromium) package=chromium ;;
    firefox) package=firefox-esr ;;
    *) echo "chromium or firefox, not $browser" >&2 && exit 2 ;;
esac

install() { # COMMAND PACKAGE
    command -v "$1" > /dev/null && return
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "$2"; } > /dev/null 2>&1
}

install node nodejs || { echo "skipped: Node cannot be had" && exit 0; }
web/build.sh || { echo "skipped: the target wasm32-wasip1 cannot be had" && exit 0; }
# The kernels, but for tests that end in a panic, which ends a module. Tests are barely optimised, and need more than the
# usual stack of 1 MiB.
CARGO_TARGET_WASM32_WASIP1_RUSTFLAGS="-C target-feature=+simd128,+bulk-memory -C link-arg=-zstack-size=8388608" \
    CARGO_TARGET_WASM32_WASIP1_RUNNER="node --no-warnings $PWD/tests/wasi.mjs" \
    cargo test --locked --target wasm32-wasip1 -p b2p-kernels --lib -- \
    --skip map:: --skip a_vector_is_not_loaded_from_fewer_values
command -v "$browser" > /dev/null || install "$package" "$package" || echo "skipped: the page; $browser cannot be had"
# Node 20 has sockets behind an option, and later ones anyway.
[ "$browser" = chromium ] || export NODE_OPTIONS=--experimental-websocket
B2P_BROWSER=$browser node --test web/tests/
