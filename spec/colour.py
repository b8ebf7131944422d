"""Colours of voxels: clause 5 of docs/format.md."""

from dataclasses import dataclass
from functools import cache
from math import isqrt
from types import SimpleNamespace

from base import POWERS, Reader, clamp, ilog2, limit, quot, require, sgn3
from coefficients import Model, RangeDecoder
from motion import INTER, SKIP
from octree import ABSENT, AXES, CORNERS, EDGES, FACES, OFFSETS, octant_xyz

JOINS = ((3, 0, 4), (4, 1, 5), (5, 2, 6), (6, 3, 7), (1, 0, 2), (2, 1, 3), (0, 0, 1))
AXIS = (0, 1, 1, 2, 2, 2, 2)
MANTISSA = (32, 35, 38, 41, 45, 49, 54, 59)


@dataclass(frozen=True)
class Steps:
    """5.2"""

    luma: int
    chroma: int

    def check(self):
        lossy = self.luma <= 87 and (self.chroma <= 87 or self.chroma == 254)
        require(lossy or (self.luma, self.chroma) == (255, 255), "5.2.1", "step indices")

    def lossless(self):
        return self.luma == 255

    def fraction(self):
        """5.1.1: f."""
        return 0 if self.lossless() else 6

    def units(self):
        if self.lossless():
            return (1, 1, 1)
        if self.chroma == 254:
            return (step(self.luma), 0, 0)
        return (step(self.luma), step(self.chroma + 2), step(self.chroma))

    def above(self):
        """5.2.4"""
        if self.lossless():
            return self
        chroma = 254 if self.chroma == 254 else max(self.chroma - 8, 0)
        return Steps(max(self.luma - 8, 0), chroma)


def step(index):
    """5.2.2"""
    return MANTISSA[index % 8] << index // 8


@dataclass
class Coloured:
    """What is known of the colours of a level."""

    steps: Steps
    target: int  # T of 5.3.2
    values: list  # [y, co, cg] of each voxel
    energies: list  # 5.9, of each voxel
    model: Model  # of the first slice


def keep(x, fraction):
    """5.1.1"""
    return limit(x, 256 << fraction)


def display(value, fraction):
    """5.1.2"""
    y, co, cg = value
    t = y - (cg >> 1)
    b = t - (co >> 1)
    half = 32 if fraction else 0
    return tuple(clamp(x + half >> fraction, 0, 255) for x in (b + co, cg + t, b))


# 5.5.3: by axes with face neighbours on both sides, and on one.
ESTIMATES = ((360, 360, 370, 460), (1170, 920, 920), (1110, 1210), (1560,))


def estimates(voxels):
    """5.5.3: the weights of a level from K to M − 1."""
    weights = []
    for near in voxels.near:
        sides = [(near[k] != ABSENT) + (near[26 - k] != ABSENT) for k in (4, 10, 12)]
        weights.append(ESTIMATES[sides.count(2)][sides.count(1)])
    return weights


def trunk_weights(levels, target):
    """5.5.3: the weights of the levels 0 to K."""
    last = levels[-1]
    weights = [[1024] * len(last) if len(levels) > target else estimates(last)]
    for nodes in reversed(levels[:-1]):
        below = iter(weights[0])
        sums = [sum(next(below) for _ in range(mask.bit_count())) for mask in nodes.masks]
        weights.insert(0, [clamp(s + 2 >> 2, 1, 16384) for s in sums])
    return weights


@cache
def joins_of(mask, weights):
    """5.5: the joins of a node whose children have these weights."""
    n, weights = [0] * 8, iter(weights)
    for place in range(8):
        n[place] = next(weights) if mask >> place & 1 else 0
    joins = []
    for slot, a, b in JOINS:
        joins.append((slot, a, b, n[a], n[b]))
        n[a] += n[b]
    return joins


