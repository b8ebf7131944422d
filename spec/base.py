"""Numbers, checksums and shared tables: clauses 1 and 2.5 of docs/format.md."""

import struct


class Refused(Exception):
    """What clause 15.3 tells a decoder to refuse, and the clause that it breaks."""

    def __init__(self, clause, what):
        super().__init__(f"{what} (clause {clause})")
        self.clause = clause


def require(condition, clause, what):
    """Refuses the stream unless `condition` holds."""
    if not condition:
        raise Refused(clause, what)


def limit(x, most):
    """1.3.2"""
    return -most if x < -most else most if x > most else x


def clamp(x, low, high):
    """1.3.2"""
    return low if x < low else high if x > high else x


def quot(a, b):
    """1.3.2: division that rounds towards 0."""
    return a // b if (a >= 0) == (b > 0) else -(-a // b)


def wrap32(x):
    """1.3.2"""
    return (x + (1 << 31)) % (1 << 32) - (1 << 31)


def ilog2(x):
    """1.3.2"""
    return x.bit_length() - 1


def sgn3(x):
    """1.3.2"""
    return (x > 0) + 2 * (x < 0)


class Reader:
    """Little-endian numbers from bytes (1.4). `clause` says how many bytes there must be."""

    def __init__(self, data, clause, at=0, end=None):
        self.data, self.clause, self.at = data, clause, at
        self.end = len(data) if end is None else end

    def take(self, count):
        require(self.at + count <= self.end, self.clause, f"the bytes end at {self.end}")
        self.at += count
        return self.data[self.at - count : self.at]

    def number(self, form):
        return struct.unpack("<" + form, self.take(struct.calcsize("<" + form)))[0]

    def varint(self):
        """1.4.2"""
        value = 0
        for shift in range(0, 35, 7):
            byte = self.number("B")
            value |= (byte & 127) << shift
            if byte < 128:
                require(value < 1 << 32 and (byte > 0 or shift == 0), "1.4.2", "varint")
                return value
        raise Refused("1.4.2", "varint of more than five bytes")


def crc32c(data):
    """1.5.1"""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


# 2.5: the logistic function and its inverse.
DECAY = 4540188453729421604


POWERS = [1 << 62]  # E and P of 2.5.2 and 5.6.2
for _ in range(720):
    POWERS.append(POWERS[-1] * DECAY >> 62)
_SQUASH = [((1 << 78) + ((1 << 62) + e) // 2) // ((1 << 62) + e) for e in POWERS]


def squash(logit):
    """2.5.2"""
    logit = limit(logit, 720)
    return _SQUASH[logit] if logit >= 0 else 65536 - _SQUASH[-logit]


def _stretch_table():
    table, logit = [], -720
    for i in range(4096):
        while logit < 720 and squash(logit) < 16 * i + 8:
            logit += 1
        table.append(logit)
    return table


STRETCH = _stretch_table()
