#!/usr/bin/env bash
# Goes on with the fuzzing campaign: every target for so many seconds, one after the other, starting from the corpus that is kept and
# from what earlier campaigns found on this machine; then the corpus is minimised. Prints a line for each target: date, executions,
# corpus, edges covered. Needs cargo-fuzz and a nightly toolchain.
#
#     fuzz/campaign.sh [SECONDS [TARGET…]]
set -euo pipefail
cd "$(dirname "$0")"

seconds=${1:-60}
shift || true
targets=("$@")
if [ ${#targets[@]} = 0 ]; then
    targets=(header stream chunking octree entropy backends model ply render)
fi
# Inputs of more bytes than the longest seed, twice, teach nothing and slow everything down.
declare -A longest=([header]=400 [stream]=2000 [chunking]=2000 [octree]=600 [entropy]=400 [backends]=4000 [model]=100 [ply]=1500 [render]=4000)

cargo +nightly fuzz build --fuzz-dir .
for target in "${targets[@]}"; do
    mkdir -p "found/$target"
    log=$(mktemp)
    nice -n 15 cargo +nightly fuzz run --fuzz-dir . "$target" "found/$target" "corpus/$target" -- \
        -max_total_time="$seconds" -max_len="${longest[$target]}" -rss_limit_mb=1024 -timeout=10 -print_final_stats=1 > "$log" 2>&1 ||
        { tail -40 "$log"; exit 1; }
    runs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
    edges=$(grep -o 'cov: [0-9]*' "$log" | tail -1)
    rm -rf "kept-$target" && mkdir "kept-$target"
    cargo +nightly fuzz run --fuzz-dir . "$target" "kept-$target" "found/$target" "corpus/$target" -- -merge=1 > "$log" 2>&1
    rm -rf "found/$target" && mv "kept-$target" "found/$target"
    echo "$(date -u +%F) $target: $runs executions in $seconds s, $(ls "found/$target" | wc -l) inputs, $edges"
    rm "$log"
done
