"""Octree levels, coding noise and convolutions of many samples at once, as tensor operations on any device: what `octree_samples.py` and `ops.py` do
for one sample on the CPU, for `train_gpu.py`."""

from dataclasses import dataclass

import torch

import ops
from heads import Level, inputs_of
from octree_samples import WEIGHTS

SPREAD = [(0x1F00000000FFFF, 32), (0x1F0000FF0000FF, 16), (0x100F00F00F00F00F, 8), (0x10C30C30C30C30C3, 4), (0x1249249249249249, 2)]
FACES = [13, 12, 14, 10, 16, 4, 22]  # a voxel and its six face neighbours in the 3x3x3 map
RINGS = [[t for t, o in enumerate(ops.OFFSETS3.tolist()) if sum(map(abs, o)) == d] for d in (1, 2, 3)]


def morton(coords):
    """Interleaved bits of coordinates [n, 3], x lowest."""
    key = coords.long()
    for mask, shift in SPREAD:
        key = (key | key << shift) & mask
    return key[:, 0] | key[:, 1] << 1 | key[:, 2] << 2


# ---------------------------------------------------------------------------------------------------------------------
# Convolutions


class _Conv(torch.autograd.Function):
    """One matrix product over gathered rows. Operands are rounded to `dtype`, sums are f32."""

    @staticmethod
    def forward(ctx, x, w, bias, table, back, relu, dtype):
        rows = gather(x, table, dtype)
        y = product(rows, w.to(dtype).flatten(0, 1)) + bias
        y = torch.relu(y) if relu else y
        ctx.save_for_backward(x, w, y if relu else None, table, back)
        ctx.dtype = dtype
        return y

    @staticmethod
    def backward(ctx, dy):
        x, w, y, table, back = ctx.saved_tensors
        if y is not None:
            dy = dy * (y > 0)
        dw = product(gather(x, table, ctx.dtype).T, dy.to(ctx.dtype)).view_as(w)
        dx = None
        if ctx.needs_input_grad[0]:
            dx = product(gather(dy, back, ctx.dtype), w.transpose(1, 2).to(ctx.dtype).flatten(0, 1))
        return dx, dw, dy.sum(0), None, None, None, None


def gather(x, table, dtype):
    """[n, taps * c]: rows of x, zero where the table names none (the row after the last)."""
    padded = torch.cat([x.to(dtype), x.new_zeros(1, x.shape[1], dtype=dtype)])
    return padded.index_select(0, table.flatten()).view(table.shape[0], -1)


def product(a, b):
    return torch.mm(a, b, out_dtype=torch.float32) if a.is_cuda and a.dtype != torch.float32 else (a @ b).float()


@dataclass
class Map:
    """`table[i, k]` is the input row that tap k of output row i reads, or the number of input rows; `back` the same of the transposed map."""

    table: torch.Tensor
    back: torch.Tensor
    dtype: torch.dtype

    def conv(self, x, w, bias, relu):
        return _Conv.apply(x, w, bias, self.table, self.back, relu, self.dtype)


@dataclass
class Descent:
    """Parent to child, the tap is the child's octant."""

    parent: torch.Tensor
    octant: torch.Tensor

    def conv(self, x, w, bias, relu):
        spread = x.new_zeros(len(self.parent), 8, x.shape[1])
        spread = spread.index_put((torch.arange(len(self.parent), device=x.device), self.octant), x[self.parent])
        y = spread.flatten(1) @ w.flatten(0, 1) + bias
        return torch.relu(y) if relu else y


# ---------------------------------------------------------------------------------------------------------------------
# Levels


@dataclass
class Voxels:
    """Voxels of one level of all samples, samples one after the other, each in Morton order. `which` is each one's sample."""

    coords: torch.Tensor
    which: torch.Tensor
    colours: torch.Tensor
    parent: torch.Tensor = None
    octant: torch.Tensor = None
    children: torch.Tensor = None
    near: torch.Tensor = None


