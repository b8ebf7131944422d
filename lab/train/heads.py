"""Heads that draw any octree level as 3D Gaussians from its occupancy and its decoded colours.

A head reads level l - 1 ("parent") and level l ("child"); all sizes are relative to a voxel of level l, so the same weights serve every level.
"""

import json

import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

import ops
from layers import initial

PARENT_CHANNELS, CHILD_CHANNELS, RAW = 12, 7, 14
SCALE_BIAS, OPACITY_BIAS = -0.31, 2.0
# What Gaussians are widened by, in squares of half their unit: half a voxel of the level, or a quarter where there are eight a voxel.
BLUR = 0.075


class Conv3(nn.Module):
    """Plain submanifold convolution, 3x3x3 taps, weight [27, c_in, c_out]."""

    def __init__(self, cin, cout, scale=1.0):
        super().__init__()
        self.weight = nn.Parameter(initial(27, cin, cout, scale))
        self.bias = nn.Parameter(torch.zeros(cout))

    def forward(self, x, kmap, relu=False):
        return ops.conv(x, self.weight, self.bias, kmap, relu)


class Block(nn.Module):
    """relu(x + b(relu(a(x))))"""

    def __init__(self, c):
        super().__init__()
        self.a, self.b = Conv3(c, c), Conv3(c, c, 0.1)

    def forward(self, x, kmap):
        return ops.residual([self.b(self.a(x, kmap, True), kmap)], x, True)


class Side(nn.ModuleDict):
    """A first convolution, `in`, and blocks `0`, `1`, ..."""

    def __init__(self, cin, c, blocks):
        super().__init__({"in": Conv3(cin, c)} | {str(i): Block(c) for i in range(blocks)})


class Head(nn.Module):
    """Raw numbers [n, k * 14] of level l. `shape`: channels, parent_blocks, child_blocks, gaussians."""

    def __init__(self, shape):
        super().__init__()
        self.shape, c = dict(shape), shape["channels"]
        self.parent = Side(PARENT_CHANNELS, c, shape["parent_blocks"])
        self.up = nn.ParameterDict({"weight": torch.eye(c) + torch.randn(8, c, c) * (0.1 / c**0.5)})
        self.child = Side(CHILD_CHANNELS, c, shape["child_blocks"])
        self.out = Conv3(c, RAW * shape["gaussians"], 0.05)

    def forward(self, parent, child, level, seen=None):
        """`level`: a `Level`. `seen(name, activation)`, if given, is called with what every layer but the last gives."""
        seen = seen or (lambda name, x: x)
        above, here = level.above, level.kernel3
        h = seen("parent.in", self.parent["in"](parent, above, True))
        h = self.blocks("parent", h, above, seen)
        up = ops.conv(h, self.up["weight"], h.new_zeros(h.shape[1]), level.descent)
        x = seen("child.in", torch.relu(self.child["in"](child, here) + up))
        x = self.blocks("child", x, here, seen)
        return self.out(x, here)

    def blocks(self, side, x, kmap, seen):
        for i in range(self.shape[f"{side}_blocks"]):
            block = getattr(self, side)[str(i)]
            inner = seen(f"{side}.{i}.a", block.a(x, kmap, True))
            x = seen(f"{side}.{i}.b", ops.residual([block.b(inner, kmap)], x, True))
        return x


def saved_head(path):
    """Shape and averaged weights of a checkpoint, or of a set of a model file: `MODEL.safetensors:best.1`."""
    file, colon, name = path.partition(".safetensors:")
    if not colon:
        saved = torch.load(path, weights_only=False, map_location="cpu")
        return saved["shape"], saved["average"]
    file += ".safetensors"
    with safe_open(file, "pt") as f:
        shape = json.loads(f.metadata()["b2p-heads"])["sets"][name]
    weights = {k.removeprefix(f"{name}."): v.float() for k, v in load_file(file).items() if k.startswith(f"{name}.")}
    return {k: v for k, v in shape.items() if k != "ranges"}, weights


