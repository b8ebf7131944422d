"""Trains one of the heads of `heads.py`. See README.md; `python train_heads.py --help` lists the options."""

import argparse
import collections
import glob
import json
import math
import os
import queue
import signal
import threading
import time

import numpy as np
import torch

import ops
from heads import Head, draw, parameters, per_voxel, place, saved_head, visible
from octree_samples import Sample, decoded_colours
from train import atomic_save, distortion, imitation, keep_memory

# Objects of which nothing is trained on.
HELD_OUT = ("person_Black_M_2_Medi", "gz_cordless_drill", "bob", "ph_wooden_bookshelf_worn", "tds_Nymph")


def object_of(path):
    return os.path.basename(path).removesuffix(".safetensors").partition("_")[2]


def random_step(rng, lossless=0.2, most=64.0):
    """Luma's quantisation step: log-uniform, for a share of the samples lossless."""
    return 1.0 if rng.random() < lossless else float(np.exp(rng.uniform(math.log(1.5), math.log(most))))


class Stream:
    """(sample, tree, role, decoded colours, step, views) in an order that is a function of the seed; prepared ahead by one thread."""

    def __init__(self, files, args, start=0):
        self.files, self.args, self.known = files, args, collections.OrderedDict()
        self.roles, self.shares = zip(*((int(r), float(w)) for r, w in (part.split(":") for part in args.roles.split(","))))
        self.queue = queue.Queue(2)
        threading.Thread(target=self._run, args=(start,), daemon=True).start()

    def sample(self, path):
        if path not in self.known:
            self.known[path] = Sample(path, max(self.roles), self.args.teacher, self.args.moved)
            if len(self.known) > self.args.keep:
                self.known.popitem(last=False)
        return self.known[path]

    def make(self, position):
        epoch, at = divmod(position, len(self.files))
        order = np.random.default_rng((self.args.seed, epoch)).permutation(len(self.files))
        rng = np.random.default_rng((self.args.seed, epoch, at))
        sample = self.sample(self.files[order[at]])
        role = int(rng.choice(self.roles, p=np.array(self.shares) / sum(self.shares)))
        while len(sample.tree.coords[role]) > self.args.most_voxels and role > min(self.roles):
            role -= 1
        step = random_step(rng)
        views = rng.permutation(len(sample.cameras))[: self.args.views]
        tree = sample.tree
        if step >= self.args.moved_from and role in sample.moved and rng.random() < self.args.moved_share:
            tree = sample.moved[role][rng.integers(len(sample.moved[role]))]
        return sample, tree, role, decoded_colours(tree, role, step, rng), step, sample.pictures(views)

    def _run(self, position):
        torch.set_num_threads(1)
        try:
            while True:
                self.queue.put(self.make(position))
                position += 1
        except Exception as error:
            self.queue.put(error)

    def next(self):
        item = self.queue.get()
        if isinstance(item, Exception):
            raise item
        return item


