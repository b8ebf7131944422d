"""Latents predicted from those of neighbours that were coded before them, octant by octant."""

import math

import torch
from torch import nn

import ops
from rates import SIGMA_MAX, SIGMA_MIN, Through

PER_NAT = 63 / math.log(SIGMA_MAX / SIGMA_MIN)  # scale indices
STEPS = ops.OFFSETS3.abs() @ torch.tensor([1, 2, 4], dtype=torch.int32)  # the axes along which a tap's voxel differs


class Neighbours(nn.Module):
    """A small network on what is known of each voxel by itself; two layers, then means and log standard deviations."""

    def __init__(self, conv, inputs, hidden, latents):
        super().__init__()
        self.lin1 = conv(inputs, hidden, 1)
        self.lin2 = conv(hidden, hidden, 1)
        self.mu = conv(hidden, latents, 1, 0.1)
        self.sigma = conv(hidden, latents, 1, 0.1)

    def network(self, x):
        x = self.lin2(self.lin1(x, relu=True), relu=True)
        return self.mu(x), self.sigma(x)


class Base(Neighbours):
    """Predicts the latents of role 0, which have no level below them: its voxels are coded octant by octant, and each is predicted from
    those of its 26 neighbours that came before."""

    def __init__(self, conv, cfg):
        k = cfg["latents"]
        super().__init__(conv, 7 * (k + 1) + 3, cfg["base_channels"], k)
        nn.init.constant_(self.sigma.bias, 1.0)

    @staticmethod
    def inputs(y, coords, table, shift=6):
        """What is known of voxels from whole latents y [n, K]: for each of the seven sets of neighbours that lie in one other octant, the
        mean of their latents in steps of 2^-shift and whether there are any, if that octant came before; and the octant's three bits.
        Also which voxels know any."""
        parts, any = known(y, coords, table, shift, False)
        return torch.cat([*parts, octant_bits(coords, y)], 1), any

    def forward(self, seen, coords, table):
        """Which voxels know any neighbour, and their means and log standard deviations, where voxels have the latents `seen`."""
        x, any = self.inputs(seen, coords, table)
        return any, *self.network(x[any])


class Near(Neighbours):
    """Corrects what the level below predicts of a role's latents, from how far it was off those of neighbours that came before."""

    def __init__(self, conv, cfg, role):
        k = cfg["latents"]
        super().__init__(conv, 2 * 7 * (k + 1) + 2 * k + 3, cfg["near_channels"][role - 1], k)
        for head in (self.mu, self.sigma):  # at first, nothing changes
            nn.init.zeros_(head.weight)

    @staticmethod
    def inputs(y, mu, index, coords, table, shift=6):
        """As those of `Base`, but of latents without their means `mu` (whole sixteenths; what is left is rounded down to steps of 2^-shift), those
        of the same parent by themselves, before the others; and each voxel's own means and scale indices, in eighths."""
        down = lambda x: Through.apply(torch.floor(x * (1 << shift)) / (1 << shift), x)
        parts, any = known(down(y - mu), coords, table, shift, True)
        return torch.cat([*parts, down(mu), index / 8, octant_bits(coords, y)], 1), any

    def forward(self, seen, mu, log_sigma, coords, table):
        """The corrected means and log standard deviations, where voxels have the latents `seen`; means come in sixteenths."""
        mu = Through.apply(torch.round(mu * 16) / 16, mu)
        index = ((log_sigma.detach() - math.log(SIGMA_MIN)) * PER_NAT).clamp(0, 63)
        x, any = self.inputs(seen, mu.detach(), index, coords, table)
        by, wider = self.network(x)
        return mu + any[:, None] * by, log_sigma + any[:, None] * wider


def octant_bits(coords, like):
    octant = ops.octants(coords)
    return torch.stack([octant >> b & 1 for b in range(3)], 1).to(like.dtype)


def known(values, coords, table, shift, siblings):
    """For each set of axes the mean [n, K] of the values of neighbours that differ along them, rounded to steps of 2^-shift (halves up),
    and whether there are any [n, 1], if their octant is the lower one. `siblings`: those of the same parent by themselves, first."""
    octant, one = ops.octants(coords), 1 << shift
    rows, parts = torch.cat([values, values.new_zeros(1, values.shape[1])]), []
    steps, offsets = STEPS.to(coords.device), [ops.OFFSETS3[:, a, None].to(coords.device) for a in range(3)]
    inside = torch.ones(27, len(coords), dtype=torch.bool, device=coords.device)
    for a, offset in enumerate(offsets):
        inside &= (offset == 0) | ((offset < 0) == (octant >> a & 1 == 1))
    for other in range(1, 8):
        before = (octant & 1 << other.bit_length() - 1) > 0
        at = table[steps == other].long()
        there = (at >= 0) & before
        own = inside[steps == other]
        for part in (there & own, there & ~own) if siblings else (there,):
            part = part.to(values.dtype)
            count = part.sum(0)[:, None]
            sum = torch.einsum("tn,tnk->nk", part, rows[at])
            mean = torch.floor((2 * one * sum + count) / (2 * count.clamp_min(1))) / one
            parts += [Through.apply(mean, sum / count.clamp_min(1)), (count > 0).to(values.dtype)]
    return parts, torch.cat(parts[1::2], 1).sum(1) > 0
