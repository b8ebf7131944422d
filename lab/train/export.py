"""Checkpoint -> model file (safetensors): the exact zone as integers, the rest as f16, the probability tables, and the proofs.

    python export.py RUN/last.pt MODEL.safetensors --data FOLDER
    python export.py --random configs/tiny.json MODEL.safetensors
    python export.py --quick RUN/last.pt --streams-of OLD.safetensors MODEL.safetensors --data FOLDER
"""

import argparse
import json
import math
import sys

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.numpy import save_file

import data
import integer
import ops
from crop import join
from integer import LIMIT, SIGMA_MAX, SIGMA_MIN, SIGMAS, sigma_of
from model import B2P, Inception, NormConv, ResBlock, latents_of, reconstructed

WEIGHT_MAX = 511
LATENT_SHIFT = 6
# In squared edges of a generated voxel, which are two finest ones.
BLUR = ops.VOXEL_BLUR / 4


# ---------------------------------------------------------------------------------------------------------------------
# Activation ranges


class Ranges:
    """Largest magnitude and a high percentile of every layer's output over the calibration crops, after its ReLU if it has one."""

    def __init__(self):
        self.peak, self.high = {}, {}

    def add(self, name, x):
        x = x.abs().flatten()
        k = max(1, int(len(x) * 0.9999))
        self.peak[name] = max(self.peak.get(name, 0.0), x.max().item())
        self.high[name] = max(self.high.get(name, 0.0), x.kthvalue(k).values.item())

    def scale(self, *names):
        """Real value of one integer step for an edge shared by `names`: outliers beyond twice the percentile are cut."""
        reach = max(min(1.15 * self.peak[n], 2 * self.high[n]) for n in names)
        return max(reach, 1e-6) / LIMIT


@torch.no_grad()
def ranges_of(model, samples):
    """Runs the float network with rounded latents and records every edge of the exact zone and of the generators."""
    r = Ranges()
    hooks = []
    names = {m: n for n, m in model.named_modules()}

    def record(module, _, output):
        r.add(names[module], output)

    for name, module in model.named_modules():
        if name.split(".")[0] in ("up", "base", "near", "pem", "fr", "gg") and (isinstance(module, (Inception, ResBlock)) or hasattr(module, "taps")):
            hooks.append(module.register_forward_hook(record))
    for role, gg in model.gg.items():  # what follows layer 4 sees its output, whichever way it was computed
        after = [*gg.after, gg.conv_out][0]
        hooks.append(after.register_forward_pre_hook(lambda _, inputs, name=f"gg.{role}.layer4": r.add(name, inputs[0])))
    for s in samples:
        trail, _, _ = model.code(s.crop, model.analyse(s.crop, s.rgb), 2, "round")
        for role in model.gg:
            model.generate(trail[int(role)], s.crop, int(role))
    for h in hooks:
        h.remove()
    return r


# ---------------------------------------------------------------------------------------------------------------------
# Quantisation


def quantise_plain(name, weight, bias, scale_in, scale_out, out):
    """weight [taps, in, out] in reals; scale_in [in] or a number. Writes int16 weights, int32 biases with the rounding constant, shifts."""
    w = weight * np.asarray(scale_in, dtype=np.float64).reshape(-1, 1) / scale_out
    peak = np.maximum(np.abs(w).max((0, 1)), 1e-12)
    shift = np.floor(np.log2((WEIGHT_MAX + 0.49) / peak)).astype(np.int64)
    # A larger bias than the proof allows would need a smaller shift.
    room = np.floor(np.log2(2**30 / np.maximum(np.abs(bias / scale_out), 1e-12))).astype(np.int64)
    shift = np.clip(np.minimum(shift, room), 0, 30)
    q = np.clip(np.rint(w * 2.0**shift), -WEIGHT_MAX, WEIGHT_MAX)
    b = np.rint(bias / scale_out * 2.0**shift) + np.where(shift > 0, 2.0 ** (shift - 1), 0)
    worst = np.abs(q).sum((0, 1)) * LIMIT + np.abs(b)
    if worst.max() >= 2**31:
        raise SystemExit(f"{name}: an accumulator may reach {worst.max():.0f}")
    out[name + ".weight"] = q.astype(np.int16)
    out[name + ".bias"] = b.astype(np.int32)
    out[name + ".shift"] = shift.astype(np.uint8)


