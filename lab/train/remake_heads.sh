#!/usr/bin/env bash
# Trains the heads that read decoded colours: remake_heads.sh MESHES PHOTOS OUT [SHARE]
# MESHES and PHOTOS are folders of glTF binaries and of pictures. SHARE scales the minutes of every step. PYTHON names the interpreter that has torch.
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
mkdir -p "$out/data" "$out/things"
for mesh in "$meshes"/*.glb; do
    case $(basename "$mesh") in person_*) ;; *) ln -sf "$mesh" "$out/things/" ;; esac
done
# make NAME ARGUMENTS…: samples, once
make() {
    local name=$1
    shift
    [ -d "$out/$name" ] && return
    "$lab" dataset -o "$out/$name-part" --supersampling 3 --textures "$photos" "$@"
    mv "$out/$name-part" "$out/$name"
    for file in "$out/$name"/*; do ln -sf "$file" "$out/data/$name-$(basename "$file")"; done
}
# Whole objects at a quarter of the scale, and crops; people are in a part of them only.
make q0 --count 60 --seed 401 --bits 8 --crop 256 --size 256 "$out/things"
make q1 --count 36 --seed 402 --bits 8 --crop 256 --size 256 "$meshes"
make c0 --count 70 --seed 411 --bits 10 --crop 128 "$out/things"
make c1 --count 70 --seed 412 --bits 9 --crop 128 "$out/things"
make c2 --count 40 --seed 413 --bits 10 --crop 128 "$meshes"
# Whole objects of a half of the scale, and objects of the project's own making.
make h0 --count 40 --seed 403 --bits 9 --crop 512 --size 512 --views 5 "$out/things"
make h1 --count 22 --seed 404 --bits 9 --crop 512 --size 512 --views 5 "$meshes"
# Larger crops, of the flatter surfaces that level 9 has.
make d0 --count 70 --seed 421 --bits 10 --crop 256 --size 288 --views 5 "$out/things"
make d1 --count 40 --seed 423 --bits 10 --crop 256 --size 288 --views 5 "$meshes"
make q2 --count 30 --seed 405 --bits 8 --crop 256 --size 256 --procedural

cd "$here"
"$python" teach.py ../../models/lite.weights.safetensors "$out/taught" "$out/data"/[cq][01]-*.safetensors "$out/data"/c2-*.safetensors
# train NAME CONFIG MINUTES ARGUMENTS…
train() {
    local name=$1 config=$2 time=$3
    shift 3
    [ -f "$out/$name/done" ] && return
    "$python" train_heads.py --config "configs/heads-$config.json" --data "$out/data" --teacher "$out/taught" --out "$out/$name" \
        --minutes "$(minutes "$time")" "$@"
    touch "$out/$name/done"
}
small=(--only c0,c1,c2,q0,q1)
taught=("${small[@]}" --draw-from 2 --imitate 1 --decay-from 0.2)
drawn1=("${small[@]}" --roles 2:0.85,1:0.15 --most-voxels 12000 --views 2)
drawn8=("${small[@]}" --roles 1:0.7,2:0.3 --most-voxels 5000 --views 1)
train start-best-1 best-1 25 "${taught[@]}" --lr 1.5e-3 --roles 2:1
train start-best-8 best-8 16 "${taught[@]}" --lr 1.5e-3 --roles 1:1
train best-1 best-1 50 --init "$out/start-best-1/last.pt" "${drawn1[@]}" --lr 7e-4 --imitate 0.2 --imitate-until 0.4 --average 0.998
train best-8 best-8 50 --init "$out/start-best-8/last.pt" "${drawn8[@]}" --lr 7e-4 --imitate 0.2 --imitate-until 0.4 --average 0.998
train whole-8 best-8 17 --init "$out/best-8/last.pt" --only q0,q1,q2,h0,h1 --roles 1:0.75,2:0.25 --most-voxels 9000 --views 2 --lr 4e-4 --decay-from 0.2
train longer-1 best-1 49 --init "$out/best-1/last.pt" --only d0,d1,c0,c2,q0,q1 --roles 2:0.9,1:0.1 --most-voxels 60000 --views 2 --lr 5e-4 --average 0.996
train start-quick-1 quick-1 8 "${taught[@]}" --lr 2e-3 --roles 2:1
train start-quick-8 quick-8 8 "${taught[@]}" --lr 2e-3 --roles 1:1
train quick-1 quick-1 21 --init "$out/start-quick-1/last.pt" --elder "$out/best-1/last.pt" "${drawn1[@]}" --lr 1.2e-3 --imitate 0.5 --imitate-until 0.4
train quick-8 quick-8 21 --init "$out/start-quick-8/last.pt" --elder "$out/best-8/last.pt" "${drawn8[@]}" --lr 1.2e-3 --imitate 0.5 --imitate-until 0.4
some=$(printf '%s,' "$out"/data/q1-000[0-5]*.safetensors)
"$python" export_heads.py "$out/heads.safetensors" best.1="$out/longer-1/last.pt" best.8="$out/whole-8/last.pt" \
    quick.1="$out/quick-1/last.pt" quick.8="$out/quick-8/last.pt" --samples "${some%,}"
