#!/usr/bin/env bash
# Continues the fuzzing campaign: every target in turn, guided by coverage, on stable Rust.
#
#     fuzz/campaign.sh [SECONDS [TARGET …]]    SECONDS per target (60), in turn until it is stopped; all targets by default
#     fuzz/campaign.sh once [SECONDS [TARGET …]]
#     fuzz/campaign.sh keep [TARGET …]         rebuilds fuzz/corpus: the seeds, and the fewest inputs with the same coverage
#     fuzz/campaign.sh total                   executions of each target
#
# Inputs and the log of executions are in fuzz/target/campaign. An input that fails an assertion is written to
# fuzz/artifacts and ends the campaign.
set -euo pipefail
cd "$(dirname "$0")"

all="header entropy octree stream transform sequence scene chunking backends model ply clouds splats render"
work=target/campaign
log=$work/log
mkdir -p $work artifacts

build() { RUSTC_WRAPPER=$PWD/rustc.sh cargo build --locked --profile fuzz -p b2p-fuzz --features fuzzing --bins --target-dir target/fuzzers; }

program() { echo "target/fuzzers/fuzz/$1"; }

# Longer inputs repeat the same code and run slower.
longest() {
    case $1 in
        octree | entropy | header) echo 400 ;;
        backends | model | render) echo 600 ;;
        *) echo 1500 ;;
    esac
}

# Runs a target and logs its executions. Faster inputs are mutated more often.
run() {
    local seconds=$1 target=$2
    mkdir -p "$work/$target"
    "$(program "$target")" -max_total_time="$seconds" -max_len="$(longest "$target")" -timeout=60 -rss_limit_mb=2048 -print_final_stats=1 \
        -entropic_scale_per_exec_time=1 -artifact_prefix="artifacts/$target-" "$work/$target" "corpus/$target" > "$work/$target.txt" 2>&1 || {
        tail -n 40 "$work/$target.txt"
        exit 1
    }
    local runs
    runs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$work/$target.txt")
    echo "$(date -u +%F) $target $runs $seconds" | tee -a $log
}

total() {
    for target in $all; do
        awk -v target="$target" '$2 == target { runs += $3; seconds += $4; first = first ? first : $1; last = $1 }
            END { printf "%-9s %11d executions in %6d s, %s to %s\n", target, runs, seconds, first, last }' $log
    done
}

# Keeps inputs by the code that they reach, not by how often they reach it.
keep() {
    local target least
    for target in "$@"; do
        mkdir -p "$work/$target"
        least=$(mktemp -d "$work/least-XXXXXX")
        cp "corpus/$target"/seed-* "$least"
        "$(program "$target")" -set_cover_merge=1 -use_counters=0 -max_len=4096 "$least" "corpus/$target" "$work/$target" > "$work/$target.txt" 2>&1 || {
            tail -n 40 "$work/$target.txt"
            exit 1
        }
        rm -r "corpus/$target"
        chmod 755 "$least"
        mv "$least" "corpus/$target"
        echo "$target: $(find "corpus/$target" -type f | wc -l) inputs"
    done
}

case ${1:-} in
    total) total ;;
    keep)
        build
        # Words, not one argument.
        # shellcheck disable=SC2046
        keep $([ $# -gt 1 ] && echo "${@:2}" || echo $all)
        ;;
    *)
        build
        once=
        [ "${1:-}" != once ] || { once=1 && shift; }
        seconds=${1:-60}
        targets=${*:2}
        while true; do
            for target in ${targets:-$all}; do
                run "$seconds" "$target"
            done
            [ -z $once ] || break
        done
        ;;
esac
