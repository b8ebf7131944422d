"""Layers and blocks that all modules are made of."""

import math

import torch
from torch import nn

import ops


def initial(taps, cin, cout, scale=1.0):
    """The centre tap is orthogonal and the others small: a network starts close to a point-wise one. With equal random taps the response
    to a constant colour would depend on which neighbours exist, and a product of random square matrices would lose most directions."""
    w = torch.randn(taps, cin, cout) * (0.15 / math.sqrt(cin))
    nn.init.orthogonal_(w[{1: 0, 8: 0, 27: 13}[taps]], math.sqrt(max(1.0, cout / cin)))
    return w * scale


class Conv(nn.Module):
    """Sparse convolution of `taps` taps; taps = 1 is a linear layer. Weight [taps, c_in, c_out]."""

    def __init__(self, cin, cout, taps=27, scale=1.0):
        super().__init__()
        self.weight = nn.Parameter(initial(taps, cin, cout, scale))
        self.bias = nn.Parameter(torch.zeros(cout))
        self.taps = taps

    def forward(self, x, kmap=None, relu=False):
        if self.taps == 1:
            return ops.linear(x, self.weight, self.bias, relu)
        return ops.conv(x, self.weight, self.bias, kmap, relu)


class NormConv(nn.Module):
    """Geometry-invariant convolution (paper section 4): the response is divided by the L2 norm of the active weights of each
    output channel; a gain and a bias follow."""

    def __init__(self, cin, cout, taps=27, gain=1.0):
        super().__init__()
        self.weight = nn.Parameter(initial(taps, cin, cout))
        self.gain = nn.Parameter(torch.full((cout,), gain))
        self.bias = nn.Parameter(torch.zeros(cout))
        self.taps, self.target, self.calibrating = taps, gain, False

    def forward(self, x, kmap=None, relu=False):
        if self.calibrating:  # gain and bias such that every channel has mean 0 and the wanted standard deviation
            self.calibrating = False
            y = self.forward(x, kmap)
            s = y.std(0)
            s = self.target / s.clamp_min(0.1 * s.mean())
            self.gain.mul_(s)
            self.bias.copy_((self.bias - y.mean(0)) * s)
        if self.taps == 1:
            w = self.weight
            return ops.linear(x, w * (self.gain * torch.rsqrt((w * w).sum(1, keepdim=True) + 1e-8)), self.bias, relu)
        return ops.norm_conv(x, self.weight, self.gain, self.bias, kmap, relu)


class Inception(nn.Module):
    def __init__(self, c, relu, norm=False, branch=0.3):
        super().__init__()
        self.relu = relu
        if norm:
            make = lambda i, o, taps, last: NormConv(i, o, taps, branch if last else 1.0)
        else:
            make = lambda i, o, taps, last: Conv(i, o, taps, branch if last else 1.0)
        self.a1 = make(c, c // 4, 27, False)
        self.a2 = make(c // 4, c // 2, 27, True)
        self.b1 = make(c, c // 4, 1, False)
        self.b2 = make(c // 4, c // 4, 27, False)
        self.b3 = make(c // 4, c // 2, 1, True)

    def forward(self, x, kmap):
        a = self.a2(self.a1(x, kmap, True), kmap)
        b = self.b3(self.b2(self.b1(x, kmap, True), kmap, True), kmap)
        return ops.residual([a, b], x, self.relu)


class ResBlock(nn.Module):
    def __init__(self, c, relu, branch=0.1):
        super().__init__()
        self.relu = relu
        self.c1 = Conv(c, c, 27)
        self.c2 = Conv(c, c, 27, branch)

    def forward(self, x, kmap):
        return ops.residual([self.c2(self.c1(x, kmap, True), kmap)], x, self.relu)
