"""Trains all heads of a model file on a GPU, on samples that may still be being made. `python train_gpu.py --help` lists the options.

Batches are crops of one size; `best` and `quick` learn from the same ones. Everything but reading files happens on the device. Objects of
`train_heads.HELD_OUT` are never trained on; every --evaluate-every steps their pictures are scored with the averaged weights.
"""

import argparse
import collections
import glob
import json
import math
import os
import threading
import time

import numpy as np
import torch
import torch.nn.functional as F
from safetensors.numpy import load_file

from batch import Batch, decoded_colours, morton
from heads import Head, parameters, per_voxel, place, saved_head
from splat_gpu import splat
from train import atomic_save, distortion
from train_heads import HELD_OUT, object_of

KINDS = {1: {3: 0.42, 2: 0.5, 1: 0.08}, 8: {1: 0.75, 2: 0.25}}  # Gaussians a voxel: roles and how often
# Luma's step from which on optimised occupancy is taken, and from which on that of the greater λ.
MOVED_FROM = {3: (5, 14), 2: (12, 30), 1: (12, 30)}


def levels_up(xyz, rgb):
    """{role: (coordinates u8, colours f32)} of roles 3 to 1 from the finest voxels."""
    coords, colours, out = torch.from_numpy(xyz).int(), torch.from_numpy(rgb).float(), {}
    for r in (3, 2, 1):
        out[r] = (coords.to(torch.uint8), colours)
        up = coords >> 1
        _, parent, count = torch.unique_consecutive(morton(up), return_inverse=True, return_counts=True)
        colours = torch.zeros(len(count), 3).index_add(0, parent, colours) / count[:, None]
        coords = up[count.cumsum(0) - count]
    return out


class Sample:
    """A file of `b2p-lab dataset`; `at[role]` are its voxels, exact, then optimised ones if there are."""

    def __init__(self, path, device):
        d = load_file(path)
        self.name, self.moved = os.path.basename(path), False
        side = max(int(d["xyz.3"].max()).bit_length(), 5)
        self.at = {r: [tuple(t.to(device) for t in v)] for r, v in levels_up(d["xyz.3"], d["rgb"]).items()}
        self.camera, self.image = torch.from_numpy(d["camera"]).to(device), torch.from_numpy(d["image"]).to(device)
        self.group = (7 if side <= 7 else 8, d["image"].shape[1])

    def add_moved(self, path, device):
        d = load_file(path)
        for key in sorted(k for k in d if k.startswith("xyz.")):
            role = int(key.split(".")[1])
            voxels = torch.from_numpy(d[key]).to(torch.uint8).to(device), torch.from_numpy(d[key.replace("xyz", "rgb")]).float().to(device)
            if len(voxels[0]):
                self.at[role].append(voxels)
        self.moved = True


class Library:
    """Samples by group, read by threads as files appear."""

    def __init__(self, args):
        self.args, self.lock, self.known, self.busy = args, threading.Lock(), {}, set()
        self.groups, self.held_out, self.error = collections.defaultdict(list), [], None
        for _ in range(args.readers):
            threading.Thread(target=self._run, daemon=True).start()

    def _claim(self):
        files = sorted(f for folder in self.args.data for f in glob.glob(os.path.join(folder, "**", "*.safetensors"), recursive=True))
        with self.lock:
            for f in files:
                new = f not in self.known and len(self.known) < self.args.keep
                if f not in self.busy and (new or f in self.known and not self.known[f].moved and os.path.exists(self._moved(f))):
                    self.busy.add(f)
                    return f
        return None

    def _moved(self, f):
        return os.path.join(self.args.moved, f.replace("/", "_")) if self.args.moved else ""

    def _run(self):
        torch.set_num_threads(1)
        try:
            while True:
                if f := self._claim():
                    self._read(f)
                else:
                    time.sleep(0.5)
        except Exception as error:
            self.error = error

    def _read(self, f):
        sample = self.known.get(f)
        fresh = sample is None
        sample = sample or Sample(f, self.args.device)
        if os.path.exists(self._moved(f)):
            sample.add_moved(self._moved(f), self.args.device)
        with self.lock:
            self.known[f] = sample
            self.busy.discard(f)
            if fresh and object_of(sample.name) in HELD_OUT:
                self.held_out.append(sample)
            elif fresh:
                self.groups[sample.group].append(sample)

    def choose(self, rng, k, role):
        """Samples of one group, at most so many voxels of this role in all, and the octree level of their finest voxels."""
        with self.lock:
            pools = list(self.groups.values())
            sizes = np.array([len(pool) for pool in pools], float)
            pool = pools[rng.choice(len(pools), p=sizes / sizes.sum())]
            chosen, left = [], self.args.voxels[k]
            for i in rng.permutation(len(pool))[: self.args.most]:
                n = len(pool[i].at[role][0][0])
                if n <= left:
                    chosen.append(pool[i])
                    left -= n
        return chosen, pool[0].group[0]