class Batch:
    """Levels of samples from their voxels at `role` up, `levels` above it. `depth` is the octree level of `role`; every sample's cube is 2^depth."""

    def __init__(self, role, depth, coords, which, colours, samples, levels=6, dtype=torch.bfloat16):
        self.role, self.samples, self.dtype = role, samples, dtype
        self.at = {role: Voxels(coords, which, colours)}
        self.first = role - min(levels, depth)
        for r in range(role, self.first, -1):
            self._above(r)
        for r in range(self.first, role + 1):
            self.at[r].near = neighbours(self.at[r], samples, 1 << (depth - (role - r)))

    def _above(self, r):
        below = self.at[r]
        up = below.coords >> 1
        key = morton(up) | below.which << 48
        unique, parent, count = torch.unique_consecutive(key, return_inverse=True, return_counts=True)
        first = count.cumsum(0) - count
        sums = torch.zeros(len(unique), 3, device=key.device).index_add(0, parent, below.colours)
        above = Voxels(up[first], below.which[first], sums / count[:, None])
        below.parent, below.octant = parent, octants(below.coords)
        above.children = torch.full((len(unique), 8), len(key), device=key.device)
        above.children[parent, below.octant] = torch.arange(len(key), device=key.device)
        self.at[r - 1] = above

    def level(self):
        """What `Head.forward` needs of `role`."""
        here, above = self.at[self.role], self.at[self.role - 1]
        level = lambda v: Map(v.near, v.near.flip(1).contiguous(), self.dtype)
        return Level(here.coords, level(above), level(here), Descent(here.parent, here.octant))

    def head_inputs(self, decoded, step):
        """Input channels of both levels, and the decoded colours in 0..1. `step` [samples] is luma's."""
        here, above = self.at[self.role], self.at[self.role - 1]
        occupancy = (above.children < len(here.coords)).float()
        return *inputs_of(occupancy, decoded[self.role - 1], decoded[self.role], here.parent, step[above.which], step[here.which]), decoded[self.role] / 255


def octants(coords):
    c = (coords & 1).long()
    return c[:, 0] + 2 * c[:, 1] + 4 * c[:, 2]


def neighbours(voxels, samples, side):
    """[n, 27] rows of the 3x3x3 neighbourhoods, n where there is none, by a dense grid with a border."""
    n, edge = len(voxels.coords), side + 2
    place = voxels.which
    for axis in (2, 1, 0):
        place = place * edge + voxels.coords[:, axis].long() + 1
    grid = torch.full((samples * edge**3 + 2 * edge**2,), n, dtype=torch.int32, device=place.device)
    grid[place] = torch.arange(n, dtype=torch.int32, device=place.device)
    offsets = ops.OFFSETS3.long() @ torch.tensor([1, edge, edge * edge])
    return grid[place[:, None] + offsets.to(place.device)].long()


# ---------------------------------------------------------------------------------------------------------------------
# Coding noise


def forward_ycc(rgb):
    r, g, b = rgb.unbind(1)
    return torch.stack([(r + 2 * g + b) / 4, r - b, g - (r + b) / 2], 1)


def inverse_ycc(ycc):
    y, co, cg = ycc.unbind(1)
    t = y - cg / 2
    b = t - co / 2
    return torch.stack([b + co, y + cg / 2, b], 1)


def padded(x):
    return torch.cat([x, x.new_zeros(1, x.shape[1])])


def predict(values, near):
    """[n, 8, c]: what every child would have as the weighted mean of its parent and that one's face neighbours."""
    rows = near[:, FACES]
    there = (rows < len(values)).float()
    weights = torch.from_numpy(WEIGHTS).to(values)
    weighted = torch.einsum("ot,nt,ntc->noc", weights, there, padded(values)[rows])
    return weighted / (there @ weights.T)[:, :, None]