def quantise_norm(name, weight, gain, bias, scale_in, scale_out, out):
    peak = np.maximum(np.abs(weight).max((0, 1)), 1e-12)
    q = np.rint(weight * (WEIGHT_MAX / peak))
    if (q**2).sum((0, 1)).max() >= 2**31 or np.abs(q).sum((0, 1)).max() * LIMIT >= 2**31:
        raise SystemExit(f"{name}: weights too large for the norm's accumulator")
    out[name + ".weight"] = q.astype(np.int16)
    out[name + ".gain"] = (gain * (scale_in / scale_out)).astype(np.float32)
    out[name + ".bias"] = (bias / scale_out).astype(np.float32)


def quantise(model, ranges):
    cfg, out = model.cfg, {}
    modules = dict(model.named_modules())
    value = lambda p: p.detach().double().numpy()

    def layer(name, scale_in, scale_out, factor=1.0, shift=0.0):
        m = modules[name]
        if isinstance(m, NormConv):
            quantise_norm(name, value(m.weight), value(m.gain), value(m.bias), scale_in, scale_out, out)
        else:
            quantise_plain(name, value(m.weight) * factor, (value(m.bias) + shift) * factor, scale_in, scale_out, out)

    def inception(name, scale):
        own = {k: ranges.scale(f"{name}.{k}") for k in ("a1", "b1", "b2")}
        layer(name + ".a1", scale, own["a1"])
        layer(name + ".a2", own["a1"], scale)
        layer(name + ".b1", scale, own["b1"])
        layer(name + ".b2", own["b1"], own["b2"])
        layer(name + ".b3", own["b2"], scale)

    def chain(first, prefix, blocks):
        """One scale for a residual chain: what enters it, every branch and every sum."""
        names = [first] + [f"{prefix}.blocks.{b}" for b in range(blocks)]
        names += [f"{prefix}.blocks.{b}.{k}" for b in range(blocks) for k in ("a2", "b3")]
        return ranges.scale(*names)

    g_scale = [ranges.scale(f"fr.{r}.lin2") if reconstructed(cfg, r) else 0.0 for r in range(3)]
    c_scale = [0.0, *g_scale[:2]]
    if cfg["upsample"] == "learned":
        for r in (1, 2):
            c_scale[r] = ranges.scale(f"up.{r}")
            layer(f"up.{r}", g_scale[r - 1], c_scale[r])
    per_nat = (SIGMAS - 1) / math.log(SIGMA_MAX / SIGMA_MIN)
    for r in map(int, model.pem):
        s = chain(f"pem.{r}.conv_in", f"pem.{r}", cfg["pem_blocks"])
        layer(f"pem.{r}.conv_in", c_scale[r], s)
        for b in range(cfg["pem_blocks"]):
            inception(f"pem.{r}.blocks.{b}", s)
        layer(f"pem.{r}.mu", s, 1.0, factor=16.0)
        layer(f"pem.{r}.sigma", s, 1.0, factor=per_nat, shift=-math.log(SIGMA_MIN))
    if cfg.get("base_channels"):
        s1, s2 = ranges.scale("base.lin1"), ranges.scale("base.lin2")
        layer("base.lin1", 2.0**-LATENT_SHIFT, s1)
        layer("base.lin2", s1, s2)
        layer("base.mu", s2, 1.0, factor=16.0)
        layer("base.sigma", s2, 1.0, factor=per_nat, shift=-math.log(SIGMA_MIN))
    for r in model.near:
        s1, s2 = ranges.scale(f"near.{r}.lin1"), ranges.scale(f"near.{r}.lin2")
        layer(f"near.{r}.lin1", 2.0**-LATENT_SHIFT, s1)
        layer(f"near.{r}.lin2", s1, s2)
        layer(f"near.{r}.mu", s2, 1.0, factor=16.0)
        layer(f"near.{r}.sigma", s2, 1.0, factor=per_nat)
    for r in range(3):
        if not reconstructed(cfg, r):
            g_scale[r] = c_scale[r]
            continue
        s = chain(f"fr.{r}.lin1", f"fr.{r}", cfg["fr_blocks"])
        inputs = np.full(latents_of(cfg, r) + (cfg["channels"] if r else 0), c_scale[r])
        inputs[:latents_of(cfg, r)] = 2.0**-LATENT_SHIFT
        layer(f"fr.{r}.lin1", inputs, s)
        for b in range(cfg["fr_blocks"]):
            inception(f"fr.{r}.blocks.{b}", s)
        layer(f"fr.{r}.lin2", s, g_scale[r])
    for role, gg in model.gg.items():
        out[f"gg.{role}.scale"] = np.array(generator_scales(f"gg.{role}", gg, ranges), np.float32)
    out["g_scale"], out["c_scale"] = np.array(g_scale, np.float32), np.array(c_scale, np.float32)
    for name, m in modules.items():
        if name.split(".")[0] in ("fc", "fs", "gg") and hasattr(m, "taps"):
            w = m.weight.detach()
            if isinstance(m, NormConv):  # free of scale: bring it to where f16 has its precision
                w = w / w.abs().amax((0, 1)).clamp_min(1e-12)
                out[name + ".gain"] = m.gain.detach().numpy().astype(np.float32)
            out[name + ".weight"] = w.half().numpy()
            out[name + ".bias"] = m.bias.detach().numpy().astype(np.float32)
    return out


