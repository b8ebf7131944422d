#!/usr/bin/env bash
# Mutation testing: cargo-mutants changes one place at a time in the container's parsers, the limits, the memory bounds and
# the entropy coders, and the tests must notice. Installs cargo-mutants into target/tools.
#
#     tests/mutants.sh [K/N]      share K of N of the mutants (0/16); a mutant takes about a minute on two cores
#
# What the unit tests leave is tried with all tests of the library. What these leave is listed at the end.
set -euo pipefail
cd "$(dirname "$0")/.."

tools=$PWD/target/tools
out=$PWD/target/mutants
[ -x "$tools/bin/cargo-mutants" ] || cargo install cargo-mutants --version 27.1.0 --locked --root "$tools"
export PATH="$tools/bin:$PATH" CARGO_PROFILE_DEV_DEBUG=0
rm -rf "$out"
mkdir -p "$out"

mutants() {
    cargo mutants -p b2p -f 'src/container/**' -f 'src/coding/**' -f src/limits.rs -f src/memory.rs -f src/decoder/memory.rs \
        --shard "$share" --sharding round-robin --gitignore true --minimum-test-timeout 60 -o "$out" "$@"
}

share=${1:-0/16}
# 2 and 3: some were missed, or took too long.
mutants -- --lib -- container:: limits:: memory:: coding:: decoder:: input:: scene:: sequence:: geometry::codec colour:: ||
    [ $? -le 3 ]
mutants --iterate -- --tests || [ $? -le 3 ]
for kind in caught missed timeout unviable; do
    echo "$kind: $(cat "$out"/mutants.out*/$kind.txt 2> /dev/null | sort -u | wc -l)"
done
cat "$out/mutants.out/missed.txt" 2> /dev/null || true
