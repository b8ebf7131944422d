"""Trains the codec. See README.md; `python train.py --help` lists the options."""

import argparse
import ctypes
import glob
import json
import math
import os
import random
import signal
import sys
import time

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file

import data
import ops
from crop import join
from grow import grow
from model import B2P, groups, parameters

HERE = os.path.dirname(os.path.abspath(__file__))


# ---------------------------------------------------------------------------------------------------------------------
# Loss


def window(size, sigma=1.5, width=11):
    """Matrix [size - width + 1, size] that convolves a row with a Gaussian window."""
    t = torch.arange(width, dtype=torch.float32) - (width - 1) / 2
    g = torch.exp(-t * t / (2 * sigma * sigma))
    g /= g.sum()
    m = torch.zeros(size - width + 1, size)
    for i in range(m.shape[0]):
        m[i, i:i + width] = g
    return m


_windows = {}


def ssim(a, b, most=256):
    """Structural similarity of pictures [V, 3, H, W] in 0..1; of larger ones than `most`, of a part at random, which is that of the whole on average."""
    for axis in (2, 3):
        if a.shape[axis] > most:
            at = int(torch.randint(a.shape[axis] - most + 1, ()))
            a, b = a.narrow(axis, at, most), b.narrow(axis, at, most)
    h, w = a.shape[2:]
    for s in (h, w):
        if (s, a.device) not in _windows:
            _windows[s, a.device] = window(s).to(a.device)
    mh, mw = _windows[h, a.device], _windows[w, a.device].T
    ma, mb, saa, sbb, sab = (mh @ torch.cat([a, b, a * a, b * b, a * b]) @ mw).chunk(5)
    c1, c2 = 0.01**2, 0.03**2
    va, vb, cov = saa - ma * ma, sbb - mb * mb, sab - ma * mb
    return (((2 * ma * mb + c1) * (2 * cov + c2)) / ((ma * ma + mb * mb + c1) * (va + vb + c2))).mean()


LUMA_CHROMA = torch.tensor([[0.33, 0.34, 0.33], [1.0, -1.0, 0.0], [-0.5, -0.5, 1.0]]).T.contiguous()
CHROMA = torch.tensor([[0.5, -0.5, 0.0], [-0.25, -0.25, 0.5]])


def distortion(image, truth, pyramid, square):
    """D = 3 L1 + `square` MSE + 0.2 (1 - SSIM), at the drawn size and at its 2x2 average, which is what evaluation looks at, plus
    `pyramid` times an L1 over coarser averages, luma and chroma, where blotches show."""
    total = 0
    for level in range(2):
        if level:
            image, truth = F.avg_pool2d(image, 2), F.avg_pool2d(truth, 2)
        e = image - truth
        total = total + (1, 2)[level] / 3 * (3 * e.abs().mean() + square * e.pow(2).mean() + 0.2 * (1 - ssim(image, truth)))
    if pyramid > 0:
        e = image - truth
        matrix = CHROMA.to(e.device)
        for _ in range(3):
            e = F.avg_pool2d(e, 2)
            c = torch.einsum("kc,vchw->vkhw", matrix, e)
            total = total + pyramid * (e.abs().mean() + c.abs().mean())
    return total


def imitation(own, taught, thin=0.05):
    """How far Gaussians are from those that other heads make of the same voxels (`model.parameters` of both), by parameters and not by what
    they look like: of a covariance whose normal is uncertain, the mean is thick. Sizes below `thin` are all the same. What the other heads
    let vanish may look like anything."""
    (offset, sigma, rotation, alpha, colour), (offset_t, sigma_t, rotation_t, alpha_t, colour_t) = own, taught
    log = lambda s: s.clamp_min(thin).log()
    apart = lambda a, b: (a - b).pow(2).sum(1)
    d = 4 * apart(offset, offset_t) + 0.5 * apart(log(sigma), log(sigma_t)) + 10 * apart(rotation, rotation_t) + 10 * apart(colour, colour_t)
    return (alpha_t * d).sum() / alpha_t.sum().clamp_min(1e-6) + (alpha - alpha_t).abs().mean()


def psnr(mse):
    return -10 * math.log10(max(mse, 1e-10))


# ---------------------------------------------------------------------------------------------------------------------
# Heads of an exported model


