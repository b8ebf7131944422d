#!/usr/bin/env bash
# Trains the models of models/ anew, from nothing: remake.sh MESHES PHOTOS OUT [SHARE]
# MESHES and PHOTOS are folders of glTF binaries and of pictures. SHARE scales the minutes of every step (1: as the shipped models had, about nine
# hours on one core; 0.01 shows that it runs). PYTHON names the interpreter that has torch.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
meshes=$(realpath "$1") photos=$(realpath "$2") share=${4:-1}
mkdir -p "$3"
out=$(realpath "$3")
python=${PYTHON:-python3}
export OMP_WAIT_POLICY=passive
minutes() { "$python" -c "print($1 * $share)"; }

cd "$here/../.."
cargo build --release -p b2p-lab
lab=${CARGO_TARGET_DIR:-target}/release/b2p-lab
if [ ! -d "$out/data" ]; then
    for seed in 0 1; do
        "$lab" dataset -o "$out/real$seed" --textures "$photos" --count 800 --seed $seed "$meshes"
        "$lab" dataset -o "$out/made$seed" --procedural --count 180 --seed 1$seed
    done
    mkdir "$out/data"
    for from in real0 real1 made0 made1; do
        for file in "$out/$from"/*; do mv "$file" "$out/data/$from-$(basename "$file")"; done
    done
fi
if [ ! -d "$out/whole" ]; then
    "$lab" dataset -o "$out/whole-part" --textures "$photos" --count 40 --seed 7 --crop 1024 --size 1024 --views 6 --supersampling 3 "$meshes"
    mv "$out/whole-part" "$out/whole"
fi

cd "$here"
# train NAME CONFIG MINUTES ARGUMENTS…
train() {
    local name=$1 config=$2 time=$3
    shift 3
    [ -f "$out/$name/done" ] && return
    "$python" train.py --config "configs/$config.json" --data "$out/data" --out "$out/$name" --minutes "$(minutes "$time")" --views 3 --pyramid 2 --square 20 \
        --average 0.999 --threads 1 --evaluate-every 1000 --log-every 50 --hint 0 --hint-until 0 "$@"
    touch "$out/$name/done"
}
# ship NAME FILE ARGUMENTS…: fits the entropy models and writes the model
ship() {
    "$python" tune.py "$out/$1/last.pt" "$out/$1/tuned.pt" --data "$out/data" --minutes "$(minutes 6)" --samples 260 --lr 3e-4 --threads 1 "${@:3}"
    "$python" export.py "$out/$1/tuned.pt" "$out/$2.safetensors" --data "$out/data" --samples 10 --verify 4 --weights "$out/$2.weights.safetensors"
}
# beside NAME FILE: these heads as quick ones of the model
beside() {
    "$python" export.py --quick "$out/$1/last.pt" --streams-of "$out/$2.safetensors" "$out/$2-both.safetensors" --data "$out/data" --samples 10 --verify 4
    mv "$out/$2-both.safetensors" "$out/$2.safetensors"
}
# The heads alone read what was decoded; they bear five times the learning rate, and a step is short.
heads=(--only-heads --lr-conv 5e-4 --lr-linear 8e-4 --warmup 300 --decay-from 0.15 --coarse 0.35)
# On whole objects, whose edges are none of a crop's; each head by itself. Half way back to where they were: there are few of them.
whole=(--only-heads --stay 0.5 --data "$out/whole" --views 2 --square 40 --held-out 1 --average 0.98 --lam 1 --lr-conv 2e-4 --lr-linear 3e-4 --warmup 10
    --decay-from 0.2 --evaluate-every 100000)
# Thin heads first imitate those of the weights that they start from.
imitate=(--only-heads --init "$out/lite.weights.safetensors" --teacher "$out/lite.weights.safetensors" --draw-from 2 --imitate-until 1e9 --lam 1
    --average 0.998 --lr-conv 1.5e-3 --lr-linear 2.4e-3 --warmup 100 --decay-from 0.3)
# imitating FILE MINUTES: quick heads for a model, that only imitate
imitating() {
    local of=(--init "$out/$1.weights.safetensors" --teacher "$out/$1.weights.safetensors")
    train "$1-quick-1" lite-quick "$2" --coarse 1 "${imitate[@]}" "${of[@]}"
    train "$1-quick-2" lite-quick "$2" --coarse 0 "${imitate[@]}" "${of[@]}" --init "$out/$1-quick-1/last.pt"
    beside "$1-quick-2" "$1"
}
# Of a network that has learned, everything but its heads, and the mean with before.
rest=(--freeze-finest --lr-heads 0 --rate-start 1 --rate-ramp 0.01 --rounding-from 0 --decay-from 0.2 --warmup 100 --square 40 --stay 0.5)
# Of a network that has learned, everything, the heads faster than the rest.
all=(--freeze-finest --lr-heads 3 --rate-start 1 --rate-ramp 0.01 --rounding-from 0 --decay-from 0.25 --warmup 50)

train start lite 100 --lam 18 --rate-start 0.2 --rate-ramp 0.12 --rounding-from 0.03 --decay-from 0.35 --warmup 400
train low lite 12 --init "$out/start/last.pt" --lam 4 --freeze-finest --rate-start 1 --rate-ramp 0.01 --rounding-from 0.02 --decay-from 0.3 --warmup 100
train low-heads lite 44 --init "$out/low/last.pt" --lam 1 "${heads[@]}"
train low-whole-1 lite 21 --init "$out/low-heads/last.pt" --coarse 1 "${whole[@]}"
train low-whole-2 lite 21 --init "$out/low-whole-1/last.pt" --coarse 0 "${whole[@]}"
train low-rest lite 30 --init "$out/low-whole-2/last.pt" --lam 4 "${rest[@]}"
ship low-rest lite-low --only-base
imitating lite-low 5
train high lite 38 --init "$out/low-heads/last.pt" --lam 16 "${all[@]}"
train high-heads lite 50 --init "$out/high/last.pt" --lam 1 "${heads[@]}" --square 40
train high-whole-1 lite 25 --init "$out/high-heads/last.pt" --coarse 1 "${whole[@]}"
train high-whole-2 lite 25 --init "$out/high-whole-1/last.pt" --coarse 0 "${whole[@]}"
ship high-whole-2 lite --only-base
train quick-1 lite-quick 20 --coarse 1 "${imitate[@]}"
train quick-2 lite-quick 18 --coarse 0 "${imitate[@]}" --init "$out/quick-1/last.pt"
train quick-whole-1 lite-quick 21 --init "$out/quick-2/last.pt" --coarse 1 "${whole[@]}"
train quick-whole-2 lite-quick 21 --init "$out/quick-whole-1/last.pt" --coarse 0 "${whole[@]}"
beside quick-whole-2 lite
train least lite 9 --init "$out/low-heads/last.pt" --lam 1.2 "${all[@]}"
train least-whole-1 lite 21 --init "$out/least/last.pt" --coarse 1 "${whole[@]}"
train least-whole-2 lite 21 --init "$out/least-whole-1/last.pt" --coarse 0 "${whole[@]}"
train least-rest lite 30 --init "$out/least-whole-2/last.pt" --lam 1.2 "${rest[@]}"
ship least-rest lite-least --only-base
imitating lite-least 7
