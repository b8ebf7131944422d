#!/usr/bin/env bash
# Installs the C library by cargo-c, which it installs into target/tools: b2p.h, libb2p_c.so, libb2p_c.a and b2p.pc.
#
#     packaging/capi.sh install PREFIX    into PREFIX, such as /usr/local
#     packaging/capi.sh remove PREFIX     removes what was installed there
#     packaging/capi.sh archive FOLDER    packs what would be installed into /usr/local, as FOLDER/libb2p-VERSION-TARGET.tar.gz
#     packaging/capi.sh test              tries both, and a program that pkg-config finds the library for, in a new prefix
#
# B2P_PROFILE names a profile that takes less time to build than `release`.
set -euo pipefail
cd "$(dirname "$0")/.."

# The last one that Rust 1.95 compiles.
cargo_c=0.10.24

tool() {
    export PATH="$PWD/target/tools/bin:$PATH"
    command -v cargo-cinstall > /dev/null && return
    cargo install --quiet --locked --debug --root target/tools --target-dir target/tools/build cargo-c@$cargo_c
    rm -rf target/tools/build
}

version() { sed -n 's/^version = "\(.*\)"$/\1/p' Cargo.toml | head -1; }

install() { # PREFIX OPTIONS...
    tool
    # Not into a folder for one architecture, where Debian's own packages are.
    cargo cinstall --locked --profile "${B2P_PROFILE:-release}" -p b2p-capi --prefix="$1" --libdir=lib "${@:2}"
}

archive() { # FOLDER
    local stage
    stage=$(mktemp -d)
    install /usr/local --destdir="$stage"
    # The same bytes for the same contents.
    tar -C "$stage/usr/local" --sort=name --owner=0 --group=0 --numeric-owner --mtime='2026-01-01 00:00Z' -cf - include lib |
        gzip -9n > "$1/libb2p-$(version)-$(rustc -vV | sed -n 's/^host: //p').tar.gz"
    rm -rf "$stage"
}

remove() { # PREFIX
    rm -f "$1/include/b2p.h" "$1"/lib/libb2p_c.{a,so,so.*} "$1/lib/pkgconfig/b2p.pc"
}

try() {
    local prefix
    prefix=$(mktemp -d)
    # shellcheck disable=SC2064
    trap "rm -rf '$prefix'" EXIT
    install "$prefix"
    (cd "$prefix" && find . -type f -printf '%s bytes: %p\n' -o -type l -printf '%p -> %l\n' | sort -k 3)
    export PKG_CONFIG_PATH=$prefix/lib/pkgconfig
    pkg-config --print-errors --exists b2p
    # The words of pkg-config are several arguments.
    # shellcheck disable=SC2046
    cc -std=c11 -Wall -Wextra -Werror capi/examples/decode.c $(pkg-config --cflags --libs b2p) -o "$prefix/shared"
    # shellcheck disable=SC2046
    cc -std=c11 -Wall -Wextra -Werror capi/examples/decode.c $(pkg-config --cflags b2p) "$prefix/lib/libb2p_c.a" \
        $(pkg-config --static --libs-only-l b2p | sed 's/-lb2p_c//') -o "$prefix/static"
    # Without the library, the program that shares it does not start.
    if "$prefix/shared" models/scene.b2p "$prefix/none.ppm" 2> /dev/null; then exit 1; fi
    LD_LIBRARY_PATH=$prefix/lib "$prefix/shared" models/scene.b2p "$prefix/shared.ppm"
    "$prefix/static" models/scene.b2p "$prefix/static.ppm" > /dev/null
    cmp "$prefix/shared.ppm" "$prefix/static.ppm"
    rm "$prefix"/{shared,static}{,.ppm}
    remove "$prefix"
    [ -z "$(find "$prefix" ! -type d)" ] || { echo "left behind:" && find "$prefix" ! -type d && exit 1; } >&2
    echo "installed, compiled with, run and removed: the C library $(version)"
}

case "${1:-} $#" in
    "install 2" | "remove 2" | "archive 2") "$1" "$(realpath -m "$2")" ;;
    "test 1") try ;;
    *) sed -n '2,7s/^# \{0,1\}//p' "$0" >&2 && exit 2 ;;
esac
