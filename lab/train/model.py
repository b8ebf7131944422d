"""The network of Bits-to-Photon (arXiv 2406.05915, appendix tables), float, for training.

Roles: 3 = finest input level, 2, 1, 0 = coarsest coded level.
"""

import math

import torch
import torch.nn.functional as F
from torch import nn
from torch.func import functional_call

import ops
from layers import Conv, Inception, NormConv, ResBlock
from passes import Base, Near
from rates import Bound, Prior, Through, bin_mass, bits, bounded_sigma


class FeatureConvert(nn.Module):
    def __init__(self, cfg, cin):
        super().__init__()
        c = cfg["channels"]
        self.conv_in = NormConv(cin, c)
        self.blocks = nn.ModuleList(Inception(c, cfg["inception_relu"]) for _ in range(cfg["fc_blocks"]))
        self.conv_out = NormConv(c, c)

    def forward(self, x, kmap):
        x = self.conv_in(x, kmap)
        for b in self.blocks:
            x = b(x, kmap)
        return self.conv_out(x, kmap)


class FeatureSqueeze(nn.Module):
    def __init__(self, cfg, context):
        super().__init__()
        c = cfg["channels"]
        self.lin1 = Conv(2 * c if context else c, c, 1)
        with torch.no_grad():  # what is known already is not worth a latent
            self.lin1.weight[:, c:] *= 0.1
        self.lin2 = Conv(c, cfg["latents"], 1)

    def forward(self, f, c):
        x = f if c is None else torch.cat([f, c], 1)
        return self.lin2(self.lin1(x, relu=True))


class Entropy(nn.Module):
    """Predictive entropy model: mean and log standard deviation of each latent, from the context alone."""

    def __init__(self, cfg):
        super().__init__()
        c = cfg["channels"]
        self.conv_in = NormConv(c, c)
        self.blocks = nn.ModuleList(Inception(c, cfg["inception_relu"], norm=True) for _ in range(cfg["pem_blocks"]))
        self.mu = Conv(c, cfg["latents"], 1, 0.1)
        self.sigma = Conv(c, cfg["latents"], 1, 0.1)
        nn.init.constant_(self.sigma.bias, 1.0)

    def forward(self, c, kmap):
        x = self.conv_in(c, kmap, True)
        for b in self.blocks:
            x = b(x, kmap)
        return self.mu(x), self.sigma(x)


def latents_of(cfg, role):
    """How many latents a voxel of a role has: roles from `latent_roles` on have none and derive from the level below."""
    return cfg["latents"] if role < cfg.get("latent_roles", 3) else 0


def reconstructed(cfg, role):
    """Whether a role has a network that makes its features. Without one, they are the features of the level below."""
    return role < cfg.get("fr_roles", 3)


class Reconstruct(nn.Module):
    def __init__(self, cfg, role):
        super().__init__()
        c, k, context = cfg["channels"], latents_of(cfg, role), role > 0
        self.lin1 = Conv(k + c if context else k, c, 1)
        with torch.no_grad():  # latents have a standard deviation of 2 to 4, features of about 1
            self.lin1.weight[:, :k] = torch.randn(1, k, c) * ((0.3 if context else 0.4) / math.sqrt(max(k, 1)))
        self.blocks = nn.ModuleList(Inception(c, cfg["inception_relu"]) for _ in range(cfg["fr_blocks"]))
        self.lin2 = Conv(c, c, 1)

    def forward(self, y, c, kmap):
        x = self.lin1(y if c is None else torch.cat([y, c], 1), relu=True)
        for b in self.blocks:
            x = b(x, kmap)
        return self.lin2(x)


