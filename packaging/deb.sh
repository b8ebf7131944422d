#!/usr/bin/env bash
# Builds the Debian package of the program, with manual pages and completions: target/packaging/b2p_VERSION_ARCH.deb
#
#     packaging/deb.sh          builds it
#     packaging/deb.sh test     then installs it into a clean root, runs it there, and removes it (packaging/try.sh)
#
# Needs cargo-deb, and says so where that is not there. Pages and completions are written in any case.
set -euo pipefail
cd "$(dirname "$0")/.."

# Its data are files beside it.
cargo build --locked --profile dist -p b2p-cli --no-default-features --features view
program=${CARGO_TARGET_DIR:-target}/dist/b2p
out=target/packaging
rm -rf $out
mkdir -p $out
[ -f web/b2p.wasm ] || web/build.sh || echo "skipped: the module of the web page"
packaging/data.sh $out/share/b2p
$program -q man $out/man
$program completions bash > $out/b2p.bash
$program completions zsh > $out/_b2p
$program completions fish > $out/b2p.fish
cargo deb --version > /dev/null 2>&1 || { echo "skipped: the Debian package; cargo-deb is not there" && exit 0; }
cargo deb --quiet --locked -p b2p-cli --profile dist --no-build --output $out/
package=$(echo $out/b2p_*.deb)
printf '%s: %s bytes\n' "$package" "$(stat -c %s "$package")"
[ "${1:-}" = test ] || exit 0

packaging/try.sh $out
