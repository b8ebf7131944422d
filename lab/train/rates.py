"""What latents cost: Gaussians integrated over the rounding bin, and the factorised prior."""

import math

import torch
from torch import nn

SIGMA_MIN, SIGMA_MAX = 0.11, 64.0
LIKELIHOOD_MIN = 1e-9


class Prior(nn.Module):
    """Factorised prior of role 0: per channel a mixture of three Gaussians, integrated over the rounding bin."""

    def __init__(self, k):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(k, 3))
        self.mean = nn.Parameter(torch.tensor([[-2.0, 0.0, 2.0]]).repeat(k, 1))
        self.log_sigma = nn.Parameter(torch.full((k, 3), 0.7))

    def forward(self, y):
        w = torch.softmax(self.weight, 1)
        return (w * bin_mass(y[:, :, None], self.mean, bounded_sigma(self.log_sigma))).sum(2)


class Bound(torch.autograd.Function):
    """Clamp whose gradient passes at a bound when it leads back inside."""

    @staticmethod
    def forward(ctx, x, lo, hi):
        ctx.save_for_backward(x)
        ctx.lo, ctx.hi = lo, hi
        return x.clamp(lo, hi)

    @staticmethod
    def backward(ctx, g):
        (x,) = ctx.saved_tensors
        stop = ((x < ctx.lo) & (g > 0)) | ((x > ctx.hi) & (g < 0))
        return g.masked_fill(stop, 0), None, None


class Through(torch.autograd.Function):
    """The first argument, with the gradient of the second."""

    @staticmethod
    def forward(ctx, exact, smooth):
        return exact.view_as(exact)

    @staticmethod
    def backward(ctx, g):
        return None, g


def bounded_sigma(log_sigma):
    return torch.exp(Bound.apply(log_sigma, math.log(SIGMA_MIN), math.log(SIGMA_MAX)))


def bin_mass(y, mu, sigma):
    """Mass of N(mu, sigma) in [y - 1/2, y + 1/2], computed in the lower tail, where erfc keeps its precision."""
    d = (y - mu).abs()
    s = 1 / (sigma * math.sqrt(2))
    return 0.5 * (torch.erfc((d - 0.5) * s) - torch.erfc((d + 0.5) * s))


def bits(mass):
    return -torch.log2(Bound.apply(mass, LIKELIHOOD_MIN, 2.0)).sum()
