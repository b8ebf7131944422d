#!/usr/bin/env bash
# Builds the Debian package of the program, with manual pages and completions: target/packaging/b2p_VERSION_ARCH.deb
#
#     packaging/deb.sh          builds it
#     packaging/deb.sh test     then installs it into a root of its own that debootstrap makes, runs it there, and removes it
#
# Needs cargo-deb; the test needs root and debootstrap. Says what it skips where they cannot be had. Pages and completions
# are written in any case.
set -euo pipefail
cd "$(dirname "$0")/.."

cargo build --locked --profile dist -p b2p-cli
program=${CARGO_TARGET_DIR:-target}/dist/b2p
out=target/packaging
rm -rf $out
mkdir -p $out
$program -q man $out/man
$program completions bash > $out/b2p.bash
$program completions zsh > $out/_b2p
$program completions fish > $out/b2p.fish
cargo deb --version > /dev/null 2>&1 || { echo "skipped: the Debian package; cargo-deb is not there" && exit 0; }
cargo deb --quiet --locked -p b2p-cli --profile dist --no-build --output $out/
package=$(echo $out/b2p_*.deb)
printf '%s: %s bytes\n' "$package" "$(stat -c %s "$package")"
[ "${1:-}" = test ] || exit 0

skip() { echo "skipped: $*"; exit 0; }

[ "$(id -u)" = 0 ] || skip "only root can make a root of its own"
command -v debootstrap > /dev/null || apt-get install -y -qq --no-install-recommends debootstrap > /dev/null 2>&1 ||
    skip "debootstrap cannot be had"
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
suite=$(. /etc/os-release && echo "$VERSION_CODENAME")
debootstrap --variant=minbase "$suite" "$root" > $out/debootstrap.log 2>&1 || skip "debootstrap fails: $out/debootstrap.log"

inside() { chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 "$@"; }

cp "$package" "$root/b2p.deb"
inside apt-get install -y -qq --no-install-recommends ./b2p.deb > $out/install.log 2>&1
inside b2p --version
inside b2p -q demo -o /tmp/demo
splats=$(cd "$root" && ls tmp/demo/level-*.ply | tail -1)
inside b2p view --terminal "/$splats" --size 20x10 > /dev/null
# There is no display: the error says what does.
if inside b2p view "/$splats" 2> $out/view.log; then exit 1; fi
grep -q -- --terminal $out/view.log
for file in $(inside dpkg -L b2p | grep -E '/(man1|completions|vendor[-_]completions[.d]*)/'); do
    test -s "$root/$file"
done
inside apt-get purge -y -qq b2p > $out/purge.log 2>&1
left=$(cd "$root" && find usr etc var/lib/b2p -path '*b2p*' 2> /dev/null | grep -v '/dpkg/' || true)
[ -z "$left" ] || { echo "left behind: $left" >&2; exit 1; }
echo "installed, run and removed in a clean $suite"
