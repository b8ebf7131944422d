#!/usr/bin/env bash
# Installs each package of a folder into a clean root, runs it there and removes it again: the Debian package, the archive
# of the program, the C library, the Python wheel and the JavaScript package.
#
#     packaging/try.sh FOLDER      such as target/packaging, or what packaging/release.sh has made
#
# The root is made by debootstrap, which needs to be root itself. Says what it skips. The program for AArch64 runs under
# QEMU, if that is there.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=$(realpath "$1")
logs=target/packaging
mkdir -p $logs
skip() { echo "skipped: $*"; }
fail() { echo "$*" >&2 && exit 1; }

[ "$(id -u)" = 0 ] || { skip "only root can make a root of its own" && exit 0; }
command -v debootstrap > /dev/null || apt-get install -y -qq --no-install-recommends debootstrap > /dev/null 2>&1 ||
    { skip "debootstrap cannot be had" && exit 0; }
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
suite=$(. /etc/os-release && echo "$VERSION_CODENAME")
debootstrap --variant=minbase "$suite" "$root" > $logs/debootstrap.log 2>&1 ||
    { skip "debootstrap fails: $logs/debootstrap.log" && exit 0; }

inside() { chroot "$root" /usr/bin/env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 "$@"; }
# Debian packages that others need: installed, not tried.
need() { inside apt-get install -y -qq --no-install-recommends "$@" > $logs/need.log 2>&1 || fail "no $*: $logs/need.log"; }
# What names it and is left behind in these folders.
left() { # WHAT FOLDER...
    local what=$1 found
    found=$(cd "$root" && find "${@:2}" -iname '*b2p*' ! -path 'var/lib/dpkg/*' 2> /dev/null || true)
    [ -z "$found" ] || fail "$what leaves behind: $found"
    echo "$what: installed, run and removed in a clean $suite"
}
# The first file of the folder with this name.
file() { # PATTERN
    find "$folder" -maxdepth 1 -name "$1" | sort | head -1
}
run() { # PROGRAM
    inside "$1" --version
    inside "$1" -q demo -o /tmp/demo
    splats=$(cd "$root" && ls tmp/demo/level-*.ply | tail -1)
    inside "$1" view --terminal "/$splats" --size 20x10 > /dev/null
    # There is no display: the error says what does.
    if inside "$1" view "/$splats" 2> $logs/view.log; then fail "a window without a display"; fi
    grep -q -- --terminal $logs/view.log
    rm -r "$root/tmp/demo"
    # With the model and the page that are beside the program.
    cp models/sample.b2p "$root/tmp/"
    inside "$1" -q decode /tmp/sample.b2p -o /tmp/sample.ply --level 8
    # Packages have the page that this checkout has.
    # shellcheck disable=SC2016
    [ ! -f web/b2p.wasm ] || inside bash -ec '"$1" serve /tmp/sample.b2p --port 8471 & trap "kill $!" EXIT
        for try in 1 2 3 4 5 6 7 8 9; do exec 3<> /dev/tcp/127.0.0.1/8471 && break; sleep 0.1; done 2> /dev/null
        printf "GET /b2p.wasm HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n" >&3
        grep -aq "^Content-Type: application/wasm" <&3' bash "$1"
    rm "$root"/tmp/sample.*
}

# The program needs no package beyond those that every Debian has.
archive() {
    local name
    name=$(basename "$1" .tar.gz)
    tar -C "$root/opt" -xzf "$1"
    run "/opt/$name/b2p"
    for part in README.md LICENSE-MIT man/b2p.1 b2p.bash _b2p b2p.fish; do
        test -s "$root/opt/$name/$part" || fail "no $part in $1"
    done
    rm -r "$root/opt/$name"
    left "$name" opt usr etc
}

emulated() {
    local name out
    name=$(basename "$1" .tar.gz)
    out=$(mktemp -d)
    tar -C "$out" -xzf "$1"
    qemu-aarch64 -L /usr/aarch64-linux-gnu "$out/$name/b2p" --version
    qemu-aarch64 -L /usr/aarch64-linux-gnu "$out/$name/b2p" -q decode models/scene.b2p --heads surfels -o "$out/a.ply"
    test -s "$out/a.ply"
    rm -r "$out"
    echo "$name: run under emulation"
}

