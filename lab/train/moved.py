"""Optimised occupancy of samples, as `b2p encode --geometry` makes it, for heads to learn from.

    python moved.py OUT DATA/*.safetensors [--lambdas '2:0.1,0.25 1:0.1,0.25']

Writes, for each sample, OUT/NAME.safetensors with `xyz.R.I` (i32, Morton order) and `rgb.R.I` (u8): the voxels of role R and their mean colours
at λ number I. Levels that the encoder does not optimise are left out. It needs the package `b2p` (`pip install ./python`).
"""

import argparse
import glob
import os
import time

import b2p
import numpy as np
from safetensors.numpy import load_file, save_file

from data import morton
from octree_samples import FINEST


def optimised(xyz, rgb, depth, role, lam):
    """Voxels and colours of `role`, of a cloud whose finest voxels are `xyz` at level `depth`."""
    level = depth - (FINEST - role)
    levels = (max(level - 3, 1), level)
    stream = b2p.encode(xyz, rgb, bits=depth, levels=levels, step=(0.5, 0.5), filter=False, effort=0, head_maps=False, geometry=lam)
    points = b2p.decode_points(stream)
    voxels = np.floor(points.xyz / 2 ** (FINEST - role)).astype(np.int32)
    order = np.argsort(morton(voxels), kind="stable")
    return np.ascontiguousarray(voxels[order]), np.ascontiguousarray(points.rgb[order])


def write(path, target, lambdas, check):
    """Optimised occupancy of the sample `path`; `lambdas[role]` are those to try."""
    d = load_file(path)
    depth, out = max(int(d["xyz.3"].max()).bit_length(), 5), {}
    for role, tried in lambdas.items():
        exact = {tuple(v) for v in d[f"xyz.{role}"]} if check else None
        for i, lam in enumerate(tried):
            voxels, colours = optimised(d["xyz.3"], d["rgb"], depth, role, lam)
            if check:
                same = sum(tuple(v) in exact for v in voxels)
                assert same > 0.5 * len(voxels), (path, role, same, len(voxels))  # the grids agree
            if not check or same < len(voxels) or len(voxels) != len(exact):
                out[f"xyz.{role}.{i}"], out[f"rgb.{role}.{i}"] = voxels, colours
    save_file(out or {"none": np.zeros(1, np.uint8)}, target + ".part")
    os.replace(target + ".part", target)
    print(os.path.basename(path), {k: len(v) for k, v in out.items() if k.startswith("xyz")}, flush=True)


def watch(folder, out, lambdas, most, part):
    """Writes what is missing as samples appear below the folder, without end; `part` = I/N takes every N-th."""
    which, of = map(int, part.split("/"))
    done = set()
    while True:
        new = [f for f in sorted(glob.glob(os.path.join(folder, "**", "*.safetensors"), recursive=True)) if f not in done and sum(f.encode()) % of == which]
        for path in new:
            done.add(path)
            if len(load_file(path)["rgb"]) <= most:
                write(path, os.path.join(out, path.replace("/", "_")), lambdas, False)
        if not new:
            time.sleep(1)


def main():
    p = argparse.ArgumentParser()
    p.add_argument("out")
    p.add_argument("samples", nargs="*")
    p.add_argument("--lambdas", default="2:0.1,0.25 1:0.1,0.25", help="by role")
    p.add_argument("--most-voxels", type=int, default=400_000, help="larger samples are left out")
    p.add_argument("--watch", metavar="FOLDER", help="take samples as they appear below this folder, for `train_gpu.py`")
    p.add_argument("--part", default="0/1", help="with --watch: I/N takes every N-th sample")
    args = p.parse_args()
    lambdas = {int(r): list(map(float, tried.split(","))) for r, tried in (part.split(":") for part in args.lambdas.split())}
    os.makedirs(args.out, exist_ok=True)
    if args.watch:
        watch(args.watch, args.out, lambdas, args.most_voxels, args.part)
    for path in args.samples:
        target = os.path.join(args.out, os.path.basename(path))
        if not os.path.exists(target) and len(load_file(path)["rgb"]) <= args.most_voxels:
            write(path, target, lambdas, True)


if __name__ == "__main__":
    main()
