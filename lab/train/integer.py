"""The exact zone in integers, read from a model file: a slow, plain second implementation of what the Rust decoder does.

Sums of products stay below 2^31, so float64 matrix products hold them exactly. Activations are int64 arrays.
"""

import json
import math

import numpy as np
import torch
from safetensors import safe_open

import ops
from model import reconstructed
from passes import Base, Near

LIMIT = 2047
SIGMA_MIN, SIGMA_MAX, SIGMAS = 0.11, 64.0, 64
UNPREDICTED = 255


def clamp(q):
    return np.clip(q, -LIMIT, LIMIT)


def relu(q):
    return np.maximum(q, 0)


def accumulate(x, weight, table):
    """Integer sums of a sparse convolution. x int64 [n, c], weight int16 [taps, c, o], table int32 [taps, n_out] with -1 for absent."""
    out = np.zeros((table.shape[1], weight.shape[2]))
    for k, row in enumerate(table):
        at = np.nonzero(row >= 0)[0]
        if len(at):
            out[at] += x[row[at]].astype(np.float64) @ weight[k].astype(np.float64)
    return out.astype(np.int64)


class Exact:
    """up, base, near, pem and fr of a model file."""

    def __init__(self, path):
        with safe_open(path, "numpy") as f:
            self.cfg = json.loads(f.metadata()["b2p"])
            self.t = {k: f.get_tensor(k) for k in f.keys()}
        self.saturated = {}

    def _count(self, name, q):
        s = self.saturated.setdefault(name, [0, 0])
        rectified = name.rsplit(".", 1)[1] in ("a1", "b1", "b2", "lin1") or name.startswith(("base", "near")) and name.endswith("lin2") or name.startswith("pem") and name.endswith("conv_in")
        s[0] += int(((q if rectified else np.abs(q)) >= LIMIT).sum())
        s[1] += q.size

    def conv(self, name, x, table, active=None):
        """One layer with its requantisation, no activation. `table` None is a linear layer."""
        if table is None:
            table = np.arange(len(x), dtype=np.int32)[None]
        w = self.t[name + ".weight"]
        acc = accumulate(x, w, table)
        assert np.abs(acc).max(initial=0) < 2**31
        if name + ".gain" in self.t:
            squares = (w.astype(np.int64) ** 2).sum(1)
            norm = np.maximum((table >= 0).T.astype(np.int64) @ squares, 1)
            scale = self.t[name + ".gain"] / np.sqrt(norm.astype(np.float32))
            v = acc.astype(np.float32) * scale + self.t[name + ".bias"]
            assert v.dtype == np.float32
            q = np.clip(np.rint(v), np.float32(-LIMIT), np.float32(LIMIT)).astype(np.int64)
        else:
            q = clamp((acc + self.t[name + ".bias"].astype(np.int64)) >> self.t[name + ".shift"].astype(np.int64))
        self._count(name, q)
        return q

    def inception(self, name, x, table):
        a = self.conv(name + ".a2", relu(self.conv(name + ".a1", x, table)), table)
        b = relu(self.conv(name + ".b1", x, None))
        b = self.conv(name + ".b3", relu(self.conv(name + ".b2", b, table)), None)
        q = clamp(np.concatenate([a, b], 1) + x)
        return relu(q) if self.cfg["inception_relu"] else q

    def context(self, role, g, descent):
        """c of a role from g of the role below; `descent` int32 [8, n]."""
        if self.cfg["upsample"] == "learned":
            return self.conv(f"up.{role}", g, descent)
        return g[descent.max(0)]

    def base(self, latents, coords, table):
        """(mu in 1/16, sigma index, or UNPREDICTED where no neighbour is known) of role 0, from its whole latents [n, K]."""
        shift = self.cfg["latent_shift"]
        x, known = Base.inputs(torch.from_numpy(latents).double(), coords, torch.from_numpy(table), shift)
        x = clamp((x.numpy() * (1 << shift)).astype(np.int64))
        x = relu(self.conv("base.lin2", relu(self.conv("base.lin1", x, None)), None))
        sigma = np.clip(self.conv("base.sigma", x, None), 0, SIGMAS - 1)
        return self.conv("base.mu", x, None), np.where(known.numpy()[:, None], sigma, UNPREDICTED)

    def near(self, role, latents, mu, index, coords, table):
        """What `entropy` gave of a role, corrected from neighbours if the model does so."""
        if not self.cfg.get("near_channels", [0, 0])[role - 1]:
            return mu, index
        shift, real, name = self.cfg["latent_shift"], lambda a: torch.from_numpy(a).double(), f"near.{role}"
        x, known = Near.inputs(real(latents), real(mu) / 16, real(index), coords, torch.from_numpy(table), shift)
        x = clamp((x.numpy() * (1 << shift)).astype(np.int64))
        x = relu(self.conv(name + ".lin2", relu(self.conv(name + ".lin1", x, None)), None))
        known = known.numpy()[:, None]
        return clamp(mu + known * self.conv(name + ".mu", x, None)), np.clip(index + known * self.conv(name + ".sigma", x, None), 0, SIGMAS - 1)

    def entropy(self, role, c, table, trace=None):
        """(mu in 1/16, sigma index) of a role."""
        x = relu(self.conv(f"pem.{role}.conv_in", c, table))
        if trace is not None:
            trace[f"pem.{role}.conv_in"] = x
        for b in range(self.cfg["pem_blocks"]):
            x = self.inception(f"pem.{role}.blocks.{b}", x, table)
            if trace is not None:
                trace[f"pem.{role}.blocks.{b}"] = x
        return self.conv(f"pem.{role}.mu", x, None), np.clip(self.conv(f"pem.{role}.sigma", x, None), 0, SIGMAS - 1)

    def reconstruct(self, role, latents, c, table, trace=None):
        if not reconstructed(self.cfg, role):
            return c
        x = clamp(latents << self.cfg["latent_shift"])
        x = relu(self.conv(f"fr.{role}.lin1", x if c is None else np.concatenate([x, c], 1), None))
        if trace is not None:
            trace[f"fr.{role}.lin1"] = x
        for b in range(self.cfg["fr_blocks"]):
            x = self.inception(f"fr.{role}.blocks.{b}", x, table)
            if trace is not None:
                trace[f"fr.{role}.blocks.{b}"] = x
        return self.conv(f"fr.{role}.lin2", x, None)

    def _bits(self, which, row, d):
        """Cost of symbols d in table rows `row`, in bits, escapes included."""
        flat, offset, low = (self.t[f"cdf.{which}{s}"] for s in ("", ".offset", ".low"))
        begin, size = offset[row].astype(np.int64), (offset[row + 1] - offset[row]).astype(np.int64)
        at = d - low[row]
        inside = (at >= 0) & (at < size - 1)
        frequency = flat[begin + np.where(inside, at, size - 1)].astype(np.int64) + 1
        bits = -np.log2(frequency / 65536.0)
        beyond = np.where(at < 0, -at, at - (size - 1) + 1) - 1
        return float((bits + np.where(inside, 0, 2 + 2 * np.floor(np.log2(np.maximum(beyond, 0) + 1)))).sum())

    def bits_prior(self, latents):
        return self._bits("prior", np.broadcast_to(np.arange(latents.shape[1]), latents.shape), latents)

    def bits_gauss(self, latents, mu, index):
        known = (index != UNPREDICTED).all(1)
        mu, index, rest = mu[known], index[known], latents[~known]
        whole = (mu + 8) >> 4
        return self._bits("gauss", index * 16 + (mu - 16 * whole + 8), latents[known] - whole) + self.bits_prior(rest)


