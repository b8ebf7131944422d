"""Where the closed form's discs draw better than a head: fits the switch that picks one of both for every voxel.

gates.py gather SET.pt HEAD --samples A.safetensors,…     errors of both, attributed to voxels, and the head's last features
gates.py fit GATE.pt SET.pt … [--held-out SET.pt …]       a convolution of those features whose sign decides

An error is squared, over white at the 2x2 average, relative to the head's own: half of it counts over the whole picture, half over the foreground. A pixel's
difference of errors goes to the voxels that a wider disc of would cover it with.
"""

import argparse
import os
import zlib

import numpy as np
import torch
import torch.nn.functional as F

import ops
from discs import Discs
from heads import draw, parameters, per_voxel, place, visible
from octree_samples import Sample, decoded_colours
from scores import load_head, score
from train_heads import random_step

WIDER = 1.3


def features(head, above, here, level):
    """Raw numbers and what the last layer reads."""
    kept = {}

    def seen(name, x):
        kept["last"] = x
        return x

    return head(above, here, level, seen), kept["last"]


def both(head, sample, role, step, rng):
    """The head's Gaussians, the discs, the discs that attribute, the features, and the splatter's unit in finest voxels."""
    k = head.shape["gaussians"]
    decoded = decoded_colours(sample.tree, role, step, rng)
    above, here, rgb = sample.tree.head_inputs(role, decoded, step)
    level, times = sample.tree.level(role), per_voxel(k)
    with torch.no_grad():
        raw, last = features(head, above, here, level)
        learned = place(parameters(raw, rgb, k), level.coords, k)
    discs = Discs(level.coords, level.kernel3.table)
    drawn = lambda four, factor=1.0: discs.place(level.coords, level.kernel3.table, rgb, times, four, factor)
    return learned, drawn(k == 8), drawn(False, WIDER), last, discs, 2 ** (3 - role) / times


def pictures(gaussians, sample, finest):
    cameras, image, coverage = sample.pictures(np.arange(len(sample.cameras)))
    return draw(gaussians, cameras, finest, torch.ones(len(image), 3), image.shape[-1]), image, coverage


def attributed(learned, discs, wide, sample, finest):
    """[n]: the discs' error less the head's, for every voxel."""
    (mine, image, coverage), (other, _, _) = (pictures(g, sample, finest) for g in (visible(learned), discs))
    truth, mask = F.avg_pool2d(image + 1 - coverage, 2), (F.avg_pool2d(coverage, 2) > 0.5).float()
    error = lambda seen: (F.avg_pool2d(seen, 2) - truth).pow(2).sum(1, keepdim=True)
    a, b = error(mine), error(other)
    weight = 0.5 / a.sum() + 0.5 * mask / (a * mask).sum()
    delta = F.interpolate((b - a) * weight, scale_factor=2) / 4
    colour = torch.zeros(len(wide[0]), 3, requires_grad=True)
    cameras = sample.cameras.contiguous()
    seen = draw([*wide[:3], colour], cameras, finest, torch.zeros(len(cameras), 3), image.shape[-1])
    seen.backward(delta.expand_as(seen).contiguous())
    return colour.grad[:, 0]


def mixed(learned, discs, switch):
    """The head's Gaussians where `switch` is off, else the discs."""
    rows = [switch.repeat_interleave(len(g[0]) // len(switch)) for g in (learned, discs)]
    return [torch.cat([a[~rows[0]], b[rows[1]]]) for a, b in zip(learned, discs)]


def gather(args):
    head, out = load_head(args.head), []
    k = head.shape["gaussians"]
    for path in args.samples.split(","):
        sample = Sample(path)
        rng = np.random.default_rng(zlib.crc32(path.encode()))
        role = {1: 2, 8: 1}[k]
        if len(sample.tree.coords[role]) > args.most_voxels:
            continue
        learned, discs, wide, last, shapes, finest = both(head, sample, role, random_step(rng), rng)
        delta = attributed(learned, discs, wide, sample, finest)
        more = torch.stack([shapes.excess.clamp(-0.2, 1), shapes.middle.clamp(0, 3), shapes.axes[:, :, 2].abs().amax(1).double()], 1).float()
        out.append({"name": sample.name, "last": last.half(), "delta": delta, "table": sample.tree.level(role).kernel3, "more": more})
        print(sample.name, len(delta), "discs %+.3f" % delta.sum(), "best of both %+.3f" % delta.clamp_max(0).sum(), flush=True)
    torch.save(out, args.out)


def logit(gate, item):
    return ops.conv(item["last"].float(), gate["weight"], gate["bias"], item["table"], False)[:, 0] + item["more"] @ gate["more"]


def gain(gate, items, threshold=0.0):
    rows = []
    with torch.no_grad():
        for item in items:
            on = logit(gate, item) > threshold
            d = item["delta"]
            rows.append((item["name"], float(d[on].sum()), float(d.sum()), float(d.clamp_max(0).sum()), float(on.float().mean())))
    return rows


def fit(args):
    items, held = ([i for path in paths for i in torch.load(path, weights_only=False)] for paths in (args.sets, args.held_out))
    c = items[0]["last"].shape[1]
    torch.manual_seed(0)
    gate = {"weight": torch.zeros(27, c, 1), "bias": torch.tensor([-1.0]), "more": torch.zeros(3)}
    trained = [gate["weight"], gate["bias"]] + [gate["more"]] * args.more
    for t in trained:
        t.requires_grad_()
    optimiser = torch.optim.Adam(trained, lr=args.lr)
    for epoch in range(args.epochs):
        for group in optimiser.param_groups:
            group["lr"] = args.lr * (1 - epoch / args.epochs) + 1e-5
        loss = 0
        for i in torch.randperm(len(items)):
            item = items[i]
            # Expected relative error, and a little of the logistic loss, which has a gradient where the switch is sure.
            z, d = logit(gate, item), item["delta"]
            part = (torch.sigmoid(z) * d).sum() + args.logistic * (d.abs() * F.softplus(z * d.sign())).sum() + args.decay * gate["weight"].pow(2).sum()
            optimiser.zero_grad()
            part.backward()
            optimiser.step()
            loss += part.item()
        if epoch % 10 == 9:
            means = [np.mean([r[1:] for r in gain(gate, x)], 0).round(3).tolist() if x else [] for x in (items, held)]
            print(epoch, round(loss / len(items), 4), "switched, all discs, best of both, share:", *means, flush=True)
    for row in gain(gate, held):
        print(row[0], *("%.3f" % x for x in row[1:]))
    torch.save({k: v.detach() for k, v in gate.items()}, args.out)


def main():
    p = argparse.ArgumentParser()
    commands = p.add_subparsers(required=True)
    g = commands.add_parser("gather")
    g.add_argument("out")
    g.add_argument("head")
    g.add_argument("--samples", required=True)
    g.add_argument("--most-voxels", type=int, default=60000)
    g.set_defaults(run=gather)
    f = commands.add_parser("fit")
    f.add_argument("out")
    f.add_argument("sets", nargs="+")
    f.add_argument("--held-out", nargs="*", default=[])
    f.add_argument("--epochs", type=int, default=60)
    f.add_argument("--lr", type=float, default=2e-3)
    f.add_argument("--logistic", type=float, default=0.3)
    f.add_argument("--decay", type=float, default=0.0)
    f.add_argument("--more", type=int, default=0)
    f.set_defaults(run=fit)
    args = p.parse_args()
    torch.set_num_threads(1)
    args.run(args)


if __name__ == "__main__":
    main()
