#!/usr/bin/env bash
# AArch64 under emulation, as some of QEMU's processors, two by default: one with dot products and arithmetic in f16
# (Raspberry Pi 5), one with neither (Raspberry Pi 3). All code is optimised as in a release.
#
#     tests/aarch64.sh [PROCESSOR …]
#         the bare decoder decodes the conformance suite with NEON and with dot products, and the kernels and what sums
#         in f16 pass their own tests
#     tests/aarch64.sh plain
#         the bare decoder decodes the suite without NEON
#     tests/aarch64.sh renderer
#         the renderer passes its own tests, hard cases among them, with NEON and without
#     tests/aarch64.sh program
#         the program as it is shipped is small enough, and decodes to the bytes that this machine's does
#
# On Debian, as root, it installs what it needs. A compiler that has the target's standard library is rustup's if that
# can add it, else Debian's.
set -euo pipefail
cd "$(dirname "$0")/.."

target=aarch64-unknown-linux-gnu
processors="cortex-a76 cortex-a53"
# As cargo builds it by default. What is packaged is smaller.
most_bytes=22000000

if ! timeout 120 rustup target add $target > /dev/null 2>&1; then
    if ! test -d /usr/lib/rustlib/$target; then
        dpkg --add-architecture arm64
        apt-get update -qq
        apt-get install -y -qq --no-install-recommends rustc-web libstd-rust-web-dev:arm64
    fi
    export RUSTC=/usr/bin/rustc CARGO_TARGET_DIR=target/debian
fi
for tool in aarch64-linux-gnu-gcc=gcc-aarch64-linux-gnu qemu-aarch64=qemu-user; do
    command -v "${tool%=*}" > /dev/null ||
        apt-get install -y -qq --no-install-recommends "${tool#*=}" libc6-dev-arm64-cross
done
# With the C library inside, for there may be none of that processor's here.
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUSTFLAGS="-C target-feature=+crt-static"

if [ "${1:-}" = program ]; then
    out=$(mktemp -d)
    trap 'rm -rf "$out"' EXIT
    cargo build --locked --release -p b2p-cli --target $target
    there=${CARGO_TARGET_DIR:-target}/$target/release/b2p
    cargo build --locked --release -p b2p-cli
    # STREAM PROCESSOR INSTRUCTIONS
    same() {
        "${CARGO_TARGET_DIR:-target}/release/b2p" -q --force decode "$1" -o "$out/here.ply"
        timeout 3600 qemu-aarch64 -cpu "$2" "$there" -q --force decode "$1" -o "$out/there.ply" --isa "$3"
        cmp "$out/here.ply" "$out/there.ply"
        echo "$1, $2, $3: the same Gaussians to the bit"
    }
    for processor in $processors; do
        same tests/data/conformance/lite-encoded-sphere.b2p "$processor" neon
        same tests/data/conformance/lite-encoded-sphere.b2p "$processor" scalar
        [ "$processor" = cortex-a53 ] || same tests/data/conformance/lite-encoded-sphere.b2p "$processor" dotprod
    done
    same models/sample.b2p max dotprod
    size=$(stat -c %s "$there")
    echo "$there: $size bytes, the model and the sample in it"
    [ "$size" -le $most_bytes ]
    exit
fi

if [ "${1:-}" = renderer ]; then
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="timeout 1800 qemu-aarch64 -cpu max"
    cargo test --release --locked --target $target -p b2p --no-default-features --features render --lib -- renderer
    exit
fi

# Emulation is slow: other numbers of threads, and streams that are refused, are tried without it.
run() { cargo test --release --locked --target $target "$@"; }
suite() { B2P_THREADS=2 run -p b2p --no-default-features --test conformance "$@"; }
kernels() { run -p b2p-kernels --lib --test convolution "$@"; }
half() { run -p b2p --no-default-features --lib "$@"; }

if [ "${1:-}" = plain ]; then
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="timeout 900 qemu-aarch64 -cpu cortex-a53"
    B2P_SKIP_ISAS=neon suite -- --nocapture --skip damage::
    exit
fi

[ $# -eq 0 ] || processors=$*

# The suite and the kernels' tests as one processor, whose name says where they tell how they went.
try() {
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="timeout 900 qemu-aarch64 -cpu $1"
    # Both have the same NEON. Plain code is slow here: the kernels' own tests have it, and `plain` decodes with it.
    export B2P_SKIP_ISAS=scalar,neon
    local sets="dotprod" floats="neon, dotprod" skipped=scalar,neon without="float::"
    # The other processor tests the kernels with NEON.
    [[ " $processors " == *" cortex-a53 "* ]] || skipped=scalar
    [ "$1" != cortex-a53 ] || { B2P_SKIP_ISAS=scalar && sets="neon" && floats="none" && skipped= && without="half::"; }
    suite -- --nocapture --skip damage:: && tells "$1" "ran on $sets" && tells "$1" "half on $floats" || return 1
    B2P_SKIP_ISAS=$skipped kernels -- --skip "$without" && half -- network::tests::half
}

# Whether a processor has told so at the end of a line, before which test threads of one processor have put their names.
tells() { grep -q "$2\$" "$told/$1" || { echo "not told: $2" && return 1; }; }

told=$(mktemp -d)
trap 'rm -rf "$told"' EXIT
suite --no-run
kernels --no-run
half --no-run
# All at once.
for processor in $processors; do
    try "$processor" > "$told/$processor" 2>&1 && touch "$told/$processor.passed" &
done
wait
for processor in $processors; do
    echo "== $processor"
    cat "$told/$processor"
    [ -e "$told/$processor.passed" ] || { echo "$processor failed" >&2 && exit 1; }
done
