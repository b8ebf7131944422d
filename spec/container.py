"""Header and chunks of version 3: clauses 2 and 3 of docs/format.md."""

import math
from collections import namedtuple
from dataclasses import dataclass, field

from base import Reader, crc32c, require

MAGIC = bytes.fromhex("89423250 0D0A1A0A")
GEOMETRY, GEOMETRY_TRUNK, COLOUR_TRUNK, COLOURS, FILTER, HEAD_MAP = 1, 5, 6, 7, 8, 129


@dataclass
class Header:
    """2.2"""

    bits: int
    base: int
    top: int
    points: int
    origin: tuple
    voxel_size: float
    slice_voxels: int
    colour_slice: int
    voxels: list  # of level L, ..., M
    sections: list  # (geometry bytes, colour bytes) of level L, ..., M
    length: int


# 3.1
Chunk = namedtuple("Chunk", "kind level slice count payload")


@dataclass
class Level:
    """The sections of a level: codes of geometry and colours."""

    level: int
    geometry: dict = field(default_factory=dict)  # level -> [(voxels, code)]
    trunk: tuple = None  # (K, payload)
    colours: dict = field(default_factory=dict)  # level -> [payload]
    colour_hash: int = None
    filter: bytes = None
    head_map: Chunk = None


def check_counts(header, clause):
    """2.2.2: voxels and points."""
    low, high = 1, 8**header.base
    for count in header.voxels:
        require(low <= count <= high, clause, "voxel counts")
        low, high = count, 8 * count
    require(low <= header.points <= low * 8 ** (header.bits - header.top), clause, "points")


def parse_header(data, flags=0):
    """2.2; `flags` are the critical ones that are expected."""
    reader = Reader(data, "2.2.1")
    require(reader.take(8) == MAGIC, "2.2.1", "magic")
    major, _ = reader.number("H"), reader.number("H")  # the minor version does not matter
    require(major == 3, "2.2.1", f"major version {major}: this decoder reads 3")
    critical, _ = reader.number("I"), reader.number("I")  # optional flags do not matter
    bits, base, top, reserved = reader.take(4)
    require(base <= top <= 21 and top - base + 1 <= 21, "2.2.2", "levels")
    levels = top - base + 1
    points = reader.number("Q")
    origin = tuple(reader.number("d") for _ in range(3))
    voxel_size = reader.number("d")
    slice_voxels, colour_slice = reader.number("I"), reader.number("I")
    voxels = [reader.number("I") for _ in range(levels)]
    sections = [(reader.number("I"), reader.number("I")) for _ in range(levels)]
    found = crc32c(data[: reader.at])
    require(reader.number("I") == found, "2.2.1", "header checksum")
    require(critical == flags and reserved == 0, "2.2.1", "critical flags and reserved byte")
    require(1 <= bits <= 21 and top <= bits, "2.2.2", "bit depth")
    require(all(map(math.isfinite, (*origin, voxel_size))) and voxel_size > 0, "2.2.3", "placement")
    require(1 <= slice_voxels <= 16384 and 1 <= colour_slice <= 65536, "2.2.1", "slice sizes")
    sizes = (slice_voxels, colour_slice, voxels, sections, reader.at)
    header = Header(bits, base, top, points, origin, voxel_size, *sizes)
    check_counts(header, "2.2.2")
    return header


class Chunks:
    """The chunks of a section, without ancillary ones (3.1)."""

    def __init__(self, data, start, end):
        require(end <= len(data), "2.1.1", "section beyond the end of the stream")
        self.chunks, self.head_maps = [], []
        reader = Reader(data, "2.1.2", start, end)
        while reader.at < end:
            chunk = self.read(reader)
            if chunk.kind < 128:
                self.chunks.append(chunk)
            elif chunk.kind == HEAD_MAP:
                self.head_maps.append(chunk)
        self.chunks.reverse()

    @staticmethod
    def read(reader, kinds=(GEOMETRY, GEOMETRY_TRUNK, COLOUR_TRUNK, COLOURS, FILTER)):
        """The next chunk; `kinds` are the critical ones that are defined here."""
        start = reader.at
        kind, level = reader.number("B"), reader.number("B")
        number, count, length = reader.varint(), reader.varint(), reader.varint()
        head = reader.data[start : reader.at]
        checksum = reader.number("I")
        payload = reader.take(length)
        require(crc32c(head + payload) == checksum, "3.1.1", f"checksum of the chunk at byte {start}")
        require(kind >= 128 or kind in kinds, "3.1.2", f"unknown chunk type {kind}")
        require(number <= 65535, "3.1.1", "slice number")
        return Chunk(kind, level, number, count, payload)

    def take(self, clause, kind, levels, number):
        """The next chunk, which must be this one."""
        require(self.chunks, clause, f"missing chunk of type {kind}")
        chunk = self.chunks.pop()
        fits = (chunk.kind, chunk.slice) == (kind, number) and chunk.level in levels
        require(fits, clause, f"chunk of type {chunk.kind}, level {chunk.level}, slice {chunk.slice}")
        return chunk

    def finish(self, clause):
        require(not self.chunks, clause, "chunk after the last of a section")


