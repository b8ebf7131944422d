#!/usr/bin/env bash
# Trains all heads on, on a GPU: remake_gpu.sh MESHES PHOTOS OUT MINUTES [ARGUMENTS OF train_gpu.py…]
# Samples, and their optimised occupancy, are made beside it: 1,584 in less than four minutes of 16 cores. LAB names a built `b2p-lab`, PYTHON an interpreter that has
# torch, CuPy and the package `b2p`.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
meshes=$(realpath "$1") photos=$(realpath "$2") minutes=$4
mkdir -p "$3/samples" "$3/moved"
out=$(realpath "$3")
shift 4
lab=${LAB:-$here/../../target/release/b2p-lab} python=${PYTHON:-python3}
things=()
for mesh in "$meshes"/*.glb; do
    case $(basename "$mesh") in person_*) ;; *) things+=("$mesh") ;; esac
done
trap 'trap - TERM; kill 0' EXIT
# make THREADS NAME ARGUMENTS…: samples
make() {
    RAYON_NUM_THREADS=$1 nice -n 5 "$lab" dataset -o "$out/samples/$2" --supersampling 3 --textures "$photos" --noisy 0.15 "${@:3}"
}
for round in 1 2 3 4 5 6; do
    count=$((round == 1 ? 16 : 60))
    make 5 "a$round" --count $count --seed $((1000 + round)) --bits 10 --crop 128 "${things[@]}"
    make 5 "b$round" --count $count --seed $((2000 + round)) --bits 10 --crop 128 "$meshes"
done &
for round in 1 2 3 4 5 6; do
    count=$((round == 1 ? 12 : 40))
    make 6 "c$round" --count $count --seed $((3000 + round)) --bits 10 --crop 256 --size 288 --views 5 "${things[@]}"
    make 6 "d$round" --count $count --seed $((4000 + round)) --bits 10 --crop 256 --size 288 --views 5 "$meshes"
done &
for round in 1 2 3 4 5 6 7 8; do
    count=$((round == 1 ? 8 : 24))
    make 3 "q$round" --count $count --seed $((5000 + round)) --bits 8 --crop 256 --size 256 "$meshes"
    make 3 "p$round" --count $count --seed $((6000 + round)) --bits 10 --crop 128 --procedural
    make 3 "e$round" --count $count --seed $((7000 + round)) --bits 9 --crop 128 "$meshes"
done &
cd "$here"
for part in 0 1 2; do
    OMP_NUM_THREADS=1 nice -n 8 "$python" moved.py "$out/moved" --watch "$out/samples" --part $part/3 --most-voxels 250000 \
        --lambdas "3:0.12,0.3 2:0.03,0.1 1:0.03,0.1" > "$out/moved$part.log" &
done
"$python" train_gpu.py --data "$out/samples" --moved "$out/moved" --out "$out/heads" --minutes "$minutes" --wait 100 \
    --lr 6e-4 --most 24 --voxels '{"1":700000,"8":150000}' "$@"
