#!/usr/bin/env bash
# Builds the program for AArch64, decodes the sample under emulation with NEON and without, and compares with this machine's Gaussians:
# the same bytes. On Debian, as root, it installs what it needs; RUSTC names a compiler that has the target's standard library.
set -euo pipefail
cd "$(dirname "$0")/.."

target=aarch64-unknown-linux-gnu
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

if ! { command -v qemu-aarch64 && command -v aarch64-linux-gnu-gcc && command -v /usr/bin/rustc; } > /dev/null; then
    dpkg --add-architecture arm64
    apt-get update -qq
    apt-get install -y -qq --no-install-recommends rustc-web libstd-rust-web-dev:arm64 gcc-aarch64-linux-gnu qemu-user
fi
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc

cargo build --release --locked -p b2p
here=${CARGO_TARGET_DIR:-target}/release/b2p
RUSTC=${RUSTC:-/usr/bin/rustc} cargo build --release --locked -p b2p --target $target --target-dir target/aarch64
there=target/aarch64/$target/release/b2p

"$here" -q decode models/sample.b2p -o "$out/here.ply"
for cpu in max cortex-a53; do
    for isa in neon scalar; do
        timeout 900 qemu-aarch64 -cpu $cpu "$there" -q decode models/sample.b2p -o "$out/there.ply" --isa $isa
        cmp "$out/here.ply" "$out/there.ply"
        echo "$cpu, $isa: the same Gaussians to the bit"
    done
done
ls -l "$there"
