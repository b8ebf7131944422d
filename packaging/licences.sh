#!/usr/bin/env bash
# Checks the licences and the sources of all dependencies (`deny.toml`) by cargo-deny, which it installs into target/tools.
# Run it when Cargo.lock changes, and before a release.
set -euo pipefail
cd "$(dirname "$0")/.."

cargo install --quiet --locked --debug --root target/tools --target-dir target/tools/build cargo-deny@0.20.2
rm -rf target/tools/build
target/tools/bin/cargo-deny --workspace --locked check licenses bans sources
