#!/usr/bin/env bash
# Splats there and back through splat-transform, a program by others, which it installs into target/. Needs Node 20 or
# later and the npm registry; without them it says so and skips.
set -euo pipefail
cd "$(dirname "$0")/.."

version=3.7.0
folder=target/splat-transform-$version
main=$folder/node_modules/@playcanvas/splat-transform/bin/cli.mjs

skip() { echo "skipped: $*"; exit 0; }

command -v node > /dev/null && command -v npm > /dev/null || skip "no Node here"
node -e 'process.exit(Number(parseInt(process.versions.node) < 20))' || skip "Node $(node --version) is older than 20"
if [ ! -e "$main" ]; then
    mkdir -p "$folder"
    # Scripts of packages are for GPUs, which nothing here uses.
    npm install --prefix "$folder" --silent --no-save --no-audit --no-fund --ignore-scripts \
        "@playcanvas/splat-transform@$version" || skip "npm could not have splat-transform $version"
fi
node "$main" --version > /dev/null || skip "splat-transform $version does not start"
# Of the whole workspace, so that nothing is compiled again with other features.
B2P_SPLAT_TRANSFORM=$PWD/$main cargo test --locked --workspace --test splat_transform -- --nocapture