def generator_scales(name, gg, ranges):
    """Real values of one integer step, for generators that run in integers: of the chain before layer 4 (what enters it, every branch and
    every sum), inside each of its blocks, and the same after layer 4."""
    scales = []
    for first, blocks, part in ((f"{name}.conv_in", gg.before, "before"), (f"{name}.layer4", gg.after, "after")):
        names = [f"{name}.{part}.{b}" for b in range(len(blocks))]
        scales.append(ranges.scale(first, *names, *(n + ".c2" for n in names)))
        scales += [ranges.scale(n + ".c1") for n in names]
    return scales


# ---------------------------------------------------------------------------------------------------------------------
# Tables


def normal_cdf(x):
    return 0.5 * torch.special.erfc(-torch.as_tensor(x, dtype=torch.float64) / math.sqrt(2)).numpy()


def frequencies(mass):
    """Integers >= 1 that sum to 65536, proportional to the masses; the last entry is the escape, whose mass is what is missing."""
    p = np.append(mass, max(0.0, 1.0 - mass.sum()))
    p = p / p.sum()
    f = 1 + np.floor(p * (65536 - len(p))).astype(np.int64)
    f[np.argmax(p)] += 65536 - f.sum()
    assert f.min() >= 1 and f.sum() == 65536
    return f


def pack(rows, lows):
    flat = np.concatenate([r - 1 for r in rows]).astype(np.uint16)
    offset = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.uint32)
    return flat, offset, np.array(lows, np.int16)


def gauss_tables():
    rows, lows = [], []
    for i in range(SIGMAS):
        sigma = float(sigma_of(i))
        half = min(330, max(1, math.ceil(5 * sigma)) + 1)
        edge = np.arange(-half, half + 2) - 0.5
        for frac in range(-8, 8):
            z = (edge - frac / 16) / sigma
            # Differences are taken in the tail where the function is small.
            upper, lower = normal_cdf(-z), normal_cdf(z)
            mass = np.where(z[:-1] > 0, upper[:-1] - upper[1:], lower[1:] - lower[:-1])
            rows.append(frequencies(mass))
            lows.append(-half)
    return pack(rows, lows)


@torch.no_grad()
def prior_tables(model):
    limit = model.cfg["latent_max"]
    y = torch.arange(-limit, limit + 1, dtype=torch.float64)[:, None].expand(-1, model.cfg["latents"])
    mass = model.prior.double()(y).numpy()
    model.prior.float()
    return pack([frequencies(mass[:, k]) for k in range(mass.shape[1])], [-limit] * mass.shape[1])


# ---------------------------------------------------------------------------------------------------------------------


def read(path):
    """Description and tensors of a model file."""
    with safe_open(path, "numpy") as f:
        return json.loads(f.metadata()["b2p"]), {k: f.get_tensor(k) for k in f.keys()}


def write(path, meta, tensors):
    save_file({k: np.ascontiguousarray(v) for k, v in sorted(tensors.items())}, path, metadata={"b2p": json.dumps(meta)})


