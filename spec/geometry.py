"""Octree occupancies: clause 4 of docs/format.md."""

from pathlib import Path

import numpy as np

from base import STRETCH, clamp, limit, quot, require, squash, wrap32
from motion import SKIP
from octree import ABSENT, BEFORE, FACES, OFFSETS, octant_xyz

M32, M64 = (1 << 32) - 1, (1 << 64) - 1
WEIGHTS = Path(__file__).parent.parent / "src/geometry/codec/weights.bin"


class Network:
    """The weights of clause 4.4."""

    def __init__(self, data):
        require(len(data) == 59936, "4.4.1", "length of the network's weights")
        rows = np.frombuffer(data[: 452 * 128], dtype=np.int8).reshape(452, 128).astype(np.int64)
        others = [k for k in range(27) if k != 13]
        self.presence = dict(zip(others, rows[:26]))
        self.known = {k: rows[26 + 9 * i] for i, k in enumerate(BEFORE)}
        self.child = {k: rows[27 + 9 * i : 35 + 9 * i] for i, k in enumerate(BEFORE)}
        self.node = np.concatenate([np.zeros((1, 128), dtype=np.int64), rows[197:452]])
        tail = data[452 * 128 :]
        self.output = np.frombuffer(tail[:2048], dtype="<i2").reshape(8, 128).astype(np.int64)
        self.bias = [int(x) for x in np.frombuffer(tail[2048:], dtype="<i4")]


class ArithmeticDecoder:
    """4.2"""

    def __init__(self, code):
        self.code, self.next = code, 0
        self.low, self.high, self.value = 0, M32, 0
        for _ in range(4):
            self.read()

    def read(self):
        byte = self.code[self.next] if self.next < len(self.code) else 0
        self.value = (self.value << 8 | byte) & M32
        self.next += 1

    def decide(self, one):
        middle = self.low + ((self.high - self.low) * one >> 16)
        bit = int(self.value <= middle)
        if bit:
            self.high = middle
        else:
            self.low = middle + 1
        while self.low >> 24 == self.high >> 24:
            self.low = self.low << 8 & M32
            self.high = self.high << 8 & M32 | 255
            self.read()
        return bit

    def finish(self):
        require(self.next == len(self.code) and self.value == self.low, "4.2.3", "end of a geometry code")


def mix(h, word):
    """4.6.4"""
    h = (h ^ word) * 0x9E3779B97F4A7C15 & M64
    return h ^ h >> 32


# 4.6.1: for each offset and octant the bit of the cell, 0 outside the 4^3 cells.
CELL = [[] for _ in OFFSETS]
for _offset, _cells in zip(OFFSETS, CELL):
    for _octant in range(8):
        _x, _y, _z = (2 * d + o for d, o in zip(_offset, octant_xyz(_octant)))
        _inside = all(-1 <= c <= 2 for c in (_x, _y, _z))
        _cells.append(1 << (_x + 1 + 4 * (_y + 1) + 16 * (_z + 1)) if _inside else 0)
ALL_CELLS = [sum(cells) for cells in CELL]
OWN = 13
FACE_BITS = sum(1 << bit for bit in (5, 17, 20, 22, 25, 37))
NEAR_BITS = sum(1 << (i + 4 * j + 16 * k) for i in range(3) for j in range(3) for k in range(3)) & ~(1 << 21)