def transform(values, there):
    """As `octree_samples.transform`."""
    weight, steps = there.float(), []
    for _ in range(3):
        a, b, wa, wb = values[:, 0::2], values[:, 1::2], weight[:, 0::2], weight[:, 1::2]
        total = (wa + wb).clamp_min(1e-9)
        gain = (wa * wb / total).sqrt()[:, :, None]
        steps.append(((b - a) * gain, gain, wa / total, wb / total))
        values, weight = (a * wa[:, :, None] + b * wb[:, :, None]) / total[:, :, None], wa + wb
    return steps


def inverse(steps, coefficients, mean):
    values = mean[:, None]
    for (_, gain, wa, wb), c in zip(reversed(steps), reversed(coefficients)):
        d = c / gain.clamp_min(1e-9) * (gain > 0)
        a, b = values - d * wb[:, :, None], values + d * wa[:, :, None]
        values = torch.stack([a, b], 2).flatten(1, 2)
    return values


def smooth(values, voxels, truth, size, samples):
    """As `octree_samples.smooth`, with a fit for each sample; `size` [n, 3]."""
    terms = {}
    table = padded(values)
    for ring, weight in zip(RINGS, (1.0, 0.6, 0.35)):
        rows = voxels.near[:, ring]
        d = (table[rows] - values[:, None]) * (rows < len(values))[:, :, None]
        for k in (0.4, 1.6):
            terms[len(ring), k] = weight / 16 * (d / (1 + (d / (k * size)[:, None]) ** 2)).sum(1)
    five = torch.stack([terms[6, 0.4], terms[12, 0.4], terms[8, 0.4], terms[6, 1.6], terms[12, 1.6] + terms[8, 1.6]], 2)  # [n, 3, 5]
    gram = torch.einsum("nci,ncj->ncij", five, five).flatten(1)
    right = (five * (truth - values)[:, :, None]).flatten(1)
    sums = lambda x: x.new_zeros(samples, x.shape[1]).index_add(0, voxels.which, x)
    gram = sums(gram).view(samples, 3, 5, 5) + 1e-3 * torch.eye(5, device=values.device)
    fit = torch.linalg.solve(gram, sums(right).view(samples, 3, 5, 1))[..., 0]
    return values + (five * fit[voxels.which]).sum(2)


def decoded_colours(batch, step, rounding, gain, chroma):
    """{role: f32 [n, 3] of whole numbers 0..255} of the batch's role and the one above, as `octree_samples.decoded_colours` makes them. `step`, `rounding`,
    `gain` [samples], `chroma` [samples, 3] over luma's step; a step of 1 is lossless."""
    to_bytes = lambda rgb: rgb.round().clamp(0, 255)
    top, first = batch.role, batch.first
    sizes = step[:, None] * chroma
    values, out = forward_ycc(batch.at[first].colours), {}
    for r in range(first + 1, top + 1):
        above, here = batch.at[r - 1], batch.at[r]
        there = above.children < len(here.coords)
        truth = forward_ycc(here.colours)
        steps = transform(padded(truth)[above.children], there)
        guess = transform(predict(values, above.near), there)
        w = above.which
        size, up, round_at = (sizes / 2.0 ** (top - r)).clamp_min(1)[w][:, None], gain[w][:, None, None], rounding[w][:, None, None]
        coded = []
        for s, g in zip(steps, guess):
            rest = s[0] - g[0] * up
            coded.append(g[0] * up + rest.sign() * (rest.abs() / size + round_at).floor() * size)
        values = inverse(steps, coded, values)[there]
        if r == top:
            for _ in range(2):
                values = smooth(values, here, truth, (sizes[here.which]).clamp_min(1), batch.samples)
        if r >= top - 1:
            lossless = (step <= 1)[here.which][:, None]
            out[r] = to_bytes(torch.where(lossless, here.colours, inverse_ycc(values)))
    return out