def is_quick(name):
    return name.startswith("gg.quick.")


def same_streams(path, cfg):
    """Description and tensors of a model file whose streams a network of this configuration is to decode."""
    meta, tensors = read(path)
    exact = ("channels", "latents", "latent_roles", "base_channels", "near_channels", "learning", "pem_blocks", "fr_blocks", "fr_roles", "upsample", "inception_relu", "latent_max")
    if any(meta.get(k) != cfg.get(k) for k in exact):
        sys.exit(f"{path} is another network")
    return meta, tensors


def export(model, samples, path, info, streams_of=None):
    out = quantise(model, ranges_of(model, samples))
    for name, t in (("cdf.gauss", gauss_tables()), ("cdf.prior", prior_tables(model))):
        out[name], out[name + ".offset"], out[name + ".low"] = t
    meta = {"format": 1, **model.cfg, "latent_shift": LATENT_SHIFT, "blur": BLUR, **info}
    if streams_of:
        before, old = same_streams(streams_of, model.cfg)
        rest = lambda tensors: {k: v for k, v in tensors.items() if not k.startswith("gg.")}
        shapes = lambda tensors: {k: v.shape for k, v in tensors.items()}
        if shapes(rest(old)) != shapes(rest(out)):
            sys.exit(f"{streams_of} is another network")
        own = {k: v for k, v in out.items() if k.startswith("gg.")}
        out = rest(old) | own | {k: v for k, v in old.items() if is_quick(k)}
        meta |= {"heads_steps": meta["steps"]} | {k: before[k] for k in ("lambda", "steps", "bit_price", "learning", "quick_steps") if k in before}
        meta["gg"] = model.cfg["gg"] + [g for g in before["gg"] if g.get("heads") == "quick"]
    write(path, meta, out)


def export_quick(model, samples, path, info, streams_of):
    """The model file `streams_of` with the heads of `model`, which was trained on its features, as quick ones beside its own."""
    meta, out = same_streams(streams_of, model.cfg)
    own = [g for g in meta["gg"] if g.get("heads", "best") == "best"]
    if [g["role"] for g in own] != [g["role"] for g in model.cfg["gg"]]:
        sys.exit(f"{streams_of} has heads for other roles")
    for shared in ("offset_range", "scale_range", "scale_bias", "opacity_bias", "resblock_relu"):
        if meta[shared] != model.cfg[shared]:
            sys.exit(f"{streams_of} has another {shared}, which all heads share")
    if meta.get("blur") != BLUR:
        sys.exit(f"{streams_of} has heads trained with another blur")
    heads = {k: v for k, v in quantise(model, ranges_of(model, samples)).items() if k.startswith("gg.")}
    out = {k: v for k, v in out.items() if not is_quick(k)} | {"gg.quick." + k.removeprefix("gg."): v for k, v in heads.items()}
    meta |= {"gg": own + [{**g, "heads": "quick"} for g in model.cfg["gg"]], "quick_steps": info["steps"]}
    write(path, meta, out)


def half_weights(model):
    """Rounds the float zone's weights to what the file holds."""
    with torch.no_grad():
        for name, m in model.named_modules():
            if name.split(".")[0] in ("fc", "fs", "gg") and hasattr(m, "taps"):
                if isinstance(m, NormConv):
                    m.weight.div_(m.weight.abs().amax((0, 1)).clamp_min(1e-12))
                m.weight.copy_(m.weight.half().float())


@torch.no_grad()
def picture_error(model, sample, g, role):
    (mean, cov, alpha, colour), _ = model.generate(g, sample.crop, role)
    h, w = sample.image.shape[2:]
    image = ops.splat(mean, cov, alpha, colour, sample.cameras, torch.ones(sample.image.shape[0], 3), w, h)
    truth = sample.image + (1 - sample.coverage)
    return (F.avg_pool2d(image, 2) - F.avg_pool2d(truth, 2)).pow(2).mean().item()