class Level:
    """The kernel maps a head needs: of level l - 1, of level l, and from the former to the latter."""

    def __init__(self, coords, above, kernel3, descent):
        self.coords, self.above, self.kernel3, self.descent = coords, above, kernel3, descent


def luma_chroma(rgb):
    """y, co, cg of colours in 0..255."""
    r, g, b = rgb.unbind(1)
    return torch.stack([(r + 2 * g + b) / 512 - 1, (r - b) / 128, (g - (r + b) / 2) / 128], 1)


def inputs(occupancy, rgb_above, rgb, parent, step):
    """Input channels of level l - 1 and level l. `occupancy` [n_above, 8] of 0 and 1; colours in 0..255; `parent` is each voxel's row above;
    `step` is luma's quantisation step, 1 for lossless."""
    step = torch.tensor(float(step))
    return inputs_of(occupancy, rgb_above, rgb, parent, step.expand(len(rgb_above)), step.expand(len(rgb)))


def inputs_of(occupancy, rgb_above, rgb, parent, step_above, step):
    """`inputs` with a step for every voxel of both levels."""
    up, own = luma_chroma(rgb_above), luma_chroma(rgb)
    above = torch.cat([occupancy, up, step_above.log2()[:, None] / 4], 1)
    return above.contiguous(), torch.cat([4 * (own - up[parent]), own, step.log2()[:, None] / 4], 1).contiguous()


def parameters(raw, rgb, gaussians):
    """What raw numbers [n, k * 14] stand for, of n * k Gaussians: offset and standard deviations in units, rotation, opacity, colour.
    `rgb`: decoded colours [n, 3] in 0..1."""
    offset, scale, rotation, opacity, colour = raw.view(-1, RAW).split([3, 3, 4, 1, 3], 1)
    rotation = F.normalize(rotation + torch.tensor([1.0, 0, 0, 0]).to(raw), dim=1)
    alpha = torch.ones_like(opacity[:, 0]) if gaussians == 1 else torch.sigmoid(opacity[:, 0] + OPACITY_BIAS)
    return torch.tanh(offset), F.softplus(scale + SCALE_BIAS), rotation, alpha, rgb.repeat_interleave(gaussians, 0) + colour


def anchors(coords, gaussians):
    """Centres that offsets count from, and the unit, in voxels of the level."""
    if gaussians == 1:
        return coords + 0.5, 1.0
    octant = torch.tensor([[o & 1, o >> 1 & 1, o >> 2] for o in range(8)], dtype=torch.float32, device=coords.device)
    return (coords[:, None] + (octant + 0.5) / 2).reshape(-1, 3), 0.5


def per_voxel(gaussians):
    """How many of the splatter's units a voxel has, so that what that widens by is `BLUR`."""
    return (2 if gaussians == 1 else 4) * (ops.VOXEL_BLUR / BLUR) ** 0.5


def place(own, coords, gaussians):
    """Gaussians that the splatter draws, `per_voxel` units a voxel, from `parameters`."""
    offset, sigma, rotation, alpha, colour = own
    anchor, unit = anchors(coords.to(offset.dtype), gaussians)
    times = per_voxel(gaussians)
    return times * (anchor + unit * offset), ops.covariance(times * unit * sigma, rotation), alpha, Clamp.apply(colour)


def visible(gaussians, least=1 / 255):
    """Those of at least this opacity: what training draws, as most of eight a voxel vanish."""
    keep = (gaussians[2] >= least).nonzero()[:, 0]
    return gaussians if len(keep) == len(gaussians[2]) else [t[keep] for t in gaussians]


class Clamp(torch.autograd.Function):
    """Clamps to 0..1; a gradient that leads back inside passes."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x.clamp(0, 1)

    @staticmethod
    def backward(ctx, dy):
        (x,) = ctx.saved_tensors
        return dy * ~((x < 0) & (dy > 0) | (x > 1) & (dy < 0))


def draw(gaussians, cameras, finest, background, size):
    """Pictures of Gaussians; cameras count in finest voxels, of which the Gaussians' unit has `finest`."""
    cameras = cameras.clone()
    cameras[:, 9:12] /= finest
    return ops.splat(*gaussians, cameras, background, size, size)
