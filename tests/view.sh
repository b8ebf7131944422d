#!/usr/bin/env bash
# The viewer in a real window: on an X server without a screen (Xvfb), with keys and a mouse (xdotool), and in a terminal.
# Tests the program that B2P_PROGRAM names, by default target/debug/b2p. On Debian, as root, it installs what it needs.
# Says what it skips where that cannot be had.
set -euo pipefail
cd "$(dirname "$0")/.."

install() { # COMMAND PACKAGES
    command -v "$1" > /dev/null && return
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${@:2}"; } > /dev/null 2>&1
}

install Xvfb xvfb || { echo "skipped: Xvfb cannot be had" && exit 0; }
install xdotool xdotool || { echo "skipped: xdotool cannot be had" && exit 0; }
for library in libX11-xcb.so.1=libx11-xcb1 libXcursor.so.1=libxcursor1 libXi.so.6=libxi6 \
    libxkbcommon-x11.so.0=libxkbcommon-x11-0; do
    ldconfig -p | grep -q "${library%=*}" || install no-such-command "${library#*=}" ||
        { echo "skipped: ${library%=*} cannot be had" && exit 0; }
done
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "skipped: Python 3.11 is not there" && exit 0; }

export B2P_PROGRAM="${B2P_PROGRAM:-$PWD/target/debug/b2p}"
[ -x "$B2P_PROGRAM" ] || cargo build --quiet --locked -p b2p-cli

# Only for files that are dropped on the window.
tools=target/tools/view
[ -x $tools/bin/python ] || python3 -m venv $tools 2> /dev/null || true
python=python3
if [ -x $tools/bin/pip ] && $tools/bin/pip install --quiet --disable-pip-version-check python-xlib==0.33 2> /dev/null; then
    python=$tools/bin/python
fi
$python tests/view.py -v