def quick_heads(path, like):
    """The quick heads of a model file as the state of `like`: f16 weights, those of normalised layers up to a factor that they don't depend on."""
    tensors = {k.removeprefix("gg.quick."): v.float() for k, v in load_file(path).items() if k.startswith("gg.quick.")}
    return {k: tensors[k].reshape(v.shape) for k, v in like.state_dict().items()}


def widths(cfg):
    """The channels of a network and of its heads."""
    return [part["channels"] for part in (cfg, *cfg["gg"])]


# ---------------------------------------------------------------------------------------------------------------------
# Schedule, as functions of the fraction of the budget that is used


def rate_weight(x, args):
    start, end = args.rate_start, args.rate_ramp
    return 1.0 if x >= end else start ** (1 - x / end)


def learning_rate(x, step, args):
    warm = min(1.0, (step + 1) / args.warmup) if args.warmup else 1.0
    if x < args.decay_from:
        return warm
    return warm * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * (x - args.decay_from) / (1 - args.decay_from))))


# ---------------------------------------------------------------------------------------------------------------------


def atomic_save(obj, path):
    torch.save(obj, path + ".tmp")
    os.replace(path + ".tmp", path)


def keep_memory():
    """Asks the C library to keep freed blocks: a step allocates the same large tensors again, and fresh pages are slow."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD
        libc.mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD
    except OSError:
        pass


class Trainer:
    def __init__(self, args):
        self.args, self.device = args, args.device
        with open(args.config) as f:
            self.cfg = json.load(f)
        torch.manual_seed(args.seed)
        self.rng = random.Random(args.seed)
        self.model = B2P(self.cfg).to(self.device)
        self.model.gg.requires_grad_(args.lr_heads > 0)
        learning = self.model.gg if args.only_heads else self.model
        self.optimiser = torch.optim.Adam(groups(learning, args.lr_conv, args.lr_linear, args.lr_heads), betas=(0.9, 0.999), eps=1e-8, fused=True)
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.step, self.used, self.calibrated, self.new_heads = 0, 0.0, False, False
        self.finest = {}  # of a frozen first encoder: its features, in f16, by the sample's name
        self.decoded = {}  # where only the heads are trained: what they read, in f16, by the sample's name
        self.longer = None  # what to start from, where it makes features of more roles
        self.teacher, self.taught = None, {}  # other heads of the same network, and what they make of a sample, in f16

    def state(self):
        return {"model": self.model.state_dict(), "average": self.average, "optimiser": self.optimiser.state_dict(), "step": self.step,
                "used": self.used, "calibrated": self.calibrated, "config": self.cfg, "args": vars(self.args), "torch_rng": torch.get_rng_state(),
                "rng": self.rng.getstate()}

    def weights_of(self, path):
        if not path.endswith(".safetensors"):
            return torch.load(path, map_location=self.device, weights_only=False)["average"]
        return {k: v.float() for k, v in load_file(path, device=self.device).items()}

    @staticmethod
    def config_of(path):
        if not path.endswith(".safetensors"):
            return torch.load(path, map_location="cpu", weights_only=False)["config"]
        with safe_open(path, "pt") as f:
            return json.loads((f.metadata() or {}).get("config", "{}"))

    def stay_near(self, path, share):
        """Moves the averaged weights this share of the way back to those of `path`."""
        start = self.weights_of(path)
        self.average = {k: torch.lerp(v, start[k], share) if v.is_floating_point() else v for k, v in self.average.items()}

    def start_from(self, path):
        """Takes the averaged weights of a checkpoint, or those that `export.py --weights` wrote; all but the heads where only heads are
        to be trained and the configuration has others. Half as many channels grow."""
        weights, before = self.weights_of(path), self.config_of(path)
        if before.get("fr_roles", 3) > self.cfg.get("fr_roles", 3):
            self.longer = B2P(before).to(self.device)
            self.longer.load_state_dict(weights)
            return
        if before and any(a < b for a, b in zip(widths(before), widths(self.cfg))):
            narrow = B2P(before).to(self.device)
            narrow.load_state_dict(weights)
            grow(self.model, narrow)
            weights = self.model.state_dict()
        heads = lambda tensors: {k: v.shape for k, v in tensors.items() if k.startswith("gg.")}
        self.new_heads = self.args.only_heads and heads(weights) != heads(self.model.state_dict())
        if self.new_heads:
            weights = {k: v for k, v in weights.items() if not k.startswith("gg.")} | {f"gg.{k}": v for k, v in self.model.gg.state_dict().items()}
        self.model.load_state_dict(weights)
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.calibrated = True

    def start_heads(self, samples):
        if self.args.quick_of:
            self.model.gg.load_state_dict(quick_heads(self.args.quick_of, self.model.gg))
        else:
            self.model.start_heads(join([s.crop for s in samples]).to(self.device), torch.cat([s.rgb for s in samples]).to(self.device))
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}

    def shorten(self, samples):
        """Takes the weights of `--init` where these make features of more roles."""
        self.model.shorten(self.longer, samples)
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.calibrated, self.longer = True, None

    def learn_from(self, path):
        """Takes the heads of a file of `export.py --weights` as a teacher of others for the same network."""
        self.teacher = B2P(self.config_of(path)).to(self.device).eval()
        self.teacher.load_state_dict(self.weights_of(path))

    @torch.no_grad()
    def taught_raw(self, sample, head):
        """What the teacher says of a sample: its heads run once."""
        if sample.name not in self.taught:
            self.taught[sample.name] = [self.teacher.generate(self.heads_read(sample, h), sample.crop, h)[1].half() for h in (1, 2)]
        return self.taught[sample.name][head - 1].float()

    def restore(self, path):
        s = torch.load(path, map_location=self.device, weights_only=False)
        self.model.load_state_dict(s["model"])
        self.average = s["average"]
        self.optimiser.load_state_dict(s["optimiser"])
        self.step, self.used, self.calibrated = s["step"], s["used"], s["calibrated"]
        torch.set_rng_state(s["torch_rng"].cpu())
        self.rng.setstate(s["rng"])

    def revive(self, crop, rgb):
        self.model.revive(crop, rgb, self.args.revive)
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}

    def fraction(self):
        return self.used / (self.args.minutes * 60) if self.args.minutes else self.step / self.args.steps

    @torch.no_grad()
    def frozen(self, sample):
        """Features of the finest level where its encoder is frozen: they are computed once."""
        if not self.args.freeze_finest:
            return None
        if sample.name not in self.finest:
            self.finest[sample.name] = self.model.analyse_finest(sample.crop, sample.rgb).half()
        return self.finest[sample.name].float()

    def keep_finest(self, folder):
        """What `frozen` computes, from the files of a folder where there are any."""
        for path in glob.glob(os.path.join(folder, "*.npy")):
            self.finest[os.path.basename(path)[: -len(".npy")]] = torch.from_numpy(np.load(path))

    @torch.no_grad()
    def heads_read(self, sample, head):
        """Reconstructed features of a head's role, from rounded latents: computed once, as nothing before the heads learns."""
        if sample.name not in self.decoded:
            features = self.model.analyse(sample.crop, sample.rgb, self.frozen(sample))
            trail, _, _ = self.model.code(sample.crop, features, 2, "round")
            self.decoded[sample.name] = [trail[r].half() for r in (1, 2)]
        return self.decoded[sample.name][head - 1].float()

    def picture_loss(self, generated, sample):
        """Distortion and mean squared error of pictures over backgrounds of random colours."""
        background = torch.rand(sample.image.shape[0], 3, device=generated[0].device)
        h, w = sample.image.shape[2:]
        image = ops.splat(*generated, sample.cameras, background, w, h)
        truth = sample.image + (1 - sample.coverage) * background[:, :, None, None]
        return distortion(image, truth, self.args.pyramid, self.args.square), (image - truth).pow(2).mean().item()

    def loss(self, sample, head, weight, mode, hint, imitate=0.0, draw=True):
        if self.args.only_heads:
            trail, rates, latents = [self.heads_read(sample, head)], [torch.zeros(())] * (head + 1), [torch.zeros(2)] * (head + 1)
        else:
            features = self.model.analyse(sample.crop, sample.rgb, self.frozen(sample))
            trail, rates, latents = self.model.code(sample.crop, features, head, mode)
        generated, raw = self.model.generate(trail[-1], sample.crop, head)
        d, mse = self.picture_loss(generated, sample) if draw else (raw.new_zeros(()), None)
        drawn = d.item()
        if imitate > 0:
            d = d + imitate * imitation(*(parameters(r, self.cfg, head == 2) for r in (raw, self.taught_raw(sample, head))))
        rate = sum(rates) / sample.crop.points
        # A latent that wanders off is cheap to code while the rate weighs nothing, and expensive to bring back.
        probes = 0.0
        if hint > 0:  # early on, the colour of each voxel is asked of g directly
            matrix = LUMA_CHROMA.to(raw.device)
            for g, probe, target in zip(trail, self.model.probe, self.model.colours(sample.crop, sample.rgb)):
                probes = probes + ((probe(g) + 0.5 - target) @ matrix).abs().mean()
        loss = hint * self.args.lam * probes + weight * rate + self.args.lam * d + 1e-4 * sum((y / 8).pow(4).mean() for y in latents if y.numel())
        return loss, {"probe": float(torch.as_tensor(probes).detach()), "rate": [r.item() / sample.crop.points for r in rates], "d": drawn,
                      "mse": mse, "std": [y.std().item() for y in latents if y.numel()]}

    def train_step(self, samples, calibration=None):
        args, x = self.args, self.fraction()
        weight, mode = rate_weight(x, args), "noise" if x < args.rounding_from else "mixed"
        head = 1 if self.rng.random() < args.coarse else 2
        hint = args.hint * max(0.0, 1 - x / args.hint_until) if args.hint_until > 0 else 0.0
        imitate = args.imitate * max(0.0, 1 - x / args.imitate_until) if self.teacher else 0.0
        heads = [1, 2] if args.both else [head]
        if not self.calibrated:
            some = calibration or samples
            self.model.calibrate(join([s.crop for s in some]).to(self.device), torch.cat([s.rgb for s in some]))
            self.model.pass_colour()
            self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
            self.calibrated = True
        self.optimiser.zero_grad(set_to_none=True)
        for sample in samples:
            for h in heads:
                loss, info = self.loss(sample, h, weight, mode, hint, imitate, draw=x >= args.draw_from)
                (loss / len(samples)).backward()
        lr = learning_rate(x, self.step, args)
        for group in self.optimiser.param_groups:
            group["lr"] = group["base"] * lr
        norm = torch.nn.utils.clip_grad_norm_([p for g in self.optimiser.param_groups for p in g["params"] if p.grad is not None], args.clip)
        if torch.isfinite(norm):
            self.optimiser.step()
        self.step += 1
        keep = min(args.average, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            now = self.model.state_dict()
            keys = [k for k in now if now[k].is_floating_point()]
            torch._foreach_lerp_([self.average[k] for k in keys], [now[k] for k in keys], 1 - keep)
        return info | {"loss": loss.item(), "head": heads[-1], "norm": norm.item(), "weight": weight, "lr": lr, "points": samples[-1].crop.points}

    @torch.no_grad()
    def evaluate(self, samples, averaged=True):
        """Rounded bpp per role and PSNR (full, foreground) of both heads, white background, at the 2x2 average."""
        if averaged:
            keep = {k: v.clone() for k, v in self.model.state_dict().items()}
            self.model.load_state_dict(self.average)
        sums, bits, points = {1: [0.0] * 4, 2: [0.0] * 4}, [0.0] * 3, 0
        for sample in samples:
            features = self.model.analyse(sample.crop, sample.rgb, self.frozen(sample))
            points += sample.crop.points
            for head in (1, 2):
                trail, rates, _ = self.model.code(sample.crop, features, head, "round")
                if head == 2:
                    bits = [b + r.item() for b, r in zip(bits, rates)]
                (mean, cov, alpha, colour), _ = self.model.generate(trail[-1], sample.crop, head)
                h, w = sample.image.shape[2:]
                white = torch.ones(sample.image.shape[0], 3, device=mean.device)
                image = ops.splat(mean, cov, alpha, colour, sample.cameras, white, w, h)
                truth = sample.image + (1 - sample.coverage)
                image, truth, mask = F.avg_pool2d(image, 2), F.avg_pool2d(truth, 2), F.avg_pool2d(sample.coverage, 2) > 0.5
                e = (image - truth).pow(2)
                s = sums[head]
                s[0] += e.sum().item()
                s[1] += e.numel()
                s[2] += (e * mask).sum().item()
                s[3] += 3 * mask.sum().item()
        if averaged:
            self.model.load_state_dict(keep)
        row = {"bpp": [round(b / points, 4) for b in bits]}
        for head, s in sums.items():
            row[f"psnr{head}"], row[f"fg{head}"] = round(psnr(s[0] / s[1]), 2), round(psnr(s[2] / s[3]), 2)
        return row


def main(argv=None):
    p = argparse.ArgumentParser(formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    p.add_argument("--data", required=True, help="folder of samples")
    p.add_argument("--out", required=True, help="folder of checkpoints and logs")
    p.add_argument("--config", default=os.path.join(HERE, "configs/full.json"))
    p.add_argument("--lam", type=float, default=5.0, help="weight of distortion against bits per finest-level point")
    p.add_argument("--minutes", type=float, default=0, help="budget in minutes; the schedule follows it")
    p.add_argument("--steps", type=int, default=20000, help="budget in steps, when no --minutes are given")
    p.add_argument("--batch", type=int, default=1)
    p.add_argument("--views", type=int, default=3, help="views drawn per sample")
    p.add_argument("--coarse", type=float, default=0.4, help="share of steps that train the head of role 1")
    p.add_argument("--both", action="store_true", help="train both heads in every step")
    p.add_argument("--pyramid", type=float, default=1.0, help="weight of the multi-scale term")
    p.add_argument("--square", type=float, default=20.0, help="weight of the squared error")
    p.add_argument("--hint", type=float, default=1.0, help="weight of the early colour probes against distortion")
    p.add_argument("--hint-until", type=float, default=0.5)
    p.add_argument("--lr-conv", type=float, default=1e-4)
    p.add_argument("--lr-linear", type=float, default=3e-4)
    p.add_argument("--lr-heads", type=float, default=1.0, help="by how much faster the heads learn when the whole network does; 0: they stay")
    p.add_argument("--warmup", type=int, default=400)
    p.add_argument("--decay-from", type=float, default=0.6)
    p.add_argument("--rate-start", type=float, default=0.003)
    p.add_argument("--rate-ramp", type=float, default=0.6)
    p.add_argument("--rounding-from", type=float, default=0.6)
    p.add_argument("--clip", type=float, default=1.0)
    p.add_argument("--average", type=float, default=0.998, help="decay of the averaged weights")
    p.add_argument("--held-out", type=int, default=8)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--device", default="cpu")
    p.add_argument("--precision", choices=["f32", "bf16"], default="bf16", help="operands of convolutions on a CPU; bf16 where it has AVX512-BF16")
    p.add_argument("--save-minutes", type=float, default=5)
    p.add_argument("--evaluate-every", type=int, default=250)
    p.add_argument("--log-every", type=int, default=10)
    p.add_argument("--resume", action="store_true", help="continue from OUT/last.pt")
    p.add_argument("--revive", type=int, choices=[1, 2], help="with --init: give this role new latents, where its own died")
    p.add_argument("--freeze-finest", action="store_true", help="leave the encoder of the finest level as it is: a step is then twice as fast")
    p.add_argument("--only-heads", action="store_true", help="train what turns features into Gaussians and leave the bits as they are; with --init from weights of other heads than --config has, new ones")
    p.add_argument("--quick-of", metavar="MODEL", help="with --only-heads: start from this exported model's quick heads")
    p.add_argument("--teacher", metavar="WEIGHTS", help="with --only-heads: imitate the heads of these weights, of the same network")
    p.add_argument("--imitate", type=float, default=1.0, help="weight of the imitation at the start")
    p.add_argument("--imitate-until", type=float, default=0.5, help="fraction of the budget at which it has vanished")
    p.add_argument("--draw-from", type=float, default=0.0, help="fraction of the budget from which pictures are drawn; before, with --teacher, heads only imitate")
    p.add_argument("--cache", help="with --freeze-finest: folder of features of the finest level, NAME.npy for each sample")
    p.add_argument("--stop-after", type=int, default=0, help="stop at this step, as an interruption would")
    p.add_argument("--stay", type=float, default=0.0, help="at the end, the share of the averaged weights that are those of --init again")
    p.add_argument("--init", help="start from the averaged weights of this checkpoint, or from a file of `export.py --weights`; of half as many channels: they grow")
    args = p.parse_args(argv)

    torch.set_num_threads(args.threads)
    keep_memory()
    ops.extension().set_bf16(args.precision == "bf16")
    os.makedirs(args.out, exist_ok=True)
    trainer = Trainer(args)
    last = os.path.join(args.out, "last.pt")
    if args.resume:
        trainer.restore(last)
    elif args.init:
        trainer.start_from(args.init)
    if (args.teacher or args.quick_of) and not args.only_heads or args.draw_from and not args.teacher:
        p.error("--teacher and --quick-of want --only-heads, --draw-from wants --teacher")
    if args.revive and args.revive >= trainer.cfg.get("latent_roles", 3):
        p.error("--revive wants a role that has latents")
    if args.stay and (not args.init or trainer.new_heads or trainer.longer):
        p.error("--stay wants weights of the same heads in --init")
    if args.teacher:
        trainer.learn_from(args.teacher)
    train_files, held_files = data.split(args.data, args.held_out)
    if trainer.longer:
        trainer.shorten([data.load_sample(f) for f in train_files[:10]])
    held = [data.load_sample(f).to(args.device) for f in held_files]
    calibration = None if trainer.calibrated else [data.load_sample(f) for f in train_files[:6]]
    if trainer.new_heads:
        trainer.start_heads([data.load_sample(f) for f in train_files[:10]])
    if args.revive and not args.resume:
        some = [data.load_sample(f) for f in train_files[:10]]
        trainer.revive(join([s.crop for s in some]), torch.cat([s.rgb for s in some]))
    if args.cache:
        trainer.keep_finest(args.cache)
    stream = data.Stream(train_files, args.views, args.seed, trainer.step * args.batch, known=trainer.finest if args.freeze_finest else trainer.decoded)
    log = open(os.path.join(args.out, "log.jsonl"), "a")

    def write(row):
        log.write(json.dumps(row) + "\n")
        log.flush()
        print(" ".join(f"{k}={v}" for k, v in row.items()), flush=True)

    stop = []
    signal.signal(signal.SIGINT, lambda *_: stop.append(1))
    signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
    saved, means, unfinished = time.monotonic(), [], trainer.fraction() < 1
    while trainer.fraction() < 1 and not stop and not (args.stop_after and trainer.step >= args.stop_after):
        begin = time.monotonic()
        info = trainer.train_step([stream.next().to(args.device) for _ in range(args.batch)], calibration)
        trainer.used += time.monotonic() - begin
        means.append(info)
        if trainer.step % args.log_every == 0:
            mean = lambda key: sum(m[key] for m in means) / len(means)
            row = {"step": trainer.step, "x": round(trainer.fraction(), 4), "loss": round(mean("loss"), 4), "sec": round(time.monotonic() - begin, 2),
                   "points": int(mean("points")), "w": round(info["weight"], 4), "norm": round(mean("norm"), 3), "probe": round(mean("probe"), 4)}
            for h in (1, 2):
                of = [m for m in means if m["head"] == h]
                if of:
                    row[f"rate{h}"] = [round(sum(m["rate"][r] for m in of) / len(of), 4) for r in range(h + 1)]
                    row[f"std{h}"] = [round(std, 2) for std in of[-1]["std"]]
                    row[f"d{h}"] = round(sum(m["d"] for m in of) / len(of), 4)
                drawn = [m["mse"] for m in of if m["mse"] is not None]
                if drawn:
                    row[f"psnr{h}"] = round(psnr(sum(drawn) / len(drawn)), 2)
            write(row)
            means = []
        if trainer.step % args.evaluate_every == 0:
            begin = time.monotonic()
            row = {"eval": trainer.step, "x": round(trainer.fraction(), 4)} | trainer.evaluate(held)
            trainer.used += time.monotonic() - begin
            write(row)
        if time.monotonic() - saved > args.save_minutes * 60:
            atomic_save(trainer.state(), last)
            saved = time.monotonic()
    if args.stay and unfinished and trainer.fraction() >= 1:
        trainer.stay_near(args.init, args.stay)
    atomic_save(trainer.state(), last)
    write({"final": trainer.step} | trainer.evaluate(held))
    return trainer


if __name__ == "__main__":
    main(sys.argv[1:])
