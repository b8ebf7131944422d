#!/usr/bin/env bash
# The conformance suite, decoded by the bare decoder, on processors that differ from the usual ones in what could matter; the kernels' own tests too:
#
#     tests/targets.sh [wasm32|armv7|s390x|riscv64|riscv64v|windows|macos …]    all of them by default
#
# wasm32  WebAssembly with SIMD, in Node: 32-bit addresses, no threads (the kernels' tests are in web/test.sh)
# armv7   32-bit ARM with NEON, whose vectors flush subnormal floats to zero, under QEMU: 32-bit addresses
# s390x   IBM Z, under QEMU: big-endian
# riscv64 RISC-V (rv64gc), under QEMU: NaNs of arithmetic have one canonical form
# riscv64v the same with vectors (RVV 1.0), which the compiler makes of the plain kernels
# windows, macos  the library, the program and the C library are type-checked only: nothing here runs them
#
# On Debian, as root, it installs what it needs; rustup adds the standard libraries. What it found is in SECURITY.md.
set -euo pipefail
cd "$(dirname "$0")/.."

# install COMMAND PACKAGE…
install() { command -v "$1" > /dev/null || { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${@:2}"; }; }

[ $# -gt 0 ] || set -- wasm32 armv7 s390x riscv64 riscv64v windows macos
for name in "$@"; do
    kernels= skip=
    case $name in
        wasm32)
            target=wasm32-wasip1
            install node nodejs
            export CARGO_TARGET_WASM32_WASIP1_RUSTFLAGS="-C target-feature=+simd128"
            export CARGO_TARGET_WASM32_WASIP1_RUNNER="timeout 1800 node --no-warnings $PWD/tests/wasi.mjs"
            ;;
        armv7)
            target=thumbv7neon-unknown-linux-gnueabihf
            install arm-linux-gnueabihf-gcc gcc-arm-linux-gnueabihf libc6-dev-armhf-cross
            install qemu-arm qemu-user
            export CARGO_TARGET_THUMBV7NEON_UNKNOWN_LINUX_GNUEABIHF_LINKER=arm-linux-gnueabihf-gcc
            export CARGO_TARGET_THUMBV7NEON_UNKNOWN_LINUX_GNUEABIHF_RUSTFLAGS="-C target-feature=+crt-static"
            export CARGO_TARGET_THUMBV7NEON_UNKNOWN_LINUX_GNUEABIHF_RUNNER="timeout 1800 qemu-arm -cpu cortex-a15"
            ;;
        s390x)
            target=s390x-unknown-linux-gnu
            install s390x-linux-gnu-gcc gcc-s390x-linux-gnu libc6-dev-s390x-cross
            install qemu-s390x qemu-user
            export CARGO_TARGET_S390X_UNKNOWN_LINUX_GNU_LINKER=s390x-linux-gnu-gcc
            export CARGO_TARGET_S390X_UNKNOWN_LINUX_GNU_RUSTFLAGS="-C target-feature=+crt-static"
            export CARGO_TARGET_S390X_UNKNOWN_LINUX_GNU_RUNNER="timeout 1800 qemu-s390x"
            # QEMU 7.2 multiplies two f32 into an f64 wrongly (MDEBR), which only the tests' reference does, and only when optimised.
            kernels="--config profile.dev.package.b2p-kernels.opt-level=1"
            ;;
        riscv64 | riscv64v)
            target=riscv64gc-unknown-linux-gnu
            install riscv64-linux-gnu-gcc gcc-riscv64-linux-gnu libc6-dev-riscv64-cross
            install qemu-riscv64 qemu-user
            export CARGO_TARGET_RISCV64GC_UNKNOWN_LINUX_GNU_LINKER=riscv64-linux-gnu-gcc
            features=+crt-static processor=rv64
            # Frames with vector registers cannot be unwound, so that no panic can be caught.
            [ $name = riscv64 ] || { features+=,+v && processor+=,v=true,vext_spec=v1.0 && skip="-- --skip hostile"; }
            export CARGO_TARGET_RISCV64GC_UNKNOWN_LINUX_GNU_RUSTFLAGS="-C target-feature=$features"
            export CARGO_TARGET_RISCV64GC_UNKNOWN_LINUX_GNU_RUNNER="timeout 1800 qemu-riscv64 -cpu $processor"
            ;;
        windows | macos)
            target=x86_64-pc-windows-msvc
            [ $name = windows ] || target=aarch64-apple-darwin
            echo "== $target"
            rustup target add $target
            cargo check --locked --target $target -p b2p -p b2p-formats -p b2p-cli -p b2p-capi
            continue
            ;;
        *)
            echo "no target $name" >&2
            exit 2
            ;;
    esac
    echo "== $target"
    rustup target add $target
    cargo test --locked --target $target -p b2p --no-default-features --test conformance -- --nocapture
    # Words, not one argument.
    # shellcheck disable=SC2086
    [ $name = wasm32 ] || cargo test --locked --target $target $kernels -p b2p-kernels --lib --test convolution $skip
done
