"""Range decoder and probability model of colour coefficients: clauses 5.4 and 5.8 of docs/format.md."""

from base import STRETCH, clamp, limit, quot, require, squash, wrap32

M64 = (1 << 64) - 1


class RangeDecoder:
    """5.4"""

    def __init__(self, payload):
        require(len(payload) % 4 == 0, "5.4.3", "bytes of a range coder")
        self.words = [int.from_bytes(payload[i : i + 4], "little") for i in range(0, len(payload), 4)]
        self.read = 0
        self.lower, self.range = 0, M64
        self.point = self.word() << 32
        self.point |= self.word()

    def word(self):
        self.read += 1
        return self.words[self.read - 1] if self.read <= len(self.words) else 0

    def decide(self, one):
        scale = self.range >> 16
        quantile = (self.point - self.lower & M64) // scale
        require(quantile < 65536, "5.4.2", "quantile")
        bit = int(quantile >= 65536 - one)
        start, size = (65536 - one, one) if bit else (0, 65536 - one)
        self.lower = self.lower + scale * start & M64
        self.range = scale * size
        if self.range < 1 << 32:
            self.lower = self.lower << 32 & M64
            self.range <<= 32
            self.point = (self.point << 32 & M64) + self.word()
        return bit

    def finish(self):
        require(len(self.words) <= self.read <= len(self.words) + 2, "5.4.3", "words of a range coder")


SIZES = (588, 81, 168, 784, 48, 896, 1152, 324)
SIGN_SIZES = (108, 63, 81, 81)
HALF = (1 << 21, 0)
RATE = [327680 // (5 * c + 8) for c in range(121)]
TRUST = [256 * (10 * c + 2) // (10 * c + 17) for c in range(121)]


def slot_input(slot):
    """5.8.2"""
    p, c = slot
    return STRETCH[p >> 10] * TRUST[c] >> 8


def slot_adapted(slot, bit):
    """5.8.2"""
    p, c = slot
    p += ((1 << 22) - 1 - p) * RATE[c] >> 16 if bit else -(p * RATE[c] >> 16)
    return p, min(c + 1, 120)


def mixed(total):
    """5.8.5, 5.8.7: the probability of a sum of weighted inputs."""
    return clamp(squash(wrap32(total) >> 16), 4, 65532)


class Model:
    """5.8.1"""

    def __init__(self):
        weights = [6554] * 9 + [0]
        self.slots = [[HALF] * (21 * size) for size in SIZES]
        self.signs = [[HALF] * (3 * size) for size in SIGN_SIZES]
        self.by_kind = [list(weights) for _ in range(21)]
        self.by_unit = [list(weights) for _ in range(21 * 12)]
        self.by_others = [list(weights) for _ in range(21 * 12)]
        self.sign_weights = [[24000] * 4 for _ in range(3)]
        self.unit_weights = [[0] * 12 for _ in range(3)]
        self.learned = [0, 0, 0]
        self.cross = [(0, 0), (0, 0)]  # product, square of Co and Cg

    def copy(self):
        other = Model.__new__(Model)
        for name in ("slots", "signs", "by_kind", "by_unit", "by_others", "sign_weights", "unit_weights"):
            setattr(other, name, [list(row) for row in getattr(self, name)])
        other.learned, other.cross = list(self.learned), list(self.cross)
        return other

    def coefficient(self, decoder, c):
        """5.8.3; `c` are the circumstances of 5.7.4."""
        total = sum(w * x for w, x in zip(self.unit_weights[c.t], c.features))
        unit = limit(wrap32(total) >> 16, 640)
        m = 0
        while m < 18:
            bit = self.magnitude(decoder, c, unit, min(m, 6))
            if m == 0:
                self.adapt_unit(c, unit, bit)
            if not bit:
                break
            m += 1
        if m == 0:
            return 0
        if m == 18:
            m += escape(decoder)
        return -m if self.sign(decoder, c) else m

    def magnitude(self, decoder, c, unit, bin):
        """5.8.5"""
        kind = 7 * c.t + bin
        both = 2 * (c.lum > 0) + (c.oth > 0)
        fine = (unit + 640) * 48 // 1281
        places = (
            ((c.ht * 3 + c.axis) * 7 + c.kids - 2) * 7 + c.nmag,
            classed(c.gr, 8, 9) * 9 + classed(c.pr, 8, 9),
            (classed(c.pr, 5, 14) * 3 + c.axis) * 4 + c.heavy,
            ((classed(c.en, 8, 7) * 7 + classed(c.gr, 10, 7)) * 4 + c.lum) * 4 + c.oth,
            fine,
            ((c.lum * 4 + c.oth) * 8 + classed(c.bl, 8, 8)) * 7 + c.nmag,
            ((fine // 2 * 3 + c.axis) * 4 + min(c.kids - 2, 3)) * 4 + both,
            (classed(c.pa, 8, 9) * 9 + classed(c.ac, 8, 9)) * 4 + both,
        )
        at = [kind * size + place for size, place in zip(SIZES, places)]
        inputs = [slot_input(slots[i]) for slots, i in zip(self.slots, at)] + [quot(unit, 2), 64]
        by_unit, by_others = self.by_unit[kind * 12 + fine // 4], self.by_others[kind * 12 + c.axis * 4 + both]
        sets = (self.by_kind[kind], by_unit, by_others)
        one = mixed(sum((u + v + w) * x for u, v, w, x in zip(*sets, inputs)))
        bit = decoder.decide(one)
        error = 65536 * bit - one
        for slots, i in zip(self.slots, at):
            slots[i] = slot_adapted(slots[i], bit)
        steps = [error * x * 7 + 32768 >> 16 for x in inputs]
        for weights in sets:
            weights[:] = [limit(w + step, 65536) for w, step in zip(weights, steps)]
        return bit

    def adapt_unit(self, c, unit, bit):
        """5.8.6"""
        error = 65536 * bit - squash(unit)
        self.learned[c.t] = min(self.learned[c.t] + 1, 4096)
        rate = 4 + (64 >> min(self.learned[c.t] >> 6, 12))
        weights = self.unit_weights[c.t]
        weights[:] = [limit(w + ((error >> 4) * x * rate >> 8), 1 << 20) for w, x in zip(weights, c.features)]

    def sign(self, decoder, c):
        """5.8.7"""
        near = (c.ht * 9 + c.psign) * 3 + c.axis
        places = (near, c.others * 7 + c.slot, c.nsign * 3 + c.axis, c.shift * 9 + c.psign)
        at = [c.t * size + place for size, place in zip(SIGN_SIZES, places)]
        inputs = [slot_input(slots[i]) for slots, i in zip(self.signs, at)]
        weights = self.sign_weights[c.t]
        one = mixed(sum(w * x for w, x in zip(weights, inputs)))
        bit = decoder.decide(one)
        error = 65536 * bit - one
        weights[:] = [limit(w + (error * x * 10 + 32768 >> 16), 65536) for w, x in zip(weights, inputs)]
        for slots, i in zip(self.signs, at):
            slots[i] = slot_adapted(slots[i], bit)
        return bit


def classed(x, width, classes):
    """5.8.5: `class`."""
    return min(x // width, classes - 1)


def escape(decoder):
    """5.8.8"""
    n = 0
    while n < 20 and decoder.decide(32768):
        n += 1
    x = 1
    for _ in range(n):
        x = 2 * x + decoder.decide(32768)
    return x - 1
