#!/usr/bin/env bash
# Builds web/b2p.wasm: the C interface for WebAssembly with SIMD. Needs rustup, which adds the target.
#
# It is that of packages, unless B2P_PROFILE names a profile that takes less time to build.
#
#     web/build.sh && python3 -m http.server -d web     then open http://localhost:8000/?src=STREAM.b2p
set -euo pipefail
cd "$(dirname "$0")/.."
rustup target list --installed | grep -qx wasm32-wasip1 || rustup target add wasm32-wasip1
export CARGO_TARGET_WASM32_WASIP1_RUSTFLAGS="-C target-feature=+simd128,+bulk-memory"
profile=${B2P_PROFILE:-dist}
cargo build --locked --profile "$profile" -p b2p-capi --features page --target wasm32-wasip1
cp "${CARGO_TARGET_DIR:-target}/wasm32-wasip1/$profile/b2p_c.wasm" web/b2p.wasm
printf 'web/b2p.wasm: %s bytes, %s compressed\n' "$(stat -c %s web/b2p.wasm)" "$(gzip -9 -c web/b2p.wasm | wc -c)"
