"""Leaves out latents that never change: what these told the network, as constants, goes into its biases.

    python prune.py RUN/last.pt OUT.pt --data FOLDER
"""

import argparse
import math

import torch

import data
from model import B2P
from passes import PER_NAT
from rates import SIGMA_MIN


@torch.no_grad()
def habits(model, samples):
    """Of each role with latents the mean and the variance of each, rounded, [2, K]; and of those that are predicted the means of what is predicted,
    values, and scale indices in eighths, [2, K]."""
    own, predicted = {}, {}
    for s in samples:
        trail, _, latents = model.code(s.crop, model.analyse(s.crop, s.rgb), 2, "round")
        for r, y in enumerate(y for y in latents if y.shape[1]):
            y = torch.round(y)
            own.setdefault(r, []).append(torch.stack([y.mean(0), y.square().mean(0)]))
            if r:
                mu, log_sigma = model.predict(r, model.context(trail[r - 1], s.crop, r), s.crop)
                index = ((log_sigma - math.log(SIGMA_MIN)) * PER_NAT).clamp(0, 63) / 8
                predicted.setdefault(r, []).append(torch.stack([mu.mean(0), index.mean(0)]))
    own, predicted = ({r: torch.stack(all).mean(0) for r, all in of.items()} for of in (own, predicted))
    return {r: torch.stack([mean, square - mean.square()]) for r, (mean, square) in own.items()}, predicted


@torch.no_grad()
def prune(model, samples, latents=None):
    """The same network without the latents that are constant in every role of these samples, or with so many as vary most: which were kept, the
    configuration, the weights."""
    own, predicted = habits(model, samples)
    k, constant = model.cfg["latents"], {r: torch.round(mean) for r, (mean, _) in own.items()}
    variance = torch.stack([v for _, v in own.values()]).amax(0)
    alive = int((variance > 1e-6).sum()) if latents is None else latents
    keep, dead = (part.sort().values for part in variance.argsort(descending=True).split([alive, k - alive]))
    weights = dict(model.state_dict())

    def outputs(layer):
        for part in (f"{layer}.weight", f"{layer}.bias"):
            weights[part] = weights[part][..., keep]

    def inputs(layer, groups):
        """Of a layer's inputs, from the first on. A group is how many there are that stay; or the constants of K latents, and whether a flag that tells
        if there are any comes after them, which takes over what they told; else the bias does."""
        weight, bias, at, left = weights[layer + ".weight"], weights[layer + ".bias"].clone(), 0, []
        for group in groups:
            if isinstance(group, int):
                left.append(weight[:, at : at + group])
                at += group
                continue
            value, flag = group
            told = value[dead] @ weight[0, at + dead]
            left.append(weight[:, at + keep])
            at += k
            if flag:
                left.append(weight[:, at : at + 1] + told)
                at += 1
            else:
                bias += told
        assert at == weight.shape[1], f"{layer} has {weight.shape[1]} inputs, not {at}"
        weights[layer + ".weight"], weights[layer + ".bias"] = torch.cat(left, 1), bias

    for name in [n for n in weights if n.startswith("prior.")]:
        weights[name] = weights[name][keep]
    for r in own:
        outputs(f"fs.{r}.lin2")
        inputs(f"fr.{r}.lin1", [(constant[r], False)] + [model.cfg["channels"]] * (r > 0))
        if r:
            outputs(f"pem.{r}.mu")
            outputs(f"pem.{r}.sigma")
    neighbours = {"base": [(constant[0], True)] * 7 + [3]} if hasattr(model, "base") else {}
    for r in map(int, model.near):
        mu, index = predicted[r]
        neighbours[f"near.{r}"] = [(constant[r] - mu, True)] * 14 + [(mu, False), (index, False), 3]
    for network, groups in neighbours.items():
        inputs(f"{network}.lin1", groups)
        outputs(f"{network}.mu")
        outputs(f"{network}.sigma")
    return keep.tolist(), {**model.cfg, "latents": len(keep)}, weights


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkpoint")
    p.add_argument("out", help="its averaged weights, for `export.py`, or for `train.py --init` with a configuration of as many latents as are left")
    p.add_argument("--data", required=True, help="folder of samples")
    p.add_argument("--samples", type=int, default=40)
    p.add_argument("--latents", type=int, help="how many to keep, those that vary most; all that vary at all when left out")
    args = p.parse_args()
    state = torch.load(args.checkpoint, map_location="cpu", weights_only=False)
    model = B2P(state["config"])
    model.load_state_dict(state["average"])
    files, _ = data.split(args.data, 8)
    samples = [data.load_sample(f) for f in files[:: max(1, len(files) // args.samples)]]
    keep, cfg, weights = prune(model.eval(), samples, args.latents)
    print(f"of {model.cfg['latents']} latents {keep} are left")
    torch.save({"config": cfg, "average": weights, "args": state["args"], "step": state["step"]}, args.out)


if __name__ == "__main__":
    main()
