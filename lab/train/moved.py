"""Optimised occupancy of samples, as `b2p encode --geometry` makes it, for heads to learn from.

    python moved.py OUT DATA/*.safetensors [--roles 2,1] [--lambdas 0.1,0.25]

Writes, for each sample, OUT/NAME.safetensors with `xyz.R.I` (i32, Morton order) and `rgb.R.I` (u8): the voxels of role R and their mean colours
at λ number I. Levels that the encoder does not optimise are left out. It needs the package `b2p` (`pip install ./python`).
"""

import argparse
import os

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


def main():
    p = argparse.ArgumentParser()
    p.add_argument("out")
    p.add_argument("samples", nargs="+")
    p.add_argument("--roles", default="2,1")
    p.add_argument("--lambdas", default="0.1,0.25")
    p.add_argument("--most-voxels", type=int, default=400_000, help="larger samples are left out")
    args = p.parse_args()
    os.makedirs(args.out, exist_ok=True)
    for path in args.samples:
        target = os.path.join(args.out, os.path.basename(path))
        d = load_file(path)
        if os.path.exists(target) or len(d["rgb"]) > args.most_voxels:
            continue
        depth, out = max(int(d["xyz.3"].max()).bit_length(), 5), {}
        for role in map(int, args.roles.split(",")):
            exact = {tuple(v) for v in d[f"xyz.{role}"]}
            for i, lam in enumerate(args.lambdas.split(",")):
                voxels, colours = optimised(d["xyz.3"], d["rgb"], depth, role, float(lam))
                same = sum(tuple(v) in exact for v in voxels)
                assert same > 0.5 * len(voxels), (path, role, same, len(voxels))  # the grids agree
                if same < len(voxels) or len(voxels) != len(exact):
                    out[f"xyz.{role}.{i}"], out[f"rgb.{role}.{i}"] = voxels, colours
        save_file(out or {"none": np.zeros(1, np.uint8)}, target)
        print(os.path.basename(path), {k: len(v) for k, v in out.items() if k.startswith("xyz")}, flush=True)


if __name__ == "__main__":
    main()