def noise(rng, samples, device, step=None):
    """What `decoded_colours` needs: steps (log-uniform in 1.5 to 64, a fifth lossless), rounding, gain, chroma."""
    steps = np.where(rng.random(samples) < 0.2, 1.0, np.exp(rng.uniform(math.log(1.5), math.log(64), samples))) if step is None else np.full(samples, step)
    chroma = np.stack([np.ones(samples), rng.uniform(1, 2, samples), rng.uniform(1.4, 2.2, samples)], 1)
    numbers = steps, rng.uniform(0.3, 0.5, samples), rng.uniform(0.6, 0.9, samples), chroma
    return [torch.from_numpy(x).float().to(device) for x in numbers]


def assemble(samples, role, depth, rng, args, step=None, views=2):
    """A batch with its decoded colours, and the pictures to hold it to."""
    numbers = noise(rng, len(samples), args.device, step)
    steps, low = numbers[0].tolist(), MOVED_FROM[role]
    chosen = []
    for s, luma in zip(samples, steps):
        have = s.at[role]
        moved = len(have) > 1 and luma >= low[0] and rng.random() < args.moved_share
        chosen.append(have[min(1 + (luma >= low[1]), len(have) - 1)] if moved else have[0])
    which = torch.repeat_interleave(torch.arange(len(chosen), device=args.device), torch.tensor([len(c[0]) for c in chosen], device=args.device))
    coords = torch.cat([c[0] for c in chosen]).int()
    batch = Batch(role, depth - (3 - role), coords, which, torch.cat([c[1] for c in chosen]), len(chosen), dtype=args.dtype)
    decoded = decoded_colours(batch, *numbers)
    at = [rng.permutation(len(s.camera))[:views] for s in samples]
    picture = torch.cat([s.image[v] for s, v in zip(samples, at)]).permute(0, 3, 1, 2).float() / 255
    cameras = torch.cat([s.camera[v] for s, v in zip(samples, at)])
    cloud = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor([len(v) for v in at])).to(args.device)
    return batch, batch.head_inputs(decoded, numbers[0]), batch.level(), (cameras, cloud, picture[:, :3], picture[:, 3:])


def drawn(head, batch, inputs, level, pictures, background, k):
    above, here, rgb = inputs
    cameras, cloud, image, _ = pictures
    own = parameters(head(above, here, level), rgb, k)
    which = batch.at[batch.role].which.repeat_interleave(k)
    gaussians = place(own, level.coords, k)
    if k > 1:
        keep = (gaussians[2] >= 1 / 255).nonzero()[:, 0]
        gaussians, which = [t[keep] for t in gaussians], which[keep]
    cameras = cameras.clone()
    cameras[:, 9:12] /= 2 ** (3 - batch.role) / per_voxel(k)
    return splat(*gaussians, which, cameras, cloud, background, image.shape[-1]), own, rgb


class Learner:
    """One head with its optimiser and averaged weights."""

    def __init__(self, name, args):
        shape, weights = saved_head(f"{args.init}:{name}")
        self.name, self.shape, self.k, self.args = name, shape, shape["gaussians"], args
        self.head, self.before = Head(shape).to(args.device), Head(shape).to(args.device)
        self.head.load_state_dict(weights)
        self.before.load_state_dict(weights)
        self.average = {k: v.detach().clone() for k, v in self.head.state_dict().items()}
        self.lr = args.lr * (1 if name.startswith("best") else 1.7)
        self.optimiser = torch.optim.Adam(self.head.parameters(), lr=self.lr, fused=args.device == "cuda")
        self.step = 0

    def learn(self, batch, inputs, level, pictures, x):
        background = torch.rand(len(pictures[1]), 3, device=self.args.device)
        seen, own, rgb = drawn(self.head, batch, inputs, level, pictures, background, self.k)
        truth = pictures[2] + (1 - pictures[3]) * background[:, :, None, None]
        loss = distortion(seen, truth, 1.0, self.args.square) + 0.05 * (own[4] - rgb.repeat_interleave(self.k, 0)).pow(2).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for p in self.head.parameters():
            p.grad.nan_to_num_(0, 0, 0)
        torch.nn.utils.clip_grad_norm_(self.head.parameters(), 1.0)
        warm, start = min(1.0, (self.step + 1) / 100), 0.25
        fall = 1.0 if x < start else 0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, (x - start) / (1 - start))))
        for group in self.optimiser.param_groups:
            group["lr"] = self.lr * warm * fall
        self.optimiser.step()
        self.step += 1
        now, keep = self.head.state_dict(), min(self.args.average, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.values()), [now[k] for k in self.average], 1 - keep)
        return loss.detach()

    def averaged(self):
        head = Head(self.shape).to(self.args.device)
        head.load_state_dict(self.average)
        return head