class Generate(nn.Module):
    """3D Gaussian generation: 14 raw numbers per generated voxel."""

    def __init__(self, cfg, gg):
        super().__init__()
        c, relu = gg["channels"], cfg["resblock_relu"]
        self.fanout = gg["children"]
        self.conv_in = NormConv(cfg["channels"], c)
        self.before = nn.ModuleList(ResBlock(c, relu) for _ in range(gg["blocks_before"]))
        if self.fanout == 8:
            self.layer4 = Conv(c, c, 8)
            with torch.no_grad():
                self.layer4.weight[1:] += self.layer4.weight[0]
        else:
            self.layer4 = NormConv(c, c, 8)
        self.after = nn.ModuleList(ResBlock(c, relu) for _ in range(gg["blocks_after"]))
        self.conv_out = NormConv(c, 14, 27, 0.15)

    def forward(self, g, crop, role):
        kmap = crop.kernel3[role]
        x = self.conv_in(g, kmap, True)
        for b in self.before:
            x = b(x, kmap)
        if self.fanout == 8:
            w = self.layer4.weight.permute(1, 0, 2).reshape(1, x.shape[1], -1).contiguous()
            x = ops.linear(x, w, self.layer4.bias.repeat(8)).view(8 * x.shape[0], -1)
            kmap = crop.children3
        else:
            x = self.layer4(x, crop.corners)
        for b in self.after:
            x = b(x, kmap)
        return self.conv_out(x, kmap)

    @torch.no_grad()
    def pass_colour(self, matrix, shift):
        """Starts with Gaussians of the colours `g @ matrix + shift`: luma and two chromas around grey."""
        route(self.conv_in, matrix @ SIGNED)
        self.conv_in.bias[:6] = shift @ SIGNED
        for b in (*self.before, *self.after):
            let_pass(b)
        route(self.layer4, torch.eye(6), tap=range(8) if self.fanout == 8 else None)
        route(self.conv_out, RECTIFIED @ colour_basis().T, at=11)


def parameters(raw, cfg, opaque):
    """What raw numbers stand for: offset and standard deviations in voxels, rotation, opacity, colour."""
    offset, scale, rotation, opacity, colour = raw.split([3, 3, 4, 1, 3], 1)
    sigma = F.softplus(scale + cfg["scale_bias"]) * cfg["scale_range"]
    rotation = F.normalize(rotation + torch.tensor([1.0, 0, 0, 0], device=raw.device, dtype=raw.dtype), dim=1)
    alpha = torch.ones_like(opacity[:, 0]) if opaque else torch.sigmoid(opacity[:, 0] + cfg["opacity_bias"])
    return torch.tanh(offset) * cfg["offset_range"], sigma, rotation, alpha, Bound.apply(0.5 + colour, 0.0, 1.0)


def gaussians(raw, coords, unit, cfg, opaque):
    """Gaussians of voxels `coords` whose size is `unit` finest voxels: mean, covariance, opacity, colour in finest-voxel units."""
    offset, sigma, rotation, alpha, colour = parameters(raw, cfg, opaque)
    return (coords.to(raw.dtype) + 0.5 + offset) * unit, ops.covariance(sigma * unit, rotation), alpha, colour


def colour_basis():
    """Orthonormal columns: luma and two chromas."""
    basis = torch.linalg.qr(torch.tensor([[1.0, 1, 1], [1, 0, -1], [-1, 2, -1]]).T)[0]
    return basis * torch.sign(basis.diagonal())


def ridge(x, y, damping=1e-3):
    """The linear map from x to y by least squares; features are often close to collinear."""
    gram = x.T @ x / len(x)
    gram += torch.eye(len(gram)).to(gram) * damping * gram.diagonal().mean()
    return torch.linalg.solve(gram, x.T @ y / len(x))


SIGNED = torch.cat([torch.eye(3), -torch.eye(3)], 1)  # a colour to it and its negative
RECTIFIED = SIGNED.T  # and back, from what a ReLU left of both


