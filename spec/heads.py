"""Learned heads in `int16` arithmetic: clauses 7, 11.1, 11.2, 12.3 and 13 of docs/format.md."""

import functools
import json
from dataclasses import dataclass

import numpy as np

import surfels
from base import require
from octree import ABSENT, Voxels

F = np.float32
LIMIT = 2047


@dataclass
class Part:
    """What a stream says of how its voxels, a range of those of the level, are drawn."""

    rows: range
    units: tuple  # 5.3.4
    sizes: tuple  # 7.5.1: `mixed` and `alone`
    thickness: tuple  # 7.5.5: of learned Gaussians and of surfels
    discs: list  # 7.5.2: for each of its voxels whether it is drawn as surfels; None for all


@dataclass
class Level:
    """The voxels of a level as they are drawn."""

    voxels: Voxels
    bits: int
    colours: list  # display colours after the filter
    before: list  # and before it
    above: list  # 7.2.1: those of the level above; None for the means of the children
    parts: list  # one, or one for each block of a scene


class Model:
    """7.1"""

    def __init__(self, data):
        length = int.from_bytes(data[:8], "little")
        tensors = json.loads(data[8 : 8 + length])
        told = json.loads(tensors.pop("__metadata__")["b2p-heads"])
        require(told["version"] == 1, "7.1.1", "version of the heads")
        self.networks = {}
        for name, shape in told["sets"].items():
            own = {key: value for key, value in tensors.items() if key.startswith(f"{name}.")}
            weights = {key[len(name) + 1 :]: tensor(data[8 + length :], value) for key, value in own.items()}
            self.networks[name] = Network(shape, weights)

    def network(self, heads, level, bits):
        """7.4.4"""
        wanted = 8 if level + 1 < bits else 1
        return self.networks.get(f"{heads}.{wanted}") or self.networks[f"{heads}.{9 - wanted}"]


def tensor(data, told):
    """9.1.1"""
    require(told["dtype"] == "F16", "7.1.1", "type of a tensor")
    begin, end = told["data_offsets"]
    return np.frombuffer(data[begin:end], dtype="<f2").reshape(told["shape"]).astype(np.float64)


class Network:
    """7.3"""

    def __init__(self, shape, weights):
        self.count, ranges = shape["gaussians"], shape["ranges"]
        self.blocks = [range(shape["parent_blocks"]), range(shape["child_blocks"])]

        def step(*names):
            return F(max(ranges[name] for name in names) * 1.5 / LIMIT)

        def layer(name, start, end):
            weight, bias = weights[f"{name}.weight"], weights.get(f"{name}.bias", 0.0)
            return *integers(weight, start, end), F(bias) / end

        p, c = (
            step(f"{side}.in", *(f"{side}.{i}.b" for i in blocks))
            for side, blocks in zip(("parent", "child"), self.blocks)
        )
        self.layers = {
            "parent.in": layer("parent.in", F(1 / 512), p),
            "up": layer("up", p, c),
            "child.in": layer("child.in", F(1 / 256), c),
            "out": layer("out", c, F(1)),
        }
        for side, chain, blocks in zip(("parent", "child"), (p, c), self.blocks):
            for i in blocks:
                inside = step(f"{side}.{i}.a")
                self.layers[f"{side}.{i}.a"] = layer(f"{side}.{i}.a", chain, inside)
                self.layers[f"{side}.{i}.b"] = layer(f"{side}.{i}.b", inside, chain)

    def run(self, nodes, parents, voxels, children):
        """7.3.1: the raw numbers [voxels, count, 14]; `parents` and `children` are the inputs."""
        h = self.chain("parent", nodes, self.apply("parent.in", nodes.near, parents).clip(min=0))
        up = np.array([[ABSENT] * 8] * len(voxels))
        up[np.arange(len(voxels)), [key & 7 for key in voxels.keys]] = nodes.parent_of
        x = self.apply("child.in", voxels.near, children) + self.apply("up", up, h)
        x = self.chain("child", voxels, x.clip(0, LIMIT))
        weights, scale, bias = self.layers["out"]
        raw = F(sums(weights, voxels.near, x)) * scale + bias
        return raw.reshape(len(voxels), self.count, 14)

    def chain(self, side, voxels, x):
        for i in self.blocks[side == "child"]:
            inside = self.apply(f"{side}.{i}.a", voxels.near, x).clip(min=0)
            x = (self.apply(f"{side}.{i}.b", voxels.near, inside) + x).clip(0, LIMIT)
        return x

    def apply(self, name, rows, x):
        """11.2.2"""
        weights, scale, bias = self.layers[name]
        return np.rint(F(sums(weights, rows, x)) * scale + bias).clip(-LIMIT, LIMIT).astype(np.int64)


