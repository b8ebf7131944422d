"""Differentiable operators: sparse convolutions, pooling and the Gaussian splatter.

Each has two paths: the C++ extension (`ops.cpp`, CPU tensors) and plain PyTorch, which serves other devices and is what the
extension is tested against. `reference()` forces the PyTorch path.
"""

import contextlib
import functools
import os
from dataclasses import dataclass, field

import torch

HERE = os.path.dirname(os.path.abspath(__file__))
_force_reference = False

# Tap order: x fastest.
OFFSETS3 = torch.tensor([[x, y, z] for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1)], dtype=torch.int32)
OFFSETS2 = torch.tensor([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=torch.int32)


@functools.cache
def extension():
    from torch.utils.cpp_extension import load

    build = os.path.join(HERE, "build")
    os.makedirs(build, exist_ok=True)
    os.environ.setdefault("PATH", "")
    bin_dir = os.path.dirname(os.path.abspath(os.sys.executable))
    if bin_dir not in os.environ["PATH"].split(os.pathsep):  # ninja lies beside the interpreter of a virtual environment
        os.environ["PATH"] = bin_dir + os.pathsep + os.environ["PATH"]
    return load("b2p_ops", [os.path.join(HERE, "ops.cpp")], extra_cflags=["-O3", "-march=native", "-fopenmp", "-std=c++20"],
                extra_ldflags=["-fopenmp"], build_directory=build)


@contextlib.contextmanager
def reference():
    global _force_reference
    before, _force_reference = _force_reference, True
    try:
        yield
    finally:
        _force_reference = before


def native(t):
    return t.device.type == "cpu" and t.dtype == torch.float32 and not _force_reference


# ---------------------------------------------------------------------------------------------------------------------
# Kernel maps


@dataclass
class Map:
    """`table[k, i]` is the input row that tap k of output row i reads, or -1; `back` is the same for the transposed map."""

    table: torch.Tensor
    back: torch.Tensor
    _pairs: list = field(default=None, repr=False)

    @property
    def outputs(self):
        return self.table.shape[1]

    def to(self, device):
        return Map(self.table.to(device), self.back.to(device))

    def pairs(self):
        """Per tap: (input rows, output rows)."""
        if self._pairs is None:
            self._pairs = []
            for row in self.table:
                out = (row >= 0).nonzero()[:, 0]
                self._pairs.append((row[out].long(), out))
        return self._pairs


def neighbours(coords):
    """3x3x3 map of a level. `coords` int32 [n, 3], >= 0."""
    table = extension().kernel_map(coords, OFFSETS3)
    return Map(table, table.flip(0).contiguous())


def neighbours_below(above, child, parent, coords):
    """3x3x3 map of `coords` from that of the level above: `child[o, p]` is the row of child o of row p, or -1."""
    table = extension().child_map(above.table, child, parent.int(), coords)
    return Map(table, table.flip(0).contiguous())


def corners(coords):
    """2x2x2 map, stride 1, offsets 0 and 1."""
    return Map(extension().kernel_map(coords, OFFSETS2), extension().kernel_map(coords, -OFFSETS2))


def octants(coords):
    c = coords & 1
    return (c[:, 0] + 2 * c[:, 1] + 4 * c[:, 2]).long()


def descent(coords, parent, parents):
    """Parent to child map: tap = octant of the child."""
    n = coords.shape[0]
    octant, child = octants(coords), torch.arange(n)
    table = torch.full((8, n), -1, dtype=torch.int32)
    table[octant, child] = parent.int()
    back = torch.full((8, parents), -1, dtype=torch.int32)
    back[octant, parent.long()] = child.int()
    return Map(table, back)


def all_children(coords):
    """The eight children of every voxel, in Morton order."""
    shift = torch.tensor([[o & 1, o >> 1 & 1, o >> 2] for o in range(8)], dtype=torch.int32)
    return (2 * coords[:, None] + shift).reshape(-1, 3).contiguous()


# ---------------------------------------------------------------------------------------------------------------------
# Convolutions


class _Conv(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, w, bias, kmap, relu):
        x = extension().rows(x, w.shape[0])
        (y,) = extension().conv(x, w, False, kmap.table, bias, None, relu)
        ctx.kmap, ctx.relu = kmap, relu
        ctx.save_for_backward(x, w, y)
        return y

    @staticmethod
    def backward(ctx, dy):
        x, w, y = ctx.saved_tensors
        e = extension()
        g, db = e.plain_grad(dy.contiguous(), y, ctx.relu, w.shape[0])
        dx = e.conv(g, w, True, ctx.kmap.back, None, None, False)[0] if ctx.needs_input_grad[0] else None
        dw = e.weight_grad(x, g, ctx.kmap.table, *w.shape[1:]) if ctx.needs_input_grad[1] else None
        return dx, dw, db, None, None


@functools.lru_cache(maxsize=64)
def identity(n):
    """The map of a linear layer."""
    table = torch.arange(n, dtype=torch.int32)[None]
    return Map(table, table)


class _NormConv(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, w, gain, bias, kmap, relu):
        x = extension().rows(x, w.shape[0])
        y, hat, inv = extension().conv(x, w, False, kmap.table, bias, gain, relu)
        ctx.kmap, ctx.relu = kmap, relu
        ctx.save_for_backward(x, w, gain, y, hat, inv)
        return y

    @staticmethod
    def backward(ctx, dy):
        x, w, gain, y, hat, inv = ctx.saved_tensors
        e = extension()
        g, dgain, db, ds = e.norm_grad(dy.contiguous(), y, hat, inv, gain, ctx.kmap.table, ctx.relu)
        dx = e.conv(g, w, True, ctx.kmap.back, None, None, False)[0] if ctx.needs_input_grad[0] else None
        dw = e.weight_grad(x, g, ctx.kmap.table, *w.shape[1:]).addcmul_(w, ds[:, None, :], value=2) if ctx.needs_input_grad[1] else None
        return dx, dw, dgain, db, None, None


def _gather_conv(x, w, kmap):
    acc = x.new_zeros(kmap.outputs, w.shape[2])
    for k, (i, o) in enumerate(kmap.pairs()):
        if len(i):
            acc = acc.index_add(0, o, x[i] @ w[k])
    return acc


def conv(x, w, bias, kmap, relu=False):
    """Sparse convolution. x [n_in, c_in], w [taps, c_in, c_out] -> [n_out, c_out]."""
    if not isinstance(kmap, Map):  # of `batch.py`
        return kmap.conv(x, w, bias, relu)
    if native(x):
        return _Conv.apply(x.contiguous(), w, bias, kmap, relu)
    y = _gather_conv(x, w, kmap) + bias
    return torch.relu(y) if relu else y


def linear(x, w, bias, relu=False):
    """x [n, c_in], w [1, c_in, c_out]."""
    if native(x):
        return _Conv.apply(x.contiguous(), w, bias, identity(x.shape[0]), relu)
    y = torch.addmm(bias, x, w[0])
    return torch.relu(y) if relu else y


def norm_conv(x, w, gain, bias, kmap, relu=False):
    """Geometry-invariant convolution: gain * conv / L2 norm of the active weights of each output channel + bias."""
    if native(x):
        return _NormConv.apply(x.contiguous(), w, gain, bias, kmap, relu)
    active = (kmap.table >= 0).to(x.dtype)
    norm = active.T @ (w * w).sum(1)
    y = gain * (_gather_conv(x, w, kmap) * torch.rsqrt(norm + 1e-8)) + bias
    return torch.relu(y) if relu else y


class _Residual(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, relu, *parts):
        y = extension().residual(parts, x, relu)
        ctx.relu, ctx.widths = relu, [p.shape[1] for p in parts]
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx, dy):
        dx, *parts = extension().residual_grad(dy.contiguous(), *ctx.saved_tensors, ctx.relu, ctx.widths)
        return dx, None, *parts


