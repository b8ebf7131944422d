#!/usr/bin/env bash
# Which lines of the code that reads untrusted bytes the tests of the workspace reach. Takes an hour or more.
#
#     tests/coverage.sh [FOLDER]     builds and tests in FOLDER (target/coverage); prints a table, and writes the lines
#                                    that no test reaches to FOLDER/missed.txt
#
# Needs llvm-profdata and llvm-cov of rustc's version of LLVM: `rustup component add llvm-tools`, or Debian's llvm-22.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=$(realpath -m "${1:-target/coverage}")

version=$(rustc -vV | sed -n 's/^LLVM version: \([0-9]*\).*/\1/p')
bundled=$(rustc --print sysroot)/lib/rustlib/$(rustc -vV | sed -n 's/^host: //p')/bin
tool() { # NAME
    PATH="$bundled:$PATH" command -v "$1" || command -v "$1-$version" || {
        echo "$1 of LLVM $version is missing: rustup component add llvm-tools, or apt-get install llvm-$version" >&2
        return 1
    }
}
profdata=$(tool llvm-profdata)
cov=$(tool llvm-cov)

mkdir -p "$folder/profiles"
rm -f "$folder"/profiles/*.profraw
# Optimised, as counters make slow tests slower. No test depends on link-time optimisation.
export RUSTFLAGS="-C instrument-coverage" CARGO_INCREMENTAL=0 CARGO_PROFILE_RELEASE_LTO=off
# Programs of one build add to the same eight files.
export LLVM_PROFILE_FILE="$folder/profiles/%8m.profraw"
# Threads that count in the same lines of a cache slow each other down many times.
export RAYON_NUM_THREADS=1 RUST_TEST_THREADS=1
cargo test --release --workspace --exclude b2p-lab --exclude b2p-kernels --locked --no-fail-fast \
    --target-dir "$folder/build" || echo "some tests failed; the lines that they reached count" >&2

"$profdata" merge -sparse "$folder"/profiles/*.profraw -o "$folder/merged.profdata"
# Test programs, and the program itself, which tests start.
objects=()
for file in "$folder"/build/release/deps/* "$folder/build/release/b2p"; do
    if [ -f "$file" ] && [ -x "$file" ] && [ "${file##*.}" != so ]; then objects+=(-object "$file"); fi
done
"$cov" export -format=lcov -instr-profile="$folder/merged.profdata" "${objects[@]}" > "$folder/lines.lcov"
python3 tests/coverage.py "$folder/lines.lcov" "$folder/missed.txt"
