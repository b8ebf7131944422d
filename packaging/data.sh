#!/usr/bin/env bash
# The data that a packaged program has beside it, in a new FOLDER: the model of learned streams, and the web page, if
# web/build.sh has built it.
#
#     packaging/data.sh FOLDER      such as .../share/b2p
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# = 1 ] || { sed -n '2,5s/^# \{0,1\}//p' "$0" >&2 && exit 2; }
mkdir -p "$1"
install -m 644 models/lite.safetensors "$1/"
[ -f web/b2p.wasm ] || { echo "skipped: the web page; web/build.sh has not built it" && exit 0; }
install -D -m 644 -t "$1/web" web/index.html
install -D -m 644 -t "$1/web/src" web/src/*.js
for module in web/b2p.wasm web/b2p-threads.wasm; do
    [ ! -f $module ] || gzip -9nc $module > "$1/web/$(basename $module).gz"
done
