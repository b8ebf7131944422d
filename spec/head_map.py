"""Head maps: clause 7.5 of docs/format.md."""

from base import Refused, clamp
from coefficients import RangeDecoder


def thickness(count):
    """7.5.5: of learned Gaussians and of surfels, in 128ths of a voxel."""
    return count % 128, min(count // 128, 127)


def parse(payload, blocks):
    """Both sizes in 64ths, `how`, and a bit for each block; None if the payload is no head map."""
    if len(payload) < 3 or 0 in payload[:2] or payload[2] > 2 or payload[2] < 2 and len(payload) > 3:
        return None
    mixed, alone, how = payload[:3]
    if how < 2:
        return mixed, alone, how, [how] * blocks
    try:
        decoder = RangeDecoder(payload[3:])
        one, last, bits = [32768] * 4, 0, []
        for _ in range(blocks):
            bit = decoder.decide(clamp(one[last], 64, 65472))
            one[last] += (65536 - one[last]) >> 4 if bit else -(one[last] >> 4)
            last = (2 * last + bit) & 3
            bits.append(bit)
        decoder.finish()
    except Refused:
        return None
    return mixed, alone, how, bits
