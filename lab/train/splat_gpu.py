"""The splatter of `ops.splat` for many views of many clouds at once: projection and order in PyTorch, pixels in CUDA (`splat.cu`, compiled by CuPy)."""

import ctypes
import functools
import os
import subprocess
import tempfile

import torch

from ops import ALPHA_MIN, NEAR, PIXEL_BLUR, VOXEL_BLUR

TILE = 8
SOURCE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "splat.cu")


@functools.cache
def kernel(name):
    import cupy

    with open(SOURCE) as f:
        return cupy.RawKernel(f.read(), name)


@functools.cache
def host():
    """The same code as C++, to be tested without a GPU."""
    folder = tempfile.mkdtemp()
    library = os.path.join(folder, "splat.so")
    subprocess.run(["g++", "-O2", "-shared", "-fPIC", "-DHOST", "-x", "c++", SOURCE, "-o", library], check=True)
    return ctypes.CDLL(library)


def launch(name, blocks, tensors, numbers):
    tensors = [t.detach().contiguous() for t in tensors]
    if tensors[0].is_cuda:
        import cupy

        kernel(name)((blocks,), (TILE * TILE,), (*(cupy.asarray(t) for t in tensors), *(cupy.int32(n) for n in numbers)))
    else:
        getattr(host(), name)(ctypes.c_int(blocks), *(ctypes.c_void_p(t.data_ptr()) for t in tensors), *map(ctypes.c_int, numbers))


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, background, order, ranges, tiles, width, height):
        image = splats.new_empty(len(background), height, width, 3)
        ctx.numbers = (*tiles, width, height)
        launch("forward", len(ranges) - 1, (splats, order, ranges, background, image), ctx.numbers)
        ctx.save_for_backward(splats, order, ranges, image)
        return image

    @staticmethod
    def backward(ctx, dimage):
        splats, order, ranges, image = ctx.saved_tensors
        grad = torch.zeros_like(splats)
        launch("backward", len(ranges) - 1, (splats, order, ranges, image, dimage, grad), ctx.numbers)
        return grad, None, None, None, None, None, None


def splat(mean, cov, opacity, colour, which, cameras, cloud, background, size):
    """Pictures [V, 3, size, size]: view v shows the Gaussians whose `which` is cloud[v], which ascend. As `ops.splat` otherwise."""
    count = torch.bincount(which, minlength=int(cloud.max()) + 1)
    first = count.cumsum(0) - count
    many = count[cloud]
    view = torch.repeat_interleave(torch.arange(len(cloud), device=mean.device), many)
    row = torch.arange(len(view), device=mean.device) - (many.cumsum(0) - many)[view] + first[cloud][view]
    camera = cameras[view]
    r, t = camera[:, :9].view(-1, 3, 3), camera[:, 9:12]
    fx, fy, cx, cy = camera[:, 12:].unbind(1)
    x, y, z = ((r * mean[row][:, None]).sum(2) + t).unbind(1)
    seen = z > NEAR
    z = torch.where(seen, z, torch.ones_like(z))
    m = torch.stack([(fx / z)[:, None] * (r[:, 0] - (x / z)[:, None] * r[:, 2]), (fy / z)[:, None] * (r[:, 1] - (y / z)[:, None] * r[:, 2])], 1)
    full = cov[row][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)
    mc = (m[:, :, None, :] * full[:, None]).sum(3)
    blur = (VOXEL_BLUR * fx * fy / z**2).clamp_min(PIXEL_BLUR)
    xx, xy, yy = (mc[:, 0] * m[:, 0]).sum(1) + blur, (mc[:, 0] * m[:, 1]).sum(1), (mc[:, 1] * m[:, 1]).sum(1) + blur
    det = xx * yy - xy**2
    u, v = fx * x / z + cx, fy * y / z + cy
    o = opacity[row]
    splats = torch.cat([torch.stack([u, v, yy / det, -xy / det, xx / det, o], 1), colour[row]], 1).float()
    with torch.no_grad():
        order, ranges, tiles = bins(u, v, xx, yy, z, o, seen, view, len(cloud), size)
    return _Splat.apply(splats, background, order, ranges, tiles, size, size).permute(0, 3, 1, 2)


def bins(u, v, xx, yy, z, o, seen, view, views, size):
    """Splats by tile and distance: rows of splats, where each tile's begin, and the tiles along both axes of a view."""
    side = -(-size // TILE)
    reach = (2 * (o / ALPHA_MIN).clamp_min(1).log()).clamp_min(0)
    ex, ey = (reach * xx).sqrt(), (reach * yy).sqrt()
    low = lambda a, e: ((a - e) / TILE).floor().clamp(0, side).int()
    high = lambda a, e: ((a + e) / TILE).floor().clamp(-1, side - 1).int()
    x0, x1, y0, y1 = low(u, ex), high(u, ex), low(v, ey), high(v, ey)
    w, h = (x1 - x0 + 1).clamp_min(0), (y1 - y0 + 1).clamp_min(0)
    count = (w * h * (seen & (o >= ALPHA_MIN))).long()
    near = torch.argsort(z)
    count = count[near]
    which = torch.repeat_interleave(near, count)
    nth = (torch.arange(len(which), device=u.device) - torch.repeat_interleave(count.cumsum(0) - count, count)).int()
    wide = w[which]
    tile = (view[which].int() * side + y0[which] + nth // wide) * side + x0[which] + nth % wide
    tile, index = torch.sort(tile, stable=True)
    ranges = torch.searchsorted(tile, torch.arange(views * side * side + 1, device=u.device, dtype=torch.int32)).int()
    return which[index].int(), ranges, (side, side)