class Mixer:
    """4.7"""

    def __init__(self, parents):
        self.bits = max(4, (parents - 1).bit_length())
        self.tables = [[(0, 0, 0)] * (1 << self.bits) for _ in range(5)]  # check, seen, one
        self.weights = [9830] * 5 + [65536, 0]

    def predict(self, logit, hashes):
        self.places = [h >> 64 - self.bits for h in hashes]
        self.checks = [h & 255 for h in hashes]
        self.entries, self.inputs = [], []
        for table, place, check in zip(self.tables, self.places, self.checks):
            found, seen, one = table[place]
            seen = seen if found == check else 0
            self.entries.append((seen, one))
            self.inputs.append((STRETCH[one >> 4] - logit) * (1024 * seen // (4 * seen + 1)) >> 8)
        self.inputs += [logit, 20]
        total = sum(x * w for x, w in zip(self.inputs, self.weights))
        logit = limit(wrap32(total) >> 16, 720)
        self.mixed = squash(logit)
        return logit

    def learn(self, bit, network):
        error = 65536 * bit - self.mixed
        steps = [3 * error * x + 32768 >> 16 for x in self.inputs]
        self.weights = [limit(w + step, 131072) for w, step in zip(self.weights, steps)]
        for i, (seen, one) in enumerate(self.entries):
            p = one if seen else network
            seen = min(seen + 1, 30)
            one = p + ((65536 * bit - p) * (65536 // (4 * seen + 1)) >> 14)
            self.tables[i][self.places[i]] = (self.checks[i], seen, min(max(one, 16), 65520))


class Refined:
    """17.6.4, 17.10.8: how decisions follow the cells of the previous frame, in so many windows."""

    def __init__(self, windows):
        offsets = (-96, -32, 96) if windows == 2 else (-96, 96)
        starts = [[squash(45 * i - 720 + d) << 6 for i in range(33)] for d in offsets]
        self.classes, self.faces = len(offsets), 6 * windows + 1
        contexts = 9 * self.classes * self.faces
        self.table = [list(starts[c % self.classes]) for c in range(contexts)]
        self.seen = [[4] * 33 for _ in range(contexts)]
        self.state = 8192

    def decide(self, decoder, logit, windows, own, octant, mask):
        """17.6.3, 17.10.8"""
        shifted = [window >> CELL[OWN][octant].bit_length() - 22 for window in windows]
        there = shifted[0] >> 21 & 1
        own_class = sum(cells >> 21 & 1 for cells in shifted)
        faces = sum((cells & FACE_BITS).bit_count() for cells in shifted)
        wrong = min(2, ((mask ^ own) & (1 << octant) - 1).bit_count())
        errors = (self.state > 2048) + (self.state > 8192)
        context = own_class + self.classes * (faces + self.faces * (wrong + 3 * errors))
        i, r = divmod(min(logit + 720, 1439), 45)
        table, seen = self.table[context], self.seen[context]
        bit = decoder.decide(clamp((table[i] * (45 - r) + table[i + 1] * r) // 45 >> 6, 16, 65520))
        for k in (i, i + 1):
            table[k] += quot(2 * (((1 << 22) - 1) * bit - table[k]), 2 * seen[k] + 3)
            seen[k] = min(seen[k] + 1, 250)
        self.state += (2048 if bit != there else 0) - (self.state >> 5)
        return bit


class Slice:
    """The state of one slice (4.1). `guides`, in predicted frames: mode and windows of each parent (17.6.1,
    17.10.8)."""

    def __init__(self, network, voxels, first, end, code, guides):
        self.network, self.voxels, self.first, self.end = network, voxels, first, end
        self.guides = guides or [(0, [0])] * len(voxels)
        self.refined = Refined(len(self.guides[0][1]))
        self.decoder = ArithmeticDecoder(code)
        self.mixer = Mixer(end - first)
        self.output, self.bias = network.output.copy(), list(network.bias)
        self.masks = []

    def decode(self, count):
        found = 0
        for i in range(self.first, self.end):
            self.masks.append(self.parent(i))
            require(self.decoder.next <= len(self.decoder.code), "4.2.3", "geometry code that ends early")
            found += self.masks[-1].bit_count()
            require(found + self.end - i - 1 <= count, "4.1.3", "children of a slice")
        self.decoder.finish()
        require(found == count, "4.1.3", "children of a slice")
        return self.masks

    def parent(self, i):
        near, network = self.voxels.near[i], self.network
        mode, windows = self.guides[i]
        own = sum(bool(windows[0] & cell) << octant for octant, cell in enumerate(CELL[OWN]))
        if mode == SKIP and own:
            return own
        known, unknown = {}, []
        for k, j in enumerate(near):
            if j != ABSENT and k != 13:
                if self.first <= j < i:
                    known[k] = self.masks[j - self.first]
                else:
                    unknown.append(k)
        total = np.zeros(128, dtype=np.int64)
        occupied, hidden = 0, ALL_CELLS[OWN]
        for k in unknown:
            total += network.presence[k]
            hidden |= ALL_CELLS[k]
        for k, mask in known.items():
            total += network.known[k]
            for octant in range(8):
                if mask >> octant & 1:
                    total += network.child[k][octant]
                    occupied |= CELL[k][octant]
        words = Words(self.voxels, near, known, unknown)
        mask = 0
        for octant in range(8):
            if octant == 7 and mask == 0:
                return 128
            node = 1 << octant | mask
            units = np.maximum(0, total + network.node[node])
            guide = (windows, own, octant, mask) if mode else None
            bit = self.child(octant, units, words, occupied, hidden, node, guide)
            mask |= bit << octant
            hidden &= ~CELL[OWN][octant]
            occupied |= CELL[OWN][octant] * bit
        return mask

    def child(self, octant, units, words, occupied, hidden, node, guide):
        """4.8; with a guide 17.6.3."""
        total = wrap32(self.bias[octant] + int(units @ self.output[octant]))
        logit = limit(total >> 12, 720)
        network = squash(logit)
        mixes = abs(logit) < 384
        if mixes:
            logit = self.mixer.predict(logit, words.contexts(octant, occupied, hidden, node))
        if guide:
            bit = self.refined.decide(self.decoder, logit, *guide)
        else:
            bit = self.decoder.decide(squash(logit))
        if mixes:
            self.mixer.learn(bit, network)
        error = 65536 * bit - network
        if abs(error) >= 4096:
            e = quot(error, 64)
            self.bias[octant] = wrap32(self.bias[octant] + 4 * e)
            grown = self.output[octant] + ((units * e >> 16) + 1 >> 1)
            self.output[octant] = np.clip(grown, -32768, 32767)
        return bit


class Words:
    """4.6.3: what the contexts of a parent's children share."""

    def __init__(self, voxels, near, known, unknown):
        self.sides = []
        self.faces = self.face_occ = self.second = 0
        for f, k in enumerate(FACES):
            there = near[k] != ABSENT
            self.faces |= there << f
            self.sides.append((known.get(k), k in unknown))
            if f < 3:
                self.face_occ |= (256 + known[k] if k in known else int(there)) << 9 * f
            else:
                second = int(voxels.near[near[k]][k] != ABSENT) if there else 2
                self.second |= second << 2 * (f - 3)
        self.presence = sum(1 << k for k, j in enumerate(near) if j != ABSENT and k != 13)

    def contexts(self, octant, occupied, hidden, node):
        """4.6.5"""
        x, y, z = octant_xyz(octant)
        shift = x + 4 * y + 16 * z
        occupied, hidden = occupied >> shift, hidden >> shift
        far = 0
        for f, (mask, is_unknown) in enumerate(self.sides):
            far |= (2 * is_unknown if mask is None else mask >> octant & 1) << 8 * f
        first = (occupied & FACE_BITS) + (octant << 48) + (self.faces << 51)
        near = mix(mix(2, occupied & NEAR_BITS), hidden & NEAR_BITS)
        return [
            mix(mix(1, first), hidden & FACE_BITS),
            near,
            mix(mix(3, near), far),
            mix(4, node + (self.face_occ << 8)),
            mix(5, node + (self.presence << 8) + (self.second << 35)),
        ]


def decode_level(network, voxels, slices, slice_voxels, motion=None):
    """The level below `voxels`, from (children, code) of each slice."""
    guides = motion and motion.occupancies(voxels)
    masks = []
    for number, (count, code) in enumerate(slices):
        first = number * slice_voxels
        end = min(first + slice_voxels, len(voxels))
        masks += Slice(network, voxels, first, end, code, guides).decode(count)
    return voxels.grow(masks)
