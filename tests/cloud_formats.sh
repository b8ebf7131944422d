#!/usr/bin/env bash
# LAS, LAZ and E57 files there and back through laspy and pye57, programs by others, which it installs into target/. Tests
# the program that B2P_PROGRAM names, or else builds it. Needs Python 3.9 or later and PyPI; without them it says so and
# skips.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=target/cloud-formats
python=$folder/bin/python

skip() { echo "skipped: $*"; exit 0; }

command -v python3 > /dev/null || skip "no Python here"
if ! "$python" -c 'import laspy, lazrs, pye57' 2> /dev/null; then
    python3 -m venv "$folder" || skip "python3 makes no virtual environments here"
    "$folder/bin/pip" install --quiet 'laspy[lazrs]==2.7.0' 'pye57==0.4.19' || skip "pip could not have laspy and pye57"
fi
[ -n "${B2P_PROGRAM:-}" ] || cargo build --locked --quiet -p b2p-cli
"$python" tests/cloud_formats.py "${B2P_PROGRAM:-target/debug/b2p}"