def route(m, matrix, at=0, first=0, tap=None):
    """Outputs at .. of the layer become `matrix` times inputs first .., and nothing else."""
    i, o = matrix.shape
    m.weight[:, :, at:at + o] = 0
    m.bias[at:at + o] = 0
    taps = [{1: 0, 8: 0, 27: 13}[m.taps]] if tap is None else tap
    for t in taps:
        m.weight[t, first:first + i, at:at + o] = matrix
    if isinstance(m, NormConv):
        m.gain[at:at + o] = matrix.norm(dim=0)


def let_pass(block):
    """The first channels, a colour and its negative, go through a block as they are."""
    for m in (block.a2,) if isinstance(block, Inception) else (block.c2,):
        m.weight[:, :, :6] = 0
        m.bias[:6] = 0


class B2P(nn.Module):
    def __init__(self, cfg):
        super().__init__()
        self.cfg = cfg
        c = cfg["channels"]
        self.fc = nn.ModuleList(FeatureConvert(cfg, 3 if r == 3 else c) for r in range(4))
        self.fs = nn.ModuleList(FeatureSqueeze(cfg, r > 0) for r in range(3) if latents_of(cfg, r))
        self.fr = nn.ModuleList(Reconstruct(cfg, r) for r in range(3) if reconstructed(cfg, r))
        self.pem = nn.ModuleDict({str(r): Entropy(cfg) for r in (1, 2) if latents_of(cfg, r)})
        self.gg = nn.ModuleDict({str(g["role"]): Generate(cfg, g) for g in cfg["gg"]})
        self.prior = Prior(cfg["latents"])
        if cfg.get("base_channels"):
            self.base = Base(Conv, cfg)
        with torch.no_grad():  # natural colours vary mostly in luma: let the first layer see chroma as strongly
            first = self.fc[3].conv_in.weight
            first.copy_(torch.tensor([[0.5, 0.5, 0.5], [2.0, -2.0, 0.0], [-1.5, -1.5, 3.0]]).T @ first)
        # Training only: what colour a voxel has, read linearly from g.
        self.probe = nn.ModuleList(Conv(c, 3, 1, 0.3) for _ in range(3))
        self.up = nn.ModuleDict()
        if cfg["upsample"] == "learned":
            for r in (1, 2):
                up = Conv(c, c, 8)
                with torch.no_grad():
                    up.weight.copy_(torch.eye(c) + torch.randn(8, c, c) * 0.1 / math.sqrt(c))
                self.up[str(r)] = up
        with torch.random.fork_rng(devices=[]):  # with and without this optional part, all else starts the same
            self.near = nn.ModuleDict({str(r): Near(Conv, cfg, r) for r in (1, 2) if cfg.get("near_channels", [0, 0])[r - 1]})

    def analyse_finest(self, crop, rgb):
        """Features of role 3, averaged over each voxel of role 2. rgb: float [n_3, 3] in 0..1."""
        return ops.pool(self.fc[3](rgb - 0.5, crop.kernel3[3]), crop.first[2])

    def analyse(self, crop, rgb, finest=None):
        """Encoder features f_r for roles 2, 1, 0. `finest`: what `analyse_finest` gave, if it is known."""
        x, out = self.analyse_finest(crop, rgb) if finest is None else finest, {}
        for r in (2, 1, 0):
            x = out[r] = self.fc[r](x, crop.kernel3[r])
            if r > 0:
                x = ops.pool(x, crop.first[r - 1])
        return out

    def context(self, g, crop, r):
        if r == 0:
            return None
        d = crop.descent[r]
        if self.cfg["upsample"] == "learned":
            return self.up[str(r)](g, d)
        return g[d.table.max(0).values.long()]

    def code(self, crop, features, top, mode):
        """Runs roles 0 .. top. mode: 'noise' (noise for rate and distortion), 'mixed' (straight-through rounding for
        distortion; for rate, noise moves the latents and rounding fits the entropy models), 'round'. Returns g, bits and latents of each role."""
        trail, rates, latents = [], [], []
        for r in range(top + 1):
            c = self.context(trail[-1], crop, r) if r else None
            y = self.squeeze(r, features[r], c)
            rounded = Through.apply(torch.round(y), y)
            noisy = y + torch.rand_like(y) - 0.5
            mu, log_sigma = self.predict(r, c, crop)
            if mode == "round":
                rates.append(self.bits(r, rounded, mu, log_sigma, crop))
            elif mode == "noise":
                rates.append(self.bits(r, noisy, mu, log_sigma, crop))
            else:  # the entropy models learn the rounded latents that they will meet, the latents the smooth proxy
                fixed = [p if p is None else p.detach() for p in (mu, log_sigma)]
                smooth = self.bits(r, noisy, *fixed, crop, seen=rounded, learn=False)
                rates.append(self.bits(r, rounded.detach(), mu, log_sigma, crop) + smooth - smooth.detach())
            latents.append(y)
            trail.append(self.reconstruct(r, noisy if mode == "noise" else rounded, c, crop))
        return trail, rates, latents

    def reconstruct(self, r, y, c, crop):
        """Features of a role, from its latents and its context."""
        return self.fr[r](y, c, crop.kernel3[r]) if reconstructed(self.cfg, r) else c

    def squeeze(self, r, features, c):
        """The latents of a role before they are rounded."""
        if not latents_of(self.cfg, r):
            return features.new_zeros(len(features), 0)
        limit = float(self.cfg["latent_max"])
        return self.fs[r](features, c).clamp(-limit, limit)

    def predict(self, r, c, crop):
        """Mean and log standard deviation of a role's latents as the level below tells them; None for role 0 and where there are no latents."""
        return self.pem[str(r)](c, crop.kernel3[r]) if r and latents_of(self.cfg, r) else (None, None)

    def bits(self, r, y, mu, log_sigma, crop, seen=None, learn=True):
        """Cost of a role's latents as they are coded: predicted from neighbours too, where the model does so and there are any that came
        before. `mu` and `log_sigma` are what `predict` gave. `seen`: what neighbours show, if not `y`; `learn`:
        whether what predicts from neighbours, and the prior, get a gradient."""
        use = (lambda m, *x: m(*x)) if learn else (lambda m, *x: functional_call(m, {k: p.detach() for k, p in m.named_parameters()}, x))
        seen, coords, table = y if seen is None else seen, crop.coords[r], crop.kernel3[r].table
        if not y.shape[1]:
            return y.sum()
        if r:
            if str(r) in self.near:
                mu, log_sigma = use(self.near[str(r)], seen, mu, log_sigma, coords, table)
            return bits(bin_mass(y, mu, bounded_sigma(log_sigma)))
        if not self.cfg.get("base_channels"):
            return bits(use(self.prior, y))
        any, mu, log_sigma = use(self.base, seen, coords, table)
        return bits(bin_mass(y[any], mu, bounded_sigma(log_sigma))) + bits(use(self.prior, y[~any]))

    def generate(self, g, crop, role):
        """Gaussians of head `role`, in finest-voxel units."""
        head = self.gg[str(role)]
        raw = head(g, crop, role)
        coords = crop.children if head.fanout == 8 else crop.coords[role]
        return gaussians(raw, coords, 2.0, self.cfg, opaque=role == 2), raw

    @torch.no_grad()
    def calibrate(self, crop, rgb, target=1.0):
        """Starting values from data: every geometry-invariant layer gets outputs of unit scale, and each squeeze becomes the leading
        principal components of its hidden layer, whitened to the wanted standard deviation. Use a crop of many colours."""
        for m in self.modules():
            if isinstance(m, NormConv):
                m.calibrating = True
        features, g = self.analyse(crop, rgb), None
        for r in range(3):
            c = self.context(g, crop, r) if r else None
            if latents_of(self.cfg, r):
                self.start_squeeze(r, features[r], c, target)
            g = self.reconstruct(r, torch.round(self.squeeze(r, features[r], c)), c, crop)
            if r:
                self.predict(r, c, crop)
                self.generate(g, crop, r)

    def start_squeeze(self, r, features, c, target):
        """A squeeze's starting values: the leading principal components of its hidden layer, whitened to a standard deviation of `target`."""
        k = self.cfg["latents"]
        hidden = self.fs[r].lin1(features if c is None else torch.cat([features, c], 1), relu=True).double()
        mean = hidden.mean(0)
        values, vectors = torch.linalg.eigh(torch.cov(hidden.T))
        w = vectors[:, -k:] * (target / values[-k:].clamp_min(1e-12).sqrt())
        self.fs[r].lin2.weight.copy_(w[None].float())
        self.fs[r].lin2.bias.copy_((-mean @ w).float())

    @torch.no_grad()
    def pass_colour(self, luma=20.0, chroma=14.0):
        """Starts the network as a pyramid of colours, so that it has only to get better: three latents of every role are what its colour
        differs from its parent's, in steps of 1/luma and 1/chroma, and what they add up to reaches the colours of the Gaussians. A colour
        goes through rectified layers as a channel and its negative. Call it after `calibrate`."""
        n, steps, eye, signed, rectified, basis = 3, torch.tensor([luma, chroma, chroma]), torch.eye(3), SIGNED, RECTIFIED, colour_basis()
        joined = rectified / 2  # to a colour from both of it and its negative
        for r, fc in enumerate(self.fc):
            route(fc.conv_in, basis @ signed if r == 3 else joined @ signed)
            for b in fc.blocks:
                let_pass(b)
            route(fc.conv_out, rectified @ signed)
        c = self.cfg["channels"]
        for r in range(3):
            k = latents_of(self.cfg, r)
            if k:
                fs = self.fs[r]
                fs.lin1.weight[:, :, :2 * n] = 0
                fs.lin1.bias[:2 * n] = 0
                fs.lin1.weight[0, :n, :2 * n] = signed
                if r:
                    fs.lin1.weight[0, c:c + n, :2 * n] = -signed
                fs.lin2.weight[:, :, :n] = 0
                fs.lin2.bias[:n] = 0
                fs.lin2.weight[0, :2 * n, :n] = rectified * steps
            if reconstructed(self.cfg, r):
                fr = self.fr[r]
                fr.lin1.weight[:, :, :2 * n] = 0
                fr.lin1.bias[:2 * n] = 0
                if k:
                    fr.lin1.weight[0, :n, :2 * n] = signed / steps[:, None]
                if r:
                    fr.lin1.weight[0, k:k + n, :2 * n] = signed
                for b in fr.blocks:
                    let_pass(b)
                route(fr.lin2, rectified)
            if r and self.up:
                route(self.up[str(r)], eye, tap=range(8))
            self.probe[r].weight.zero_()
            self.probe[r].weight[0, :n] = basis.T
            self.probe[r].bias.zero_()
        features = torch.eye(c)[:, :n], torch.zeros(n)
        for gg in self.gg.values():
            gg.pass_colour(*features)

    @torch.no_grad()
    def start_heads(self, crop, rgb):
        """Starting values for heads of a network that has learned: layers of unit scale, and the colours that a linear fit reads from the
        features that they get. Use a crop of many colours."""
        for m in self.gg.modules():
            if isinstance(m, NormConv):
                m.calibrating = True
        trail, _, _ = self.code(crop, self.analyse(crop, rgb), 2, "round")
        for role, gg in self.gg.items():
            r = int(role)
            self.generate(trail[r], crop, r)
            known = torch.cat([trail[r], torch.ones(len(trail[r]), 1)], 1).double()
            fit = ridge(known, ((self.colours(crop, rgb)[r] - 0.5) @ colour_basis()).double()).float()
            gg.pass_colour(fit[:-1], fit[-1])

    def revive(self, crop, rgb, role=2, step=(14.0, 10.0, 10.0)):
        """Gives a role whose latents died new ones: its first three become the error of the colours that it draws, predicted linearly
        from the features that the encoder has, in steps of 1/`step` of luma and two chromas; the decoder answers each with the shift
        that corrects its colours on average (the pseudo-inverse of its mean response)."""
        n, r = 3, str(role)
        fs, fr, pem, steps = self.fs[role], self.fr[role], self.pem[r], torch.tensor(step)
        features = self.analyse(crop, rgb)
        trail, _, _ = self.code(crop, features, role, "round")
        (_, _, _, colour), raw = self.generate(trail[role], crop, role)
        basis = colour_basis()
        response = [torch.autograd.grad((raw[:, 11:14] @ basis).mean(0)[k], fr.lin1.bias, retain_graph=True)[0] for k in range(n)]
        with torch.no_grad():
            known = torch.cat([features[role], self.context(trail[role - 1], crop, role)], 1)
            x = torch.cat([known, torch.ones(len(known), 1)], 1).double()
            error = (self.colours(crop, rgb)[role] - colour) @ basis
            fit = ridge(x, error.double()).float()
            for at, sign in ((0, 1), (n, -1)):
                fs.lin1.weight[0, :, at:at + n], fs.lin1.bias[at:at + n] = sign * fit[:-1], sign * fit[-1]
            fs.lin2.weight[0, :, :n], fs.lin2.weight[0, :2 * n, n:], fs.lin2.bias[:n] = 0, 0, 0
            fs.lin2.weight[0, :2 * n, :n] = torch.cat([torch.diag(steps), -torch.diag(steps)])
            fr.lin1.weight[0, :n] = torch.linalg.pinv(torch.stack(response)).T / steps[:, None]
            for head in (pem.mu, pem.sigma):
                head.weight[:, :, :n], head.bias[:n] = 0, 0
            pem.sigma.bias[:n] = (x.float() @ fit * steps).std(0).clamp_min(0.2).log()

    @torch.no_grad()
    def shorten(self, model, samples):
        """Takes the weights of a network that makes features of more roles; what the level below tells of these becomes what comes nearest to
        their features, linearly."""
        weights = model.state_dict()
        for r in range(3):
            if reconstructed(self.cfg, r) or not reconstructed(model.cfg, r):
                continue
            known, wanted = [], []
            for s in samples:
                trail, _, _ = model.code(s.crop, model.analyse(s.crop, s.rgb), r, "round")
                known.append(model.context(trail[r - 1], s.crop, r).double())
                wanted.append(trail[r].double())
            known, wanted = torch.cat(known), torch.cat(wanted)
            fit = ridge(torch.cat([known, torch.ones(len(known), 1).to(known)], 1), wanted, 1e-5).float()
            up = f"up.{r}"
            weights[up + ".weight"] = weights[up + ".weight"] @ fit[:-1]
            weights[up + ".bias"] = weights[up + ".bias"] @ fit[:-1] + fit[-1]
        own = self.state_dict()
        self.load_state_dict({k: v for k, v in weights.items() if k in own})

    def colours(self, crop, rgb):
        """Mean colour of the voxels of roles 0, 1, 2."""
        out = [rgb]
        for r in (2, 1, 0):
            out.insert(0, ops.pool(out[0], crop.first[r]))
        return out[:3]


def groups(model, lr_conv, lr_linear, heads=1.0):
    """Parameter groups: geometry-invariant and other convolutions move at lr_conv, everything else at lr_linear; those of the heads
    `heads` times as fast."""
    parts = {}
    for name, p in model.named_parameters():
        conv, head = p.ndim == 3 and p.shape[0] > 1, name.startswith("gg.")
        base = (lr_conv if conv else lr_linear) * (heads if head else 1.0)
        parts.setdefault((head, conv), {"params": [], "base": base})["params"].append(p)
    return list(parts.values())
