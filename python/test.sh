#!/usr/bin/env bash
# Builds the wheel of the Python package in the profile that B2P_PROFILE names, by default dev, installs it into an
# environment of its own in target/, and runs its tests. Tests that compare with the program need target/debug/b2p, or
# B2P_PROGRAM, and are skipped without. Where Python 3.11 or the package index cannot be had, it says so and ends well.
set -euo pipefail
cd "$(dirname "$0")/.."

profile=${B2P_PROFILE:-dev}
skip() { echo "skipped: $*"; exit 0; }

home=$PWD/target/tools/python-package
python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null || skip "Python 3.11 or later is not there"
[ -x "$home/bin/pip" ] || python3 -m venv "$home" 2> /dev/null || skip "python3 -m venv does not work"
packages=(maturin==1.16.0 pytest==9.2.0 numpy==2.4.6 mypy==2.4.1)
"$home/bin/pip" install --quiet --disable-pip-version-check "${packages[@]}" || skip "packages cannot be had"
export PATH="$home/bin:$PATH" VIRTUAL_ENV="$home"

wheels=target/wheels/$profile
rm -rf "$wheels"
maturin build --quiet --locked --profile "$profile" --manifest-path python/Cargo.toml --out "$wheels"
pip install --quiet --disable-pip-version-check --no-deps --force-reinstall "$wheels"/*.whl
# In this folder the package's sources would hide the one that is installed.
cd python/tests
pytest -q -p no:cacheprovider -c ../pyproject.toml --rootdir . "$@" .
