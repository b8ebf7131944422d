#!/usr/bin/env bash
# The data that a packaged program has beside it, in a new FOLDER: the model of learned streams, and the web page, with
# the modules that web/build.sh has built.
#
#     packaging/data.sh FOLDER      such as .../share/b2p
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# = 1 ] || { sed -n '2,5s/^# \{0,1\}//p' "$0" >&2 && exit 2; }
mkdir -p "$1"
install -m 644 models/lite.safetensors "$1/"
install -D -m 644 -t "$1/web" web/index.html
install -D -m 644 -t "$1/web/src" web/src/*.js
for module in b2p.wasm b2p-threads.wasm; do
    if [ -f web/$module ]; then
        gzip -9nc web/$module > "$1/web/$module.gz"
    else
        echo "skipped: $module of the web page; web/build.sh has not built it"
    fi
done