def sigma_of(index):
    return SIGMA_MIN * (SIGMA_MAX / SIGMA_MIN) ** (np.asarray(index) / (SIGMAS - 1))


def tables(crop):
    """Numpy kernel maps of a crop: per role, and parent to child."""
    return [k.table.numpy() for k in crop.kernel3], {r: d.table.numpy() for r, d in crop.descent.items()}


@torch.no_grad()
def code(exact, model, crop, rgb, top=2, trace=None):
    """The reference encoder: float FC and FS of `model`, everything else in integers. Returns bits per role, and g of role `top` as reals.
    `trace` (a dict) receives every intermediate."""
    t = trace if trace is not None else {}
    table3, descent = tables(crop)
    features = model.analyse(crop, rgb)
    bits, g = [], None
    for r in range(top + 1):
        c = exact.context(r, g, descent[r]) if r else None
        real = torch.from_numpy((c * float(exact.t["c_scale"][r])).astype(np.float32)) if r else None
        y = model.squeeze(r, features[r], real)
        latents = torch.round(y).numpy().astype(np.int64)
        t[f"fc.{r}"], t[f"fs.{r}"], t[f"latent.{r}"] = features[r].numpy(), y.numpy(), latents
        if r:
            t[f"c.{r}"] = c
        if not latents.shape[1]:
            bits.append(0.0)
        elif r or exact.cfg.get("base_channels"):
            if r:
                t[f"pem.mu.{r}"], t[f"pem.sigma.{r}"] = exact.entropy(r, c, table3[r], trace)
                mu, index = exact.near(r, latents, t[f"pem.mu.{r}"], t[f"pem.sigma.{r}"], crop.coords[r], table3[r])
            else:
                mu, index = exact.base(latents, crop.coords[0], table3[0])
            bits.append(exact.bits_gauss(latents, mu, index))
            t[f"mu.{r}"], t[f"sigma.{r}"] = mu, index
        else:
            bits.append(exact.bits_prior(latents))
        g = exact.reconstruct(r, latents, c, table3[r], trace)
        t[f"g.{r}"] = g
    return bits, torch.from_numpy((g * float(exact.t["g_scale"][top])).astype(np.float32))