@torch.no_grad()
def verify(path, model, samples):
    """Rate of the integer path against the float path on whole crops, pictures of both, and saturation."""
    exact, totals, points, error = integer.Exact(path), np.zeros((2, 3)), 0, {int(role): np.zeros(2) for role in model.gg}
    for s in samples:
        trail, rates, _ = model.code(s.crop, model.analyse(s.crop, s.rgb), 2, "round")
        for role, e in error.items():
            bits, gi = integer.code(exact, model, s.crop, s.rgb, role)
            e += [picture_error(model, s, trail[role], role), picture_error(model, s, gi, role)]
        totals += np.array([[r.item() for r in rates], bits])
        points += s.crop.points
    penalty = totals[1].sum() / totals[0].sum() - 1
    saturated = {k: f"{a / b:.1e}" for k, (a, b) in exact.saturated.items() if a}
    print(f"bpp float {totals[0] / points} = {totals[0].sum() / points:.4f}")
    print(f"bpp integer {totals[1] / points} = {totals[1].sum() / points:.4f}: {100 * penalty:+.2f} %")
    for role, e in error.items():
        psnr = -10 * np.log10(e / len(samples))
        print(f"head {role}: PSNR float {psnr[0]:.2f}, from integer features {psnr[1]:.2f} dB")
    print(f"saturated shares {saturated}")
    return penalty


def load_checkpoint(path, averaged=True):
    s = torch.load(path, map_location="cpu", weights_only=False)
    model = B2P(s["config"])
    model.load_state_dict(s["average"] if averaged else s["model"])
    return model.eval(), {"lambda": s["args"]["lam"], "steps": s["step"]}


@torch.no_grad()
def untrained(config, samples, seed=1):
    """A network with random weights, biases and gains."""
    torch.manual_seed(seed)
    with open(config) as f:
        model = B2P(json.load(f)).eval()
    for name, p in model.named_parameters():
        if name.endswith(("bias", "gain")):
            p.add_(torch.randn_like(p) * 0.05)
        if name.startswith("near.") and name.endswith(("mu.weight", "sigma.weight")):
            p.copy_(torch.randn_like(p) * 0.1)
    model.calibrate(join([s.crop for s in samples]), torch.cat([s.rgb for s in samples]))
    return model


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("checkpoint", nargs="?", help="left out with --random")
    p.add_argument("out")
    p.add_argument("--data", help="folder of samples to calibrate on; procedural ones when left out")
    p.add_argument("--samples", type=int, default=8)
    p.add_argument("--verify", type=int, default=3, help="crops for the check against the float path")
    p.add_argument("--random", metavar="CONFIG", help="an untrained network of this configuration, for tests")
    p.add_argument("--weights", metavar="FILE", help="also write the float weights, in f16, for `train.py --init`")
    p.add_argument("--streams-of", metavar="FILE", help="take all but the heads from this exported model, so that its streams stay valid: after `train.py --only-heads`")
    p.add_argument("--quick", metavar="CHECKPOINT", help="with --streams-of: that model with the heads of this checkpoint as quick ones beside its own")
    p.add_argument("--bit-price", type=json.loads, metavar="JSON", help="what encoders shall take a bit to be worth when they round latents, in squared steps: one number, or K for each of the three roles (0)")
    p.add_argument("--last", action="store_true", help="the last weights instead of the averaged ones")
    args = p.parse_args()
    samples = [data.procedural(i) for i in range(2)]
    if args.data:
        training, held = data.split(args.data, 8)
        samples = [data.load_sample(f) for f in held[:args.verify] + training[:max(0, args.samples - args.verify)]]
    if bool(args.checkpoint) + bool(args.random) + bool(args.quick) != 1 or args.quick and not args.streams_of:
        p.error("a checkpoint, --random, or --quick with --streams-of")
    if args.random:
        torch.manual_seed(1)
        model, info = untrained(args.random, samples), {"steps": 0}
    else:
        model, info = load_checkpoint(args.quick or args.checkpoint, not args.last)
    if args.bit_price is not None:
        info["bit_price"] = args.bit_price
    if args.quick:
        export_quick(model, samples, args.out, info, args.streams_of)
    else:
        export(model, samples, args.out, info, args.streams_of)
    if args.weights:
        tensors = {k: v.half().numpy() for k, v in model.state_dict().items()}
        save_file(tensors, args.weights, metadata={"config": json.dumps(model.cfg)})
    half_weights(model)
    if verify(args.out, model, samples[:args.verify]) > 0.02:
        print("warning: the integer path costs more than 2 %")


if __name__ == "__main__":
    main()