def sliced(count, size):
    """Sizes of the slices of `count` voxels."""
    return [min(size, count - at) for at in range(0, count, size)]


def read_level(data, header, level):
    """Takes the sections of a level apart (3.2, 3.3)."""
    index = level - header.base
    start = header.length + sum(map(sum, header.sections[:index]))
    middle = start + header.sections[index][0]
    end = middle + header.sections[index][1]
    above = header.voxels[index - 1] if index > 0 else 1
    counts = {level - 1: above} if index > 0 else {0: 1}
    result = Level(level)
    chunks = Chunks(data, start, middle)
    first = level
    if level == header.base:
        first = 1
        if level > 0:
            first = read_geometry_trunk(chunks, header, counts, result)
    for n in range(first, level + 1):
        result.geometry[n] = []
        for number, parents in enumerate(sliced(counts[n - 1], header.slice_voxels)):
            chunk = chunks.take("3.2.3", GEOMETRY, [n], number)
            require(parents <= chunk.count <= 8 * parents, "3.2.3", "children of a slice")
            result.geometry[n].append((chunk.count, chunk.payload))
        counts[n] = sum(count for count, _ in result.geometry[n])
    chunks.finish("3.2.1")
    require(counts[level] == header.voxels[index], "3.2.4", f"voxels of level {level}")
    require(max(counts.values()) == counts[level], "3.2.4", "voxels of a level before")
    read_colours(Chunks(data, middle, end), header, counts, result)
    return result


def read_geometry_trunk(chunks, header, counts, result):
    """3.2.2; the first level after the trunk."""
    chunk = chunks.take("3.2.1", GEOMETRY_TRUNK, range(1, header.base + 1), 0)
    reader = Reader(chunk.payload, "3.2.2")
    for n in range(1, chunk.level + 1):
        require(counts[n - 1] <= header.slice_voxels, "3.2.2", "parents of a level in the trunk")
        counts[n] = reader.varint()
        require(counts[n - 1] <= counts[n] <= 8 * counts[n - 1], "3.2.2", "voxels of a level in the trunk")
        require(counts[n] <= header.voxels[0], "3.2.4", "voxels of a level in the trunk")
        result.geometry[n] = [(counts[n], reader.take(reader.varint()))]
    require(reader.at == reader.end and chunk.count == counts[chunk.level], "3.2.2", "end of the trunk")
    return chunk.level + 1


def read_colours(chunks, header, counts, result):
    """3.3"""
    level = result.level
    maps = [chunk for chunk in chunks.head_maps if chunk.level == level]
    result.head_map = maps[0] if maps else None

    def payload(chunk):
        if result.colour_hash is not None:
            return chunk.payload
        require(len(chunk.payload) >= 8, "3.3.3", "colour hash")
        result.colour_hash = int.from_bytes(chunk.payload[:8], "little")
        return chunk.payload[8:]

    first = level
    if level == header.base:
        chunk = chunks.take("3.3.1", COLOUR_TRUNK, range(level + 1), 0)
        require(chunk.count == counts[chunk.level], "3.3.1", "voxels of the colour trunk")
        require(chunk.level == 0 or chunk.count <= 65536, "3.3.1", "voxels of the colour trunk")
        result.trunk = (chunk.level, payload(chunk))
        first = chunk.level + 1
    for n in range(first, level + 1):
        result.colours[n] = []
        for number, parents in enumerate(sliced(counts[n - 1], header.colour_slice)):
            chunk = chunks.take("3.3.2", COLOURS, [n], number)
            require(chunk.count == parents, "3.3.2", "parents of a colour slice")
            result.colours[n].append(payload(chunk))
    if chunks.chunks:
        chunk = chunks.take("3.3.4", FILTER, [level], 0)
        require(chunk.count == counts[level], "3.3.4", "voxels of the colour filter")
        result.filter = chunk.payload
    chunks.finish("3.3.4")