def sums(weights, rows, x):
    """11.1.1; 12.3.1 keeps the sums within 32 bits."""
    x, rows = np.vstack([x, np.zeros_like(x[:1])]), np.array(rows)  # ABSENT is the last row
    return sum(x[rows[:, tap]] @ weights[tap] for tap in range(len(weights)))


def integers(weight, start, end):
    """12.3.1, 12.3.2: integer weights, and the scale of each output channel."""
    taps, inputs, outputs = weight.shape
    bound = 2**28 if taps == 27 else 2**31
    whole, scale = np.zeros(weight.shape, dtype=np.int64), np.zeros(outputs, dtype=F)
    for o in range(outputs):
        own = weight[:, :, o]
        total, peak = abs(own).sum(), abs(own).max()

        def lower(top):
            while (total * ratio(top) - taps * inputs / 2) * LIMIT >= bound:
                top = top * 7 // 8
            return top

        def ratio(top):
            return top / peak if peak else 0.0

        top = lower(LIMIT)
        while True:
            found = np.rint(own * ratio(top)).astype(np.int64)
            if abs(found).sum() * LIMIT < bound and (found**2).sum() < 2**31:
                break
            top = lower(top * 7 // 8)
        whole[:, :, o] = found
        if peak and top:
            scale[o] = F((peak / top) * (np.float64(start) / np.float64(end)))
    return whole, scale


def exp(x):
    """13.3.2"""
    x = np.clip(x, F(-87), F(87))
    z = x * np.uint32(0x3FB8AA3B).view(F) + F(12582912)
    n = z - F(12582912)
    r = x - n * F(0.6933594) - n * F(-2.1219444e-4)
    p = r * (F(1) / F(5040)) + F(1) / F(720)
    for c in (F(1) / F(120), F(1) / F(24), F(1) / F(6), F(0.5), F(1), F(1)):
        p = p * r + c
    return (p.view(np.uint32) + (z.view(np.uint32) << np.uint32(23))).view(F)


def sigmoid(x):
    """13.3.3"""
    return F(1) / (F(1) + exp(-x))


def tanh(x):
    """13.3.3"""
    return F(1) - F(2) / (F(1) + exp(F(2) * x))


def softplus(x):
    """13.3.4"""
    t = exp(-abs(x))
    s = t / (F(2) + t)
    q = s * s
    p = q * (F(1) / F(13)) + F(1) / F(11)
    for k in (9, 7, 5, 3, 1):
        p = p * q + F(1) / F(k)
    return np.maximum(x, F(0)) + F(2) * s * p


def log2(x):
    """13.3.5"""
    mantissa, exponent = np.frexp(np.float64(x))
    m, e = mantissa * 2, exponent - 1
    s = (m - 1) / (m + 1)
    q, series = s * s, 0.0
    for k in range(9, -1, -1):
        series = series * q + 1 / (2 * k + 1)
    return F(e + 2 * s * series * 1.4426950408889634)


def normalise(q):
    """13.2.1, of rows."""
    wide = q.astype(np.float64)
    norm = np.sqrt(sum(wide[..., i] * wide[..., i] for i in range(4)))[..., None]
    unit = np.array([1, 0, 0, 0], dtype=F)
    return np.where(norm == 0, unit, F(wide / np.where(norm == 0, 1, norm)))


def luma_chroma(colours):
    """7.2.2"""
    r, g, b = np.array(colours, dtype=np.int64).T
    return np.stack([r + 2 * g + b - 512, 4 * (r - b), 4 * g - 2 * (r + b)], axis=1)


def coarseness(units):
    """7.2.3"""
    lossless = units == (1, 1, 1)
    q = np.clip(F(1) if lossless else F(units[0]) / F(64), F(1), F(65536))
    return min(int(log2(q) * F(128) + F(0.5)), LIMIT)


def level_above(voxels):
    """The voxels of the level above, with their occupancies, and where each voxel's parent is."""
    keys = sorted({key >> 3 for key in voxels.keys})
    places = {key: i for i, key in enumerate(keys)}
    masks, coordinates = [0] * len(keys), [None] * len(keys)
    parent_of = [places[key >> 3] for key in voxels.keys]
    for key, at, i in zip(voxels.keys, voxels.coordinates, parent_of):
        masks[i] |= 1 << (key & 7)
        coordinates[i] = tuple(x >> 1 for x in at)
    nodes = Voxels(voxels.level - 1, keys, coordinates)
    nodes.masks, nodes.parent_of = masks, parent_of
    return nodes


def means(nodes, colours):
    """7.2.1, 18.4.3: `roundhalfup` of the children's mean."""
    total, count = np.zeros((len(nodes), 3), dtype=np.int64), np.zeros((len(nodes), 1), dtype=np.int64)
    np.add.at(total, nodes.parent_of, np.array(colours, dtype=np.int64))
    np.add.at(count, nodes.parent_of, 1)
    return (2 * total + count) // (2 * count)


def inputs(level, nodes, step):
    """7.2.4, 7.2.5"""
    above = luma_chroma(means(nodes, level.before) if level.above is None else level.above)
    bits = [[512 * (mask >> o & 1) for o in range(8)] for mask in nodes.masks]
    parents = np.hstack([np.array(bits), above, np.full((len(nodes), 1), step)])
    own = luma_chroma(level.colours)
    children = np.hstack([4 * (own - above[nodes.parent_of]), own, np.full((len(own), 1), step)])
    return parents, (children + 1 >> 1).clip(-LIMIT, LIMIT)


def activated(level, rows, raw):
    """7.4: Gaussians of the voxels `rows`, whose raw numbers these are."""
    count = raw.shape[1]
    octants = np.array([[o & 1, o >> 1 & 1, o >> 2] for o in range(8)]) if count == 8 else np.zeros((1, 3))
    cells = np.array(level.voxels.coordinates, dtype=np.float64)[rows]
    u = F(2) / F(1 << level.voxels.level) / F(2 if count == 8 else 1)
    anchor = (2 if count == 8 else 1) * cells[:, None] + octants + 0.5
    rgb = np.array(level.colours, dtype=F)[rows][:, None] / F(255)
    kept = np.ones(raw.shape[:2], dtype=bool) if count == 1 else raw[..., 10] >= F(-5.5373343) - F(2)
    one = np.array([1, 0, 0, 0], dtype=F)
    arrays = (
        F(anchor * np.float64(u) - 1) + tanh(raw[..., :3]) * u,
        softplus(raw[..., 3:6] + F(-0.31)) * u,
        normalise(raw[..., 6:10] + one),
        sigmoid(raw[..., 10] + F(2)) if count == 8 else np.ones(raw.shape[:2], dtype=F),
        np.clip(rgb + raw[..., 11:], F(0), F(1)),
    )
    return surfels.Gaussians(*(array[kept] for array in arrays))


def sparse(level, rows):
    """7.5.4"""
    degree = np.array([sum(k != ABSENT for k in level.voxels.near[i]) for i in rows])
    lonely = len(rows) >= 1024 and 512 * (degree == 1).sum() >= len(rows)
    return lonely and 64 * (degree <= 3).sum() >= len(rows)


def gaussians(level, model=None, heads=None):
    """Those of each part of a level: of clause 6 without a model, else of clause 7."""
    rows = [part.rows for part in level.parts]
    count = 4 if level.voxels.level + 1 < level.bits else 1
    nodes = level_above(level.voxels) if model and level.voxels.level else None

    @functools.cache
    def discs(which):
        sizes = [part.sizes[which] for part in level.parts for _ in part.rows]
        return surfels.surfels(level.voxels, level.colours, count, sizes, rows)

    mixed, alone = 0, 1
    for part in level.parts:
        learned_by, discs_by = (F(T) / F(128) * (F(2) / F(1 << level.voxels.level)) for T in part.thickness)
        if nodes is None or part.discs is None or sparse(level, part.rows):
            drawn = discs(alone).of([count * i + k for i in part.rows for k in range(count)])
            yield drawn.thicker(discs_by)
            continue
        network = model.network(heads, level.voxels.level, level.bits)
        parents, children = inputs(level, nodes, coarseness(part.units))
        raw = network.run(nodes, parents, level.voxels, children)
        learned = [i for i, disc in zip(part.rows, part.discs) if not disc]
        drawn = [count * i + k for i, disc in zip(part.rows, part.discs) if disc for k in range(count)]
        drawn = discs(mixed).of(drawn).thicker(discs_by)
        yield activated(level, learned, raw[learned]).thicker(learned_by).followed_by(drawn)