def residual(parts, x, relu):
    """The end of a block: parts [n, ..] side by side, plus x."""
    if native(x):
        return _Residual.apply(x, relu, *parts)
    y = torch.cat(parts, 1) + x
    return torch.relu(y) if relu else y


class _Pool(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, first):
        ctx.first, ctx.rows = first, x.shape[0]
        return extension().pool(x, first)

    @staticmethod
    def backward(ctx, dy):
        return extension().pool_grad(dy.contiguous(), ctx.first, ctx.rows), None


def pool(x, first):
    """Mean over the children first[i] .. first[i + 1] of each parent."""
    if native(x):
        return _Pool.apply(x.contiguous(), first)
    count = (first[1:] - first[:-1]).long()
    parent = torch.repeat_interleave(torch.arange(len(count), device=x.device), count)
    return x.new_zeros(len(count), x.shape[1]).index_add(0, parent, x) / count[:, None].to(x.dtype)


# ---------------------------------------------------------------------------------------------------------------------
# Splatter

ALPHA_MAX, ALPHA_MIN, T_MIN, NEAR = 0.99, 1.0 / 16384, 1e-4, 1e-2
# What every splat is widened by: so much of a finest voxel squared, or of a pixel squared if that is more.
VOXEL_BLUR, PIXEL_BLUR = 0.15, 1.0 / 64


