"""Fits the entropy models to rounded latents: everything else is frozen, so pictures stay as they are and only the rate falls.

Training counts bits of noisy latents, whose distribution differs from that of rounded ones where they are small. The averaged
weights are tuned and written as a checkpoint that export.py reads.

    python tune.py RUN/last.pt RUN/tuned.pt --data FOLDER --minutes 4
"""

import argparse
import math
import time

import numpy as np
import torch

import data
from model import B2P
from train import atomic_save, keep_memory


@torch.no_grad()
def inputs(model, sample):
    """(context, rounded latents, kernel map) of roles 0 .. 2, the crop, and the number of points."""
    features, g, out = model.analyse(sample.crop, sample.rgb), None, []
    for r in range(3):
        c, kmap = model.context(g, sample.crop, r) if r else None, sample.crop.kernel3[r]
        y = torch.round(model.squeeze(r, features[r], c))
        out.append((c, y, kmap))
        if r < 2:
            g = model.reconstruct(r, y, c, sample.crop)
    return out, sample.crop, sample.crop.points


def rates(model, roles, crop, coarse_mean=False):
    """Bits per role. `coarse_mean`: with the means in the sixteenths that the stream has."""
    out = []
    for r, (c, y, _) in enumerate(roles):
        mu, log_sigma = model.predict(r, c, crop)
        if coarse_mean and mu is not None:
            mu = mu + (torch.round(mu * 16) / 16 - mu).detach()
        out.append(model.bits(r, y, mu, log_sigma, crop))
    return out


@torch.no_grad()
def measure(model, cached):
    total, points = np.zeros(3), 0
    for roles, crop, n in cached:
        total += [r.item() for r in rates(model, roles, crop, True)]
        points += n
    return total / points


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkpoint")
    p.add_argument("out")
    p.add_argument("--data", required=True)
    p.add_argument("--minutes", type=float, default=4)
    p.add_argument("--samples", type=int, default=150, help="crops, whose latents are computed once")
    p.add_argument("--lr", type=float, default=3e-4)
    p.add_argument("--base-channels", type=int, default=48, help="of the network that predicts role 0 from neighbours, if the model has none yet")
    p.add_argument("--near-channels", type=int, nargs=2, default=[64, 0], help="of the networks that correct roles 1 and 2 from neighbours, if the model has none yet")
    p.add_argument("--only-base", action="store_true", help="leave the models of roles 1 and 2 as they are but for what corrects them: after `train.py --rounding-from 0` they know rounded latents")
    p.add_argument("--threads", type=int, default=2)
    args = p.parse_args()
    torch.set_num_threads(args.threads)
    keep_memory()
    begin = time.monotonic()
    state = torch.load(args.checkpoint, map_location="cpu", weights_only=False)
    state["config"].setdefault("base_channels", args.base_channels)
    state["config"].setdefault("near_channels", args.near_channels)
    model = B2P(state["config"])
    model.load_state_dict(state["average"], strict=False)
    training, held = data.split(args.data, 8)
    order = np.random.default_rng(0).permutation(len(training))[:args.samples]
    held = [inputs(model, data.load_sample(f)) for f in held]
    before = measure(model, held)
    cached, step = [], 0
    groups = [{"params": [*model.prior.parameters(), *([] if args.only_base else model.pem.parameters())], "base": args.lr}]
    if model.cfg["base_channels"]:  # small, and often new
        groups.append({"params": [*model.base.parameters()], "base": 3 * args.lr})
    groups.append({"params": [*model.near.parameters()], "base": 6 * args.lr})
    tuned = [p for group in groups for p in group["params"]]
    optimiser = torch.optim.Adam(groups, args.lr, betas=(0.9, 0.99))
    rng = np.random.default_rng(1)
    while (x := (time.monotonic() - begin) / (60 * args.minutes)) < 1:
        if len(cached) < len(order):
            cached.append(inputs(model, data.load_sample(training[order[len(cached)]])))
            roles, crop, points = cached[-1]
        else:
            roles, crop, points = cached[rng.integers(len(cached))]
        for group in optimiser.param_groups:
            group["lr"] = group["base"] * min(1, (step + 1) / 20) * 0.5 * (1 + math.cos(math.pi * x))
        optimiser.zero_grad()
        (sum(rates(model, roles, crop, True)) / points).backward()
        torch.nn.utils.clip_grad_norm_(tuned, 1.0)
        optimiser.step()
        step += 1
    after = measure(model, held)
    print(f"{step} steps; held-out bpp {before.round(4)} = {before.sum():.4f} -> {after.round(4)} = {after.sum():.4f}")
    state["average"] = {k: v.detach().clone() for k, v in model.state_dict().items()}
    atomic_save({k: state[k] for k in ("average", "config", "args", "step")}, args.out)


if __name__ == "__main__":
    main()
