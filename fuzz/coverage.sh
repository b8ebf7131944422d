#!/usr/bin/env bash
# The share of each module's lines that the fuzz targets reach with the committed corpus.
#
#     fuzz/coverage.sh           a table by module, then the files
#     fuzz/coverage.sh FILE …    lines of these files that are not reached, for example src/geometry/octree.rs
set -euo pipefail
cd "$(dirname "$0")/.."

tools=$(rustc --print sysroot)/lib/rustlib/x86_64-unknown-linux-gnu/bin
test -x "$tools/llvm-cov" || rustup component add llvm-tools
out=target/coverage
mkdir -p $out

if [ $# -eq 0 ]; then
    rm -f $out/*.profraw
    export RUSTFLAGS="-C instrument-coverage" LLVM_PROFILE_FILE="$PWD/$out/%p-%m.profraw"
    cargo test --locked -p b2p-fuzz --target-dir $out --test replay -- every_input_that_is_kept_passes
    "$tools/llvm-profdata" merge -sparse $out/*.profraw -o $out/all.profdata
fi
program=$(find $out/debug/deps -name 'replay-*' -type f -executable -printf '%T@ %p\n' | sort -n | tail -n 1 | cut -d' ' -f2)
if [ $# -gt 0 ]; then
    "$tools/llvm-cov" show "$program" -instr-profile=$out/all.profdata "$@" | grep -E '^ *[0-9]+\| *0\|'
    exit
fi
"$tools/llvm-cov" report "$program" -instr-profile=$out/all.profdata | sed "s|^${PWD#/}/||" | tee $out/files.txt |
    awk '$1 ~ /^src\// || $1 ~ /^kernels\/src\// { split($1, part, "/"); module = part[1] == "src" ? part[2] : "kernels"
            lines[module] += $8; missed[module] += $9 }
        END { for (module in lines) printf "%-12s %5d lines  %5.1f %%\n", module, lines[module], 100 - 100 * missed[module] / lines[module] }' | sort
grep -E '^src/(container|coding|geometry|colour)/' $out/files.txt | awk '{ printf "  %-36s %5d lines, %4d missed\n", $1, $8, $9 }'
