#!/usr/bin/env bash
# Trains the models of models/ from nothing: remake.sh MESHES PHOTOS OUT [SHARE]
# MESHES and PHOTOS are folders of glTF binaries and of pictures. SHARE scales the minutes of every step (1: about as the shipped models had, fourteen
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

# Crops, and whole objects at a half and a quarter of the scale.
if [ ! -d "$out/mixed" ]; then
    "$lab" dataset -o "$out/half0" --textures "$photos" --count 120 --seed 31 --bits 9 --crop 512 --size 512 "$meshes"
    "$lab" dataset -o "$out/half1" --procedural --count 20 --seed 32 --bits 9 --crop 512 --size 512
    "$lab" dataset -o "$out/quarter0" --textures "$photos" --count 200 --seed 33 --bits 8 --crop 256 --size 256 --views 8 "$meshes"
    "$lab" dataset -o "$out/quarter1" --procedural --count 40 --seed 34 --bits 8 --crop 256 --size 256 --views 8
    "$lab" dataset -o "$out/half2" --textures "$photos" --count 160 --seed 51 --bits 9 --crop 512 --size 512 "$meshes"
    "$lab" dataset -o "$out/half3" --procedural --count 40 --seed 52 --bits 9 --crop 512 --size 512
    "$lab" dataset -o "$out/quarter2" --textures "$photos" --count 160 --seed 53 --bits 8 --crop 256 --size 256 --views 8 "$meshes"
    mkdir "$out/mixed-part"
    for from in half0 half1 half2 half3 quarter0 quarter1 quarter2; do
        for file in "$out/$from"/*; do mv "$file" "$out/mixed-part/$from-$(basename "$file")"; done
    done
    for crop in "$out"/data/*-00[0-5]*; do ln -s "$crop" "$out/mixed-part/"; done
    mv "$out/mixed-part" "$out/mixed"
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
# fit NAME: fits the entropy models to rounded latents
fit() {
    "$python" tune.py "$out/$1/last.pt" "$out/$1/tuned.pt" --data "$out/data" --minutes "$(minutes 6)" --samples 260 --lr 3e-4 --threads 1 --only-base
}
# prune NAME NEW: leaves out latents that never change, once all has learned
prune() {
    mkdir -p "$out/$2"
    "$python" prune.py "$out/$1/last.pt" "$out/$2/last.pt" --data "$out/mixed" --latents 3
}
# prices A B C: of luma and two chromas
prices() { echo "[$1, $2, $3]"; }
# ship NAME FILE PRICES PRICES: writes the model, and what bits of roles 0 and 1 are worth to its encoder
ship() {
    local all="[$(prices $3), $(prices $4), $(prices 0 0 0)]"
    "$python" export.py "$out/$1/last.pt" "$out/$2.safetensors" --data "$out/mixed" --samples 10 --verify 2 --weights "$out/$2.weights.safetensors" --bit-price "$all"
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
# Thin heads imitate those of the weights that they start from.
imitate=(--only-heads --draw-from 2 --imitate-until 1e9 --lam 1 --coarse 0.5 --average 0.998 --lr-conv 1.5e-3 --lr-linear 2.4e-3 --warmup 100 --decay-from 0.3)
# imitating FILE MINUTES: quick heads for a model
imitating() {
    train "$1-quick" lite-quick "$2" "${imitate[@]}" --init "$out/$1.weights.safetensors" --teacher "$out/$1.weights.safetensors"
    beside "$1-quick" "$1"
}
# Of a network that has learned, everything but its heads, and the mean with before.
rest=(--freeze-finest --lr-heads 0 --rate-start 1 --rate-ramp 0.01 --rounding-from 0 --decay-from 0.2 --warmup 100 --square 40 --stay 0.5)
# Of a network that has learned, everything, the heads faster than the rest.
all=(--freeze-finest --lr-heads 3 --rate-start 1 --rate-ramp 0.01 --rounding-from 0 --decay-from 0.25 --warmup 50)
# The same, with whole objects among the crops.
mixed=(--data "$out/mixed" --held-out 20 --freeze-finest --lr-heads 3 --rate-start 1 --rate-ramp 0.01 --rounding-from 0 --decay-from 0.2 --warmup 200 --square 40)

# Heads alone, once all else has learned.
last=(--data "$out/mixed" --held-out 20 --only-heads --lam 1 --lr-conv 4e-4 --lr-linear 6.5e-4 --warmup 50 --decay-from 0.2 --coarse 0.45 --average 0.998 --square 40)

train start lite-start 100 --lam 18 --rate-start 0.2 --rate-ramp 0.12 --rounding-from 0.03 --decay-from 0.35 --warmup 400
train low lite-start 12 --init "$out/start/last.pt" --lam 4 --freeze-finest --rate-start 1 --rate-ramp 0.01 --rounding-from 0.02 --decay-from 0.3 --warmup 100
train low-heads lite-start 44 --init "$out/low/last.pt" --lam 1 "${heads[@]}"
train low-whole-1 lite-start 21 --init "$out/low-heads/last.pt" --coarse 1 "${whole[@]}"
train low-whole-2 lite-start 21 --init "$out/low-whole-1/last.pt" --coarse 0 "${whole[@]}"
train low-rest lite-start 30 --init "$out/low-whole-2/last.pt" --lam 4 "${rest[@]}"
fit low-rest
train low-mixed lite-start 42 --init "$out/low-rest/tuned.pt" --lam 4 "${mixed[@]}"
train low-more lite-start 70 --init "$out/low-mixed/last.pt" --lam 4 "${mixed[@]}"
train low-last lite-start 19 --init "$out/low-more/last.pt" "${last[@]}"
train low-again lite-start 23 --init "$out/low-last/last.pt" --lam 4 --stay 0.5 "${mixed[@]}"
prune low-again low-pruned
train low-three lite 36 --init "$out/low-pruned/last.pt" --lam 4 --stay 0.5 "${mixed[@]}"
ship low-three lite-low "0.06 0.15 0.15" "0.03 0.1 0.1"
imitating lite-low 15
train high lite-start 38 --init "$out/low-heads/last.pt" --lam 16 "${all[@]}"
train high-heads lite-start 50 --init "$out/high/last.pt" --lam 1 "${heads[@]}" --square 40
train high-whole-1 lite-start 25 --init "$out/high-heads/last.pt" --coarse 1 "${whole[@]}"
train high-whole-2 lite-start 25 --init "$out/high-whole-1/last.pt" --coarse 0 "${whole[@]}"
fit high-whole-2
train high-mixed lite-start 82 --init "$out/high-whole-2/tuned.pt" --lam 16 "${mixed[@]}"
train high-more lite-start 82 --init "$out/high-mixed/last.pt" --lam 16 --stay 0.5 "${mixed[@]}"
train high-last lite-start 24 --init "$out/high-more/last.pt" "${last[@]}"
train high-again lite-start 62 --init "$out/high-last/last.pt" --lam 16 --stay 0.5 "${mixed[@]}"
prune high-again high-pruned
ship high-pruned lite "0.09 0.22 0.22" "0.075 0.15 0.15"
imitating lite 15
train least lite-start 9 --init "$out/low-heads/last.pt" --lam 1.2 "${all[@]}"
train least-whole-1 lite-start 21 --init "$out/least/last.pt" --coarse 1 "${whole[@]}"
train least-whole-2 lite-start 21 --init "$out/least-whole-1/last.pt" --coarse 0 "${whole[@]}"
train least-rest lite-start 30 --init "$out/least-whole-2/last.pt" --lam 1.2 "${rest[@]}"
fit least-rest
train least-mixed lite-start 40 --init "$out/least-rest/tuned.pt" --lam 1.2 "${mixed[@]}"
train least-last lite-start 19 --init "$out/least-mixed/last.pt" "${last[@]}"
train least-again lite-start 19 --init "$out/least-last/last.pt" --lam 1.2 --stay 0.5 "${mixed[@]}"
prune least-again least-pruned
ship least-pruned lite-least "0.06 0.15 0.15" "0.015 0.05 0.05"
imitating lite-least 15