@torch.no_grad()
def scores(heads, samples, role, k, args, step=12.0):
    """[object, head]: PSNR at the 2x2 average over white, the mean of an object's samples."""
    found = collections.defaultdict(list)
    for s in samples:
        if len(s.at[role][0][0]) > args.voxels[k]:
            continue
        rng = np.random.default_rng(1)
        made = assemble([s], role, s.group[0], rng, args, step, views=6)
        truth = F.avg_pool2d(made[3][2] + 1 - made[3][3], 2)
        white = torch.ones(len(truth), 3, device=args.device)
        seen = [F.avg_pool2d(drawn(h, *made, white, k)[0], 2).clamp(0, 1) for h in heads]
        found[object_of(s.name)].append([-10 * math.log10(max((v - truth).pow(2).mean().item(), 1e-9)) for v in seen])
    return {name: np.round(np.mean(v, 0), 3).tolist() for name, v in sorted(found.items())}


def options():
    p = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    p.add_argument("--init", default="../../models/heads.safetensors", help="the model file to start from")
    p.add_argument("--data", nargs="+", required=True, help="folders of samples, with their subfolders")
    p.add_argument("--moved", help="folder of optimised occupancy, files named as the samples' paths with _ for /")
    p.add_argument("--out", required=True)
    p.add_argument("--minutes", type=float, default=8)
    p.add_argument("--lr", type=float, default=8e-4, help="of `best`; `quick` has 1.7 times it")
    p.add_argument("--average", type=float, default=0.9985)
    p.add_argument("--square", type=float, default=40.0)
    p.add_argument("--moved-share", type=float, default=0.5)
    p.add_argument("--share-8", type=float, default=0.25, help="of the steps, for heads of eight Gaussians a voxel")
    p.add_argument("--most", type=int, default=12, help="samples in a batch")
    p.add_argument("--voxels", type=json.loads, default={"1": 260000, "8": 60000}, help="voxels in a batch, by Gaussians a voxel")
    p.add_argument("--keep", type=int, default=3000, help="samples to read")
    p.add_argument("--wait", type=int, default=60, help="samples to wait for before the first step")
    p.add_argument("--readers", type=int, default=2)
    p.add_argument("--evaluate-every", type=int, default=600)
    p.add_argument("--device", default="cuda")
    p.add_argument("--seed", type=int, default=0)
    return p


def save(learners, folder):
    for m in learners:
        atomic_save({"shape": m.shape, "average": {n: v.cpu() for n, v in m.average.items()}}, os.path.join(folder, f"{m.name}.pt"))


def evaluate(learners, library, args, say):
    """What is held out, drawn by each head before and after."""
    for k, role in ((1, 2), (1, 3), (8, 1)):
        heads = [h for m in learners[k] for h in (m.before, m.averaged())]
        say("held out", k, role, scores(heads, list(library.held_out)[:30], role, k, args))


def main(argv=None):
    args = options().parse_args(argv)
    args.dtype = torch.bfloat16 if args.device == "cuda" else torch.float32
    args.voxels = {int(k): v for k, v in args.voxels.items()}
    os.makedirs(args.out, exist_ok=True)
    begin = time.monotonic()
    elapsed = lambda: (time.monotonic() - begin) / (60 * args.minutes)
    say = lambda *what: print(f"{time.monotonic() - begin:.1f}", *what, flush=True)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    learners = {k: [Learner(f"{kind}.{k}", args) for kind in ("best", "quick")] for k in KINDS}
    every = [m for group in learners.values() for m in group]
    library = Library(args)
    while (len(library.known) < args.wait or not library.groups) and not library.error:
        time.sleep(0.5)
    say("samples", {g: len(v) for g, v in library.groups.items()}, "held out", len(library.held_out))
    steps, losses = 0, collections.defaultdict(list)
    while elapsed() < 1:
        if library.error:
            raise library.error
        k = 8 if rng.random() < args.share_8 else 1
        roles, shares = zip(*KINDS[k].items())
        role = int(rng.choice(roles, p=shares))
        chosen, depth = library.choose(rng, k, role)
        if not chosen:
            continue
        made = assemble(chosen, role, depth, rng, args)
        for learner in learners[k]:
            losses[f"{learner.name}:{role}"].append(learner.learn(*made, elapsed()))
        steps += 1
        if steps % 100 == 0:
            means = {n: round(torch.stack(v).mean().item(), 5) for n, v in sorted(losses.items())}
            say("step", steps, f"x {elapsed():.3f}", means, "samples", len(library.known))
            losses.clear()
        if steps % args.evaluate_every == 0:
            evaluate(learners, library, args, say)
            save(every, args.out)
    evaluate(learners, library, args, say)
    save(every, args.out)
    say("done", steps)
    return steps


if __name__ == "__main__":
    main()