class Trainer:
    def __init__(self, args):
        self.args = args
        with open(args.config) as f:
            self.shape = json.load(f)
        torch.manual_seed(args.seed)
        self.head, self.gaussians = Head(self.shape), self.shape["gaussians"]
        self.optimiser = torch.optim.Adam(self.head.parameters(), lr=args.lr, betas=(0.9, 0.999), fused=True)
        self.average = {k: v.detach().clone() for k, v in self.head.state_dict().items()}
        self.step, self.used = 0, 0.0
        self.elder = None
        if args.elder:
            shape, weights = saved_head(args.elder)
            self.elder = Head(shape)
            self.elder.load_state_dict(weights)

    def state(self):
        return {"shape": self.shape, "model": self.head.state_dict(), "average": self.average, "optimiser": self.optimiser.state_dict(),
                "step": self.step, "used": self.used, "args": vars(self.args)}

    def start_from(self, path):
        self.head.load_state_dict(saved_head(path)[1])
        self.average = {k: v.clone() for k, v in self.head.state_dict().items()}

    def resume(self, path):
        self.start_from(path)
        s = torch.load(path, weights_only=False)
        self.head.load_state_dict(s["model"])
        self.optimiser.load_state_dict(s["optimiser"])
        self.step, self.used = s["step"], s["used"]

    def fraction(self):
        return self.used / (self.args.minutes * 60) if self.args.minutes else self.step / self.args.steps

    def taught(self, sample, tree, role, rgb, level, above, here):
        """What to imitate: an elder head that reads the same, or what the teacher said of this role, with true colours."""
        k = self.gaussians
        with torch.no_grad():
            if self.elder:
                return parameters(self.elder(above, here, level), rgb, k)
            if sample.taught is None or tree is not sample.tree or role != {1: 2, 8: 1}[k]:
                return None
            own = parameters(sample.taught[f"raw.{role}"].float(), rgb, k)
            colour = torch.from_numpy(sample.tree.colours[role]) / 255 if k == 1 else sample.tree.child_colours(role)[0]
            return (*own[:4], colour)

    def loss(self, item, imitate, drawing):
        sample, tree, role, decoded, step, (cameras, image, coverage) = item
        level = tree.level(role)
        above, here, rgb = tree.head_inputs(role, decoded, step)
        own = parameters(self.head(above, here, level), rgb, self.gaussians)
        loss, info = own[0].new_zeros(()), {"role": role, "voxels": len(rgb)}
        if drawing:
            background = torch.rand(len(image), 3)
            seen = draw(visible(place(own, level.coords, self.gaussians)), cameras, 2 ** (3 - role) / per_voxel(self.gaussians), background, image.shape[-1])
            truth = image + (1 - coverage) * background[:, :, None, None]
            loss = loss + distortion(seen, truth, self.args.pyramid, self.args.square)
            info |= {"d": loss.item(), "mse": (seen - truth).pow(2).mean().item()}
        if imitate > 0 and (taught := self.taught(sample, tree, role, rgb, level, above, here)):
            apart = imitation(own, taught)
            loss, info["apart"] = loss + imitate * apart, apart.item()
        if self.args.small:  # what the pictures say nothing of keeps the decoded colour
            loss = loss + self.args.small * (own[4] - rgb.repeat_interleave(self.gaussians, 0)).pow(2).mean()
        return loss, info

    def train_step(self, item):
        args, x = self.args, self.fraction()
        imitate = args.imitate * max(0.0, 1 - x / args.imitate_until)
        loss, info = self.loss(item, imitate, x >= args.draw_from)
        if not loss.requires_grad:
            return info
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        warm = min(1.0, (self.step + 1) / args.warmup)
        fall = 1.0 if x < args.decay_from else 0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * min(1.0, (x - args.decay_from) / (1 - args.decay_from))))
        for group in self.optimiser.param_groups:
            group["lr"] = args.lr * warm * fall
        norm = torch.nn.utils.clip_grad_norm_(self.head.parameters(), args.clip)
        if torch.isfinite(norm):
            self.optimiser.step()
        self.step += 1
        keep = min(args.average, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            now = self.head.state_dict()
            torch._foreach_lerp_(list(self.average.values()), [now[k] for k in self.average], 1 - keep)
        return info | {"loss": loss.item(), "norm": norm.item()}

    def averaged(self):
        head = Head(self.shape)
        head.load_state_dict(self.average)
        return head.eval()


def options():
    p = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    p.add_argument("--config", required=True, help="shape of the head: configs/heads-*.json")
    p.add_argument("--data", required=True, help="folder of samples of whole objects")
    p.add_argument("--out", required=True, help="folder of checkpoints and the log")
    p.add_argument("--teacher", help="folder that `teach.py` wrote")
    p.add_argument("--moved", help="folder that `moved.py` wrote: samples with optimised occupancy")
    p.add_argument("--moved-share", type=float, default=0.5, help="how often the occupancy is an optimised one, if there is one")
    p.add_argument("--moved-from", type=float, default=8.0, help="luma's step from which on it may be")
    p.add_argument("--elder", help="checkpoint, or MODEL.safetensors:SET, of a head of as many Gaussians to imitate instead")
    p.add_argument("--init", help="checkpoint, or MODEL.safetensors:SET, to start from")
    p.add_argument("--resume", action="store_true", help="go on from OUT/last.pt")
    p.add_argument("--roles", default="2:1", help="roles and how often they are drawn; 3 is a sample's finest level")
    p.add_argument("--most-voxels", type=int, default=80000, help="of a larger level a coarser role is taken instead")
    p.add_argument("--only", default="", help="only samples whose names contain one of these, comma-separated")
    p.add_argument("--minutes", type=float, default=0, help="budget; the schedule follows the clock")
    p.add_argument("--steps", type=int, default=2000, help="budget without --minutes")
    p.add_argument("--views", type=int, default=2)
    p.add_argument("--lr", type=float, default=1e-3)
    p.add_argument("--warmup", type=int, default=50)
    p.add_argument("--decay-from", type=float, default=0.3)
    p.add_argument("--average", type=float, default=0.995)
    p.add_argument("--clip", type=float, default=1.0)
    p.add_argument("--imitate", type=float, default=0.0, help="weight of imitation at the start")
    p.add_argument("--imitate-until", type=float, default=1e9, help="fraction of the budget at which it has vanished")
    p.add_argument("--draw-from", type=float, default=0.0, help="fraction of the budget from which pictures are drawn")
    p.add_argument("--pyramid", type=float, default=1.0)
    p.add_argument("--square", type=float, default=40.0)
    p.add_argument("--small", type=float, default=0.05, help="weight of the squared change of colours")
    p.add_argument("--keep", type=int, default=400, help="samples to keep in memory")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--precision", choices=["f32", "bf16"], default="f32", help="operands of convolutions; bf16 where the processor has AVX512-BF16")
    p.add_argument("--save-minutes", type=float, default=2)
    return p


def main(argv=None):
    args = options().parse_args(argv)
    torch.set_num_threads(args.threads)
    ops.extension().set_bf16(args.precision == "bf16")
    keep_memory()
    os.makedirs(args.out, exist_ok=True)
    last = os.path.join(args.out, "last.pt")
    trainer = Trainer(args)
    if args.resume:
        trainer.resume(last)
    elif args.init:
        trainer.start_from(args.init)
    files = [f for f in sorted(glob.glob(os.path.join(args.data, "*.safetensors"))) if not f.endswith(tuple(f"_{name}.safetensors" for name in HELD_OUT))]
    files = [f for f in files if any(part in os.path.basename(f) for part in args.only.split(","))]
    if args.draw_from >= 1:
        files = [f for f in files if args.elder or args.teacher and os.path.exists(os.path.join(args.teacher, os.path.basename(f)))]
    stream = Stream(files, args, trainer.step)
    stop = []
    for s in (signal.SIGINT, signal.SIGTERM):
        signal.signal(s, lambda *_: stop.append(1))
    log = open(os.path.join(args.out, "log.jsonl"), "a")
    saved, rows = time.monotonic(), []
    while trainer.fraction() < 1 and not stop:
        begin = time.monotonic()
        rows.append(trainer.train_step(stream.next()))
        trainer.used += time.monotonic() - begin
        if trainer.step % 20 == 0:
            row = {"step": trainer.step, "x": round(trainer.fraction(), 3), "sec": round(time.monotonic() - begin, 2)}
            for key in ("loss", "apart", "d", "mse", "norm", "voxels"):
                values = [r[key] for r in rows if key in r]
                if values:
                    row[key] = round(float(np.mean(values)), 5)
            print(json.dumps(row), file=log, flush=True)
            print(row, flush=True)
            rows = []
        if time.monotonic() - saved > args.save_minutes * 60:
            atomic_save(trainer.state(), last)
            saved = time.monotonic()
    atomic_save(trainer.state(), last)


if __name__ == "__main__":
    main()
