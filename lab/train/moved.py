"""Optimised occupancy of samples, as `b2p encode --geometry` makes it, for heads to learn from.

    python moved.py OUT DATA/*.safetensors [--roles 2,1] [--lambdas 0.1,0.25]

Writes, for each sample, OUT/NAME.safetensors with `xyz.R.I` (i32, Morton order) and `rgb.R.I` (u8): the voxels of role R and their mean colours
at λ number I. Levels that the encoder does not optimise are left out. B2P names the program.
"""

import argparse
import os
import re
import subprocess
import tempfile

import numpy as np
from safetensors.numpy import load_file, save_file

from data import morton
from octree_samples import FINEST

PROGRAM = os.environ.get("B2P", "b2p")


def write_ply(path, xyz, rgb):
    rows = np.empty(len(xyz), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("r", "u1"), ("g", "u1"), ("b", "u1")])
    for i, axis in enumerate("xyz"):
        rows[axis] = xyz[:, i]
    for i, channel in enumerate("rgb"):
        rows[channel] = rgb[:, i]
    properties = [f"property float {a}" for a in "xyz"] + [f"property uchar {c}" for c in ("red", "green", "blue")]
    header = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}", *properties, "end_header", ""])
    with open(path, "wb") as f:
        f.write(header.encode() + rows.tobytes())


def read_ply(path):
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "int": "<i4"}
    with open(path, "rb") as f:
        head, body = f.read().split(b"end_header\n", 1)
    kind = np.dtype([(name, types[t]) for t, name in re.findall(r"property (\w+) (\w+)", head.decode())])
    rows = np.frombuffer(body, kind, int(re.search(rb"element vertex (\d+)", head)[1]))
    return np.stack([rows[a] for a in "xyz"], 1), np.stack([rows[c] for c in ("red", "green", "blue")], 1)


def optimised(xyz, rgb, depth, role, lam, folder):
    """Voxels and colours of `role`, of a cloud whose finest voxels are `xyz` at level `depth`."""
    level = depth - (FINEST - role)
    cloud, stream, points = (os.path.join(folder, name) for name in ("cloud.ply", "stream.b2p", "points.ply"))
    write_ply(cloud, xyz, rgb)
    run = lambda *arguments: subprocess.run([PROGRAM, *arguments], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    run("encode", "-f", cloud, "-o", stream, "--bits", str(depth), "--levels", f"{max(level - 3, 1)}..{level}", "--step", "0.5,0.5", "--no-filter",
        "--effort", "0", "--no-head-maps", "--geometry", str(lam))
    run("decode", "-f", stream, "--points", "-o", points)
    at, colours = read_ply(points)
    voxels = np.floor(at / 2 ** (FINEST - role)).astype(np.int32)
    order = np.argsort(morton(voxels), kind="stable")
    return np.ascontiguousarray(voxels[order]), np.ascontiguousarray(colours[order])


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
                with tempfile.TemporaryDirectory() as folder:
                    voxels, colours = optimised(d["xyz.3"], d["rgb"], depth, role, lam, folder)
                same = sum(tuple(v) in exact for v in voxels)
                assert same > 0.5 * len(voxels), (path, role, same, len(voxels))  # the grids agree
                if same < len(voxels) or len(voxels) != len(exact):
                    out[f"xyz.{role}.{i}"], out[f"rgb.{role}.{i}"] = voxels, colours
        save_file(out or {"none": np.zeros(1, np.uint8)}, target)
        print(os.path.basename(path), {k: len(v) for k, v in out.items() if k.startswith("xyz")}, flush=True)


if __name__ == "__main__":
    main()