def share(d, v, w):
    """5.5.4"""
    return d * (((w << 14) + (v + w) // 2) // (v + w)) >> 14


def forward(joins, values):
    """5.5.5, of one channel: the differences by slot."""
    values, differences = list(values), [0] * 7
    for slot, a, b, v, w in joins:
        if v and w:
            differences[slot] = values[b] - values[a]
            values[a] += share(differences[slot], v, w)
        elif w:
            values[a] = values[b]
    return differences


def inverse(joins, mean, differences):
    """5.5.6, of one channel: the values by place."""
    values = [mean] + [0] * 7
    for slot, a, b, v, w in reversed(joins):
        if v and w:
            values[a] -= share(differences[slot], v, w)
            values[b] = values[a] + differences[slot]
        elif w:
            values[b] = values[a]
    return values


def fwd(v, w):
    """5.5.7"""
    return (isqrt((v * w << 16) // (v + w)) + 1) // 2


def inv(v, w):
    """5.5.7"""
    return ((1 << 24) + fwd(v, w) // 2) // fwd(v, w)


# 5.6.2
GAUSSIAN = [power + (1 << 49) >> 50 for power in POWERS[:600]]
SEEN = [13] + FACES
TOUCHING = (0, 831, 113, 15)


def _weight(k, mask, octant):
    children = [octant_xyz(o) for o in range(8) if mask >> o & 1]
    c = len(children)
    d = 0
    for axis in range(3):
        apart = c * (octant_xyz(octant)[axis] - 2 * OFFSETS[k][axis]) - sum(o[axis] for o in children)
        d += apart * apart
    k = (6400 * d + 49 * c * c) // (98 * c * c)
    return GAUSSIAN[k] if k < 600 else 0


WEIGHT = {k: [[_weight(k, mask, o) for o in range(8)] if mask else None for mask in range(256)] for k in SEEN}


def mean(sums, weight):
    """5.6.4"""
    inverse = (1 << 32) // max(weight, 1)
    return [s * inverse + (1 << 31) >> 32 for s in sums]


def log(x):
    """5.7.2"""
    octave = ilog2(x + 2)
    return (octave << 3 | (x + 2 << 3 >> octave) & 7) - 8


def signed(negative, s):
    """5.7.2"""
    e = (s >= 2) + (s >= 6) + (s >= 12) + (s >= 24)
    return 4 - e if negative else 4 + e


EMPTY = [[0] * 3 for _ in range(7)]


class SliceDecoder:
    """The children of the nodes `first..end` (5.6, 5.7). `guides`, in predicted frames: mode and colours of each node's
    children (17.7)."""

    def __init__(self, nodes, children, weights, height, above, first, end, steps, gain, model, decoder, guides):
        self.weights, self.height = weights, height
        self.nodes, self.children, self.above = nodes, children, above
        self.first, self.end = first, end
        self.units, self.fraction, self.lossless = steps.units(), steps.fraction(), steps.lossless()
        self.gain, self.model, self.decoder = gain, model, decoder
        self.guides = guides or [(0, ())] * len(nodes)
        self.base = nodes.first[first]
        self.values, self.energies, self.blocks = [], [], []

    def decode(self):
        for i in range(self.first, self.end):
            mask, value = self.nodes.masks[i], self.above.values[i]
            block, sums = EMPTY, [0, 0, 0]
            done = mask.bit_count() - 1
            if self.guides[i][0] == SKIP:
                self.values += [value if found is None else found for found in self.guides[i][1]]
            elif done == 0:
                self.values.append(value)
            else:
                block = [[0] * 3 for _ in range(7)]
                child = self.nodes.first[i]
                joins = joins_of(mask, tuple(self.weights[child : child + done + 1]))
                differences, sums = self.coefficients(i, mask, joins, block)
                channels = [inverse(joins, value[t], [d[t] for d in differences]) for t in range(3)]
                for octant in range(8):
                    if mask >> octant & 1:
                        self.values.append([keep(channel[octant], self.fraction) for channel in channels])
            self.blocks.append(block)
            self.energies.append([min(16 * s // max(done, 1), 255) for s in sums])

    def predictions(self, i, mask, joins):
        """5.6.5, 5.6.6: A and B by slot and channel."""
        near, far = [[0] * 3] * 8, [[0] * 3] * 8
        own_first = self.nodes.first[i]
        child = own_first
        for octant in range(8):
            if not mask >> octant & 1:
                continue
            sums, weight = [0, 0, 0], 0
            for k in SEEN:
                j = self.nodes.near[i][k]
                if j != ABSENT:
                    w = WEIGHT[k][self.nodes.masks[j]][octant]
                    sums = [s + w * x for s, x in zip(sums, self.above.values[j])]
                    weight += w
            far[octant] = mean(sums, weight)
            for k, j in enumerate(self.children.near[child]):
                if self.base <= j < own_first:
                    w = TOUCHING[AXES[k]]
                    sums = [s + w * x for s, x in zip(sums, self.values[j - self.base])]
                    weight += w
            near[octant] = mean(sums, weight)
            child += 1
        if self.guides[i][0] == INTER:
            octants = [octant for octant in range(8) if mask >> octant & 1]
            self.bring(near, dict(zip(octants, self.guides[i][1])))
        split = [[forward(joins, [v[t] for v in values]) for t in range(3)] for values in (near, far)]
        return [[[channels[t][slot] for t in range(3)] for slot in range(7)] for channels in split]

    @staticmethod
    def bring(near, found):
        """17.7.3; `found` are the colours between voxels of the previous frame by octant, None where there is none."""
        changes = [[x - n for x, n in zip(value, near[o])] for o, value in found.items() if value is not None]
        d = [quot(sum(change), len(changes)) for change in zip(*changes)] or [0, 0, 0]
        for octant, value in found.items():
            near[octant] = value or [limit(n + x, 16384) for n, x in zip(near[octant], d)]

    def gradient(self, i):
        own, others = self.above.values[i], [self.nodes.near[i][k] for k in FACES]
        others = [self.above.values[j] for j in others if j != ABSENT]
        return [sum(abs(own[t] - other[t]) for other in others) // max(len(others), 1) for t in range(3)]

    def coefficients(self, i, mask, joins, own):
        """5.7.3: differences by slot and channel, sums of magnitudes; fills `own`."""
        a, b = self.predictions(i, mask, joins)
        c = SimpleNamespace()  # 5.7.4
        c.kids, c.ht = mask.bit_count(), self.height
        gradient, energy = self.gradient(i), self.above.energies[i]
        around = []
        for k in (4, 10, 12):
            j = self.nodes.near[i][k]
            around.append(self.blocks[j - self.first] if j >= self.first else EMPTY)
        differences, sums, done = [[0] * 3 for _ in range(7)], [0, 0, 0], 0
        for slot, _, _, v, w in reversed(joins):
            if v == 0 or w == 0:
                continue
            c.slot, c.axis, c.lum, c.oth, c.others = slot, AXIS[slot], 0, 0, 0
            c.heavy = sum(fwd(v, w) > x for x in (3000, 3700, 4200))
            self.fwd, self.inv = (4096, 4096) if self.lossless else (fwd(v, w), inv(v, w))
            magnitudes = [self.sixteenths(t, abs(a[slot][t])) for t in range(3)]
            brought, gain = 0, 256 if self.guides[i][0] == INTER else self.gain
            for t in range(3):
                expected = a[slot][t] * gain + 128 >> 8
                if self.units[t] == 0:
                    differences[slot][t] = expected
                    continue
                c.t = t
                self.circumstances(c, a[slot], b[slot], magnitudes, gradient, energy, around, sums, done)
                follow = self.follow(t - 1, brought) if t > 0 else 0
                expected += follow
                q = self.model.coefficient(self.decoder, c)
                value = limit(q * self.units[t] * self.inv + 2048 >> 12, 1 << 20)
                differences[slot][t] = limit(expected + value, 1 << 16)
                if t == 0:
                    brought = value
                elif brought:
                    self.learn(t - 1, brought, follow + value)
                own[slot][t] = limit(q, 127)
                m = min(abs(q), 127)
                sums[t] += m
                if t == 0:
                    c.lum, c.others = min(m, 3), sgn3(q)
                elif t == 1:
                    c.oth, c.others = min(m, 3), c.others + 3 * sgn3(q)
            done += 1
        return differences, sums

    def sixteenths(self, t, x):
        """5.7.2"""
        return min(4095, (x * self.fwd >> 8) * ((1 << 32) // max(self.units[t], 1)) >> 32)

    def circumstances(self, c, a, b, magnitudes, gradient, energy, around, sums, done):
        """5.7.4 and the features of 5.8.4."""
        t = c.t
        blocks = [block[c.slot][t] for block in around]
        c.nmag = sum(min(abs(q), 2) for q in blocks)
        c.nsign = 9 * sgn3(blocks[0]) + 3 * sgn3(blocks[1]) + sgn3(blocks[2])
        c.en = log(energy[t])
        c.gr = log(self.sixteenths(t, gradient[t]))
        c.pr = log(magnitudes[t])
        c.pa = log(self.sixteenths(t, abs(b[t])))
        c.ac = log(magnitudes[0] if t > 0 else max(magnitudes[1:]))
        run = log(16 * sums[t] // done) if done else 0
        c.bl = min(run, 55) if done else 60
        c.psign = signed(a[t] < 0, magnitudes[t])
        s = a[t] - b[t]
        c.shift = signed(s < 0, self.sixteenths(t, abs(s)))
        kinds = (c.en - 24, c.gr - 24, c.pr - 24, run - 16, c.pa - 24, c.ac - 24)
        c.features = (*kinds, 16 * c.lum, 16 * c.oth, 8 * c.heavy - 12, 8 * c.nmag, 0 if done else 24, 32)

    def follow(self, c, x):
        """5.7.5"""
        if x == 0:
            return 0
        product, square = self.model.cross[c]
        ratio = limit(quot(product * 256, square + 64 * self.units[0] ** 2), 512)
        return ratio * x + 128 >> 8

    def learn(self, c, x, y):
        """5.7.5"""
        product, square = self.model.cross[c]
        self.model.cross[c] = (product + x * y - (product >> 11), square + x * x - (square >> 11))


def spread(nodes, energies):
    """5.9.2: the energies of all children."""
    result = []
    for near, mask in zip(nodes.near, nodes.masks):
        sums, weight = [0, 0, 0], 0
        for k, j in enumerate(near):
            if j != ABSENT:
                w = (40, 15, 7, 3)[AXES[k]]
                sums = [s + w * e for s, e in zip(sums, energies[j])]
                weight += w
        result += [[s // weight for s in sums]] * mask.bit_count()
    return result


def decode_trunk(levels, payload, motion=None):
    """5.3.2: the colours of the levels 0 to K, whose voxels are `levels`."""
    reader = Reader(payload, "5.3")
    steps = Steps(reader.number("B"), reader.number("B"))
    steps.check()
    gain = reader.number("B")
    colour = [reader.number("B"), reader.number("h"), reader.number("h")]
    require(all(abs(x) <= 255 for x in colour[1:]), "5.3.2", "chroma of the root")
    target = reader.number("B")
    steps_of = [steps]
    for _ in levels[1:]:
        steps_of.insert(0, steps_of[0].above())
    decoder = RangeDecoder(payload[reader.at :])
    fraction = steps.fraction()
    value = [keep(x << fraction, fraction) for x in colour]
    coloured = [Coloured(steps_of[0], target, [value], [[0, 0, 0]], Model())]
    weights = trunk_weights(levels, target)
    for n, steps in enumerate(steps_of[1:], 1):
        (nodes, children), height = levels[n - 1 : n + 1], min(max(target - n, 0), 3)
        above, guides = coloured[-1], motion and motion.colours(nodes, children, levels[-1].level)
        own = (steps, gain, above.model, decoder, guides)
        part = SliceDecoder(nodes, children, weights[n], height, above, 0, len(nodes), *own)
        part.decode()
        coloured.append(Coloured(steps, target, part.values, spread(nodes, part.energies), part.model))
    decoder.finish()
    return coloured


def decode_level(nodes, children, level, above, payloads, slice_nodes, motion=None):
    """5.3.1; `nodes` is the level above."""
    up = max(above.target - level, 0)
    weights = estimates(children) if up else [1024] * len(children)
    values, energies, steps, model = [], [], None, None
    guides = motion and motion.colours(nodes, children, level)
    for number, payload in enumerate(payloads):
        reader = Reader(payload, "5.3")
        own = Steps(reader.number("B"), reader.number("B"))
        own.check()
        require(own.lossless() == above.steps.lossless(), "5.1.3", "lossless and lossy colours")
        gain = reader.number("B")
        first = number * slice_nodes
        end = min(first + slice_nodes, len(nodes))
        decoder = RangeDecoder(payload[reader.at :])
        state = (own, gain, above.model.copy(), decoder, guides)
        part = SliceDecoder(nodes, children, weights, min(up, 3), above, first, end, *state)
        part.decode()
        decoder.finish()
        values += part.values
        energies += part.energies
        if number == 0:
            steps, model = own, part.model
    return Coloured(steps, above.target, values, spread(nodes, energies), model)


def filtered(voxels, values, steps, payload):
    """5.11: the values after the filter."""
    require(payload and payload[0] in (1, 2) and len(payload) == 1 + 15 * payload[0], "5.11.1", "colour filter")
    weights = [w - 256 if w > 127 else w for w in payload[1:]]
    for at in range(0, len(weights), 15):
        passed = [weights[at + 5 * t : at + 5 * t + 5] for t in range(3)]
        values = filter_pass(voxels, values, steps, passed)
    return values


def response(d, r):
    """5.11.2"""
    x = abs(d) * r >> 12
    return d * (4096 - (x * x >> 12)) >> 12 if x < 4096 else 0


def filter_pass(voxels, values, steps, weights):
    """5.11.3"""
    units, fraction = steps.units(), steps.fraction()
    inverse = [[min((1 << 24) // max(u * z // 10, 1), 65536) if u else 65536 for u in units] for z in (7, 28)]
    result = []
    for own, near in zip(values, voxels.near):
        classes = [[values[near[k]] for k in ks if near[k] != ABSENT] for ks in (FACES, EDGES, CORNERS)]
        total = sum(count * len(c) for count, c in zip((20, 12, 7), classes))
        scale = 65536 // max(total, 1)
        out = []
        for t in range(3):
            n, q = ([sum(response(v[t] - own[t], r[t]) for v in c) for c in classes] for r in inverse)
            sums = (20 * n[0], 12 * n[1], 7 * n[2], 20 * q[0], 12 * q[1] + 7 * q[2])
            terms = [s * scale >> 14 for s in sums]
            moved = sum(w * x for w, x in zip(weights[t], terms)) + 32 >> 6
            out.append(keep(own[t] + moved, fraction))
        result.append(out)
    return result
