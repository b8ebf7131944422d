"""Scenes of blocks: clause 18 of docs/format.md."""

import struct
from dataclasses import dataclass, replace

import container
import heads
from base import Reader, require
from octree import Voxels
from xxh3 import xxh3_64

CRITICAL_FLAG, INDEX, FRAME_TABLE = 2, 10, 11


@dataclass
class Block:
    """18.2.2: a block in the index. Its cube is the voxel of this level and key."""

    level: int
    key: int
    points: int
    voxels: list  # of level L, ..., M of the scene
    start: int
    end: int
    hash: int

    def header(self, common):
        """18.3.1: what the header of its stream states, slice sizes, placement and sections aside."""
        return replace(
            common,
            bits=common.bits - self.level,
            base=common.base - self.level,
            top=common.top - self.level,
            points=self.points,
            voxels=self.voxels,
        )


def is_scene(data):
    """2.2.1"""
    return len(data) >= 16 and data[8] == 3 and struct.unpack("<I", data[12:16])[0] == CRITICAL_FLAG


def first_key(before, level):
    """18.2.2: the least key of a cube of this level behind the block before."""
    if before is None:
        return 0
    if before.level <= level:
        return before.key + 1 << 3 * (level - before.level)
    return (before.key >> 3 * (before.level - level)) + 1


def read_block(reader, before, header):
    """18.2.2"""
    level = reader.number("B")
    require(level <= min(header.base, header.bits - 1, 10), "18.2.2", "level of a block")
    key = first_key(before, level) + reader.varint()
    require(key < 8**level, "18.2.2", "key of a block")
    points = reader.varint()
    voxels = [reader.varint() for _ in header.voxels]
    length, found = reader.varint(), reader.number("Q")
    start = before.end if before else 0
    block = Block(level, key, points, voxels, start, start + length, found)
    container.check_counts(block.header(header), "18.2.3")
    return block


def read_index(data, header):
    """18.2: the blocks; their places count from the end of the index."""
    reader = Reader(data, "18.1.1", header.length)
    chunk = None
    while chunk is None or chunk.kind >= 128:
        chunk = container.Chunks.read(reader, (INDEX, FRAME_TABLE))
    fits = (chunk.kind, chunk.level, chunk.slice) == (INDEX, 0, 0)
    require(fits and chunk.count > 0, "18.2.1", "index of the scene")
    payload = Reader(chunk.payload, "18.2.2")
    require(payload.number("B") == 1, "18.2.2", "units of the index")
    blocks = [None]
    for _ in range(chunk.count):
        blocks.append(read_block(payload, blocks[-1], header))
    require(payload.at == payload.end, "18.2.2", "bytes after the last block of the index")
    return blocks[1:], reader.at


class Scene:
    """Decodes a scene level by level. `stream` makes a decoder of a block's stream."""

    def __init__(self, data, stream):
        self.header = container.parse_header(data, CRITICAL_FLAG)
        require(not any(map(any, self.header.sections)), "18.1.2", "lengths of sections")
        self.blocks, at = read_index(data, self.header)
        require(sum(block.points for block in self.blocks) == self.header.points, "18.1.2", "points of all blocks")
        sums = [sum(counts) for counts in zip(*(block.voxels for block in self.blocks))]
        require(sums == self.header.voxels, "18.1.2", "voxels of all blocks")
        self.streams = []
        for block in self.blocks:
            part = data[at + block.start : at + block.end]
            require(len(part) == block.end - block.start, "18.2.4", "block beyond the end of the scene")
            require(xxh3_64(part) == block.hash, "18.2.4", "hash of a block")
            self.streams.append(stream(part))
            self.check_header(block, self.streams[-1].header)
        require(len(data) == at + self.blocks[-1].end, "18.1.1", "bytes after the last block")

    def check_header(self, block, found):
        """18.3.1"""
        stated = [(h.bits, h.base, h.top, h.points, h.voxels) for h in (found, block.header(self.header))]
        require(stated[0] == stated[1], "18.3.1", "header of a block")

    def decode(self, level):
        """18.3.2, 18.4: the next level."""
        keys, coordinates, colours, before, parts = [], [], [], [], []
        for block, stream in zip(self.blocks, self.streams):
            below = level - block.level
            own = stream.decode(below)
            corner = [sum((block.key >> 3 * i + axis & 1) << i for i in range(block.level)) for axis in range(3)]
            (part,) = own.parts
            parts.append(replace(part, rows=range(len(keys), len(keys) + len(own.voxels))))
            keys += [(block.key << 3 * below) + key for key in own.voxels.keys]
            coordinates += [tuple((c << below) + x for c, x in zip(corner, at)) for at in own.voxels.coordinates]
            colours += own.colours
            before += own.before
        return heads.Level(Voxels(level, keys, coordinates), self.header.bits, colours, before, None, parts)
