"""XXH3-64 with seed 0 and the default secret (clause 1.5.2), after the xxHash specification."""

M32, M64 = (1 << 32) - 1, (1 << 64) - 1
P32 = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
P64 = (0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5)
MX1, MX2 = 0x165667919E3779F9, 0x9FB21C651E98DF25
SECRET = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671fcb79e64eccc0e578825ad07dccff7221"
    "b8084674f743248ee03590e6813a264c3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8"
    "a8fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364eac5ac8334d3ebc3c581a0fffa1363eb"
    "170ddd51b7f0da49d316552629d4689e2b16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)


def _word(data, at):
    return int.from_bytes(data[at : at + 8], "little")


def _half(data, at):
    return int.from_bytes(data[at : at + 4], "little")


def _fold(a, b):
    product = a * b
    return (product & M64) ^ (product >> 64)


def _avalanche(h):
    h = (h ^ h >> 37) * MX1 & M64
    return h ^ h >> 32


def _avalanche64(h):
    h = (h ^ h >> 33) * P64[1] & M64
    h = (h ^ h >> 29) * P64[2] & M64
    return h ^ h >> 32


def _mix16(data, at, secret):
    return _fold(_word(data, at) ^ _word(SECRET, secret), _word(data, at + 8) ^ _word(SECRET, secret + 8))


def _short(data):
    n = len(data)
    if n == 0:
        return _avalanche64(_word(SECRET, 56) ^ _word(SECRET, 64))
    if n <= 3:
        combined = data[n - 1] | n << 8 | data[0] << 16 | data[n >> 1] << 24
        return _avalanche64(combined ^ _half(SECRET, 0) ^ _half(SECRET, 4))
    if n <= 8:
        keyed = _half(data, n - 4) + (_half(data, 0) << 32) ^ _word(SECRET, 8) ^ _word(SECRET, 16)
        turned = [(keyed << n | keyed >> 64 - n) & M64 for n in (49, 24)]
        h = (keyed ^ turned[0] ^ turned[1]) * MX2 & M64
        h = (h ^ (h >> 35) + len(data)) * MX2 & M64
        return h ^ h >> 28
    low = _word(SECRET, 24) ^ _word(SECRET, 32) ^ _word(data, 0)
    high = _word(SECRET, 40) ^ _word(SECRET, 48) ^ _word(data, n - 8)
    return _avalanche(n + int.from_bytes(low.to_bytes(8, "big"), "little") + high + _fold(low, high) & M64)


def _middle(data):
    n = len(data)
    acc = n * P64[0]
    if n <= 128:
        for i in reversed(range((n - 1) // 32 + 1)):
            acc += _mix16(data, 16 * i, 32 * i) + _mix16(data, n - 16 * (i + 1), 32 * i + 16)
        return _avalanche(acc & M64)
    for i in range(8):
        acc += _mix16(data, 16 * i, 16 * i)
    acc = _avalanche(acc & M64)
    for i in range(8, n // 16):
        acc += _mix16(data, 16 * i, 16 * (i - 8) + 3)
    acc += _mix16(data, n - 16, 136 - 17)
    return _avalanche(acc & M64)


def _long(data):
    n = len(data)
    acc = [P32[2], P64[0], P64[1], P64[2], P64[3], P32[1], P64[4], P32[0]]

    def stripe(at, secret):
        for i in range(8):
            value = _word(data, at + 8 * i)
            key = value ^ _word(SECRET, secret + 8 * i)
            acc[i ^ 1] = acc[i ^ 1] + value & M64
            acc[i] = acc[i] + (key & M32) * (key >> 32) & M64

    stripes = (n - 1) // 64
    per_block = (len(SECRET) - 64) // 8
    for s in range(stripes):
        stripe(64 * s, 8 * (s % per_block))
        if s % per_block == per_block - 1:
            for i in range(8):
                key = _word(SECRET, len(SECRET) - 64 + 8 * i)
                acc[i] = (acc[i] ^ acc[i] >> 47 ^ key) * P32[0] & M64
    stripe(n - 64, len(SECRET) - 64 - 7)
    result = n * P64[0] & M64
    for i in range(4):
        result += _fold(acc[2 * i] ^ _word(SECRET, 11 + 16 * i), acc[2 * i + 1] ^ _word(SECRET, 11 + 16 * i + 8))
    return _avalanche(result & M64)


def xxh3_64(data):
    """The hash of bytes."""
    if len(data) <= 16:
        return _short(data)
    return _middle(data) if len(data) <= 240 else _long(data)