debian() {
    cp "$1" "$root/b2p.deb"
    inside apt-get install -y -qq --no-install-recommends ./b2p.deb > $logs/install.log 2>&1
    run b2p
    for part in $(inside dpkg -L b2p | grep -E '/(man1|completions|vendor[-_]completions[.d]*)/'); do
        test -s "$root/$part" || fail "$part is empty"
    done
    inside apt-get purge -y -qq b2p > $logs/purge.log 2>&1
    rm "$root/b2p.deb"
    left "$(basename "$1")" usr etc var
}

library() {
    tar -C "$root/usr/local" -xzf "$1"
    inside ldconfig
    need gcc libc6-dev pkg-config
    cp capi/examples/decode.c models/scene.b2p "$root/tmp/"
    # shellcheck disable=SC2016
    inside sh -ec 'cd /tmp; cc decode.c $(pkg-config --cflags --libs b2p) -o decode; ./decode scene.b2p scene.ppm; test -s scene.ppm'
    tar -tzf "$1" | grep -v '/$' | (cd "$root/usr/local" && xargs rm)
    inside ldconfig
    rm "$root"/tmp/{decode*,scene*}
    left "$(basename "$1" .tar.gz)" usr/local
}

# What it needs is downloaded outside, as there is no network in the root.
wheel() {
    need python3 python3-venv
    python3 -m pip download --quiet --disable-pip-version-check --dest "$root/wheels" --only-binary :all: \
        --python-version "$(inside python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')" numpy > $logs/pip.log 2>&1 ||
        { skip "the wheel; NumPy cannot be had: $logs/pip.log" && return; }
    cp "$1" "$root/wheels/"
    cp models/scene.b2p "$root/tmp/"
    inside python3 -m venv /opt/python
    inside /opt/python/bin/pip install --quiet --no-index --find-links /wheels b2p
    inside /opt/python/bin/python -c '
import b2p
picture = b2p.render("/tmp/scene.b2p", b2p.Camera.orbit(20, 20), 64, 48)
assert picture.shape[:2] == (48, 64), picture.shape'
    inside /opt/python/bin/pip uninstall --quiet --yes b2p
    rm -r "$root/wheels" "$root/tmp/scene.b2p"
    left "$(basename "$1")" opt/python
    rm -r "$root/opt/python"
}

package() {
    need nodejs
    mkdir -p "$root/srv/node_modules/b2p"
    tar -C "$root/srv/node_modules/b2p" --strip-components=1 -xzf "$1"
    cp models/scene.b2p "$root/srv/"
    cat > "$root/srv/try.mjs" << 'END'
import { readFileSync } from "node:fs";
import { B2p } from "b2p";
const b2p = await B2p.load(readFileSync("node_modules/b2p/b2p.wasm"));
const pixels = b2p.decode(readFileSync("scene.b2p")).render({ azimuth: 20, elevation: 20, width: 64, height: 48 });
if (pixels.length !== 4 * 64 * 48 || pixels.every((x) => x === 255)) throw new Error("no picture");
END
    inside sh -ec 'cd /srv; node try.mjs'
    rm -r "$root/srv/node_modules" "$root"/srv/{scene.b2p,try.mjs}
    left "$(basename "$1")" srv
}

try() { # FUNCTION PATTERN WHAT
    local found
    found=$(file "$2")
    if [ -n "$found" ]; then "$1" "$found"; else skip "$3: not in $folder"; fi
}

# Before what others need is installed.
try archive "b2p-*-$(uname -m)-unknown-linux-gnu.tar.gz" "the program"
try debian "b2p_*_$(dpkg --print-architecture).deb" "the Debian package"
try wheel "b2p-*.whl" "the Python wheel"
try package "b2p-*.tgz" "the JavaScript package"
try library "libb2p-*-$(uname -m)-unknown-linux-gnu.tar.gz" "the C library"
if command -v qemu-aarch64 > /dev/null && [ "$(uname -m)" != aarch64 ]; then
    try emulated "b2p-*-aarch64-unknown-linux-gnu.tar.gz" "the program for AArch64"
fi
