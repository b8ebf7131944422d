"""Writes heads as a model file: export_heads.py OUT.safetensors best.1=CHECKPOINT … --samples A.safetensors,…

Tensors are f16, named `best.1.parent.in.weight` and so on. The metadata's `b2p-heads` is JSON: `version`, `blur` (what Gaussians are widened by, in squares
of half their unit: of half a voxel, or a quarter of one where there are eight a voxel) and `sets`, of each the shape and `ranges`: of every layer but the last the magnitude that one activation in 10,000 exceeds,
over the samples at several quantisation steps.
"""

import argparse
import json
import os

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from heads import BLUR
from octree_samples import Sample, decoded_colours
from scores import load_head

STEPS = (1.0, 6.0, 40.0)


def rounded(head):
    """The head with weights as the file holds them."""
    head.load_state_dict({k: v.half().float() for k, v in head.state_dict().items()})
    return head


@torch.no_grad()
def ranges(head, samples, quantile=0.9999):
    """{layer: the largest over samples of that quantile of its activations}."""
    found = {}

    def seen(name, x):
        value = float(np.quantile(x.numpy(), quantile))
        found[name] = max(found.get(name, 0.0), value)
        return x

    for sample in samples:
        for role in (2, 1):
            for step in STEPS:
                decoded = decoded_colours(sample.tree, role, step, np.random.default_rng(0))
                above, here, _ = sample.tree.head_inputs(role, decoded, step)
                head(above, here, sample.tree.level(role), seen)
    return {k: round(v, 5) for k, v in found.items()}


def kept(path, but):
    """Tensors and descriptions of the sets of a model file except those named `but`."""
    with safe_open(path, "pt") as f:
        sets = json.loads(f.metadata()["b2p-heads"])["sets"]
    sets = {name: shape for name, shape in sets.items() if name not in but}
    return {k: v for k, v in load_file(path).items() if k.startswith(tuple(f"{name}." for name in sets))}, sets


def main(argv=None):
    p = argparse.ArgumentParser()
    p.add_argument("out")
    p.add_argument("sets", nargs="+", metavar="NAME=CHECKPOINT")
    p.add_argument("--keep", metavar="MODEL.safetensors", help="copy the other sets of this file, as they are")
    p.add_argument("--samples", required=True, help="sample files that ranges come from, comma-separated")
    args = p.parse_args(argv)
    torch.set_num_threads(1)
    samples = [Sample(path) for path in args.samples.split(",")]
    tensors, sets = kept(args.keep, [s.split("=")[0] for s in args.sets]) if args.keep else ({}, {})
    for name, path in (s.split("=") for s in args.sets):
        head = rounded(load_head(path))
        tensors |= {f"{name}.{k}": v.half().contiguous() for k, v in head.state_dict().items()}
        sets[name] = head.shape | {"ranges": ranges(head, samples)}
    note = json.dumps({"version": 1, "blur": BLUR, "sets": sets})
    save_file(tensors, args.out + ".part", metadata={"b2p-heads": note})
    os.replace(args.out + ".part", args.out)


if __name__ == "__main__":
    main()
