#!/usr/bin/env bash
# Builds what a release consists of into target/release-VERSION/, with SHA256SUMS:
#
# - the program for x86-64 and AArch64 Linux, each with manual pages, completions and licences (.tar.gz)
# - the Debian package
# - the C library with header and b2p.pc, for x86-64 Linux (.tar.gz, where cargo-c can be had)
# - the WebAssembly module and the JavaScript package (.tgz, where npm can be had)
# - the Python wheel (where maturin can be had)
# - the crates, as `cargo publish` would send them
#
# Each of them is then installed, run and removed in a clean root (packaging/try.sh). What cannot be built here is skipped
# with a word. Nothing is published.
set -euo pipefail
cd "$(dirname "$0")/.."

version=$(sed -n 's/^version = "\(.*\)"$/\1/p' Cargo.toml | head -1)
out=target/release-$version
built=${CARGO_TARGET_DIR:-target}
rm -rf "$out"
mkdir -p "$out"

skip() { echo "skipped: $*"; }

# TARGET PROGRAM
archive() {
    local name=b2p-$version-$1 folder
    folder=$(mktemp -d)
    mkdir "$folder/$name"
    cp "$2" README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE "$folder/$name/"
    cp -r target/packaging/{share,man,b2p.bash,_b2p,b2p.fish} "$folder/$name/"
    # The same bytes for the same contents.
    tar -C "$folder" --sort=name --owner=0 --group=0 --numeric-owner --mtime='2026-01-01 00:00Z' -cf - "$name" |
        gzip -9n > "$out/$name.tar.gz"
    rm -rf "$folder"
}

packaging/licences.sh

# The page is part of the packages.
if web/build.sh; then
    cp web/b2p*.wasm "$out/"
    if command -v npm > /dev/null; then
        (cd web && npm pack --silent --pack-destination "../$out")
    else
        skip "the JavaScript package; npm is not there"
    fi
else
    skip "WebAssembly; the target wasm32-wasip1 cannot be had"
fi

packaging/deb.sh
cp target/packaging/b2p_*.deb "$out/" || skip "the Debian package"
archive "$(rustc -vV | sed -n 's/^host: //p')" "$built/dist/b2p"

other=aarch64-unknown-linux-gnu
if command -v aarch64-linux-gnu-gcc > /dev/null && timeout 120 rustup target add $other > /dev/null 2>&1; then
    CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc \
        cargo build --locked --profile dist -p b2p-cli --no-default-features --features view --target $other
    archive $other "$built/$other/dist/b2p"
else
    skip "AArch64; aarch64-linux-gnu-gcc or the target cannot be had"
fi

packaging/capi.sh archive "$out" || skip "the C library"

if command -v maturin > /dev/null; then
    maturin build --quiet --locked --release --manifest-path python/Cargo.toml --out "$out"
else
    skip "the wheel; maturin is not there"
fi

# Those that are published; they need not compile here once more.
cargo package --locked --workspace --exclude b2p-lab --exclude b2p-python --exclude b2p-fuzz --exclude xtask \
    --no-verify --allow-dirty --quiet --target-dir target/package-crates
cp target/package-crates/package/*.crate "$out/"

(cd "$out" && sha256sum -- * > SHA256SUMS)
ls -l "$out"
packaging/try.sh "$out"
# Its data are beside it (docs/performance.md says what the rest is).
most=12000000
size=$(stat -c %s "$built/dist/b2p")
[ "$size" -le $most ] || { echo "the program has $size bytes, at most $most are wanted" >&2; exit 1; }
