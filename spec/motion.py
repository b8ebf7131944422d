"""What a frame is predicted from: motion, the moved and the warped frame, clauses 17.5 to 17.10 of docs/format.md."""

from dataclasses import dataclass
from itertools import groupby, product
from math import prod
from operator import add

from base import Reader, clamp, ilog2, quot, require
from coefficients import RangeDecoder
from octree import CELLS, Voxels, octant_xyz

INTRA, INTER, SKIP = 0, 1, 2
CORNERS_BELOW = [octant_xyz(o) for o in range(8)]
# 17.9.4: steps to the blocks around one, those at faces first, then those at edges, then those at corners.
AROUND = sorted(product((-1, 0, 1), repeat=3), key=lambda step: sum(map(abs, step)))[1:]
# 17.9.5: the axes of steps to the blocks nearby a part.
NEARBY = [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)]


def half_up(a, b):
    """1.3.5"""
    return (2 * a + b) // (2 * b)


def corner_weights(part, whole):
    """17.7.2, 17.10.4, 17.10.5: for each d in {0, 1}³ the product over axes of part where d is 1, else whole − part."""
    for d in CORNERS_BELOW:
        yield d, prod(p if c else whole - p for c, p in zip(d, part))


def mean_of_corners(corner, above):
    """17.10.3: the prediction of a corner by the corners of the level above."""
    found = [above[place] for place in product(*({x >> 1, x + 1 >> 1} for x in corner))]
    n = len(found)
    return tuple(sum(components) + (n >> 1) >> ilog2(n) for components in zip(*found))


@dataclass
class Known:
    """A level of a frame that was decoded: its voxels, and their colours before the filter. 17.10.6: of the warped
    frame all near cells, and which of them are voxels."""

    voxels: Voxels
    values: list
    inner: set = None

    def layers(self):
        """17.6.1, 17.10.8: the places of which windows are made: of voxels, in the warped frame then of near cells."""
        return [self.voxels.places] if self.inner is None else [self.inner, self.voxels.places]

    def colour(self, place):
        """The colour at a place, None if it was not occupied."""
        i = self.voxels.places.get(place)
        return None if i is None else self.values[i]