def covariance(scale, rotation):
    """Covariances xx xy xz yy yz zz [n, 6] of splats with standard deviations [n, 3] and unit quaternions w x y z [n, 4]."""
    w, x, y, z = rotation.unbind(1)
    r = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                     2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).view(-1, 3, 3)
    m = r * scale[:, None, :]
    a, b, c = m.unbind(1)
    return torch.stack([(a * a).sum(1), (a * b).sum(1), (a * c).sum(1), (b * b).sum(1), (b * c).sum(1), (c * c).sum(1)], 1)


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx, mean, cov, opacity, colour, cameras, background, width, height):
        image = extension().splat(mean, cov, opacity, colour, cameras, background, width, height)
        ctx.save_for_backward(mean, cov, opacity, colour, cameras, image)
        return image

    @staticmethod
    def backward(ctx, dimage):
        mean, cov, opacity, colour, cameras, image = ctx.saved_tensors
        return (*extension().splat_grad(mean, cov, opacity, colour, cameras, image, dimage.contiguous()), None, None, None, None)


def splat(mean, cov, opacity, colour, cameras, background, width, height):
    """Pictures [V, 3, height, width] of Gaussians seen by cameras [V, 16] over backgrounds [V, 3]. Opacity is [n]."""
    if native(mean):
        c = [t.contiguous() for t in (mean, cov, opacity, colour, cameras, background)]
        return _Splat.apply(*c, width, height)
    return torch.stack([_splat_view(mean, cov, opacity, colour, c, b, width, height) for c, b in zip(cameras, background)])


def _splat_view(mean, cov, opacity, colour, camera, background, width, height):
    r, t = camera[:9].view(3, 3), camera[9:12]
    fx, fy, cx, cy = camera[12:].unbind()
    p = mean @ r.T + t
    keep = ((p[:, 2] > NEAR) & (opacity >= ALPHA_MIN)).nonzero()[:, 0]
    p, s, o, col = p[keep], cov[keep], opacity[keep], colour[keep]
    x, y, z = p.unbind(1)
    zero = torch.zeros_like(x)
    j = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], 1).view(-1, 2, 3)
    m = j @ r
    full = s[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    blur = (VOXEL_BLUR * fx * fy / z**2).clamp_min(PIXEL_BLUR)
    c2 = m @ full @ m.transpose(1, 2) + blur[:, None, None] * torch.eye(2, device=p.device, dtype=p.dtype)
    det = c2[:, 0, 0] * c2[:, 1, 1] - c2[:, 0, 1] ** 2
    a, b, c = c2[:, 1, 1] / det, -c2[:, 0, 1] / det, c2[:, 0, 0] / det
    u, v = fx * x / z + cx, fy * y / z + cy
    with torch.no_grad():  # all pairs of a pixel and a splat that may reach it
        reach = 2 * torch.log(o / ALPHA_MIN)
        ex, ey = (reach * c2[:, 0, 0]).clamp_min(0).sqrt(), (reach * c2[:, 1, 1]).clamp_min(0).sqrt()
        x0, x1 = (u - ex - 0.5).ceil().clamp(0, width).long(), (u + ex - 0.5).floor().clamp(-1, width - 1).long()
        y0, y1 = (v - ey - 0.5).ceil().clamp(0, height).long(), (v + ey - 0.5).floor().clamp(-1, height - 1).long()
        w, h = (x1 - x0 + 1).clamp_min(0), (y1 - y0 + 1).clamp_min(0)
        count = w * h
        order = torch.argsort(z, stable=True)
        count_o = count[order]
        which = torch.repeat_interleave(order, count_o)
        nth = torch.arange(len(which), device=p.device) - torch.repeat_interleave(count_o.cumsum(0) - count_o, count_o)
        px, py = x0[which] + nth % w[which].clamp_min(1), y0[which] + nth // w[which].clamp_min(1)
        pixel, index = torch.sort(py * width + px, stable=True)
        which, px, py = which[index], px[index], py[index]
    dx, dy = px + 0.5 - u[which], py + 0.5 - v[which]
    power = -0.5 * (a[which] * dx * dx + c[which] * dy * dy) - b[which] * dx * dy
    alpha = (o[which] * torch.exp(power.clamp_max(0))).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    # Transmittance before each pair: a cumulative sum of logarithms, restarted at each pixel.
    total = torch.log1p(-alpha.double()).cumsum(0)
    before = total - torch.log1p(-alpha.double())
    first = torch.ones_like(pixel, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    segment = first.cumsum(0) - 1
    trans = torch.exp(before - before[first.nonzero()[:, 0]][segment]).to(p.dtype)
    weight = torch.where(trans >= T_MIN, alpha * trans, torch.zeros_like(alpha))
    size = height * width
    image = torch.zeros(size, 3, device=p.device, dtype=p.dtype).index_add(0, pixel, weight[:, None] * col[which])
    left = 1 - torch.zeros(size, device=p.device, dtype=p.dtype).index_add(0, pixel, weight)
    return (image + left[:, None] * background).T.reshape(3, height, width)
