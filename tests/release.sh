#!/usr/bin/env bash
# Builds the optimised program, which must be small enough, runs its demo, and decodes the conformance suite to the same
# bytes as the program of the tests, whose arithmetic is checked for overflow.
#
#     tests/release.sh [RELEASED [TESTED]]    programs to compare, which are not built then
set -euo pipefail
cd "$(dirname "$0")/.."

target=${CARGO_TARGET_DIR:-target}
released=${1:-$target/release/b2p}
tested=${2:-$target/debug/b2p}
most_bytes=21000000
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

[ $# -ge 1 ] || cargo build --locked --release -p b2p-cli
[ $# -ge 2 ] || cargo build --locked -p b2p-cli

size=$(stat -c %s "$released")
echo "$released: $size bytes, at most $most_bytes are allowed"
[ "$size" -le $most_bytes ]
"$released" -q demo -o "$out/demo"

count=0
same() { # STREAM ARGUMENT …
    local stream=$1
    shift
    "$released" -q --force decode "$stream" -o "$out/released.ply" "$@"
    "$tested" -q --force decode "$stream" -o "$out/tested.ply" "$@"
    cmp "$out/released.ply" "$out/tested.ply"
    count=$((count + 1))
}

suite=tests/data/conformance
for heads in best quick surfels; do
    for stream in "$suite"/version-3/*.b2p "$suite"/scenes/*.b2p models/scene.b2p; do
        same "$stream" --heads $heads
    done
    for stream in "$suite"/sequences/*.b2p; do
        # Learned heads draw no single voxel.
        [ $heads = surfels ] || [[ $stream != */root-alone.b2p ]] || continue
        # The second one is predicted from the first.
        for frame in 0 1; do
            same "$stream" --heads $heads --frame $frame
        done
    done
done
echo "$count decodings, the same to the bit"