def surface_step(place, voxels):
    """17.10.9: how far the surface near a voxel is from it, in sixteenths of a voxel."""
    steps = [d for d in product((-1, 0, 1), repeat=3) if tuple(map(add, place, d)) in voxels]
    n, m = len(steps), [sum(d[a] for d in steps) for a in range(3)]
    s = [[n * sum(d[a] * d[b] for d in steps) - m[a] * m[b] for b in range(3)] for a in range(3)]

    def minor(a, b):
        (a, c), (b, d) = [((i + 1) % 3, (i + 2) % 3) for i in (a, b)]
        return s[a][b] * s[c][d] - s[a][d] * s[c][b]

    t = sum(minor(a, a) for a in range(3))
    if t == 0:
        return 0, 0, 0
    return tuple((32 * sum(minor(a, b) * m[b] for b in range(3)) + n * t) // (2 * n * t) for a in range(3))


class Bits:
    """17.5.2, 17.9.3: adaptive decisions. The names of the states are those of the document."""

    def __init__(self, counted):
        self.states, self.counted = {}, counted

    def decide(self, decoder, *name):
        p, n = self.states.get(name, (32768, 0))
        bit = decoder.decide(clamp(p, 256, 65280))
        if self.counted:
            p += quot(2 * ((65535 if bit else 0) - p), 2 * n + 3)
        else:
            p = p + (65535 - p >> 4) if bit else p - (p >> 4)
        self.states[name] = p, min(n + 1, 30)
        return bit

    def one_of(self, decoder, kind, vectors):
        """17.9.4, 17.9.5: one of the first six of several vectors, None if it is none of them."""
        return next((v for i, v in enumerate(vectors[:6]) if self.decide(decoder, kind, i)), None)

    def difference(self, decoder, kind=""):
        """17.5.3: a difference of vectors."""
        return [self.component(decoder, kind, axis) for axis in range(3)]

    def component(self, decoder, kind, axis):
        if not self.decide(decoder, kind + "some", axis):
            return 0
        negative, m = self.decide(decoder, kind + "sign", axis), 1
        while m < 15 and self.decide(decoder, kind + "more", axis, m - 1):
            m += 1
        if m == 15:
            n, e = 0, 1
            while decoder.decide(32768):
                n += 1
                require(n <= 16, "17.5.3", "difference of vectors")
            for _ in range(n):
                e = 2 * e + decoder.decide(32768)
            m += e - 1
        return -m if negative else m


class Motion:
    """The motion of a predicted frame. `payloads` are those of the levels L to M, `previous` the Known levels of the
    frame before."""

    def __init__(self, payloads, header, previous):
        reader = Reader(payloads[0], "17.5.1")
        first, self.unit, self.reference, modes = reader.take(4)
        self.block_level, self.warped, self.moves_coarse = first & 31, first >> 5 & 1, first >> 6 & 1
        self.divided, self.smooth = first > 127 and not self.warped, first > 127 and self.warped
        self.vector = tuple(reader.number("h") for _ in range(3))
        require(self.divided or not self.moves_coarse, "17.5.1", "coarse colours that move")
        deepest = header.base - self.divided - self.moves_coarse
        require(self.block_level <= deepest and header.top <= self.unit <= 21, "17.5.1", "levels of the motion")
        furthest = header.top if self.warped else min(header.top, self.block_level + 5)
        nearest = header.top if self.warped else self.block_level + 2 * self.moves_coarse
        require(nearest <= self.reference <= furthest, "17.5.1", "reference level")
        self.above = (modes & 15, modes >> 4)
        require(max(self.above) <= SKIP, "17.5.1", "modes of the motion")
        require(not (self.warped and any(self.vector)), "17.5.1", "vector of a warped frame")
        self.check(self.vector)
        self.base, self.payloads, self.previous = header.base, payloads, previous
        self.bits, self.modes, self.coarse = Bits(self.divided or self.warped), {}, {}
        if self.warped:
            self.moved = self.warp(*self.read_lattice(reader, header.top), header.top)
        self.decoder = RangeDecoder(payloads[0][reader.at :])

    def check(self, vector):
        """17.5.3"""
        least, most = max(-(1 << self.unit), -32768), min(1 << self.unit, 32767)
        require(all(least <= x <= most for x in vector), "17.5.3", "vector out of range")

    def reach(self, voxels):
        """17.5.1: decodes the motion of level L once its blocks are known, the voxels of level B, and their parts."""
        if voxels.level == self.block_level:
            self.blocks, self.above_blocks = voxels, [(3, 3)] * len(voxels)
            if self.warped:
                self.vectors = [(0, 0, 0)] * len(voxels)
            else:
                self.read_vectors()
            last = min(self.base, self.block_level + 1) if self.divided else self.base
            for level in range(self.block_level + 1, last + 1):
                self.read_modes(level, self.decoder)
            if last == self.base:
                self.decoder.finish()
            reference = min(self.reference, self.block_level + 3) if self.divided else self.reference
            if not self.warped:
                self.moved = self.move(self.blocks, self.vectors, reference)
        elif self.divided and voxels.level == self.block_level + 1:
            self.parts = voxels
            if self.block_level + 2 <= self.base:
                for level in range(self.block_level + 2, self.base + 1):
                    self.read_modes(level, self.decoder)
                self.decoder.finish()

    def read_finer(self, level):
        """17.5.1: the motion of a level below L."""
        decoder = RangeDecoder(self.payloads[level - self.base])
        self.read_modes(level, decoder)
        decoder.finish()

    def read_vectors(self):
        """17.5.3, 17.9.4"""
        self.vectors, changed = [], 0
        for i, near in enumerate(self.blocks.near):
            around = [self.vectors[near[k]] for k in (12, 10, 4) if near[k] >= 0]
            sure = (2 if len(set(around)) == 1 else 1) if around else 0
            if len(around) == 3:
                vector = tuple(sorted(components)[1] for components in zip(*around))
            elif around:
                vector = around[0]
            else:
                vector = self.vectors[-1] if i > 0 else self.vector
            changed = self.bits.decide(self.decoder, "differs", changed, sure)
            if changed:
                around = self.around(near, vector) if self.divided else []
                same = self.bits.one_of(self.decoder, "alike", around)
                vector = same or tuple(a + b for a, b in zip(vector, self.bits.difference(self.decoder)))
            self.check(vector)
            self.vectors.append(vector)

    def around(self, near, predicted):
        """17.9.4: vectors of the blocks around one that come before it."""
        found = []
        for x, y, z in AROUND:
            k = near[13 + x + 3 * y + 9 * z]
            if 0 <= k < len(self.vectors) and self.vectors[k] not in [predicted, *found]:
                found.append(self.vectors[k])
        return found

    def read_part_vectors(self, decoder):
        """17.9.5"""
        blocks = [self.blocks.places[tuple(c >> 1 for c in place)] for place in self.parts.coordinates]
        self.part_vectors, several = [], 0
        for block, parts in groupby(range(len(blocks)), key=lambda part: blocks[part]):
            parts, common = list(parts), self.vectors[block]
            several = self.bits.decide(decoder, "several", min(len(parts), 4), several)
            other, own = None, []
            for part in parts:
                vector = common
                if several:
                    other = self.bits.decide(decoder, "other", other)
                if several and other:
                    nearby = self.nearby(block, self.parts.coordinates[part], own)
                    vector = self.bits.one_of(decoder, "same", nearby)
                    if vector is None:
                        vector = tuple(a + b for a, b in zip(common, self.bits.difference(decoder, "part ")))
                self.check(vector)
                own.append(vector)
            self.part_vectors += own
        moved = self.move(self.parts, self.part_vectors, self.reference, self.moves_coarse)
        self.moved.update((level, known) for level, known in moved.items() if level > self.parts.level)
        if self.moves_coarse:
            self.coarse = moved

    def nearby(self, block, place, before):
        """17.9.5: vectors that a part may have: of parts before it, and of the blocks at its side."""
        found, at = [], self.blocks.coordinates[block]
        touching = [[a + (2 * (p & 1) - 1) * (i in axes) for i, (a, p) in enumerate(zip(at, place))] for axes in NEARBY]
        numbers = [self.blocks.places.get(tuple(place)) for place in touching]
        for vector in before[::-1] + [self.vectors[number] for number in numbers if number is not None]:
            if vector not in [self.vectors[block], *found]:
                found.append(vector)
        return found

    def read_modes(self, level, decoder):
        """17.5.4, 17.9.6"""
        if self.divided and level == self.block_level + 2:
            self.read_part_vectors(decoder)
            blocks = [self.blocks.places[tuple(c >> 1 for c in place)] for place in self.parts.coordinates]
            all_above = [self.modes[level - 1][block] for block in blocks]
        else:
            all_above = self.modes.get(level - 1, self.above_blocks)
        modes, before = [], (0, 0)
        for above in all_above:
            own = []
            for kind in (0, 1):
                index = above[kind]
                if self.bits.counted and kind == 0 and index < 3:
                    index += 4 * above[1]
                elif self.bits.counted and kind == 1:
                    index += 4 * own[0]
                name = kind, index, before[kind]
                if not self.bits.decide(decoder, "any", *name):
                    own.append(INTRA)
                else:
                    own.append(SKIP if self.bits.decide(decoder, "skip", *name) else INTER)
            before = tuple(own)
            modes.append(before)
        self.modes[level] = modes

    def rounded(self, vector, level):
        """17.5.5"""
        shift = self.unit - level
        return tuple(v + (1 << shift >> 1) >> shift for v in vector)

    def move(self, blocks, vectors, reference, coarse=False):
        """17.8: the moved frame's levels, R and those above it. 17.9.8: if `coarse`, all of them, each of means of level
        R."""
        if reference <= blocks.level + 1:
            return {}
        source, down = self.previous[reference], reference - blocks.level
        most, found = 2 * len(source.voxels) + 64, {}
        for vector in set(vectors):
            d = self.rounded(vector, reference)
            for (x, y, z), value in zip(source.voxels.coordinates, source.values):
                place = (x + d[0], y + d[1], z + d[2])
                block = blocks.places.get(tuple(c >> down for c in place))
                if block is not None and vectors[block] == vector:
                    found[place] = value
                    require(len(found) <= most, "17.8.2", "voxels of the moved frame")
        moved, sums = {}, {place: (value, 1) for place, value in found.items()}
        for level in range(reference, 0 if coarse else blocks.level, -1):
            means = [[half_up(v, n) for v in value] for value, n in sums.values()]
            moved[level] = Known(Voxels(level, None, list(sums)), means)
            children = {}
            for (place, (value, n)), mean in zip(sums.items(), means):
                children.setdefault(tuple(c >> 1 for c in place), []).append((value, n) if coarse else (mean, 1))
            sums = {
                place: ([sum(v) for v in zip(*(value for value, _ in counted))], sum(n for _, n in counted))
                for place, counted in children.items()
            }
        return moved

    def read_lattice(self, reader, top):
        """17.10.1: the level of the lattice, the vectors of its corners, and T."""
        reader.clause = "17.10.1"
        lattice, least = reader.take(2)
        length = reader.varint()
        require(max(top - 8, 0) <= lattice <= top - 2, "17.10.1", "level of the lattice")
        require(least >= 40, "17.10.1", "least weight of a voxel")
        decoder, vectors = RangeDecoder(reader.take(length)), {}
        for level in range(lattice + 1):
            vectors = self.read_corners(level, min(lattice - level, 2), vectors, decoder)
        decoder.finish()
        return lattice, vectors, least

    def read_corners(self, level, j, above, decoder):
        """17.10.2, 17.10.3: the vectors of the corners of a level by their places, from those of the level above."""
        nodes = self.previous[level].voxels.coordinates
        corners = {tuple(a + b for a, b in zip(place, d)) for place in nodes for d in CORNERS_BELOW}
        vectors, bent, vector = {}, set(), (0, 0, 0)
        for x, y, z in sorted(corners, key=lambda corner: corner[::-1]):
            predicted = mean_of_corners((x, y, z), above) if level > 0 else vector
            near = sum(less in bent for less in ((x - 1, y, z), (x, y - 1, z), (x, y, z - 1)))
            vector = predicted
            if self.bits.decide(decoder, "bends", j, min(near, 2)):
                difference = self.bits.difference(decoder, f"corner {j} ")
                vector = tuple(a + b for a, b in zip(predicted, difference))
            self.check(vector)
            if vector != predicted:
                bent.add((x, y, z))
            vectors[x, y, z] = vector
        return vectors

    def warped_place(self, place, level, down, vectors, h):
        """17.10.4, 17.10.9: where a voxel moves to, in sixteenths of a voxel."""
        node = [x >> down for x in place]
        o, sums = [2 * (x - (c << down)) + 1 for x, c in zip(place, node)], [0, 0, 0]
        for d, w in corner_weights(o, 2 << down):
            vector = vectors[tuple(a + b for a, b in zip(node, d))]
            sums = [s + w * v for s, v in zip(sums, vector)]
        moved = [16 * x + (16 * s + (1 << h - 1) >> h) for x, s in zip(place, sums)]
        if not self.smooth or all(x & 15 == 0 for x in moved):
            return moved
        return [x + step for x, step in zip(moved, surface_step(place, self.previous[level].voxels.places))]

    def warp(self, lattice, vectors, least, top):
        """17.10.4 to 17.10.6: the levels of the warped frame."""
        source, down, cells = self.previous[top], top - lattice, {}
        h = 3 * (down + 1) + self.unit - top
        for place, value in zip(source.voxels.coordinates, source.values):
            at = self.warped_place(place, top, down, vectors, h)
            for d, w in corner_weights([x & 15 for x in at], 16):
                cell = tuple((x >> 4) + c for x, c in zip(at, d))
                if w > 0 and all(0 <= c < 1 << top for c in cell):
                    weight, *sums = cells.get(cell, (0, 0, 0, 0))
                    cells[cell] = weight + w, *(s + w * v for s, v in zip(sums, value))
        near = {cell: counted for cell, counted in cells.items() if counted[0] >= 640}
        require(len(near) <= 4 * len(source.voxels) + 64, "17.10.5", "near cells of the warped frame")
        inner = {cell for cell, counted in near.items() if counted[0] >= 16 * least}
        moved = {}
        for level in range(top, 0, -1):
            means = [[half_up(s, weight) for s in sums] for weight, *sums in near.values()]
            moved[level] = Known(Voxels(level, None, list(near)), means, inner)
            children = {}
            for cell, counted in near.items():
                children.setdefault(tuple(c >> 1 for c in cell), []).append(counted)
            near = {cell: tuple(map(sum, zip(*counted))) for cell, counted in children.items()}
            inner = {tuple(c >> 1 for c in cell) for cell in inner}
        return moved

    def of(self, nodes):
        """17.5.5, 17.5.6, 17.10.7: for each node the modes and the vector that hold for its children; and what they
        are predicted from."""
        level = nodes.level + 1
        if level > self.base and level not in self.modes:
            self.read_finer(level)
        moved = self.warped or self.block_level < level < self.reference
        source = (self.moved if moved else self.previous)[level]
        if level <= self.block_level:
            return [(self.above, self.vector)] * len(nodes), source
        of_parts = self.divided and level > self.block_level + 1
        own, vectors = (self.parts, self.part_vectors) if of_parts else (self.blocks, self.vectors)
        at = [tuple(c >> level - 1 - own.level for c in place) for place in nodes.coordinates]
        blocks = [own.places[place] for place in at]
        return [(self.modes[level][b], (0, 0, 0) if moved else vectors[b]) for b in blocks], source

    def occupancies(self, nodes):
        """17.6.1, 17.10.8: mode and windows of each node."""
        guides, (own, source) = [], self.of(nodes)
        layers = source.layers()
        for (modes, vector), place in zip(own, nodes.coordinates):
            corner = [2 * c - v for c, v in zip(place, self.rounded(vector, nodes.level + 1))]
            cells = [tuple(a + b for a, b in zip(corner, cell)) for cell in CELLS] if modes[0] else []
            windows = [sum((cell in layer) << bit for bit, cell in enumerate(cells)) for layer in layers]
            guides.append((modes[0], windows))
        return guides

    def colours(self, nodes, children, known):
        """17.7, 17.9.8: mode of each node, and colours of its children. The voxels of level `known` are decoded before
        these colours."""
        guides, (own, source) = [], self.of(nodes)
        if self.moves_coarse and children.level <= self.block_level + 1 <= known:
            own, source = [(modes, (0, 0, 0)) for modes, _ in own], self.coarse[children.level]
        for (modes, vector), first, mask in zip(own, nodes.first, nodes.masks):
            colour = {INTRA: lambda *_: None, INTER: self.between, SKIP: self.was}[modes[1]]
            places = children.coordinates[first : first + mask.bit_count()]
            guides.append((modes[1], [colour(place, vector, source) for place in places]))
        return guides

    def was(self, place, vector, source):
        """17.7.1"""
        d = self.rounded(vector, source.voxels.level)
        return source.colour(tuple(a - b for a, b in zip(place, d)))

    def between(self, place, vector, source):
        """17.7.2"""
        shift = self.unit - source.voxels.level
        low, part = [v >> shift for v in vector], [(v << 4) >> shift & 15 for v in vector]
        sums, total = [0, 0, 0], 0
        for corner, weight in corner_weights(part, 16):
            value = source.colour(tuple(x - v - c for x, v, c in zip(place, low, corner))) if weight else None
            if value is not None:
                sums = [s + weight * x for s, x in zip(sums, value)]
                total += weight
        return [half_up(s, total) for s in sums] if total else None
